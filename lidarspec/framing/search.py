"""Find frames in a byte stream by a rule that is the same for every sensor.

The leftmost valid candidate is accepted, and the search continues after its last byte. After an
invalid candidate, the search continues at the next byte. If several types match at one offset, the
type that is declared first is used. A type with `after` is searched only while it is active. A type
with `confirm` is accepted only in runs without gaps (`lidarspec.framing.weak_frames`).

All candidates of a piece are checked together, so the time is linear in the size of the input. The
result is the same as that of a search byte by byte.
"""

from __future__ import annotations

import bisect

import numpy as np

from lidarspec.framing.candidates import (
    Bytes1D,
    Candidates,
    Framing,
    LiveCandidates,
    Offsets,
    PieceResult,
    SearchState,
)
from lidarspec.framing.results import IMPLAUSIBLE, PLUGIN, SHORT, VALID, Frames

#: If at least this number of bytes is between two changes of the active types, the piece ends at
#: the second change, so that its remaining bytes are not checked for types that are no longer
#: active.
MIN_STAY_BYTES = 1 << 12


def find_frames(
    framing: Framing, buffer: Bytes1D, state: SearchState, base: int, *, final: bool
) -> PieceResult:
    """Find the frames in one piece of a stream.

    Args:
        buffer: the undecided bytes of the last search, and the new bytes.
        state: the state between pieces, which is updated.
        base: the offset of the buffer in the stream.
        final: whether the stream ends with this piece, so that incomplete candidates are rejected.
    """
    candidates = Candidates(framing, buffer, state, final=final)
    piece = PieceResult(Frames.make_empty(candidates.buffer), len(candidates.buffer))
    periods = [(0, state.after)]
    walks = dict[str | None, _FrameWalk]()
    position = 0
    while position < piece.end:
        after = state.after
        walk = walks.get(after)
        if walk is None:
            live = candidates.find_live(state)
            if live is None:
                piece.end = position
                break
            walk = walks[after] = _FrameWalk(framing, candidates, live, state, base)
        position = walk.advance(position, piece)
        if state.after == after:
            break
        before = state.changed
        state.changed = base + position
        if state.changed - before >= MIN_STAY_BYTES:
            piece.end = position
            break
        periods.append((position, state.after))
    parts = [frames for walk in walks.values() for frames in walk.frames()]
    if parts:
        piece.frames = Frames.join(parts)
        if len(parts) > 1:
            piece.frames = piece.frames.select(np.argsort(piece.frames.starts))
        _remember_size(state, piece.frames, periods[-1][0])
    count_rejected(framing, piece, candidates, periods)
    return piece


class _FrameWalk:
    """Accepts the candidates of a piece while one set of frame types is active.

    Args:
        base: the offset of the piece in the stream.
    """

    def __init__(
        self,
        framing: Framing,
        candidates: Candidates,
        live: LiveCandidates,
        state: SearchState,
        base: int,
    ) -> None:
        self._framing = framing
        self._state = state
        self._base = base
        self._is_whole = candidates.is_whole
        self._frames = frames = live.frames
        self._runs = live.runs
        self._ends = ends = live.ends
        self._after: Offsets | None = None  # the row that follows each candidate, if not the next
        stops = np.zeros(len(frames), np.bool_)
        stops[-1:] = True
        if len(frames) > 1:
            if not frames.is_all_valid:
                ends[frames.status == SHORT] = len(candidates.buffer) + 1
            if bool((frames.starts[1:] < ends[:-1]).any()):
                self._after = frames.starts.searchsorted(ends)
                stops |= self._after != np.arange(1, len(frames) + 1)
        self._changes = bytes(len(frames))
        if framing.named:
            changes = framing.find_switching_types(state)[frames.kinds] & (frames.status == VALID)
            self._changes = changes.tobytes()
            stops |= changes
        self._stops: list[int] = np.flatnonzero(stops).tolist()
        self._starts: list[int] = frames.starts.tolist() if any(self._changes) else []
        self._taken: list[tuple[int, int]] = []  # first and last rows that follow one another
        self._continued: list[tuple[int, int]] = []  # kinds and offsets of continued runs

    def advance(self, position: int, piece: PieceResult) -> int:
        """Accept valid candidates until the piece ends or the active types change.

        Args:
            piece: the result for the piece, which is updated.

        Returns:
            The end of the last accepted frame, or of the piece.
        """
        position = self._continue_run(position)
        frames = self._frames
        row = 0
        if position:
            if self._starts:
                row = bisect.bisect_left(self._starts, position)
            else:
                row = int(frames.starts.searchsorted(position))
        while row < len(frames):
            last = self._stops[bisect.bisect_left(self._stops, row)]
            if self._changes[last]:
                self._accept_rows(row, last)
                self._state.after = self._framing.names[frames.kinds.item(last)]
                return self._ends.item(last)
            if frames.status.item(last) == SHORT:
                self._accept_rows(row, last - 1)
                piece.end = frames.starts.item(last)
                piece.is_waiting = self._is_whole
                piece.need = frames.sizes.item(last)
                break
            self._accept_rows(row, last)
            if self._after is None:
                row = last + 1
            else:
                row = self._after.item(last)
        return piece.end

    def frames(self) -> list[Frames]:
        """Return all accepted frames, in several parts."""
        if len(self._taken) == 1:
            first, last = self._taken[0]
            taken = self._frames.select(slice(first, last + 1))
        else:
            taken = self._frames.select(_list_rows(np.array(self._taken, np.intp).reshape(-1, 2)))
        parts = [taken]
        if self._runs:
            is_weak = np.isin(taken.kinds, list(self._runs))
            parts = [taken.select(~is_weak)]
            for kind, runs in self._runs.items():
                continued = [offset for other, offset in self._continued if other == kind]
                offsets = [taken.starts[taken.kinds == kind], np.array(continued, np.intp)]
                parts.append(runs.members(np.concatenate(offsets)))
        return [part for part in parts if len(part)]

    def _accept_rows(self, first: int, last: int) -> None:
        """Accept the candidates from row `first` to row `last`."""
        self._taken.append((first, last))
        if self._runs and last >= first:
            kind = self._frames.kinds.item(last)
            if kind in self._runs:
                self._state.run = self._framing.names[kind]
                self._state.run_end = self._base + self._ends.item(last)

    def _continue_run(self, position: int) -> int:
        """Extend the run that ends at `position`, and return the new end of the run.

        Returns `position` if no run continues there.
        """
        if self._state.run_end != self._base + position:
            return position
        for kind, runs in self._runs.items():
            if self._framing.names[kind] != self._state.run or self._has_type_before(
                kind, position
            ):
                continue
            row = runs.find_row(position)
            if row is not None:
                self._continued.append((kind, position))
                position = runs.ends.item(row)
                self._state.run_end = self._base + position
                break
        return position

    def _has_type_before(self, kind: int, position: int) -> bool:
        """Return whether the candidate at an offset has a type declared before `kind`.

        Such a candidate takes precedence.
        """
        starts = self._frames.starts
        row = int(starts.searchsorted(position))
        if row == len(starts) or starts.item(row) != position:
            return False
        return self._frames.kinds.item(row) < kind


