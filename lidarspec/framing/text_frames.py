"""The engine of frames with a wire form: text, or escaped bytes.

The form finds where candidates end, and decodes them to the bytes of the struct; these are judged
by their layouts, as binary frames are.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import PluginError
from lidarspec.frames.arrays import alike, repeated
from lidarspec.frames.frame_table import Group, Rows, Table
from lidarspec.frames.layout import Layout, Refused, Sums, marks, rows_at
from lidarspec.frames.slots import Recoder
from lidarspec.framing.frame_codec import Codec
from lidarspec.framing.results import CHECKSUM, LENGTH, PLUGIN, SHORT, Frames, Recoded
from lidarspec.spec.description import Frame


class TextCodec(Codec):
    """A frame type with a wire form, whose structs are judged by their layouts.

    Raises:
        SpecError: for a struct whose fields have no computable place.
    """

    def __init__(self, frame: Frame, recoder: Recoder) -> None:
        super().__init__(frame)
        self.recoder = recoder
        self.tree = recoder.tree
        self.size = None
        self.prefix = {offset: (0xFF, byte) for offset, byte in recoder.prefix.items()}
        self.marks = marks(self.prefix)

    @property
    def _checked_constants(self) -> Mapping[int, tuple[int, int]]:
        return {}  # the prefix is one of the text, not of the struct

    def survey(
        self,
        buffer: NDArray[np.uint8],
        offsets: NDArray[np.intp],
        stops: NDArray[np.intp] | None = None,
        *,
        kind: int = 0,
        gathered: bool = True,
        sums: Sums | None = None,
    ) -> Frames:
        if not len(
            offsets
        ):  # as most types of a sensor have none, the buffer is not gone through for each
            return Frames(buffer, repeated(kind, 0), offsets, offsets, status=np.zeros(0, np.uint8))
        reading = self.recoder.reading(buffer, offsets)
        told = offsets + max(self.prefix, default=-1) < (
            len(buffer) if stops is None else stops
        )  # else it may be no candidate at all
        status, errors = (
            np.where((reading.sizes == 0) | ~told, SHORT, LENGTH).astype(np.uint8),
            list[PluginError](),
        )
        whole = np.flatnonzero((reading.sizes > 0) & told)
        if reading.intact is not None:
            status[whole[~reading.intact[whole]]] = CHECKSUM
            whole = whole[reading.intact[whole]]
        groups = list[tuple[Layout, NDArray[np.intp], NDArray[np.uint8]]]()
        for layout, which, rows, is_read in self.recoder.rows(
            reading, offsets[whole], reading.sizes[whole]
        ):
            if isinstance(layout, Refused):
                status[whole[which]] = PLUGIN if layout.error else LENGTH
                errors += [layout.error] if layout.error else []
                continue
            own = whole[which] if is_read.all() else whole[which[is_read]]
            if not len(own):
                continue
            good = rows if len(own) == len(which) else rows[is_read]
            status[own] = self.judge(layout)(good, errors, sums)
            groups.append((layout, own, good))
        recoded = (Recoded(kind, offsets, tuple(groups)),) if groups else ()
        kinds, sizes = repeated(kind, len(offsets)), np.maximum(reading.sizes, 0)
        return Frames(
            buffer, kinds, offsets, sizes, status=status, errors=tuple(errors), recoded=recoded
        )

    def table(self, frames: Iterable[bytes]) -> Table:
        frames = list(frames)
        sizes = np.array([len(frame) for frame in frames], np.intp)
        joined = np.frombuffer(b"".join(frames), np.uint8)
        return self.gather(
            Frames(joined, repeated(0, len(frames)), np.cumsum(sizes) - sizes, sizes)
        )

    def gather(self, frames: Frames) -> Table:
        known = next(
            (one.only(frames.starts) for one in frames.recoded if one.kind == alike(frames.kinds)),
            None,
        )
        if known is None:
            reading = self.recoder.reading(frames.buffer, frames.starts)
            read = self.recoder.rows(reading, frames.starts, frames.sizes)
            known = [
                (layout, which[right], rows[right])
                for layout, which, rows, right in read
                if isinstance(layout, Layout)
            ]
        return Rows(self.schema, [Group(*group) for group in known])

    def table_of_structs(self, structs: Iterable[bytes]) -> Table:
        structs = list(structs)
        sizes = np.array([len(struct) for struct in structs], np.intp)
        joined = np.frombuffer(b"".join(structs), np.uint8)
        starts = np.cumsum(sizes) - sizes
        groups = [
            Group(layout, which, rows_at(joined, starts[which], layout.size))
            for layout, which in self.tree.classify(joined, starts, starts + sizes)
            if isinstance(layout, Layout)
        ]
        return Rows(self.schema, groups)
