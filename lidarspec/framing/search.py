"""Finding frames in a byte stream: the one rule, the same for every sensor.

A stream decodes to the leftmost valid candidate, then on after its last byte; an invalid candidate
advances by one byte. At one offset the order of the frame types decides. A type with `after` is
looked for only while the frame that it names is the last seen of those named by any `after`; a type
with `confirm` counts only in unbroken runs.

All candidates of a piece are judged in bulk, and those that are taken are found in bulk too, with a
step for each conflict only, and one for each frame that changes what is looked for; while types
with `confirm` are, `lidarspec.framing.weak_frames` goes from run to run. So the work is linear in
the input however often headers or changes appear in it, and the result is that of the byte-by-byte
rule.
"""

from __future__ import annotations

import bisect
from typing import Protocol

import numpy as np

from lidarspec.framing.candidates import Bytes1D, Candidates, Framing, Mode, Offsets, Piece
from lidarspec.framing.results import SHORT, VALID, Frames
from lidarspec.framing.weak_frames import Runs

#: bytes from one change of what is looked for to the next, at which a piece ends there, and the
#: next one is judged for what follows alone.
SELDOM = 1 << 12


def leftmost(framing: Framing, buffer: Bytes1D, mode: Mode, base: int, *, final: bool) -> Piece:
    """Cut one piece.

    Args:
        buffer: the bytes not yet decided and those after them.
        mode: remembered between pieces, changed here.
        base: offset of the buffer in the stream.
        final: give up candidates that need more bytes than there are.
    """
    candidates = Candidates(framing, buffer, mode, final=final)
    piece = Piece(Frames.none(candidates.buffer), len(candidates.buffer))
    stays, walks = [(0, mode.after)], dict[str | None, Walk]()
    position = 0
    while position < piece.end:
        walk = walks.get(after := mode.after)
        if walk is None:
            live = candidates.live(mode)
            if live is None:
                piece.end = position
                break
            walk = walks[after] = _walk(framing, candidates, live, mode, base)
        position = walk.advance(position, piece)
        if mode.after == after:
            break
        before, mode.changed = mode.changed, base + position
        if mode.changed - before >= SELDOM:
            piece.end = position
            break
        stays.append((position, mode.after))
    frames = [frames for walk in walks.values() if len(frames := walk.frames())]
    if frames:
        piece.frames = joined = Frames.joined(frames)
        if len(frames) > 1:
            piece.frames = joined.only(np.argsort(joined.starts))
        if not framing.weak(piece.frames.kinds.item(-1)):
            _remember_size(mode, piece.frames, stays[-1][0])
    count_rejected(framing, piece, candidates, stays)
    return piece


class Walk(Protocol):
    """What goes through a piece while the same types are looked for, as often as they are again."""

    def advance(self, position: int, piece: Piece) -> int:
        """Take what is valid from an offset on, until the end or a frame that changes what is
        looked for; where that frame ends.

        Args:
            piece: where it ends and what it waits for is entered into it, unless what is looked for
                changes.
        """

    def frames(self) -> Frames:
        """All that were taken."""


def _walk(framing: Framing, candidates: Candidates, live: Frames, mode: Mode, base: int) -> Walk:
    if framing.any_weak(mode):
        return Runs(framing, candidates, live, mode, base)
    return _Chain(framing, candidates, live, mode)


