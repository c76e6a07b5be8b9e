"""Frames at one distance, as the rows of an array: found without a search, in a stream as in
datagrams.

In a stream that nothing disturbs, frames follow one another without a byte between; datagrams of
one size stand in a capture at one distance, and in an array without one. Where all of them are
frames of one layout, and nothing that comes first in the order stands at their first bytes, the
search would take the same. So they are judged as rows, which takes a few calls: of a stream up to
the first that is none, where the search goes on; of datagrams all or none.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lidarspec.frames.arrays import alike, repeated
from lidarspec.frames.layout import Bytes2D, Layout, Marks, exclude, right
from lidarspec.framing.candidates import Framing, Mode, Piece
from lidarspec.framing.results import Frames, Indices, Numbers

#: rows that are looked at before all are; bytes of a piece that is looked at so even after a piece
#: with damaged frames.
FEW, SMALL = 64, 1 << 16

#: constants that tell the types of most datagrams.
TOLD = 4


def steady_stream(
    framing: Framing, buffer: NDArray[np.uint8], mode: Mode, base: int
) -> Piece | None:
    """The frames of a piece from its first byte on; None where they are to be searched for.

    Args:
        buffer: the bytes not yet decided and those after them.
        mode: as after the piece before; remembered in it is whether this was worth its time.
        base: offset of the buffer in the stream.
    """
    number = len(buffer) // mode.size if mode.size and (mode.steady or len(buffer) <= SMALL) else 0
    if not number:
        return None
    rows = buffer[: number * mode.size].reshape(number, mode.size)
    for kind in framing.active(mode):
        lead = leading(framing, kind, rows)
        if lead is None:
            continue
        is_weak = framing.is_weak(kind)
        if is_weak and (mode.run, mode.run_end) != (framing.names[kind], base):
            return None
        frames = (
            judged(framing, kind, buffer, rows[:lead], 0)
            if 2 * lead > number and not framing.switches(kind, mode)
            else None
        )
        if frames is None:
            return None
        valid = lead if frames.is_sound else int((frames.status != 0).argmax())
        mode.steady = 2 * valid > number
        if not mode.steady:
            return None
        if is_weak:
            mode.run_end = base + valid * mode.size
        return _piece(framing, mode, frames.only(slice(0, valid)))
    return None


def steady_datagrams(
    framing: Framing, buffer: NDArray[np.uint8], starts: Numbers, sizes: Indices, mode: Mode
) -> Frames | None:
    """Datagrams of one size at one distance, judged as frames of one type and layout; None where
    they may be anything else.

    So they may where they have not all the constants of one type and none of those before it, and
    where they change what is looked for.
    """
    rows = _rows(buffer, starts, sizes)
    kind = None if rows is None else _likely(framing, rows, mode)
    if (
        rows is None
        or kind is None
        or right(framing.words[kind], rows) is not None
        or framing.switches(kind, mode)
    ):
        return None
    return judged(framing, kind, buffer, rows, int(starts[0]))


def judged(
    framing: Framing, kind: int, buffer: NDArray[np.uint8], rows: Bytes2D, first: int
) -> Frames | None:
    """Rows with the constants of a type as candidates of one layout; None where they have not one
    of their size.

    Args:
        rows: of the buffer, at one distance.
        first: where they begin in it.
    """
    survey = framing.codecs[kind].survey_rows(rows, sums=framing.sums)
    if survey is None:
        return None
    layout, status, errors = survey
    number, size = rows.shape
    step = rows.strides[0] if number > 1 else size
    starts = range(first, first + number * step, step)
    kinds, sizes = repeated(kind, number), repeated(size, number)
    return Frames(
        buffer, kinds, starts, sizes, layouts=(layout,), status=status, rows=rows, errors=errors
    )


def leading(framing: Framing, kind: int, rows: Bytes2D) -> int | None:
    """How many rows from the first on have the constants of a type, as far as the rows go; None
    where no row has them.
    """
    told = tuple(
        word for word in framing.words[kind] if word[0] + word[1].itemsize <= rows.shape[1]
    )
    for some in (rows[:FEW], rows):
        marked = right(told, some)
        if marked is not None and np.count_nonzero(marked):
            return int(marked.argmin())
    return len(rows) if marked is None else None


def step_between(starts: Indices) -> int:
    """The bytes from each start to the next, where they are the same for all; else 0."""
    steps = starts[1:] - starts[:-1]
    step = steps.item(0) if len(steps) else 0
    return step if step > 0 and np.count_nonzero(steps == step) == len(steps) else 0


def _piece(framing: Framing, mode: Mode, frames: Frames) -> Piece:
    """A piece that ends with these frames, and waits for a next one where that is there in part."""
    number, size = len(frames), mode.size
    rest = frames.buffer[number * size :]
    kind, layout = frames.kinds.item(0), frames.layout
    need = (
        _awaited(framing, mode, kind, layout, rest.tobytes())
        if layout is not None and 0 < len(rest) < size
        else 0
    )
    return Piece(frames, number * size, need > 0, need)


def _awaited(framing: Framing, mode: Mode, kind: int, layout: Layout, rest: bytes) -> int:
    """How many bytes tell more of a next frame of the same layout, of which so much is there; 0
    where it may be something else.
    """
    first = next(
        (other for other in framing.active(mode) if _begins(framing.marks[other], rest)), None
    )
    if first != kind or framing.codecs[kind].size != layout.size:
        return 0
    need = layout.size
    for spot, (mask, value) in layout.known.items():
        if spot >= len(rest):
            need = min(need, spot + 1)
        elif rest[spot] & mask != value:
            return 0
    return need


def _begins(marks: Marks, data: bytes) -> bool:
    return all(spot >= len(data) or data[spot] & mask == value for spot, mask, value in marks)


def _rows(buffer: NDArray[np.uint8], starts: Numbers, sizes: Indices) -> Bytes2D | None:
    """Datagrams as the rows of an array, where they have one size and stand at one distance, one
    after another; else None.
    """
    count = len(sizes)
    size = sizes.item(0) if count else 0
    if not size or (alike(sizes) is None and np.count_nonzero(sizes == size) < count):
        return None
    step = (
        starts.step if isinstance(starts, range) else size if count == 1 else step_between(starts)
    )
    return (
        np.ndarray((count, size), np.uint8, buffer, int(starts[0]), (step, 1))
        if step >= size
        else None
    )


def _likely(framing: Framing, rows: Bytes2D, mode: Mode) -> int | None:
    """The type that the first datagram resembles, if none of those with its constants resembles one
    that comes first; else None.
    """
    first, before = rows[0].tobytes(), list[int]()
    for kind in framing.active(mode):
        if framing.codecs[kind].size not in (None, len(first)) or framing.ends[kind] > len(first):
            continue
        if all(first[spot] & mask == value for spot, mask, value in framing.marks[kind][:TOLD]):
            return None if any(_resembled(framing, other, kind, rows) for other in before) else kind
        before.append(kind)
    return None


def _resembled(framing: Framing, kind: int, other: int, rows: Bytes2D) -> bool:
    """Whether any row with the constants of the other type has those of this type as well."""
    if exclude(framing.marks[kind], framing.marks[other]):
        return False
    marked = right(framing.words[kind], rows)
    return marked is None or bool(np.count_nonzero(marked))
