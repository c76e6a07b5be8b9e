"""Finding frames in a byte stream: the one rule, the same for every sensor.

A stream decodes to the leftmost valid candidate, then on after its last byte; an invalid candidate advances by one
byte. At one offset the order of the frame types decides. A type with `after` is looked for only while the frame that
it names is the last seen of those named by any `after`; a type with `confirm` counts only in unbroken runs.

All candidates of a piece are judged in bulk, and those that are taken are found in bulk too, with a step for each conflict
only. A piece ends with the frame that changes what is looked for; while types with `confirm` are, `lidarspec.framing.weak_frames` goes
from run to run. So the work is linear in the input however often headers appear in it, and the result is that of the
byte-by-byte rule.
"""

from __future__ import annotations

import bisect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import PluginError
from lidarspec.framing.frame_engine import Codec
from lidarspec.framing.results import CONSTANT, COUNTED, PLUGIN, SHORT, VALID, Frames
from lidarspec.wire.layout import Marks, Sums, words

#: candidates of one type in a piece; where there are more, the piece is made shorter, so that memory stays small.
MOST = 1 << 15

Bytes1D = NDArray[np.uint8]
Offsets = NDArray[np.intp]


@dataclass
class Mode:
    """What is remembered between pieces: the last frame named by any `after`, a run of weak frames under way, the last frame's size.

    Attributes:
        steady: frames of that size seem to follow one another without a byte between.
    """

    after: str | None = None
    run: str | None = None
    run_end: int = -1
    size: int = 0
    steady: bool = True


@dataclass
class Piece:
    """The outcome for one piece.

    Attributes:
        frames: those that are taken; their places are those in the piece.
        end: where the rest begins, which has to be looked at again.
        waiting: whether the rest makes sense only together with bytes that follow the piece.
        need: how long the rest has to be at least before that; 0 if unknown.
        rejected: number of rejected candidates by counter.
        errors: failures of the plugin.
    """

    frames: Frames
    end: int
    waiting: bool = False
    need: int = 0
    rejected: dict[str, int] = field(default_factory=dict)
    errors: list[PluginError] = field(default_factory=list)

    def reject(self, numbers: Sequence[int], errors: Sequence[PluginError]) -> None:
        """Count candidates as rejected: how many of each status."""
        for reason, number in enumerate(numbers):
            name = COUNTED.get(reason)
            if number and name:
                self.rejected[name] = self.rejected.get(name, 0) + number
                if reason == PLUGIN:
                    self.errors += errors[:1]