class _Chain:
    """A `Walk` while no weak type is looked for.

    Args:
        live: the candidates that are valid or wait for bytes; one that waits takes all that there
            are.
    """

    def __init__(self, framing: Framing, candidates: Candidates, live: Frames, mode: Mode) -> None:
        self._framing, self._mode, self._live, self._is_whole = (
            framing,
            mode,
            live,
            candidates.is_whole,
        )
        ends, self._after = live.starts + live.sizes, None
        stops = np.zeros(len(live), np.bool_)
        stops[-1:] = True
        if len(live) > 1:
            if not live.is_sound:
                ends[live.status == SHORT] = len(candidates.buffer) + 1
            if bool((live.starts[1:] < ends[:-1]).any()):
                self._after = live.starts.searchsorted(ends)
                stops |= self._after != np.arange(1, len(live) + 1)
        self._changes, self._kinds, self._ends = bytes(len(live)), list[int](), list[int]()
        if framing.named:
            changes = framing.switching(mode)[live.kinds] & (live.status == VALID)
            self._changes, self._kinds, self._ends = (
                changes.tobytes(),
                live.kinds.tolist(),
                ends.tolist(),
            )
            stops |= changes
        self._stops: list[int] = np.flatnonzero(stops).tolist()
        self._starts: list[int] = live.starts.tolist() if any(self._changes) else []
        self._runs: list[tuple[int, int]] = []

    def advance(self, position: int, piece: Piece) -> int:
        live, first = self._live, 0
        if position:
            first = (
                bisect.bisect_left(self._starts, position)
                if self._starts
                else int(live.starts.searchsorted(position))
            )
        while first < len(live):
            last = self._stops[bisect.bisect_left(self._stops, first)]
            if self._changes[last]:
                self._runs.append((first, last))
                self._mode.after = self._framing.names[self._kinds[last]]
                return self._ends[last]
            if live.status.item(last) == SHORT:
                self._runs.append((first, last - 1))
                piece.end, piece.waiting, piece.need = (
                    live.starts.item(last),
                    self._is_whole,
                    live.sizes.item(last),
                )
                break
            self._runs.append((first, last))
            first = last + 1 if self._after is None else self._after.item(last)
        return piece.end

    def frames(self) -> Frames:
        if len(self._runs) == 1:
            (first, last), *_ = self._runs
            return self._live.only(slice(first, last + 1))
        return self._live.only(_counted(np.array(self._runs, np.intp).reshape(-1, 2)))


def _counted(runs: Offsets) -> Offsets:
    """The numbers from each first to each last, (k,)."""
    firsts, numbers = runs[:, 0], runs[:, 1] - runs[:, 0] + 1
    begins = np.cumsum(numbers) - numbers
    offsets: Offsets = np.arange(int(numbers.sum())) + np.repeat(firsts - begins, numbers)
    return offsets


def _remember_size(mode: Mode, frames: Frames, since: int) -> None:
    """Note for the next piece how the frames follow one another, of those since what is looked for
    changed last.
    """
    own = frames.starts[frames.starts.searchsorted(since) :]
    if len(own):
        mode.size = frames.sizes.item(-1)
        mode.steady = own.item(-1) - own.item(0) == mode.size * (len(own) - 1)


def count_rejected(
    framing: Framing, piece: Piece, candidates: Candidates, stays: list[tuple[int, str | None]]
) -> None:
    """Count the candidates outside the frames, and at a frame's first byte those of the types that
    come before its own.

    Args:
        stays: from which offset on which types were looked for.
    """
    frames, begins = piece.frames, np.array([begin for begin, _ in stays])
    numbers = {name: number for number, name in enumerate({name for _, name in stays})}
    modes = np.array([numbers[name] for _, name in stays])
    for kind, own in candidates.judged.items():
        refused = (
            np.flatnonzero(own.status > (VALID if candidates.final else SHORT))
            if not own.is_sound
            else ()
        )
        if not len(refused):
            continue
        spots = own.starts[refused]
        counted = spots < piece.end
        if len(stays) > 1 and (after := framing.codecs[kind].frame.after) is not None:
            counted &= modes[begins.searchsorted(spots, side="right") - 1] == numbers.get(after, -1)
        if len(frames):
            before = np.searchsorted(frames.starts, spots, side="right") - 1
            held = np.maximum(before, 0)
            inside = (before >= 0) & (spots < frames.starts[held] + frames.sizes[held])
            counted &= ~inside | (
                (spots == frames.starts[held]) & (own.kinds[refused] < frames.kinds[held])
            )
        if counted.any():
            piece.reject(np.bincount(own.status[refused[counted]]).tolist(), own.errors)
