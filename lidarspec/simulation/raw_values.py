"""Write raw values into the frames of a table, and into the parts of frames."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import SpecError
from lidarspec.frames.frame_table import CompiledTable, LayoutRows
from lidarspec.simulation.frame_maker import complete_structs
from lidarspec.spec.tree import FieldInfo

Floats = NDArray[np.float64]


def round_raw(info: FieldInfo, raw: Floats) -> Floats:
    """Return raw values, rounded if the field is an integer."""
    if info.kind == "int":
        return np.rint(raw)
    return raw


class PartRows(CompiledTable):
    """The parts of frames, as a table; `put_back` writes them into the frames."""

    def __init__(self, frames: CompiledTable, path: str) -> None:
        parts = frames.schema.split_part_path(path)
        if parts is None or parts[2]:
            raise SpecError("the frame has no parts with this path", path=path)
        self.place = parts[:2]
        self.frames = frames
        own, self.which = frames.parts(*self.place)
        super().__init__(
            own.schema,
            [LayoutRows(group.layout, group.where, group.rows.copy()) for group in own.groups],
        )

    def put_back(self) -> None:
        """Write the parts with their checksums into the frames."""
        left = iter(complete_structs(self))
        axis, kind = self.place
        destinations = list[tuple[int, int, NDArray[np.uint8]]]()
        for group, buffer, walked in self.frames.find_parts(axis):
            kinds = [kind.node.name for kind in group.layout.regions[axis].kinds]
            for piece in (
                piece for pieces in walked.rounds for piece in pieces if kinds[piece.kind] == kind
            ):
                destinations += [
                    (int(group.where[owner]), int(offset), buffer)
                    for owner, offset in zip(piece.owners, piece.offsets, strict=True)
                ]
        for _, offset, buffer in sorted(destinations, key=lambda found: found[:2]):
            part = next(left)
            buffer[offset : offset + len(part)] = np.frombuffer(part, np.uint8)


def write_raw(table: CompiledTable, path: str, values: NDArray[Any]) -> None:
    """Write raw values into every frame that has the field.

    Args:
        values: the values, (n, ...), or one value for all frames.
    """
    for group in table.groups:
        leaf = group.layout.leaves.get(path)
        if leaf is None:
            continue
        own = values if values.ndim == 0 else values[group.where]
        if own.ndim:
            own = own.reshape(own.shape[: 1 + len(leaf.shape)])[
                (slice(None), *(slice(0, length) for length in leaf.shape))
            ]
        leaf.store(group.rows, own)
