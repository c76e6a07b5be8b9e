"""Finding frames in a byte stream: the one rule, the same for every sensor.

A stream decodes to the leftmost valid candidate, then on after its last byte; an invalid candidate advances by one
byte. At one offset the order of the frame types decides. A type with `after` is looked for only while the frame that
it names is the last seen of those named by any `after`; a type with `confirm` counts only in unbroken runs.

All candidates of a piece are judged in bulk. Where no type needs memory, those that are taken are found in bulk too, with
a step for each conflict only; else a walk goes over the candidates that are not rejected. So the work is linear in the
input however often headers appear in it, and the result is that of the byte-by-byte rule.
"""

from __future__ import annotations

import bisect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.codecs import CHECKSUM, CONSTANT, IMPLAUSIBLE, LENGTH, PLUGIN, SHORT, VALID, Codec

#: which counter a rejected candidate raises.
COUNTED = {LENGTH: "bad_length", CHECKSUM: "bad_checksum", IMPLAUSIBLE: "implausible", PLUGIN: "plugin_errors"}


@dataclass(eq=False)
class Candidates:
    """The candidates of one frame type in a piece of a stream, by offset."""

    codec: Codec
    offsets: NDArray[np.intp]
    status: NDArray[np.uint8]
    sizes: NDArray[np.intp]
    errors: tuple[str, ...]

    @classmethod
    def find(cls, codec: Codec, buffer: NDArray[np.uint8]) -> Candidates:
        """Those whose constants at the start match as far as the bytes go."""
        match = np.ones(len(buffer), np.bool_)
        for spot, (mask, value) in codec.prefix.items():
            if spot < len(buffer):
                there = buffer[spot:] if mask == 0xFF else buffer[spot:] & np.uint8(mask)
                match[: len(buffer) - spot] &= there == value
        offsets = np.flatnonzero(match)
        survey = codec.survey(buffer, offsets)
        kept = survey.status != CONSTANT
        return cls(codec, offsets[kept], survey.status[kept], survey.sizes[kept], survey.errors)

    @classmethod
    def none(cls, codec: Codec) -> Candidates:
        """No candidates, of a type that is not looked for."""
        return cls(codec, np.empty(0, np.intp), np.empty(0, np.uint8), np.empty(0, np.intp), ())


@dataclass
class Mode:
    """What the walk remembers between pieces: the last frame named by any `after`, and a run of weak frames under way."""

    after: str | None = None
    run: str | None = None
    run_end: int = -1


@dataclass
class Piece:
    """The outcome for one piece.

    Attributes:
        kinds, offsets, sizes: of the frames: index of the type, first byte, number of bytes.
        end: where the rest begins, which has to be looked at again together with what follows.
        need: how long the rest has to be at least before that makes sense; 0 if unknown.
        rejected: number of rejected candidates by counter.
        errors: tracebacks out of plugins.
    """

    kinds: NDArray[np.intp] = field(default_factory=lambda: np.empty(0, np.intp))
    offsets: NDArray[np.intp] = field(default_factory=lambda: np.empty(0, np.intp))
    sizes: NDArray[np.intp] = field(default_factory=lambda: np.empty(0, np.intp))
    end: int = 0
    need: int = 0
    rejected: dict[str, int] = field(default_factory=dict)
    errors: list[str] = field(default_factory=list)

    def reject(self, candidates: Candidates, which: NDArray[Any] | slice) -> None:
        """Count some candidates as rejected, each under its reason."""
        for status, number in enumerate(np.bincount(candidates.status[which], minlength=PLUGIN + 1).tolist()):
            name = COUNTED.get(LENGTH if status == SHORT else status)
            if number and name:
                self.rejected[name] = self.rejected.get(name, 0) + number
                if status == PLUGIN:
                    self.errors += candidates.errors[:1]


