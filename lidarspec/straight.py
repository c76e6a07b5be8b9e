"""Frames that follow one another without a byte between, as in a stream that is received as it comes: found without a search.

Where all of them are frames of one layout, and nothing that comes first in the order stands at their first bytes, the search
would take the same. So they are judged as rows, which takes a few calls; on anything else the search goes on.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lidarspec.allocation import counted, repeated
from lidarspec.frames.constants import Marks, right
from lidarspec.frames.layout import Layout
from lidarspec.framing import Framing, Mode, Piece

#: bytes of a piece that is looked at so, at most: where the frames turn out to be damaged, it is looked at twice.
SMALL = 1 << 16


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
        told = tuple(word for word in framing.words[kind] if word[0] + word[1].itemsize <= mode.size)
        marked = right(told, rows)
        if marked is not None and not np.count_nonzero(marked):
            continue
        survey = framing.codecs[kind].alike(rows) if marked is None and not framing.switches(kind, mode) else None
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