class Framing:
    """The frame types of one stream, ready to be looked for.

    Args:
        codecs: those of the incoming frame types, by name, in the order that decides at one offset.
        sums: what computes checksums; by default their algorithms.
    """

    def __init__(self, codecs: Mapping[str, Codec], sums: Sums | None = None) -> None:
        self.names, self.codecs, self.sums = tuple(codecs), list(codecs.values()), sums
        self.named = {codec.frame.after for codec in self.codecs} - {None}
        self.marks = [codec.marks for codec in self.codecs]
        self.words = [words(marks) for marks in self.marks]
        #: bytes up to the end of the last of those.
        self.ends = [max((spot + dtype.itemsize for spot, dtype, _, _ in found), default=0) for found in self.words]
        lengths = [codec.frame.max_length for codec in self.codecs]
        #: no candidate waits for more bytes than these.
        self.reach = max(lengths) + max(codec.frame.max_length * codec.frame.confirm for codec in self.codecs)
        self._active: dict[str | None, list[int]] = {}

    def active(self, mode: Mode) -> list[int]:
        """The types that are looked for now, in order."""
        known = self._active.get(mode.after)
        if known is None:
            known = self._active[mode.after] = [i for i, codec in enumerate(self.codecs) if codec.frame.after in (None, mode.after)]
        return known

    def weak(self, kind: int) -> bool:
        """Whether frames of a type are believed in runs alone."""
        return self.codecs[kind].frame.confirm > 1

    def switches(self, kind: int, mode: Mode) -> bool:
        """Whether a frame of this type changes what is looked for."""
        return self.names[kind] in self.named and self.names[kind] != mode.after

    def switching(self, mode: Mode) -> NDArray[np.bool_]:
        """Whether a frame of each type changes what is looked for, (types + 1,), by its index; the last, for -1, is False."""
        return np.array([*(self.switches(kind, mode) for kind in range(len(self.names))), False])

    def survey(self, kind: int, buffer: Bytes1D, offsets: Offsets, *, gathered: bool = True) -> Frames:
        """The candidates of a type at these offsets, which have its constants, each with its layout and whether it is a frame."""
        return self.codecs[kind].survey(buffer, offsets, kind=kind, gathered=gathered, sums=self.sums)

    def candidates(self, buffer: Bytes1D, mode: Mode) -> tuple[Bytes1D, list[Frames]]:
        """The candidates of each type that is looked for and not weak, in the bytes or, where there are too many, in fewer of them."""
        known: dict[Marks, Offsets] = {}
        spots: dict[int, Offsets] = {}
        for kind in self.active(mode):
            if not self.weak(kind):
                begin, rest = self.marks[kind][:2], self.marks[kind][2:]  # many types begin alike
                if begin not in known:
                    known[begin] = matches(buffer, begin)
                spots[kind] = fitting(buffer, known[begin], rest)
        limit = min((int(offsets[MOST]) for offsets in spots.values() if len(offsets) > MOST), default=len(buffer))
        if limit < len(buffer):
            buffer = buffer[: max(limit, self.reach)]
            spots = {kind: offsets[: int(np.searchsorted(offsets, len(buffer)))] for kind, offsets in spots.items()}
        surveys = [self.survey(kind, buffer, offsets) for kind, offsets in spots.items() if len(offsets)]
        return buffer, [own if own.is_sound or (right := own.status != CONSTANT).all() else own.only(right) for own in surveys]


def matches(buffer: Bytes1D, constants: Marks) -> Offsets:
    """The offsets where the constants are right as far as the bytes go, (k,), ascending."""
    if not constants:
        return np.arange(len(buffer))
    length = len(buffer)
    (first, _, _), *rest = constants
    match = _right(buffer, *constants[0])
    for spot, mask, value in rest[:1]:  # two together leave few offsets of noise to look at
        inside = min(len(match), max(length - spot, 0))
        match[:inside] &= _right(buffer, spot, mask, value)[:inside]
    offsets = fitting(buffer, np.flatnonzero(match), tuple(rest[1:]))
    if first:
        offsets = np.concatenate([offsets, fitting(buffer, np.arange(max(length - first, 0), length), tuple(rest))])
    return offsets


def _right(buffer: Bytes1D, spot: int, mask: int, value: int) -> NDArray[np.bool_]:
    """At which offsets a constant is right, for those where it is there."""
    there = buffer[spot:]
    return np.asarray((there if mask == 0xFF else there & np.uint8(mask)) == np.uint8(value))


def fitting(buffer: Bytes1D, offsets: Offsets, constants: Marks) -> Offsets:
    """The offsets, in order, where the constants are right as far as the bytes go, (k,)."""
    for spot, mask, value in constants if len(offsets) else ():
        inside = int(offsets.searchsorted(len(buffer) - spot))
        found = buffer.take(offsets[:inside] + spot)
        kept = np.flatnonzero((found if mask == 0xFF else found & np.uint8(mask)) == value)
        if len(kept) < inside:
            offsets = np.concatenate([offsets[kept], offsets[inside:]])
    return offsets