class Framing:
    """The frame types of one stream, ready to be looked for.

    Args:
        codecs: those of the incoming frame types, by name, in the order that decides at one offset.
    """

    def __init__(self, codecs: Mapping[str, Codec]) -> None:
        self.names, self.codecs = list(codecs), list(codecs.values())
        self.named = {codec.frame.after for codec in self.codecs} - {None}
        self._plain = not self.named and all(codec.frame.confirm == 1 for codec in self.codecs)

    def scan(self, buffer: NDArray[np.uint8], mode: Mode, *, base: int, final: bool) -> Piece:
        """Cut one piece.

        Args:
            buffer: the bytes not yet decided and those after them.
            mode: remembered between pieces, changed here.
            base: offset of the buffer in the stream.
            final: give up candidates that need more bytes than there are.

        Returns:
            The frames, and in `end` the first byte that has to be looked at again together with what follows.
        """
        found = self._candidates(buffer, mode)
        if self._plain:
            return leftmost(found, len(buffer), final=final)
        piece = Piece()
        _Walker(self, found, mode, piece, base, len(buffer), final=final).run()
        return piece

    def _candidates(self, buffer: NDArray[np.uint8], mode: Mode) -> list[Candidates]:
        """The candidates of each type that may be looked for in this piece: now, or after a frame that stands in it."""
        found: dict[int, Candidates] = {}
        seen, waiting = {None, mode.after}, list(range(len(self.codecs)))
        while ready := [index for index in waiting if self.codecs[index].frame.after in seen]:
            found |= {index: Candidates.find(self.codecs[index], buffer) for index in ready}
            seen |= {self.names[index] for index in ready if (found[index].status == VALID).any()}
            waiting = [index for index in waiting if index not in found]
        return [found[index] if index in found else Candidates.none(codec) for index, codec in enumerate(self.codecs)]

    def active(self, index: int, mode: Mode) -> bool:
        """Whether a type is looked for now."""
        after = self.codecs[index].frame.after
        return after is None or after == mode.after


def leftmost(found: Sequence[Candidates], length: int, *, final: bool) -> Piece:
    """The rule for types that need no memory (no `after`, no `confirm`), for a whole piece at once."""
    live = [np.flatnonzero((c.status == VALID) | ((c.status == SHORT) & (not final))) for c in found]
    kinds = np.repeat(np.arange(len(found)), [len(which) for which in live])
    offsets = np.concatenate([c.offsets[which] for c, which in zip(found, live, strict=True)])
    sizes = np.concatenate([c.sizes[which] for c, which in zip(found, live, strict=True)])
    short = np.concatenate([c.status[which] == SHORT for c, which in zip(found, live, strict=True)])
    if len(found) > 1:
        order = np.lexsort((kinds, offsets))
        first = np.ones(len(order), np.bool_)
        first[1:] = np.diff(offsets[order]) > 0
        kinds, offsets, sizes, short = (array[order[first]] for array in (kinds, offsets, sizes, short))
    chosen = _chain(offsets, np.where(short, length + 1, offsets + sizes))
    piece = Piece(end=length)
    if len(chosen) and short[chosen[-1]]:
        piece.end, piece.need = int(offsets[chosen[-1]]), int(sizes[chosen[-1]])
        chosen = chosen[:-1]
    piece.kinds, piece.offsets, piece.sizes = kinds[chosen], offsets[chosen], sizes[chosen]
    _count_rejected(piece, found, final=final)
    return piece


def _chain(offsets: NDArray[np.intp], ends: NDArray[np.intp]) -> NDArray[np.intp]:
    """Indices of the candidates that are taken from left to right, each from the end of the one before."""
    after = np.searchsorted(offsets, ends)
    jumps = np.flatnonzero(after != np.arange(1, len(offsets) + 1)).tolist()
    if not jumps:
        return np.arange(len(offsets))
    runs, start = [], 0
    while start < len(offsets):
        spot = bisect.bisect_left(jumps, start)
        last = jumps[spot] if spot < len(jumps) else len(offsets) - 1
        runs.append(np.arange(start, last + 1))
        start = int(after[last])
    return np.concatenate(runs)


def _count_rejected(piece: Piece, found: Sequence[Candidates], *, final: bool) -> None:
    """Count the candidates outside the frames, and at a frame's first byte those of the types that come before its own."""
    ends = piece.offsets + piece.sizes
    for kind, candidates in enumerate(found):
        refused = (candidates.status != VALID) & ((candidates.status != SHORT) | final)
        spots = candidates.offsets
        before = np.searchsorted(piece.offsets, spots, side="right") - 1
        counted = refused & (spots < piece.end)
        if len(ends):
            held = np.maximum(before, 0)
            inside = (before >= 0) & (spots < ends[held])
            counted &= ~inside | ((spots == piece.offsets[held]) & (kind < piece.kinds[held]))
        piece.reject(candidates, counted)


