"""Frames that follow one another without a byte between, as in a stream that nothing disturbs: found without a search.

Where all of them are frames of one layout, and nothing that comes first in the order stands at their first bytes, the search
would take the same. So they are judged as rows, which takes a few calls, up to the first that is none; there the search goes on.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lidarspec.framing.search import Framing, Mode, Piece
from lidarspec.wire.arrays import counted, repeated
from lidarspec.wire.layout import Bytes2D, Layout, Marks, right

#: rows that are looked at before all are; bytes of a piece that is looked at so even after a piece with damaged frames.
FEW, SMALL = 64, 1 << 16


def straight(framing: Framing, buffer: NDArray[np.uint8], mode: Mode) -> Piece | None:
    """The frames of a piece from its first byte on; None where they are to be searched for.

    Args:
        buffer: the bytes not yet decided and those after them.
        mode: as after the piece before; remembered in it is whether this was worth its time.
    """
    number = len(buffer) // mode.size if mode.size and (mode.steady or len(buffer) <= SMALL) else 0
    if not number:
        return None
    rows = buffer[: number * mode.size].reshape(number, mode.size)
    for kind in framing.active(mode):
        lead = _leading(framing, kind, rows)
        if lead is None:
            continue
        survey = framing.codecs[kind].alike(rows[:lead]) if 2 * lead > number and not framing.switches(kind, mode) else None
        if survey is None or survey.layout is None:
            return None
        valid = int((survey.status != 0).argmax()) if np.count_nonzero(survey.status) else lead
        mode.steady = 2 * valid > number
        return _piece(framing, mode, kind, survey.layout, rows[:valid], buffer) if mode.steady else None
    return None


def _leading(framing: Framing, kind: int, rows: Bytes2D) -> int | None:
    """How many rows from the first on have the constants of a type, as far as the rows go; None where no row has them."""
    told = tuple(word for word in framing.words[kind] if word[0] + word[1].itemsize <= rows.shape[1])
    for some in (rows[:FEW], rows):
        marked = right(told, some)
        if marked is not None and np.count_nonzero(marked):
            return int(marked.argmin())
    return len(rows) if marked is None else None


def _piece(framing: Framing, mode: Mode, kind: int, layout: Layout, rows: Bytes2D, buffer: NDArray[np.uint8]) -> Piece:
    """A piece that ends with these frames, and waits for a next one where that is there in part."""
    number, size = rows.shape
    rest = buffer[rows.size :]
    need = _awaited(framing, mode, kind, layout, rest.tobytes()) if 0 < len(rest) < size else 0
    spots = counted(number) * size
    return Piece(repeated(kind, number), spots, repeated(size, number), rows.size, need > 0, need, rows, layout=layout)


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
