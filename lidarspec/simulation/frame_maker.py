"""Frames made of physical values by path: everything else is 0, constants and checksums are in place.

This is `build` for many frames at once, and without asking for every field: what a sensor sends is declared by the values that
matter (a `sweep`, an answer to a command), and counts and options in the header decide the layout as they do for a decoder.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import SpecError
from lidarspec.framing.frame_engine import CompiledCodec, codec
from lidarspec.spec.description import Spec
from lidarspec.wire.frame_table import Group, Rows
from lidarspec.wire.layout import Layout, Leaf
from lidarspec.wire.layout_tree import TooLong, Unknown, layout_of

Values = Mapping[str, Any]


class FrameMaker:
    """Makes frames of one type of a sensor; layouts are kept from one call to the next.

    Raises:
        SpecError: where the frame type is not compiled.
    """

    def __init__(self, sensor: Spec, frame: str) -> None:
        engine = codec(sensor.frames[frame])
        if not isinstance(engine, CompiledCodec):
            raise SpecError(f"cannot be simulated, since it is not compiled: {engine.reason}", path=frame, sensor=sensor.id)
        self.sensor, self.engine = sensor, engine
        self._layouts: dict[tuple[int, ...], Layout] = {}
        self._asked: list[str] = []
        others = sensor.data_frames if sensor.frames[frame].data else ()
        self._elsewhere = {path for other in others for path in codec(sensor.frames[other]).schema.fields}

    def table(self, frames: Sequence[Values]) -> Rows:
        """One frame for each mapping of field paths to physical values; arrays may be given as bytes, too.

        Raises:
            SpecError: where a value is given to a field that the frame does not have.
        """
        members: dict[int, tuple[Layout, list[int]]] = {}
        for index, values in enumerate(frames):
            layout = self._layout(values)
            members.setdefault(id(layout), (layout, []))[1].append(index)
        groups = [
            Group(layout, np.array(which, np.intp), self._rows(layout, [frames[i] for i in which])) for layout, which in members.values()
        ]
        return Rows(self.engine.schema, groups)

    def frame(self, values: Values) -> bytes:
        """One frame, sealed."""
        return sealed(self.table([values]))[0]

    def _layout(self, values: Values) -> Layout:
        """The layout that these values of header fields ask for."""
        frame = self.engine.frame
        while True:
            header = {path: self._raw(values, path) for path in self._asked}
            key = tuple(header.values())
            try:
                if key not in self._layouts:
                    self._layouts[key] = layout_of(frame.tree, header, frame.max_length)
                return self._layouts[key]
            except Unknown as unknown:
                self._asked.append(unknown.leaf.info.path)
                self._layouts.clear()
            except TooLong as error:
                raise self._too_long(values, str(error)) from None

    def _too_long(self, values: Values, path: str) -> SpecError:
        fields, most = self.engine.schema.fields, self.engine.frame.max_length
        left_out = [path for path in self._asked if path not in values and fields[path].const is None]
        given = ", ".join(f"{path} = {values[path]}" for path in self._asked if path in values)
        reason = f"with {given} there is no frame of at most {most} bytes (max_length)"
        if left_out:
            reason = f"sweep has to give {left_out[0]!r}, which the length of the frame depends on"
        return SpecError(reason, path=path, sensor=self.sensor.id)

    def _rows(self, layout: Layout, frames: Sequence[Values]) -> NDArray[np.uint8]:
        rows = np.zeros((len(frames), layout.size), np.uint8)
        for path in dict.fromkeys(path for values in frames for path in values):
            leaf = layout.leaves.get(path)
            if leaf is None and path in self._elsewhere:
                continue
            if leaf is None:
                raise SpecError("sweep gives a value to a field that the frame does not have", path=path, sensor=self.sensor.id)
            leaf.store(rows, _steps(leaf, [values.get(path, 0) for values in frames]))
        layout.seal(rows)
        return rows

    def _raw(self, values: Values, path: str) -> int:
        info = self.engine.schema.fields[path]
        if path in values:
            return int(info.raw(float(values[path])))
        return int(info.const) if isinstance(info.const, int) else 0


def sealed(table: Rows) -> list[bytes]:
    """The frames of a table in order, with constants and checksums in place."""
    frames = [b""] * len(table)
    for group in table.groups:
        group.layout.seal(group.rows)
        size, data = group.layout.size, group.rows.tobytes()
        for spot, place in enumerate(group.where.tolist()):
            frames[place] = data[spot * size : (spot + 1) * size]
    return frames


def _steps(leaf: Leaf, given: Sequence[Any]) -> NDArray[Any]:
    """Physical values as raw ones, with room for the arrays that the field is in; bytes fill up with zeros."""
    info = leaf.info
    if info.kind == "bytes":
        size = leaf.shape[-1]
        given = [list(value[:size].ljust(size, b"\0")) if isinstance(value, bytes) else value for value in given]
    values = np.array([np.asarray(value, np.float64) for value in given])
    values = values.reshape(*values.shape, *(1,) * (1 + len(leaf.shape) - values.ndim))
    return np.asarray(info.raw(values))
