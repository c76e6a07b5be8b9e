"""Check frames at equal distances as the rows of an array, without a search.

In a stream without errors, each frame begins directly after the previous one. Such frames are
checked as rows, which takes a few calls of NumPy. The result is the same as that of the search.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lidarspec.frames.arrays import broadcast_value, repeat
from lidarspec.frames.layout import Bytes2D, Layout, Marks, are_contradictory, match_constants
from lidarspec.framing.candidates import Framing, PieceResult, SearchState
from lidarspec.framing.results import Frames, Indices, Numbers

#: The constants of this number of rows are compared before the constants of all rows.
FIRST_ROWS = 64
#: A piece of at most this number of bytes is checked as rows even after a piece with errors.
SMALL_PIECE_BYTES = 1 << 16
#: The first datagram is compared with this number of constants of each type.
DISTINCTIVE_CONSTANTS = 4


def find_regular_frames(
    framing: Framing, buffer: NDArray[np.uint8], state: SearchState, base: int
) -> PieceResult | None:
    """Return the frames at the start of a piece; None if the piece must be searched.

    Args:
        buffer: the undecided bytes of the last search, and the new bytes.
        state: the state between pieces, which is updated.
        base: the offset of the buffer in the stream.
    """
    if not state.size or not (state.is_steady or len(buffer) <= SMALL_PIECE_BYTES):
        return None
    number = len(buffer) // state.size
    if not number:
        return None
    rows = buffer[: number * state.size].reshape(number, state.size)
    for kind in framing.active_types(state):
        lead = count_leading_matches(framing, kind, rows)
        if lead is None:
            continue
        is_weak = framing.is_weak(kind)
        if is_weak and (state.run, state.run_end) != (framing.names[kind], base):
            return None
        if 2 * lead <= number or framing.switches(kind, state):
            return None
        frames = check_rows(framing, kind, buffer, rows[:lead], 0)
        if frames is None:
            return None
        if frames.is_all_valid:
            valid = lead
        else:
            valid = int((frames.status != 0).argmax())
        state.is_steady = 2 * valid > number
        if not state.is_steady:
            return None
        if is_weak:
            state.run_end = base + valid * state.size
        return _make_result(framing, state, frames.select(slice(0, valid)))
    return None


def find_regular_datagrams(
    framing: Framing, buffer: NDArray[np.uint8], starts: Numbers, sizes: Indices, state: SearchState
) -> Frames | None:
    """Check datagrams at equal distances as frames of one type and layout.

    Returns None if the datagrams differ in size, type or layout.
    """
    rows = _view_rows(buffer, starts, sizes)
    if rows is None:
        return None
    kind = _guess_type(framing, rows, state)
    if kind is None or match_constants(framing.words[kind], rows) is not None:
        return None
    if framing.switches(kind, state):
        return None
    return check_rows(framing, kind, buffer, rows, int(starts[0]))


def check_rows(
    framing: Framing, kind: int, buffer: NDArray[np.uint8], rows: Bytes2D, first: int
) -> Frames | None:
    """Check rows as candidates of one type; None if they have no common layout.

    Args:
        kind: the index of the type, whose constants match in all rows.
        first: the offset of the first row in the buffer.
    """
    survey = framing.codecs[kind].survey_rows(rows, sums=framing.sums)
    if survey is None:
        return None
    layout, status, errors = survey
    number, size = rows.shape
    step = rows.strides[0] if number > 1 else size
    starts = range(first, first + number * step, step)
    return Frames(
        buffer,
        repeat(kind, number),
        starts,
        repeat(size, number),
        layouts=(layout,),
        status=status,
        rows=rows,
        errors=errors,
    )


def count_leading_matches(framing: Framing, kind: int, rows: Bytes2D) -> int | None:
    """Return how many rows at the start have the constants of a type.

    Returns None if no row has the constants.
    """
    constants = tuple(
        word for word in framing.words[kind] if word[0] + word[1].itemsize <= rows.shape[1]
    )
    for some in (rows[:FIRST_ROWS], rows):
        marked = match_constants(constants, some)
        if marked is not None and np.count_nonzero(marked):
            return int(marked.argmin())
    if marked is None:
        return len(rows)
    return None


def find_common_step(starts: Indices) -> int:
    """Return the common distance from each start to the next; 0 if the distances differ."""
    steps = starts[1:] - starts[:-1]
    step = steps.item(0) if len(steps) else 0
    if step > 0 and np.count_nonzero(steps == step) == len(steps):
        return step
    return 0


def _make_result(framing: Framing, state: SearchState, frames: Frames) -> PieceResult:
    """Return the result for a piece, given the frames at the start of the piece."""
    end = len(frames) * state.size
    rest = frames.buffer[end:]
    need = 0
    if frames.layout is not None and 0 < len(rest) < state.size:
        need = _count_needed(framing, state, frames.kinds.item(0), frames.layout, rest.tobytes())
    return PieceResult(frames, end, need > 0, need)


def _count_needed(
    framing: Framing, state: SearchState, kind: int, layout: Layout, rest: bytes
) -> int:
    """Return how many bytes of an incomplete frame are needed to check it further.

    Returns 0 if the number is unknown.
    """
    first = next(
        (
            other
            for other in framing.active_types(state)
            if _begins_with(framing.marks[other], rest)
        ),
        None,
    )
    if first != kind or framing.codecs[kind].size != layout.size:
        return 0
    need = layout.size
    for offset, (mask, value) in layout.known.items():
        if offset >= len(rest):
            need = min(need, offset + 1)
        elif rest[offset] & mask != value:
            return 0
    return need


def _begins_with(marks: Marks, data: bytes) -> bool:
    """Return whether the first bytes of a frame agree with the constants of a type."""
    return all(offset >= len(data) or data[offset] & mask == value for offset, mask, value in marks)


def _view_rows(buffer: NDArray[np.uint8], starts: Numbers, sizes: Indices) -> Bytes2D | None:
    """Return datagrams as rows of an array; None if sizes or distances differ."""
    count = len(sizes)
    size = sizes.item(0) if count else 0
    if not size or (broadcast_value(sizes) is None and np.count_nonzero(sizes == size) < count):
        return None
    if isinstance(starts, range):
        step = starts.step
    else:
        step = size if count == 1 else find_common_step(starts)
    if step < size:
        return None
    return np.ndarray((count, size), np.uint8, buffer, int(starts[0]), (step, 1))


def _guess_type(framing: Framing, rows: Bytes2D, state: SearchState) -> int | None:
    """Return the type whose constants are in the first datagram, or None."""
    first = rows[0].tobytes()
    before = list[int]()
    for kind in framing.active_types(state):
        if framing.codecs[kind].size not in (None, len(first)) or framing.ends[kind] > len(first):
            continue
        constants = framing.marks[kind][:DISTINCTIVE_CONSTANTS]
        if all(first[offset] & mask == value for offset, mask, value in constants):
            if any(_may_have_constants(framing, other, kind, rows) for other in before):
                return None
            return kind
        before.append(kind)
    return None


def _may_have_constants(framing: Framing, kind: int, other: int, rows: Bytes2D) -> bool:
    """Return whether any row may have the constants of the type `kind`.

    Args:
        other: a type whose constants the rows are assumed to have.
    """
    if are_contradictory(framing.marks[kind], framing.marks[other]):
        return False
    marked = match_constants(framing.words[kind], rows)
    return marked is None or bool(np.count_nonzero(marked))
