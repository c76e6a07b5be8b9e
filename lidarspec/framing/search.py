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
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lidarspec.framing.frame_engine import Codec
from lidarspec.framing.plausibility import CHECKSUM, CONSTANT, IMPLAUSIBLE, LENGTH, PLUGIN, SHORT, VALID, taken
from lidarspec.wire.arrays import repeated, some
from lidarspec.wire.layout import Layout, Marks, words

#: which counter a rejected candidate raises.
COUNTED = {LENGTH: "bad_length", CHECKSUM: "bad_checksum", IMPLAUSIBLE: "implausible", PLUGIN: "plugin_errors"}

#: candidates of one type in a piece; where there are more, the piece is made shorter, so that memory stays small.
MOST = 1 << 15

Bytes1D = NDArray[np.uint8]
Offsets = NDArray[np.intp]


@dataclass(eq=False)
class Candidates:
    """The candidates of one frame type in a piece of a stream, by offset.

    Attributes:
        kind: index of the type.
        rows: the bytes of the first ones, as many as it has rows; None where they have not all one layout.
    """

    kind: int
    offsets: Offsets
    status: NDArray[np.uint8]
    sizes: Offsets
    errors: tuple[str, ...] = ()
    rows: NDArray[np.uint8] | None = None

    @classmethod
    def judged(cls, kind: int, codec: Codec, buffer: Bytes1D, offsets: Offsets) -> Candidates:
        """Those of the offsets whose constants are right."""
        survey = codec.survey(buffer, offsets)
        found = cls(kind, offsets, survey.status, survey.sizes, survey.errors, survey.rows)
        if found.valid or not (wrong := survey.status == CONSTANT).any():
            return found
        return found.only(~wrong)

    @cached_property
    def valid(self) -> bool:
        """Whether all of them are valid."""
        return not self.status.any()

    def only(self, which: NDArray[np.bool_]) -> Candidates:
        """Some of them."""
        rows = None if self.rows is None else taken(self.rows, which[: len(self.rows)])
        return Candidates(self.kind, self.offsets[which], self.status[which], some(self.sizes, which), self.errors, rows)


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
        kinds, offsets, sizes: of the frames: index of the type, first byte, number of bytes.
        end: where the rest begins, which has to be looked at again.
        waiting: whether the rest makes sense only together with bytes that follow the piece.
        need: how long the rest has to be at least before that; 0 if unknown.
        rows: the bytes of the frames, one a row, where all have one layout; None where nobody gathered them.
        rejected: number of rejected candidates by counter.
        errors: tracebacks out of plugins.
        layout: that all frames have, one after another from the first byte on; None where they have not, or nobody knows.
    """

    kinds: Offsets = field(default_factory=lambda: np.empty(0, np.intp))
    offsets: Offsets = field(default_factory=lambda: np.empty(0, np.intp))
    sizes: Offsets = field(default_factory=lambda: np.empty(0, np.intp))
    end: int = 0
    waiting: bool = False
    need: int = 0
    rows: NDArray[np.uint8] | None = None
    rejected: dict[str, int] = field(default_factory=dict)
    errors: list[str] = field(default_factory=list)
    layout: Layout | None = None

    def reject(self, numbers: Sequence[int], errors: Sequence[str]) -> None:
        """Count candidates as rejected: how many of each status."""
        for reason, number in enumerate(numbers):
            name = COUNTED.get(LENGTH if reason == SHORT else reason)
            if number and name:
                self.rejected[name] = self.rejected.get(name, 0) + number
                if reason == PLUGIN:
                    self.errors += errors[:1]


class Framing:
    """The frame types of one stream, ready to be looked for.

    Args:
        codecs: those of the incoming frame types, by name, in the order that decides at one offset.
    """

    def __init__(self, codecs: Mapping[str, Codec]) -> None:
        self.names, self.codecs = list(codecs), list(codecs.values())
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

    def strong(self, buffer: Bytes1D, mode: Mode) -> tuple[Bytes1D, list[Candidates]]:
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
        found = [Candidates.judged(kind, self.codecs[kind], buffer, offsets) for kind, offsets in spots.items() if len(offsets)]
        return buffer, found


def matches(buffer: Bytes1D, constants: Marks) -> Offsets:
    """Where the constants are right as far as the bytes go."""
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
    """Those of the offsets, in order, where the constants are right as far as the bytes go."""
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
    buffer, found = framing.strong(buffer, mode)
    final = final and len(buffer) == whole
    piece = Piece(end=len(buffer))
    if not found:
        return piece
    live = merged(found, final=final)
    chosen = _chain(live.offsets, live.sizes, live.status, len(buffer))
    count = len(live.offsets) if chosen is None else len(chosen)
    last = -1 if not count else count - 1 if chosen is None else int(chosen[-1])
    if count and live.status[last] == SHORT:
        count -= 1
        piece.end, piece.waiting, piece.need = int(live.offsets[last]), len(buffer) == whole, int(live.sizes[last])
    live = live.only(slice(0, count) if chosen is None else chosen[:count])
    if framing.named:
        live = _until_switched(framing, live, mode, piece)
    piece.kinds, piece.offsets, piece.sizes, piece.rows = live.kinds, live.offsets, live.sizes, live.rows
    if len(live.sizes):
        mode.size = live.sizes.item(-1)
        mode.steady = live.offsets.item(-1) - live.offsets.item(0) == mode.size * (len(live.sizes) - 1)
    count_rejected(piece, found, final=final)
    return piece


@dataclass(frozen=True, eq=False)
class Live:
    """The candidates that are valid or wait for bytes, by offset, one at each.

    Attributes:
        rows: the bytes of the valid ones, where all have one layout and were gathered.
    """

    kinds: Offsets
    offsets: Offsets
    sizes: Offsets
    status: NDArray[np.uint8]
    rows: NDArray[np.uint8] | None = None

    def only(self, which: Offsets | slice) -> Live:
        """Some of them, in order."""
        rows = self.rows
        if rows is not None and (not isinstance(which, slice) or which.stop < len(rows)):
            rows = rows[which] if isinstance(which, slice) else taken(rows, which)
        return Live(some(self.kinds, which), self.offsets[which], some(self.sizes, which), self.status[which], rows)


def merged(found: Sequence[Candidates], *, final: bool) -> Live:
    """The live candidates of several types in one order, at each offset those of the type that comes first."""
    worst = VALID if final else SHORT
    live = [one if one.valid or bool((one.status <= worst).all()) else one.only(one.status <= worst) for one in found]
    if len(live) == 1:
        one = live[0]
        return Live(repeated(one.kind, len(one.offsets)), one.offsets, one.sizes, one.status, one.rows)
    kinds = np.repeat([one.kind for one in live], [len(one.offsets) for one in live])
    offsets = np.concatenate([one.offsets for one in live])
    order = np.lexsort((kinds, offsets))
    order = order[np.diff(offsets[order], prepend=-1) > 0]
    sizes, status = (np.concatenate([getattr(one, name) for one in live])[order] for name in ("sizes", "status"))
    return Live(kinds[order], offsets[order], sizes, status)


def _chain(offsets: Offsets, sizes: Offsets, status: NDArray[np.uint8], length: int) -> Offsets | None:
    """Indices of the candidates that are taken from left to right, each from the end of the one before; None if all are.

    One that waits for bytes takes all that there are.
    """
    if len(offsets) < 2:
        return None
    ends = offsets + sizes
    ends[status == SHORT] = length + 1
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


def _until_switched(framing: Framing, live: Live, mode: Mode, piece: Piece) -> Live:
    """The frames up to the first one that changes what is looked for; the piece ends with it."""
    switching = np.array([framing.switches(kind, mode) for kind in range(len(framing.names))])
    spots = np.flatnonzero(switching[live.kinds])
    if not len(spots):
        return live
    last = int(spots[0])
    mode.after = framing.names[int(live.kinds[last])]
    piece.end, piece.waiting, piece.need = int(live.offsets[last] + live.sizes[last]), False, 0
    return live.only(slice(0, last + 1))


def count_rejected(piece: Piece, found: Sequence[Candidates], *, final: bool) -> None:
    """Count the candidates outside the frames, and at a frame's first byte those of the types that come before its own."""
    for candidates in found:
        refused = np.flatnonzero(candidates.status > (VALID if final else SHORT)) if not candidates.valid else ()
        if not len(refused):
            continue
        spots = candidates.offsets[refused]
        counted = spots < piece.end
        if len(piece.offsets):
            before = np.searchsorted(piece.offsets, spots, side="right") - 1
            held = np.maximum(before, 0)
            inside = (before >= 0) & (spots < piece.offsets[held] + piece.sizes[held])
            counted &= ~inside | ((spots == piece.offsets[held]) & (candidates.kind < piece.kinds[held]))
        if counted.any():
            piece.reject(np.bincount(candidates.status[refused[counted]]).tolist(), candidates.errors)
