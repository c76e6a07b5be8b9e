"""The candidates in a piece of a stream: which types are looked for, where their constants stand,
and what is judged of them.

A type with `after` is looked for only while the frame that it names is the last seen of those named
by any `after`. All candidates of a piece are judged in bulk, those of each type once, when it is
looked for first: what is looked for may change with every frame.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import PluginError
from lidarspec.frames.layout import Marks, Sums, words
from lidarspec.framing.frame_codec import Codec
from lidarspec.framing.results import CONSTANT, COUNTED, PLUGIN, SHORT, VALID, Frames

#: candidates of one type in a piece; where there are more, the piece is made shorter, so that
#: memory stays small.
MOST = 1 << 15

Bytes1D = NDArray[np.uint8]
Offsets = NDArray[np.intp]


@dataclass
class Mode:
    """What is remembered between pieces: the last frame named by any `after`, a run of weak frames
    under way, the last frame's size.

    Attributes:
        changed: where in the stream what is looked for changed last.
        steady: frames of that size seem to follow one another without a byte between.
    """

    after: str | None = None
    changed: float = -math.inf
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
        self.ends = [
            max((spot + dtype.itemsize for spot, dtype, _, _ in found), default=0)
            for found in self.words
        ]
        lengths = [codec.frame.max_length for codec in self.codecs]
        #: no candidate waits for more bytes than these.
        self.reach = max(lengths) + max(
            codec.frame.max_length * codec.frame.confirm for codec in self.codecs
        )
        self._weak = {kind for kind, codec in enumerate(self.codecs) if codec.frame.confirm > 1}
        self._active: dict[str | None, list[int]] = {}

    def active(self, mode: Mode) -> list[int]:
        """The types that are looked for now, in order."""
        known = self._active.get(mode.after)
        if known is None:
            known = self._active[mode.after] = [
                i for i, codec in enumerate(self.codecs) if codec.frame.after in (None, mode.after)
            ]
        return known

    def weak(self, kind: int) -> bool:
        """Whether frames of a type are believed in runs alone."""
        return kind in self._weak

    def any_weak(self, mode: Mode) -> bool:
        """Whether any type that is looked for now is weak."""
        return bool(self._weak) and not self._weak.isdisjoint(self.active(mode))

    def switches(self, kind: int, mode: Mode) -> bool:
        """Whether a frame of this type changes what is looked for."""
        return self.names[kind] in self.named and self.names[kind] != mode.after

    def switching(self, mode: Mode) -> NDArray[np.bool_]:
        """Whether a frame of each type changes what is looked for, (types + 1,), by its index; the
        last, for -1, is False.
        """
        return np.array([*(self.switches(kind, mode) for kind in range(len(self.names))), False])

    def survey(
        self,
        kind: int,
        buffer: Bytes1D,
        offsets: Offsets,
        stops: Offsets | None = None,
        *,
        gathered: bool = True,
    ) -> Frames:
        """The candidates of a type at these offsets, which have its constants, each with its layout
        and whether it is a frame.
        """
        return self.codecs[kind].survey(
            buffer, offsets, stops, kind=kind, gathered=gathered, sums=self.sums
        )


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
        offsets = np.concatenate(
            [offsets, fitting(buffer, np.arange(max(length - first, 0), length), tuple(rest))]
        )
    return offsets


def _right(buffer: Bytes1D, spot: int, mask: int, value: int) -> NDArray[np.bool_]:
    """At which offsets a constant is right, for those where it is there."""
    there = buffer[spot:]
    return np.asarray((there if mask == 0xFF else there & np.uint8(mask)) == np.uint8(value))


def fitting(buffer: Bytes1D, offsets: Offsets, constants: Marks) -> Offsets:
    """The offsets, in order, where the constants are right as far as the bytes go, (k,)."""
    for spot, mask, value in constants:
        if not len(offsets):
            break
        inside = int(offsets.searchsorted(len(buffer) - spot))
        found = buffer.take(offsets[:inside] + spot)
        kept = np.flatnonzero((found if mask == 0xFF else found & np.uint8(mask)) == value)
        if len(kept) < inside:
            offsets = np.concatenate([offsets[kept], offsets[inside:]])
    return offsets


class Candidates:
    """The candidates of strong types in a piece of a stream.

    Args:
        buffer: the bytes not yet decided and those after them.
        mode: what is looked for at first.
        final: give up candidates that need more bytes than there are.

    Attributes:
        buffer: the bytes; fewer of them where there are too many candidates.
        is_whole: whether these are all.
        judged: the candidates of each type that was looked for and has some, by its index.
    """

    def __init__(self, framing: Framing, buffer: Bytes1D, mode: Mode, *, final: bool) -> None:
        self._framing, self.buffer = framing, buffer
        self._begun: dict[Marks, Offsets] = {}
        self.judged: dict[int, Frames] = {}
        self._known: set[int] = set()
        spots = self._spots(mode)
        limit = min(
            (int(offsets[MOST]) for offsets in spots.values() if len(offsets) > MOST),
            default=len(buffer),
        )
        if limit < len(buffer):
            self.buffer = buffer[: max(limit, framing.reach)]
            self._begun.clear()
            spots = {
                kind: offsets[: int(np.searchsorted(offsets, len(self.buffer)))]
                for kind, offsets in spots.items()
            }
        self.is_whole = len(self.buffer) == len(buffer)
        self.final = final and self.is_whole
        self._judge(spots)

    def live(self, mode: Mode) -> Frames | None:
        """Those that are valid or wait for bytes, by offset, at each the one whose type comes
        first; None where there are too many.
        """
        spots = self._spots(mode)
        if any(len(offsets) > MOST for offsets in spots.values()):
            return None
        self._judge(spots)
        own = [self.judged[kind] for kind in self._framing.active(mode) if kind in self.judged]
        return merged(own, final=self.final) if own else Frames.none(self.buffer)

    def _spots(self, mode: Mode) -> dict[int, Offsets]:
        """Where the constants of types stand that have not been looked for before."""
        spots: dict[int, Offsets] = {}
        for kind in self._framing.active(mode):
            if kind not in self._known and not self._framing.weak(kind):
                begin, rest = (
                    self._framing.marks[kind][:2],
                    self._framing.marks[kind][2:],
                )  # many types begin alike
                if begin not in self._begun:
                    self._begun[begin] = matches(self.buffer, begin)
                spots[kind] = fitting(self.buffer, self._begun[begin], rest)
        return spots

    def _judge(self, spots: Mapping[int, Offsets]) -> None:
        self._known |= spots.keys()
        for kind, offsets in spots.items():
            if not len(offsets):
                continue
            own = self._framing.survey(kind, self.buffer, offsets)
            self.judged[kind] = (
                own if own.is_sound or (right := own.status != CONSTANT).all() else own.only(right)
            )


def merged(candidates: Sequence[Frames], *, final: bool) -> Frames:
    """The candidates of several types that are valid or wait for bytes, by offset, at each the one
    whose type comes first.
    """
    worst = VALID if final else SHORT
    parts = [
        own if own.is_sound or bool((own.status <= worst).all()) else own.only(own.status <= worst)
        for own in candidates
    ]
    live = Frames.joined([part for part in parts if len(part)] or parts[:1])
    if len(parts) == 1:
        return live
    order = np.argsort(live.starts, kind="stable")  # at each offset still in the order of the types
    return live.only(order[np.diff(live.starts[order], prepend=-1) > 0])
