"""Frames that follow one another without a byte between, as in a stream that is received as it comes: found without a search.

Where all of them are frames of one layout, and nothing that comes first in the order stands at their first bytes, the search
would take the same. So they are judged as rows, which takes a few calls; on anything else the search goes on.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.allocation import counted, repeated
from lidarspec.frames.layout import Bytes2D, Layout, elements
from lidarspec.framing import Framing, Marks, Mode, Piece

#: bytes of a piece that is looked at so, at most: where the frames turn out to be damaged, it is looked at twice.
SMALL = 1 << 16

#: constants that stand side by side: offset, type, mask (None: all bits), value.
Word = tuple[int, np.dtype[Any], Any, Any]


def straight(framing: Framing, buffer: NDArray[np.uint8], mode: Mode) -> Piece | None:
    """The frames of a piece from its first byte on; None where they are to be searched for.

    Args:
        buffer: the bytes not yet decided and those after them.
        mode: as after the piece before.
    """
    number = len(buffer) // mode.size if mode.size and len(buffer) <= SMALL else 0
    if not number:
        return None
    rows = buffer[: number * mode.size].reshape(number, mode.size)
    for kind in framing.active(mode):
        marked = fitting(words(framing.marks[kind]), rows)
        if not marked:
            continue
        survey = framing.codecs[kind].alike(rows) if marked == number and not framing.switches(kind, mode) else None
        if survey is None or survey.layout is None or np.count_nonzero(survey.status):
            return None
        need = _awaited(framing, mode, kind, survey.layout, buffer[rows.size :].tobytes()) if rows.size < len(buffer) else 0
        return Piece(
            repeated(kind, number),
            counted(number) * mode.size,
            repeated(mode.size, number),
            rows.size,
            need > 0,
            need,
            rows,
            layout=survey.layout,
        )
    return None


def _awaited(framing: Framing, mode: Mode, kind: int, layout: Layout, rest: bytes) -> int:
    """How many bytes tell more of a next frame of the same layout, of which so much is there; 0 where it may be something else."""
    first = next((other for other in framing.active(mode) if _begins(framing.marks[other], rest)), None)
    if first != kind or framing.codecs[kind].size != layout.size:
        return 0
    need = layout.size
    for spot, (mask, value) in layout.constants.items():
        if spot >= len(rest):
            need = min(need, spot + 1)
        elif rest[spot] & mask != value:
            return 0
    return need


def _begins(marks: Marks, data: bytes) -> bool:
    return all(spot >= len(data) or data[spot] & mask == value for spot, mask, value in marks)


def fitting(constants: list[Word], rows: Bytes2D) -> int:
    """How many rows have these constants, as far as the rows go."""
    marked = None
    for spot, dtype, mask, value in constants:
        if spot + dtype.itemsize > rows.shape[1]:
            continue
        found = elements(rows, dtype, spot, (), ())
        right = (found if mask is None else found & mask) == value
        marked = right if marked is None else np.bitwise_and(marked, right, out=marked)
        if not np.count_nonzero(marked):
            return 0
    return len(rows) if marked is None else int(np.count_nonzero(marked))


@lru_cache(maxsize=2048)
def words(marks: Marks) -> list[Word]:
    """Constants as few words of 1, 2, 4 or 8 bytes, each of bytes that all have constants."""
    left, found = {spot: (mask, value) for spot, mask, value in marks}, list[Word]()
    while left:
        first = min(left)
        size = next(size for size in (8, 4, 2, 1) if all(spot in left for spot in range(first, first + size)))
        parts = [left.pop(first + index) for index in range(size)]
        dtype = np.dtype(f"<u{size}")
        mask, value = (np.frombuffer(bytes(part), dtype)[0] for part in zip(*parts, strict=True))
        found.append((first, dtype, None if all(part[0] == 0xFF for part in parts) else mask, value))
    return found