def leftmost(framing: Framing, buffer: Bytes1D, mode: Mode, *, final: bool) -> Piece:
    """Cut one piece while no weak type is looked for.

    Args:
        buffer: the bytes not yet decided and those after them.
        mode: remembered between pieces, changed here.
        final: give up candidates that need more bytes than there are.
    """
    whole = len(buffer)
    buffer, candidates = framing.candidates(buffer, mode)
    final = final and len(buffer) == whole
    piece = Piece(Frames.none(buffer), len(buffer))
    if not candidates:
        return piece
    live = merged(candidates, final=final)
    chosen = _chain(live, len(buffer))
    count = len(live) if chosen is None else len(chosen)
    last = -1 if not count else count - 1 if chosen is None else int(chosen[-1])
    if count and live.status[last] == SHORT:
        count -= 1
        piece.end, piece.waiting, piece.need = int(live.starts[last]), len(buffer) == whole, int(live.sizes[last])
    frames = live.only(slice(0, count) if chosen is None else chosen[:count])
    piece.frames = frames = _until_switched(framing, frames, mode, piece) if framing.named else frames
    if len(frames):
        mode.size = frames.sizes.item(-1)
        mode.steady = frames.starts.item(-1) - frames.starts.item(0) == mode.size * (len(frames) - 1)
    count_rejected(piece, candidates, final=final)
    return piece


def merged(candidates: Sequence[Frames], *, final: bool) -> Frames:
    """The candidates of several types that are valid or wait for bytes, by offset, at each the one whose type comes first."""
    worst = VALID if final else SHORT
    parts = [own if own.is_sound or bool((own.status <= worst).all()) else own.only(own.status <= worst) for own in candidates]
    live = Frames.joined([part for part in parts if len(part)] or parts[:1])
    if len(parts) == 1:
        return live
    order = np.argsort(live.starts, kind="stable")  # at each offset still in the order of the types
    return live.only(order[np.diff(live.starts[order], prepend=-1) > 0])


def _chain(live: Frames, length: int) -> Offsets | None:
    """Indices of the candidates that are taken from left to right, each from the end of the one before; None if all are.

    One that waits for bytes takes all that there are.
    """
    offsets = live.starts
    if len(offsets) < 2:
        return None
    ends = offsets + live.sizes
    ends[live.status == SHORT] = length + 1
    if not bool((offsets[1:] < ends[:-1]).any()):
        return None
    after = np.searchsorted(offsets, ends)
    jumps = np.flatnonzero(after != np.arange(1, len(offsets) + 1)).tolist()
    runs, start = [], 0
    while start < len(offsets):
        spot = bisect.bisect_left(jumps, start)
        last = jumps[spot] if spot < len(jumps) else len(offsets) - 1
        runs.append(np.arange(start, last + 1))
        start = int(after[last])
    return np.concatenate(runs)


def _until_switched(framing: Framing, frames: Frames, mode: Mode, piece: Piece) -> Frames:
    """The frames up to the first one that changes what is looked for; the piece ends with it."""
    spots = np.flatnonzero(framing.switching(mode)[frames.kinds])
    if not len(spots):
        return frames
    last = int(spots[0])
    mode.after = framing.names[int(frames.kinds[last])]
    piece.end, piece.waiting, piece.need = int(frames.starts[last] + frames.sizes[last]), False, 0
    return frames.only(slice(0, last + 1))


def count_rejected(piece: Piece, candidates: Sequence[Frames], *, final: bool) -> None:
    """Count the candidates outside the frames, and at a frame's first byte those of the types that come before its own."""
    frames = piece.frames
    for own in candidates:
        refused = np.flatnonzero(own.status > (VALID if final else SHORT)) if not own.is_sound else ()
        if not len(refused):
            continue
        spots = own.starts[refused]
        counted = spots < piece.end
        if len(frames):
            before = np.searchsorted(frames.starts, spots, side="right") - 1
            held = np.maximum(before, 0)
            inside = (before >= 0) & (spots < frames.starts[held] + frames.sizes[held])
            counted &= ~inside | ((spots == frames.starts[held]) & (own.kinds[refused] < frames.kinds[held]))
        if counted.any():
            piece.reject(np.bincount(own.status[refused[counted]]).tolist(), own.errors)
