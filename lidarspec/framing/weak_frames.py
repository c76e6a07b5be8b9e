"""Weak frame types, which are accepted only in runs of consecutive frames.

Frames of a type with `confirm=k` are accepted only if at least k valid frames follow one another
without a gap. The whole run is then accepted. The reason is that a short frame without a checksum
is often valid by chance: a frame of five bytes may be valid at every sixth offset of random bytes.
A run of such frames is rarely valid by chance.

The first candidate of a run of at least k frames is called a *head*. The search handles a head as
one candidate, with the end of the run as its end.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lidarspec.frames.arrays import repeat
from lidarspec.framing.results import SHORT, VALID, Frames, Indices


@dataclass(frozen=True, eq=False)
class WeakRuns:
    """The runs of one weak type in a piece of a stream.

    Attributes:
        frames: the n candidates of the type that are valid or incomplete, sorted by offset.
        following: for each candidate, the row of the next candidate in its run, (n + 2,). The row
            is n if the run ends, and n + 1 if more bytes are needed. The last two elements map
            n to n, and n + 1 to n + 1.
        confirm: the minimum length of a run that is accepted.
        is_single: whether frames have to be accepted one at a time, because a frame of this type
            changes which frame types are searched after it.
    """

    frames: Frames
    following: Indices
    confirm: int
    is_single: bool

    @cached_property
    def ends(self) -> Indices:
        """The end offset of the run of each candidate, (n,)."""
        ends = self.frames.starts + self.frames.sizes
        if self._jumps:
            return ends[self._jumps[-1]]
        return ends

    @cached_property
    def heads(self) -> Frames:
        """The candidates at which a run of at least `confirm` frames begins or may begin."""
        count = len(self.frames)
        rows = np.arange(count)
        for _ in range(self.confirm - 1):
            rows = self.following[rows]
        is_head = rows != count
        is_short = (rows > count) | (self.frames.status == SHORT)
        heads = self.frames.select(is_head)
        heads.status = np.where(is_short[is_head], SHORT, VALID)
        return heads

    def find_row(self, offset: int) -> int | None:
        """Return the row of the candidate at an offset; None if no valid one is there."""
        row = int(self.frames.starts.searchsorted(offset))
        if row == len(self.frames) or self.frames.starts.item(row) != offset:
            return None
        if self.frames.status.item(row) == VALID:
            return row
        return None

    def members(self, offsets: Indices) -> Frames:
        """Return all frames of the runs that begin at these offsets."""
        is_member = np.zeros(len(self.frames), np.bool_)
        is_member[self.frames.starts.searchsorted(offsets)] = True
        for jumps in self._jumps:
            is_member[jumps[np.flatnonzero(is_member)]] = True
        return self.frames.select(is_member)

    @cached_property
    def _jumps(self) -> list[Indices]:
        """Arrays that map each row to the row 1, 2, 4, 8 ... frames later in its run."""
        count = len(self.frames)
        rows = np.arange(count)
        further = self.following[:count]
        jump_rows = list[Indices]()
        if self.is_single:
            jumps = rows
        else:
            jumps = np.where(further < count, further, rows)
        while (jumps != rows).any():
            jump_rows.append(jumps)
            rows = jumps
            jumps = jumps[jumps]
        return jump_rows


def find_runs(
    candidates: Frames,
    preferred: Frames,
    *,
    confirm: int,
    is_single: bool,
    final: bool,
) -> WeakRuns:
    """Return the runs of a weak type.

    Args:
        candidates: the candidates of the type with any status, sorted by offset.
        preferred: the valid and incomplete candidates of the types that are declared before this
            type, sorted by offset.
        final: whether no bytes follow, so that incomplete candidates are invalid.
    """
    # The next frame of a run begins directly after the last byte of a frame. If a frame of a
    # preferred type begins there, the run ends.
    frames = candidates.select(candidates.status <= (VALID if final else SHORT))
    is_short = frames.status == SHORT
    count = len(frames)
    ends_here = count
    waits = count + 1
    stops = frames.starts + frames.sizes
    rows, is_found = _find_rows(frames.starts, stops)
    following = np.full(count + 2, ends_here, np.intp)
    following[-1] = waits
    own = following[:count]  # a view
    own[is_found] = rows[is_found]
    if not final:
        own[(stops >= len(frames.buffer)) | (is_found & is_short[rows])] = waits
    rows, is_found = _find_rows(preferred.starts, stops)
    own[is_found] = np.where(preferred.status[rows[is_found]] == SHORT, waits, ends_here)
    own[is_short] = waits
    return WeakRuns(frames, following, confirm, is_single)


def _find_rows(values: Indices, wanted: Indices) -> tuple[Indices, NDArray[np.bool_]]:
    """Return the index of each wanted value in an ascending array, and whether it exists."""
    if not len(values):
        return repeat(0, len(wanted)), np.zeros(len(wanted), np.bool_)
    rows = np.minimum(values.searchsorted(wanted), len(values) - 1)
    return rows, values[rows] == wanted
