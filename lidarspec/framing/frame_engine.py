"""The codec of binary frames with layouts.

`CompiledCodec` checks many candidates at once. `get_codec` returns the codec of any frame type.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import PluginError
from lidarspec.frames.arrays import broadcast_value, count_up, repeat
from lidarspec.frames.compilability import NotCompilableError
from lidarspec.frames.frame_table import CompiledTable, LayoutRows
from lidarspec.frames.layout import Layout, LayoutRefusal, Sums, gather_rows
from lidarspec.frames.layout_tree import Group, frame_layouts
from lidarspec.frames.wire_coder import FormCoder, frame_coder
from lidarspec.framing.frame_codec import Codec
from lidarspec.framing.plain_frames import PlainCodec
from lidarspec.framing.results import (
    CONSTANT,
    LENGTH,
    PLUGIN,
    SHORT,
    VALID,
    Frames,
    Status,
)
from lidarspec.framing.text_frames import TextCodec
from lidarspec.framing.variable_lengths import JointChecker, LayoutFamilies, LayoutGroup
from lidarspec.spec.description import Frame

#: The number of bytes of candidates that are checked together, so that memory is limited for any
#: input.
MAX_BATCH_BYTES = 1 << 19


class CompiledCodec(Codec):
    """The codec of a frame type with layouts.

    Raises:
        NotCompilableError: if the offset of a field of the struct cannot be computed.
    """

    def __init__(self, frame: Frame) -> None:
        layouts = frame_layouts(frame)
        if isinstance(layouts, NotCompilableError):
            raise layouts
        super().__init__(frame)
        self.tree = layouts
        layout = layouts.layout(b"")
        self.layout = layout if isinstance(layout, Layout) else None
        self._families = LayoutFamilies()

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
        groups: list[Group] = (
            [(self.layout, count_up(len(offsets)))]
            if self.layout is not None
            else self.tree.classify(buffer, offsets, stops)
        )
        if self.frame.endless is not None:
            groups = self._refuse_longer_datagrams(groups, offsets, stops)
        kinds = repeat(kind, len(offsets))
        errors = list[PluginError]()
        if (
            len(groups) == 1
            and len(groups[0][1]) == len(offsets)
            and isinstance(only := groups[0][0], Layout)
        ):
            status, sizes, rows = self._check_layout(
                buffer, offsets, stops, only, errors, gathered=gathered, sums=sums
            )
            return Frames(
                buffer,
                kinds,
                offsets,
                sizes,
                layouts=(only,),
                status=status,
                rows=rows,
                errors=tuple(errors),
            )
        status = np.full(len(offsets), SHORT, np.uint8)
        forms = np.full(len(offsets), -1, np.intp)
        layouts = list[Layout]()
        short = list[tuple[NDArray[np.intp], NDArray[np.intp]]]()
        left = list[LayoutGroup]()
        for layout, which in groups:
            if isinstance(layout, LayoutRefusal):
                if layout.error:
                    status[which] = PLUGIN
                elif layout.has_wrong_constant:
                    status[which] = CONSTANT
                else:
                    status[which] = LENGTH
                errors += [layout.error] if layout.error else []
                continue
            forms[which] = len(layouts)
            layouts.append(layout)
            left.append((layout, which))
        sizes = np.array([*(layout.size for layout in layouts), 0], np.intp)[forms]
        together, left = self._families.split(left, self.make_checker)
        for some in together:
            left += self._check_together(buffer, offsets, stops, some, status, sizes, sums)
        for layout, which in left:
            status[which], own, _ = self._check_layout(
                buffer,
                offsets[which],
                None if stops is None else stops[which],
                layout,
                errors,
                gathered=gathered,
                sums=sums,
            )
            short += [(which, own)] if broadcast_value(own) is None else []
        for which, own in short:
            sizes[which] = own
        return Frames(
            buffer,
            kinds,
            offsets,
            sizes,
            layouts=tuple(layouts),
            forms=forms,
            status=status,
            errors=tuple(errors),
        )

    def _refuse_longer_datagrams(
        self,
        groups: list[Group],
        offsets: NDArray[np.intp],
        stops: NDArray[np.intp] | None,
    ) -> list[Group]:
        """Move datagrams that are too long for the type to a group without a layout."""
        # The frames of this type extend to the end of the datagram. They do not exist in a stream,
        # in which `stops` is None.
        is_fitting = np.zeros(len(offsets), np.bool_)
        if stops is not None:
            is_fitting = stops - offsets <= self.frame.max_struct_bytes
        kept = [(layout, which[is_fitting[which]]) for layout, which in groups]
        refused = (LayoutRefusal(), np.flatnonzero(~is_fitting))
        return [group for group in (*kept, refused) if len(group[1])]

    def _check_together(
        self,
        buffer: NDArray[np.uint8],
        offsets: NDArray[np.intp],
        stops: NDArray[np.intp] | None,
        together: JointChecker,
        status: NDArray[np.uint8],
        sizes: NDArray[np.intp],
        sums: Sums | None,
    ) -> list[LayoutGroup]:
        """Check the candidates of similar layouts together.

        Args:
            status: the status of all candidates, which is updated.
            sizes: the size of all candidates, which is updated.

        Returns:
            The groups that have to be checked layout by layout.
        """
        which = together.which
        if stops is None:
            ends = np.full(len(which), len(buffer))
        else:
            ends = stops[which]
        is_whole = offsets[which] + sizes[which] <= ends
        partial = which[~is_whole]
        status[partial], sizes[partial] = _check_incomplete(
            buffer, offsets[partial], ends[~is_whole], together.layouts[0], sizes[partial]
        )
        whole = which[is_whole]
        status[whole] = together.check(buffer, offsets[whole], together.forms[is_whole], sums)
        if together.is_complete:
            return []
        is_undecided = np.zeros(len(which), np.bool_)
        is_undecided[is_whole] = status[whole] == VALID
        return together.group_by_layout(is_undecided)

    def survey_rows(
        self, rows: NDArray[np.uint8], *, sums: Sums | None = None
    ) -> tuple[Layout, Status, tuple[PluginError, ...]] | None:
        layout = self.layout or self.tree.find_common_layout(rows)
        if layout is None or layout.size != rows.shape[1]:
            return None
        errors: list[PluginError] = []
        return layout, self.make_checker(layout)(rows, errors, sums), tuple(errors)

    def _check_layout(
        self,
        buffer: NDArray[np.uint8],
        offsets: NDArray[np.intp],
        stops: NDArray[np.intp] | None,
        layout: Layout,
        errors: list[PluginError],
        *,
        gathered: bool,
        sums: Sums | None,
    ) -> tuple[NDArray[np.uint8], NDArray[np.intp], NDArray[np.uint8] | None]:
        """Check the candidates of one layout.

        Returns:
            The status of each candidate, (n,).
            The size of each complete candidate in bytes, and for an incomplete candidate the number
            of bytes that are needed to decide about it, (n,).
            The bytes of the complete candidates, (k, size), if they were gathered; else None.
        """
        whole = offsets <= (len(buffer) if stops is None else stops) - layout.size
        count = int(np.count_nonzero(whole))
        number = len(offsets)
        own = offsets if count == number else offsets[whole]
        gathered = gathered and (count == number or bool(whole[:count].all()))
        check = self.make_checker(layout)
        step = max(MAX_BATCH_BYTES // layout.size, 1)
        kept = None
        if count <= step or not gathered:
            rows = gather_rows(buffer, own, layout.size, gathered=gathered)
            row_status = check(rows, errors, sums)
            kept = rows if gathered else None
        else:
            blocks = (own[start : start + step] for start in range(0, count, step))
            row_status = np.concatenate(
                [check(gather_rows(buffer, block, layout.size), errors, sums) for block in blocks]
            )
        if count == number:
            return row_status, repeat(layout.size, number), kept
        status = np.empty(number, np.uint8)
        sizes = np.full(number, layout.size)
        status[whole] = row_status
        ends = len(buffer) if stops is None else stops[~whole]
        status[~whole], sizes[~whole] = _check_incomplete(
            buffer, offsets[~whole], ends, layout, sizes[~whole]
        )
        return status, sizes, kept

    def table(self, frames: Iterable[bytes]) -> CompiledTable:
        frames = list(frames)
        joined = np.frombuffer(b"".join(frames), np.uint8)
        sizes = np.array([len(frame) for frame in frames], np.intp)
        return self.gather(Frames(joined, repeat(0, len(frames)), np.cumsum(sizes) - sizes, sizes))

    def gather(self, frames: Frames) -> CompiledTable:
        """Return the columns of frames of this type, given as `Frames`."""
        if frames.rows is not None and frames.layout is not None:
            if 2 * frames.rows.size >= len(frames.buffer):
                rows = frames.rows
            else:
                rows = np.ascontiguousarray(frames.rows)
            return CompiledTable(
                self.schema, [LayoutRows(frames.layout, count_up(len(rows)), rows)]
            )
        known = (
            frames.group_by_layout()
            if frames.layouts
            else self.tree.classify(frames.buffer, frames.starts, self._find_stops(frames))
        )
        groups = []
        for layout, which in known:
            if isinstance(layout, LayoutRefusal):
                continue
            if len(which) == len(frames):
                starts = frames.starts
            else:
                starts = frames.starts[which]
            is_sparse = 2 * len(which) * layout.size < len(frames.buffer)
            groups.append(
                LayoutRows(
                    layout,
                    which,
                    gather_rows(frames.buffer, starts, layout.size, gathered=is_sparse),
                )
            )
        return CompiledTable(self.schema, groups)

    def _find_stops(self, frames: Frames) -> NDArray[np.intp] | None:
        """Return the ends of frames; None if layouts do not depend on the end of a frame."""
        if self.frame.endless is None:
            return None
        return np.asarray(frames.starts + frames.sizes)


def _check_incomplete(
    buffer: NDArray[np.uint8],
    offsets: NDArray[np.intp],
    stops: NDArray[np.intp] | int,
    layout: Layout,
    sizes: NDArray[np.intp],
) -> tuple[NDArray[np.uint8], NDArray[np.intp]]:
    """Return the status of incomplete candidates, and how many bytes each requires."""
    status = np.full(len(offsets), SHORT, np.uint8)
    sizes = sizes.copy()
    for verdict, bits in ((LENGTH, layout.held), (CONSTANT, layout.constants)):
        for offset in sorted(bits, reverse=True):
            mask, value = bits[offset]
            there = offsets + offset < stops
            status[there] = np.where(
                buffer[offsets[there] + offset] & mask == value, status[there], verdict
            )
            sizes[~there] = np.minimum(sizes[~there], offset + 1)
    return status, sizes


@functools.lru_cache(maxsize=2048)
def get_codec(frame: Frame) -> CompiledCodec | PlainCodec | TextCodec:
    """Return the codec of a frame type; repeated calls return the same object."""
    coder = frame_coder(frame)
    if isinstance(coder, FormCoder):
        return TextCodec(frame, coder)
    try:
        return CompiledCodec(frame)
    except NotCompilableError as refusal:
        return PlainCodec(frame, str(refusal))