class _Walker:
    """One pass over the candidates of a piece."""

    def __init__(
        self, framing: Framing, found: Sequence[Candidates], mode: Mode, piece: Piece, base: int, length: int, *, final: bool
    ) -> None:
        self.framing, self.found, self.mode, self.piece = framing, found, mode, piece
        self.base, self.length, self.final = base, length, final
        self.position = 0
        self.taken: list[tuple[int, int, int]] = []
        self.tables: list[dict[int, int]] = []
        for candidates in found:
            live = np.flatnonzero((candidates.status == VALID) | (candidates.status == SHORT))
            self.tables.append(dict(zip(candidates.offsets[live].tolist(), live.tolist(), strict=True)))
        self.spots = sorted(set().union(*self.tables))
        self.refused = {spot for candidates in found for spot in candidates.offsets[candidates.status != VALID].tolist()}

    def run(self) -> None:
        """Accept what is valid from left to right, until the end or a candidate that needs more bytes."""
        self.piece.end = self._walk()
        self._count(self.position, self.piece.end)
        columns = np.array(self.taken, np.intp).reshape(len(self.taken), 3).T
        self.piece.kinds, self.piece.offsets, self.piece.sizes = columns

    def _walk(self) -> int:
        for spot in self.spots:
            if spot < self.position:
                continue
            taken = self._at(spot)
            if taken is None:
                return spot
            if taken >= 0:
                self._count(self.position, spot, before=taken)
                self._accept(taken, spot)
        return self.length

    def _at(self, spot: int) -> int | None:
        """The type that is accepted at an offset, -1 if none is, None if that takes more bytes than there are."""
        for index, table in enumerate(self.tables):
            entry = table.get(spot)
            if entry is None or not self.framing.active(index, self.mode):
                continue
            candidates = self.found[index]
            if candidates.status[entry] == SHORT:
                if not self.final:
                    self.piece.need = int(candidates.sizes[entry])
                    return None
                continue
            confirmed = self._confirmed(index, spot)
            if confirmed is None:
                return None
            if confirmed:
                return index
            candidates.status[entry] = IMPLAUSIBLE
            self.refused.add(spot)
        return -1

    def _accept(self, index: int, spot: int) -> None:
        name = self.framing.names[index]
        size = int(self.found[index].sizes[self.tables[index][spot]])
        self.taken.append((index, spot, size))
        self.position = spot + size
        weak = self.framing.codecs[index].frame.confirm > 1
        self.mode.run, self.mode.run_end = (name, self.base + self.position) if weak else (None, -1)
        if name in self.framing.named:
            self.mode.after = name

    def _confirmed(self, index: int, spot: int) -> bool | None:
        """Whether enough valid frames of a weak type follow each other from here; None if that cannot be known yet."""
        wanted = self.framing.codecs[index].frame.confirm
        if wanted == 1 or (self.mode.run == self.framing.names[index] and self.mode.run_end == self.base + spot):
            return True
        candidates, table = self.found[index], self.tables[index]
        for _ in range(wanted):
            if spot >= self.length:
                return False if self.final else None
            earlier = self._earlier(index, spot)
            if earlier is None or earlier:
                return None if earlier is None else False
            entry = table.get(spot)
            if entry is None or candidates.status[entry] not in (VALID, SHORT):
                return False
            if candidates.status[entry] == SHORT:
                return False if self.final else None
            spot += int(candidates.sizes[entry])
        return True

    def _earlier(self, index: int, spot: int) -> bool | None:
        """Whether a type that comes first in the order stands at an offset; None if that cannot be known yet."""
        for other in range(index):
            entry = self.tables[other].get(spot)
            if entry is None or not self.framing.active(other, self.mode):
                continue
            status = self.found[other].status[entry]
            if status == VALID and self.framing.codecs[other].frame.confirm == 1:
                return True
            if status == SHORT and not self.final:
                return None
        return False

    def _count(self, start: int, stop: int, *, before: int = 0) -> None:
        """Count what was rejected from `start` up to `stop`, and at `stop` by the types that come before `before`."""
        if start == stop and stop not in self.refused:
            return  # one frame right after another
        for index, candidates in enumerate(self.found):
            if not len(candidates.offsets) or not self.framing.active(index, self.mode):
                continue
            low, high = np.searchsorted(candidates.offsets, [start, stop + (index < before)])
            self.piece.reject(candidates, slice(low, high))