def _list_rows(runs: Offsets) -> Offsets:
    """Return all numbers from the first to the last of each run, (k,).

    Args:
        runs: the first and the last number of each run, (n, 2).
    """
    firsts = runs[:, 0]
    counts = runs[:, 1] - firsts + 1
    begins = np.cumsum(counts) - counts
    rows: Offsets = np.arange(int(counts.sum())) + np.repeat(firsts - begins, counts)
    return rows


def _remember_size(state: SearchState, frames: Frames, since: int) -> None:
    """Store the size of the frames, and whether they follow one another without gaps.

    Args:
        since: the offset of the first frame to compare, which is the last change of active types.
    """
    own = frames.starts[frames.starts.searchsorted(since) :]
    if len(own):
        state.size = frames.sizes.item(-1)
        state.is_steady = own.item(-1) - own.item(0) == state.size * (len(own) - 1)


def count_rejected(
    framing: Framing,
    piece: PieceResult,
    candidates: Candidates,
    periods: list[tuple[int, str | None]],
) -> None:
    """Count the rejected candidates outside of accepted frames.

    Args:
        periods: (offset, `SearchState.after`) of each period with the same active types. A period
            begins at its offset, and ends at the offset of the next period.
    """
    frames = piece.frames
    begins = np.array([begin for begin, _ in periods])
    numbers = {name: number for number, name in enumerate({name for _, name in periods})}
    modes = np.array([numbers[name] for _, name in periods])
    for kind, own in candidates.checked.items():
        status = own.status
        if framing.is_weak(kind):  # a valid candidate that was not accepted is in no run
            status = np.where(status == VALID, IMPLAUSIBLE, status)
        elif own.is_all_valid:
            continue
        refused = np.flatnonzero(status > (VALID if candidates.final else SHORT))
        if not len(refused):
            continue
        offsets = own.starts[refused]
        is_counted = offsets < piece.end
        after = framing.codecs[kind].frame.after
        if len(periods) > 1 and after is not None:
            own_modes = modes[begins.searchsorted(offsets, side="right") - 1]
            is_counted &= own_modes == numbers.get(after, -1)
        if len(frames):
            before = np.searchsorted(frames.starts, offsets, side="right") - 1
            held = np.maximum(before, 0)
            is_inside = (before >= 0) & (offsets < frames.starts[held] + frames.sizes[held])
            # A failure of the plugin is reported even if another type accepts the bytes.
            is_failure = (status[refused] == PLUGIN) & (offsets == frames.starts[held])
            is_counted &= ~is_inside | (is_failure & (kind < frames.kinds[held]))
        if is_counted.any():
            piece.reject(np.bincount(status[refused[is_counted]]).tolist(), own.errors)
