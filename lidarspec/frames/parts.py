"""Parts, which are frames within a frame: where each stands, in many frames at once.

What comes next is known when the part before it is: its size says where it begins. So frames are
walked through side by side, a part of each in every round: which kind it is, by its constants;
which layout its header has; and whether there is a further one. What is found is places in a
buffer, as frames are, so that parts have layouts, rows and tables like any frame
(`frame_table.Rows.parts`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import PluginError
from lidarspec.frames.layout import (
    Bytes2D,
    Layout,
    Leaf,
    Refused,
    Word,
    equal,
    marks,
    span,
    words,
)
from lidarspec.spec import tree

Offsets = NDArray[np.intp]

#: what became of the parts of a frame: all are there, the bytes end before, a length that cannot
#: be, constants of no kind, a plugin failed.
FOUND, CUT_OFF, LENGTH, CONSTANT, FAILED = range(5)
#: of a part whose own struct alone says how long it is.
ANY = -1


class Layouts(Protocol):
    """The layouts of a frame type or kind of parts, as a `HeaderTree` has them."""

    root: tree.Node
    limit: int

    def classify(
        self, buffer: NDArray[np.uint8], offsets: Offsets, stops: Offsets | None = None
    ) -> list[tuple[Layout | Refused, Offsets]]:
        """Return the candidates at these offsets by layout.

        Candidates with an incomplete header are left out. `stops` are the offsets after their last
        bytes.
        """

    def layout_for(self, read: Callable[[Leaf | Measure], int]) -> Layout:
        """Return the layout that values of header fields lead to."""


@dataclass(frozen=True, eq=False)
class Kind:
    """A kind of parts: its layouts, fields and first constants.

    It also has the formula for the length of the next part.
    """

    node: tree.Kind
    layouts: Layouts
    prefix: Mapping[int, tuple[int, int]]

    @cached_property
    def start(self) -> tuple[Word, ...]:
        """The constants that it begins with."""
        return words(marks(self.prefix))

    @cached_property
    def is_checked(self) -> bool:
        """Whether it has a checksum of its own, or conditions, or parts with such."""
        found = tree.nodes(self.node.root)
        return any(
            isinstance(node, tree.Sealed | tree.Check)
            or any(info.allowed for info in tree.infos(node))
            for node in found
        )

    def further(self, layout: Layout) -> tuple[Word, ...]:
        """The constants of a layout behind those that all begin with."""
        known = layout.notes.get(Kind)
        if known is None:
            left = {
                spot: byte
                for spot, byte in layout.constants.items()
                if self.prefix.get(spot) != byte
            }
            known = layout.notes[Kind] = words(marks(left))
        further: tuple[Word, ...] = known
        return further


@dataclass(frozen=True)
class Rule:
    """What says where the last part is, as `tree.Parts` does, for one header."""

    count: int | None = None
    size: int | None = None
    within: int | None = None


@dataclass(frozen=True, eq=False)
class Piece:
    """Parts of one layout that were found in one round.

    `owners` are the frames that they are in, `spots` their offsets in the buffer.
    """

    kind: int
    layout: Layout
    owners: Offsets
    spots: Offsets


@dataclass(frozen=True, eq=False)
class Walked:
    """The parts of n frames, by round.

    `status` is `FOUND` or the reason why not, (n,). `sizes` are the bytes of the parts found, (n,).
    """

    status: NDArray[np.uint8]
    sizes: Offsets
    rounds: Sequence[Sequence[Piece]]
    errors: tuple[PluginError, ...] = ()


@dataclass(frozen=True, eq=False)
class Region:
    """Where the parts of a frame of one kind of header stand.

    Attributes:
        kinds: of its parts.
        start: their first byte.
        rule: what says where the last one is.
        limit: the longest frame.
        given: values of fields of the frame around them that they ask for.
        size: the bytes of all parts; of a region that is still measured, None.
    """

    node: tree.Parts
    kinds: tuple[Kind, ...]
    start: int
    rule: Rule
    limit: int
    given: Mapping[str, int]
    size: int | None = None

    @property
    def is_measured(self) -> bool:
        """Whether frames of this layout are known to have these parts.

        Checksums and conditions of the parts may still fail.
        """
        return self.rule.within is None

    @property
    def has_checks(self) -> bool:
        """Whether any part has a checksum or conditions of its own."""
        return any(kind.is_checked for kind in self.kinds)

    def walked(
        self, buffer: NDArray[np.uint8], offsets: Offsets, stops: Offsets | None = None
    ) -> Walked:
        """Return the parts of the frames at these offsets.

        Args:
            stops: the offsets after their last bytes; by default the end of the buffer.
        """
        return _Walk(self, buffer, offsets + self.start, stops).walked()

    def in_rows(self, rows: Bytes2D) -> tuple[NDArray[np.uint8], Walked]:
        """The parts of whole frames, given as rows of bytes, and the buffer that they stand in."""
        return span(rows), self.walked(span(rows), np.arange(len(rows)) * rows.strides[0])

    def sound(self, frame: bytes) -> bool:
        """Whether the parts of one frame are sound, and as long as they have to be."""
        _, walked = self.in_rows(np.frombuffer(frame, np.uint8).reshape(1, -1))
        return (
            not walked.status[0]
            and walked.sizes[0] == self.size
            and all(layout.sound(data) for _, layout, data in self.listed(frame))
        )

    def listed(self, frame: bytes) -> list[tuple[Kind, Layout, bytes]]:
        """The parts of one frame: kind, layout and bytes of each."""
        _, walked = self.in_rows(np.frombuffer(frame, np.uint8).reshape(1, -1))
        pieces = ((piece, int(piece.spots[0])) for pieces in walked.rounds for piece in pieces)
        return [
            (self.kinds[piece.kind], piece.layout, frame[spot : spot + piece.layout.size])
            for piece, spot in pieces
        ]


class _Walk:
    """One walk through the parts of frames that begin at `starts` of a buffer."""

    def __init__(
        self, region: Region, buffer: NDArray[np.uint8], starts: Offsets, stops: Offsets | None
    ) -> None:
        self._region = region
        self._buffer = buffer
        self._starts = starts
        self._ends = starts.copy()
        self._stops = stops
        rule = region.rule
        room = region.limit - region.start
        self._rule = rule
        if rule.within is None:
            self._room = room
        else:
            self._room = min(room, rule.within)
        self._announced = np.full(len(starts), ANY if rule.size is None else rule.size)
        self._status = np.zeros(len(starts), np.uint8)
        self._errors = list[PluginError]()

    def walked(self) -> Walked:
        """What is found."""
        rounds = list[list[Piece]]()
        active = np.arange(len(self._starts))
        while len(active := self._going_on(active, len(rounds))):
            rounds.append(self._round(active))
        return Walked(self._status, self._ends - self._starts, rounds, tuple(self._errors))

    def _going_on(self, active: Offsets, number: int) -> Offsets:
        """The frames that have a further part."""
        if np.count_nonzero(self._status):
            active = active[self._status[active] == FOUND]
        if self._rule.count is not None:
            if number < self._rule.count:
                return active
            return active[:0]
        if self._rule.within is not None:
            active = active[self._ends[active] - self._starts[active] < self._rule.within]
        else:
            active = active[self._announced[active] != 0]
        return active

    def _round(self, active: Offsets) -> list[Piece]:
        """Find the next part of each frame.

        The first kind with the right constants, as far as the bytes go, takes it.
        """
        pieces = list[Piece]()
        for number, kind in enumerate(self._region.kinds):
            if not len(active):
                break
            held = self._right(active, kind.start)
            if held is not None and not np.count_nonzero(held):
                continue  # one of many kinds, that none of these parts is of
            if held is None:
                own = active
                others = [active[:0]]
            else:
                own = active[held]
                others = [active[~held]]
            seen = np.zeros(len(own), np.bool_)
            for layout, which in kind.layouts.classify(
                self._buffer, self._ends[own], self._stops_of(own)
            ):
                seen[which] = True
                if isinstance(layout, Refused):
                    self._refused(layout, own[which])
                    continue
                theirs = own[which]
                held = self._right(theirs, kind.further(layout))
                if held is not None:
                    others.append(theirs[~held])
                    theirs = theirs[held]
                theirs = self._whole(layout, self._measured(layout, theirs))
                if len(theirs):
                    pieces.append(Piece(number, layout, theirs, self._ends[theirs]))
                    self._taken(kind, layout, theirs)
            self._status[own[~seen]] = CUT_OFF
            if len(others) == 1:
                active = others[0]
            else:
                active = np.concatenate(others)
        self._status[active] = CONSTANT
        return pieces

    def _stops_of(self, which: Offsets) -> Offsets | None:
        if self._stops is None:
            return None
        return self._stops[which]

    def _right(self, which: Offsets, constants: tuple[Word, ...]) -> NDArray[np.bool_] | None:
        """In which frames constants of the next part are right, as `right_at` has it."""
        if constants:
            return right_at(self._buffer, self._ends[which], constants, self._stops_of(which))
        return None

    def _refused(self, refused: Refused, which: Offsets) -> None:
        if refused.error:
            self._status[which] = FAILED
        elif refused.by_constant:
            self._status[which] = CONSTANT
        else:
            self._status[which] = LENGTH
        self._errors += [refused.error] if refused.error else []

    def _measured(self, layout: Layout, which: Offsets) -> Offsets:
        """Those whose lengths are right, as far as the bytes go; the status of the others."""
        if layout.held:
            held = self._right(which, words(marks(layout.held)))
        else:
            held = None
        if held is None:
            return which
        self._status[which[~held]] = LENGTH
        return which[held]

    def _whole(self, layout: Layout, which: Offsets) -> Offsets:
        """Those that have their part whole, and as long as was said; the status of the others."""
        ends = self._ends[which] + layout.size
        announced = self._announced[which]
        wrong = (ends - self._starts[which] > self._room) | (layout.size == 0)
        cut_off = ends > (len(self._buffer) if self._stops is None else self._stops[which])
        other = (announced != ANY) & (announced != layout.size)
        if not (np.count_nonzero(wrong) or np.count_nonzero(cut_off) or np.count_nonzero(other)):
            return which
        self._status[which] = np.where(
            wrong, LENGTH, np.where(cut_off, CUT_OFF, np.where(other, LENGTH, FOUND))
        )
        which = which[self._status[which] == FOUND]
        return which

    def _taken(self, kind: Kind, layout: Layout, which: Offsets) -> None:
        """Go on behind parts of one layout."""
        formula = kind.node.following
        spots = self._ends[which]
        self._ends[which] = spots + layout.size
        if formula is None:
            return
        if isinstance(formula, tree.Ref) and formula.path in layout.leaves:
            announced = layout.leaves[formula.path].read(self._buffer, spots)[1].astype(np.int64)
        else:
            announced = np.array(
                [self._computed(kind, layout, formula, spot) for spot in spots.tolist()], np.int64
            )
        self._announced[which] = announced
        self._status[which[announced < 0]] = LENGTH

    def _computed(self, kind: Kind, layout: Layout, formula: tree.Formula, spot: int) -> int:
        """What a formula says in one part; -1 where it fails."""
        part = self._buffer[spot : spot + layout.size].tobytes()

        def read(path: str) -> int | None:
            if path.startswith("_."):
                return self._region.given[path[2:]]
            leaf = layout.leaves.get(path)
            if leaf is None:
                return None
            return leaf.scalar(part)

        try:
            return min(int(tree.evaluated(formula, read)), self._region.limit + 1)
        except Exception as error:
            self._errors.append(PluginError.of(error, "struct"))
            return -1


def right_at(
    buffer: NDArray[np.uint8],
    spots: Offsets,
    constants: tuple[Word, ...],
    stops: Offsets | None = None,
) -> NDArray[np.bool_] | None:
    """Return which candidates have the right constants, (n,); None if all have.

    Constants are compared as far as the bytes go, up to these `stops` or to the end of the buffer.
    """
    held: NDArray[np.bool_] | None = None
    for word in constants:
        spot, dtype, _, _ = word
        room = len(buffer) - spot - dtype.itemsize
        if bool((spots <= (room if stops is None else stops - spot - dtype.itemsize)).all()):
            windows: NDArray[Any] = np.ndarray((room + 1,), dtype, buffer.data, spot, (1,))
            each = equal(windows[spots], word)
        else:
            if stops is None:
                ends = [len(buffer)] * len(spots)
            else:
                ends = stops.tolist()
            parts = (
                buffer[at + spot : min(at + spot + dtype.itemsize, end)]
                for at, end in zip(spots.tolist(), ends, strict=True)
            )
            each = np.array([_begins(part.tobytes(), word) for part in parts], np.bool_)
        if np.count_nonzero(each) < len(each):
            held = each if held is None else held & each
    return held


def _begins(data: bytes, word: Word) -> bool:
    """Whether bytes are those of a constant, as far as they go."""
    mask, value = word[2:]
    every = (1 << 8 * len(data)) - 1
    return (
        int.from_bytes(data, "little") & every & (-1 if mask is None else int(mask))
        == int(value) & every
    )


@dataclass(frozen=True, eq=False)
class Measure:
    """The bytes of all parts, read like a field of the header."""

    info: tree.FieldInfo
    region: Region

    def read(
        self, buffer: NDArray[np.uint8], offsets: Offsets, stops: Offsets | None = None
    ) -> tuple[Offsets | None, NDArray[Any]]:
        """As `Leaf.read`; a negative number, of the status, for what cannot be a frame."""
        walked = self.region.walked(buffer, offsets, stops)
        values = np.where(walked.status == FOUND, walked.sizes, -walked.status.astype(np.int64))
        cut_off = walked.status == CUT_OFF
        if not np.count_nonzero(cut_off):
            return None, values
        is_all = cut_off & (
            offsets + self.region.limit <= (len(buffer) if stops is None else stops)
        )  # no frame is so long that more bytes would help
        values[is_all] = -LENGTH
        there = np.flatnonzero(~cut_off | is_all)
        return there, values[there]

    def of(self, frame: bytes | memoryview) -> int | None:
        """As `Leaf.of`."""
        values = self.read(np.frombuffer(frame, np.uint8), np.zeros(1, np.intp))[1]
        if len(values):
            return int(values[0])
        return None

    def load(self, rows: Bytes2D) -> NDArray[Any]:
        """As `Leaf.load`; -1 where parts are cut off."""
        walked = self.region.in_rows(rows)[1]
        return np.where(walked.status == FOUND, walked.sizes, -walked.status.astype(np.int64))
