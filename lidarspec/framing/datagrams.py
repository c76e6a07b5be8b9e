"""Find the frame type of each datagram, which is one whole frame or invalid.

The types are tried in the order of declaration, and the first type that matches is used. A type
with `after` is tried only while it is active. A frame must be as long as its datagram.

Fragments of a message are joined first (`lidarspec.framing.datagram_assembly`).
"""

from __future__ import annotations

import bisect

import numpy as np
from numpy.typing import NDArray

from lidarspec.frames.arrays import broadcast_value, repeat
from lidarspec.frames.layout import Layout, match_word
from lidarspec.framing.candidates import Bytes1D, Framing, PieceResult, SearchState
from lidarspec.framing.regular_rows import find_common_step, find_regular_datagrams
from lidarspec.framing.results import (
    CONSTANT,
    LENGTH,
    PLUGIN,
    SHORT,
    VALID,
    Frames,
    Indices,
    Numbers,
    Status,
    to_array,
)


def classify_datagrams(
    framing: Framing, buffer: Bytes1D, starts: Numbers, sizes: Indices, state: SearchState
) -> PieceResult:
    """Find the type of each datagram.

    Args:
        starts: the offset of each datagram in the buffer, in the order of arrival.
        sizes: the size of each datagram in bytes.
        state: the state between batches, which is updated.

    Returns:
        All datagrams as frames; datagrams that are not frames have the kind -1.
    """
    regular_frames = find_regular_datagrams(framing, buffer, starts, sizes, state)
    if regular_frames is not None and regular_frames.is_all_valid:
        return PieceResult(regular_frames, len(buffer))
    return _DatagramBatch(framing, buffer, to_array(starts), sizes, regular_frames).classify(state)


class _DatagramBatch:
    """Checks a batch of datagrams, once for each set of active types.

    Args:
        regular_frames: the datagrams as frames of one type and layout, if possible.
    """

    def __init__(
        self,
        framing: Framing,
        buffer: Bytes1D,
        starts: Indices,
        sizes: Indices,
        regular_frames: Frames | None,
    ) -> None:
        self._framing = framing
        self._buffer = buffer
        self._starts = starts
        self._sizes = sizes
        self._regular_frames = regular_frames
        self._known: dict[str | None, tuple[int, Frames, Status, list[int]]] = {}
        self._piece = PieceResult(Frames.make_empty(buffer), len(buffer))

    def classify(self, state: SearchState) -> PieceResult:
        """Find the type of each datagram."""
        position = 0
        parts = list[Frames]()
        while position < len(self._starts):
            part = self._classify_from(position, state)
            parts.append(part)
            position += len(part)
        if parts:
            self._piece.frames = Frames.join(parts)
        return self._piece

    def _classify_from(self, position: int, state: SearchState) -> Frames:
        """Find the types of the datagrams, beginning with index `position`.

        The result ends with the first frame that changes the active types.
        """
        if state.after not in self._known:
            frames, reasons = self._check(self._starts[position:], self._sizes[position:], state)
            if self._framing.named:
                is_switch = self._framing.find_switching_types(state)[frames.kinds]
                rows = (np.flatnonzero(is_switch) + position).tolist()
            else:
                rows = []
            self._known[state.after] = position, frames, reasons, rows
        first, frames, reasons, rows = self._known[state.after]
        index = bisect.bisect_left(rows, position)
        if index < len(rows):
            stop = rows[index] + 1
        else:
            stop = len(self._starts)
        frames = frames.select(slice(position - first, stop - first))
        lost = np.flatnonzero(frames.kinds < 0)
        if len(lost):
            frames = self._count_rejected(frames, lost, reasons[position - first :][lost], state)
        if (
            len(frames)
            and frames.kinds[-1] >= 0
            and self._framing.switches(int(frames.kinds[-1]), state)
        ):
            state.after = self._framing.names[int(frames.kinds[-1])]
        return frames

    def _check(self, starts: Indices, sizes: Indices, state: SearchState) -> tuple[Frames, Status]:
        """Find the type and the layout of each datagram."""
        number = len(starts)
        common_size = broadcast_value(sizes)
        if common_size is not None:
            least = common_size
            most = common_size
        elif number:
            least = int(sizes.min())
            most = int(sizes.max())
        else:
            least = 0
            most = 0
        kinds = repeat(-1, number)
        forms = repeat(-1, number)
        reasons = np.zeros(number, np.uint8)
        left = np.arange(number)
        layouts: tuple[Layout, ...] = ()
        fixed = [
            (kind, self._framing.codecs[kind].size) for kind in self._framing.active_types(state)
        ]
        # No datagram fits them, so they can only give a reason.
        others = [kind for kind, size in fixed if size is not None and not least <= size <= most]
        for kind in (*(kind for kind, _ in fixed if kind not in others), *others):
            if not len(left):
                break
            own, lengths = (starts, sizes) if len(left) == number else (starts[left], sizes[left])
            marked = self._has_constants(kind, own, lengths)
            if not np.count_nonzero(marked):
                continue
            if not marked.all():
                own = own[marked]
                lengths = lengths[marked]
                which = left[marked]
            else:
                which = left
            frames = self._survey(kind, own, lengths)
            fits = frames.sizes == lengths
            if not frames.is_all_valid:
                fits &= frames.status == VALID
            elif len(own) == number and fits.all():
                return frames, reasons
            if broadcast_value(kinds) is not None:
                kinds, forms = np.full((2, number), -1, np.intp)
            kinds[which[fits]] = kind
            forms[which[fits]] = np.where(frames.forms < 0, -1, frames.forms + len(layouts))[fits]
            layouts += frames.layouts
            if np.count_nonzero(fits) < len(fits):
                status = np.where(
                    frames.sizes > lengths,
                    np.uint8(SHORT),
                    np.where(frames.status == VALID, LENGTH, frames.status),
                )
                reasons[which] = np.maximum(reasons[which], status)
            left = np.flatnonzero(kinds < 0)
        return Frames(self._buffer, kinds, starts, sizes, layouts=layouts, forms=forms), reasons

    def _survey(self, kind: int, starts: Indices, sizes: Indices) -> Frames:
        """Check datagrams as frames of one type, and return them with their status."""
        regular_frames = self._regular_frames
        self._regular_frames = None
        if (
            regular_frames is not None
            and regular_frames.kinds[0] == kind
            and len(starts) == len(regular_frames)
        ):
            return regular_frames
        return self._framing.survey(kind, self._buffer, starts, starts + sizes, gathered=False)

    def _count_rejected(
        self, frames: Frames, lost: Indices, reasons: Status, state: SearchState
    ) -> Frames:
        """Count invalid datagrams.

        If the plugin raised an error for a datagram, the cause may be another datagram of the
        batch. Such a datagram is checked again alone, and is only counted if it is still invalid.

        Args:
            lost: the indices of the invalid datagrams.
            reasons: the status of each invalid datagram.

        Returns:
            The datagrams up to the first frame that changes the active types.
        """
        parts = list[Frames]()
        begun = 0
        for index in lost[reasons == PLUGIN].tolist():
            alone = self._check_alone(frames.select(slice(index, index + 1)), state)
            if alone is None:
                continue
            parts += [frames.select(slice(begun, index)), alone]
            begun = index + 1
            if self._framing.switches(alone.kinds.item(0), state):
                frames = frames.select(slice(0, begun))
                break
        counted = (reasons != PLUGIN) & (lost < len(frames))
        self._count_by_reason(reasons[counted], frames.sizes[lost[counted]], state)
        if parts:
            return Frames.join([*parts, frames.select(slice(begun, None))])
        return frames

    def _check_alone(self, datagram: Frames, state: SearchState) -> Frames | None:
        """Check one datagram, and return it as a frame; None if it is invalid."""
        rejected = 0
        start = datagram.starts
        size = datagram.sizes
        data = self._buffer[start.item(0) : start.item(0) + size.item(0)]
        for kind in self._framing.active_types(state) if len(data) else ():
            if not self._has_constants(kind, start, size).all():
                continue
            is_rest = self._framing.codecs[kind].frame.endless is not None
            stops = np.array([len(data)]) if is_rest else None
            frame = self._framing.survey(kind, data, np.zeros(1, np.intp), stops)
            if frame.status[0] == VALID and frame.sizes[0] == len(data):
                return Frames(
                    self._buffer, frame.kinds, start, size, layouts=frame.layouts, forms=frame.forms
                )
            rejected = max(rejected, int(frame.status[0]) or LENGTH)
            self._piece.errors += frame.errors
        self._count_by_reason(np.array([rejected], np.uint8), size, state)
        return None

    def _count_by_reason(
        self, reasons: NDArray[np.uint8], sizes: Indices, state: SearchState
    ) -> None:
        """Add rejected datagrams to the counters of the reasons."""
        least = min(self._framing.ends[kind] for kind in self._framing.active_types(state))
        unknown = np.isin(reasons, (VALID, CONSTANT))
        others = unknown & (sizes >= max(least, 1))
        if number := int(np.count_nonzero(others)):
            self._piece.rejected["bad_constant"] = (
                self._piece.rejected.get("bad_constant", 0) + number
            )
        self._piece.reject(np.bincount(np.where(unknown, LENGTH, reasons)[~others]).tolist(), ())

    def _has_constants(self, kind: int, starts: Indices, sizes: Indices) -> NDArray[np.bool_]:
        """Return whether each datagram has the constants of a type, (n,)."""
        constants = self._framing.words[kind]
        end = self._framing.ends[kind]
        size = broadcast_value(sizes)
        if size is None or size < end:
            whole = sizes >= end
            if not whole.all():
                marked = whole.copy()
                marked[whole] = self._has_constants(kind, starts[whole], sizes[whole])
                return marked
        marked = np.ones(len(starts), np.bool_)
        step = find_common_step(starts)
        for word in constants if len(starts) else ():
            offset, dtype, _, _ = word
            if step:
                values = np.ndarray(
                    (len(starts),), dtype, self._buffer, starts.item(0) + offset, (step,)
                )
            else:
                values = np.ndarray(
                    (len(self._buffer) - offset - dtype.itemsize + 1,),
                    dtype,
                    self._buffer,
                    offset,
                    (1,),
                )[starts]
            marked &= match_word(values, word)
        return marked
