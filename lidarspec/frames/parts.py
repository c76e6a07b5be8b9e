"""Find the parts of many frames (frames within a frame) at once.

The search runs in rounds: each round finds the next part of every frame.
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
    LayoutRefusal,
    Leaf,
    Word,
    match_word,
    merge_constants,
    sort_constants,
    view_span,
)
from lidarspec.frames.measured_size import CUT_OFF, FOUND, LENGTH, MeasuredSize
from lidarspec.spec import tree

Offsets = NDArray[np.intp]

#: The status of a frame if the constants of a part match no kind of parts.
CONSTANT = 3
#: The status of a frame if an expression of a plugin failed.
FAILED = 4

#: The maximum number of bits of fields that are compared as columns of signed integers.
MAX_COLUMN_BITS = 63

#: The announced size of a part if no field outside the part declares it.
ANY_SIZE = -1


class LayoutLookup(Protocol):
    """Finds the layouts of a frame type or of a kind of parts."""

    root: tree.Node
    limit: int

    def classify(
        self, buffer: NDArray[np.uint8], offsets: Offsets, stops: Offsets | None = None
    ) -> list[tuple[Layout | LayoutRefusal, Offsets]]:
        """Return the candidates at these offsets, grouped by layout.

        Candidates with an incomplete header are left out.

        Args:
            stops: the end offset of each candidate; by default the end of the buffer.
        """

    def layout_for(self, read: Callable[[Leaf | MeasuredSize], int]) -> Layout:
        """Return the layout for the values of header fields, which `read` returns."""


@dataclass(frozen=True, eq=False)
class PartKind:
    """The layouts and constants of a kind of parts.

    Attributes:
        layouts: the layouts of the parts.
        prefix: the constants that all parts of this kind begin with, as (mask, value) by offset.
    """

    node: tree.Kind
    layouts: LayoutLookup
    prefix: Mapping[int, tuple[int, int]]

    @cached_property
    def start(self) -> tuple[Word, ...]:
        """The constants in `prefix`, merged into words that are compared at once."""
        return merge_constants(sort_constants(self.prefix))

    @cached_property
    def is_checked(self) -> bool:
        """Whether parts of this kind, or the parts in them, have checksums or conditions."""
        return any(
            isinstance(node, tree.ChecksummedStruct | tree.Check)
            or any(info.allowed for info in tree.infos(node))
            for node in tree.nodes(self.node.root)
        )

    def find_further_constants(self, layout: Layout) -> tuple[Word, ...]:
        """Return the constants of a layout that are not in `prefix`."""
        cached = layout.notes.get(PartKind)
        if cached is None:
            constants = {
                offset: constant
                for offset, constant in layout.constants.items()
                if self.prefix.get(offset) != constant
            }
            cached = layout.notes[PartKind] = merge_constants(sort_constants(constants))
        further: tuple[Word, ...] = cached
        return further


@dataclass(frozen=True)
class PartRule:
    """The number and the sizes of the parts that a header declares.

    If `count` and `within` are None, each part determines whether another part follows.

    Attributes:
        count: the number of parts; None if it is not declared.
        size: the size of the first part in bytes; None if it is not declared.
        within: the total size of all parts in bytes; None if it is not declared.
    """

    count: int | None = None
    size: int | None = None
    within: int | None = None


@dataclass(frozen=True, eq=False)
class PartRound:
    """Parts of one layout that one round of the search has found.

    Attributes:
        kind: the index of the kind of the parts.
        owners: the indices of the frames that contain the parts.
        offsets: the offsets of the parts in the buffer.
    """

    kind: int
    layout: Layout
    owners: Offsets
    offsets: Offsets


@dataclass(frozen=True, eq=False)
class FoundParts:
    """The parts of n frames.

    Attributes:
        status: `FOUND`, or the reason why not all parts were found, (n,).
        sizes: the total size of the parts that were found in each frame, in bytes, (n,).
        rounds: the parts that were found in each round of the search.
        errors: the errors of plugin expressions.
    """

    status: NDArray[np.uint8]
    sizes: Offsets
    rounds: Sequence[Sequence[PartRound]]
    errors: tuple[PluginError, ...] = ()


@dataclass(frozen=True, eq=False)
class Region:
    """The position of the parts in frames of one header variant.

    Attributes:
        kinds: the kinds of parts, in the order in which they are tried.
        start: the offset of the first part.
        rule: the rule that determines the last part.
        limit: the maximum size of a frame, in bytes.
        given: the values of fields of the outer frame that formulas of the parts use.
        size: the total size of all parts in bytes; None if it is not known yet.
    """

    node: tree.PartSequence
    kinds: tuple[PartKind, ...]
    start: int
    rule: PartRule
    limit: int
    given: Mapping[str, int]
    size: int | None = None

    @property
    def is_measured(self) -> bool:
        """Whether the total size of the parts is found by reading the parts."""
        return self.rule.within is None

    @property
    def has_checks(self) -> bool:
        """Whether any part has checksums or conditions."""
        return any(kind.is_checked for kind in self.kinds)

    def walk(
        self, buffer: NDArray[np.uint8], offsets: Offsets, stops: Offsets | None = None
    ) -> FoundParts:
        """Find the parts of the frames at these offsets of a buffer.

        Args:
            stops: the end offset of each frame; by default the end of the buffer.
        """
        return _PartWalk(self, buffer, offsets + self.start, stops).run()

    def find_parts(self, rows: Bytes2D) -> tuple[NDArray[np.uint8], FoundParts]:
        """Find the parts of frames given as rows of bytes.

        Returns:
            A buffer with the bytes of the frames, and the parts in this buffer.
        """
        return view_span(rows), self.walk(view_span(rows), np.arange(len(rows)) * rows.strides[0])

    def is_valid(self, frame: bytes) -> bool:
        """Return whether all parts of one frame are valid and fill the region exactly."""
        _, walked = self.find_parts(np.frombuffer(frame, np.uint8).reshape(1, -1))
        return (
            not walked.status[0]
            and walked.sizes[0] == self.size
            and all(layout.is_valid(data) for _, layout, data in self.list_parts(frame))
        )

    def list_parts(self, frame: bytes) -> list[tuple[PartKind, Layout, bytes]]:
        """Return kind, layout and bytes of each part of one frame."""
        _, walked = self.find_parts(np.frombuffer(frame, np.uint8).reshape(1, -1))
        pieces = ((piece, int(piece.offsets[0])) for pieces in walked.rounds for piece in pieces)
        return [
            (self.kinds[piece.kind], piece.layout, frame[offset : offset + piece.layout.size])
            for piece, offset in pieces
        ]


class _PartWalk:
    """A search for the parts of frames in a buffer.

    Args:
        starts: the offset of the first part of each frame.
        stops: the end offset of each frame; by default the end of the buffer.
    """

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
        self._announced = np.full(len(starts), ANY_SIZE if rule.size is None else rule.size)
        self._status = np.zeros(len(starts), np.uint8)
        self._errors = list[PluginError]()

    def run(self) -> FoundParts:
        """Find all parts, round by round."""
        rounds = list[list[PartRound]]()
        active = np.arange(len(self._starts))
        while len(active := self._select_unfinished(active, len(rounds))):
            rounds.append(self._find_next_parts(active))
        return FoundParts(self._status, self._ends - self._starts, rounds, tuple(self._errors))

    def _select_unfinished(self, active: Offsets, number: int) -> Offsets:
        """Return the frames that have a further part."""
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

    def _find_next_parts(self, active: Offsets) -> list[PartRound]:
        """Find the next part of each frame."""
        pieces = list[PartRound]()
        for number, kind in enumerate(self._region.kinds):
            if not len(active):
                break
            matches = self._match_constants(active, kind.start)
            if matches is not None and not np.count_nonzero(matches):
                continue  # no part in this round is of this kind
            if matches is None:
                own = active
                others = [active[:0]]
            else:
                own = active[matches]
                others = [active[~matches]]
            has_header = np.zeros(len(own), np.bool_)
            for layout, which in kind.layouts.classify(
                self._buffer, self._ends[own], self._select_stops(own)
            ):
                has_header[which] = True
                if isinstance(layout, LayoutRefusal):
                    self._set_refusal(layout, own[which])
                    continue
                owners = own[which]
                matches = self._match_constants(owners, kind.find_further_constants(layout))
                if matches is not None:
                    others.append(owners[~matches])
                    owners = owners[matches]
                owners = self._check_bounds(layout, self._check_declared_sizes(layout, owners))
                if len(owners):
                    pieces.append(PartRound(number, layout, owners, self._ends[owners]))
                    self._advance(kind, layout, owners)
            self._status[own[~has_header]] = CUT_OFF
            if len(others) == 1:
                active = others[0]
            else:
                active = np.concatenate(others)
        self._status[active] = CONSTANT
        return pieces

    def _select_stops(self, which: Offsets) -> Offsets | None:
        if self._stops is None:
            return None
        return self._stops[which]

    def _match_constants(
        self, which: Offsets, constants: tuple[Word, ...]
    ) -> NDArray[np.bool_] | None:
        """Return whether the next part of each frame has the constants; None if all have."""
        if constants:
            return match_constants_at(
                self._buffer, self._ends[which], constants, self._select_stops(which)
            )
        return None

    def _set_refusal(self, refused: LayoutRefusal, which: Offsets) -> None:
        if refused.error:
            self._status[which] = FAILED
        elif refused.has_wrong_constant:
            self._status[which] = CONSTANT
        else:
            self._status[which] = LENGTH
        self._errors += [refused.error] if refused.error else []

    def _check_declared_sizes(self, layout: Layout, which: Offsets) -> Offsets:
        """Return the frames in whose next part the size fields agree with the layout."""
        if not layout.held:
            return which
        matches = self._match_constants(which, merge_constants(sort_constants(layout.held)))
        if matches is None:
            return which
        self._status[which[~matches]] = LENGTH
        return which[matches]

    def _check_bounds(self, layout: Layout, which: Offsets) -> Offsets:
        """Return the frames in which the next part is complete and has the right size."""
        ends = self._ends[which] + layout.size
        announced = self._announced[which]
        wrong = (ends - self._starts[which] > self._room) | (layout.size == 0)
        cut_off = ends > (len(self._buffer) if self._stops is None else self._stops[which])
        other = (announced != ANY_SIZE) & (announced != layout.size)
        if not (np.count_nonzero(wrong) or np.count_nonzero(cut_off) or np.count_nonzero(other)):
            return which
        self._status[which] = np.where(
            wrong, LENGTH, np.where(cut_off, CUT_OFF, np.where(other, LENGTH, FOUND))
        )
        which = which[self._status[which] == FOUND]
        return which

    def _advance(self, kind: PartKind, layout: Layout, which: Offsets) -> None:
        """Move to the end of parts that have one layout, and read the size of the next part."""
        formula = kind.node.following
        offsets = self._ends[which]
        self._ends[which] = offsets + layout.size
        if kind.node.until is not None:
            is_last = self._evaluate_all(layout, kind.node.until, offsets)
            self._announced[which] = np.where(is_last == 0, ANY_SIZE, 0)
            self._status[which[is_last < 0]] = FAILED
            return
        if formula is None:
            return
        announced = self._evaluate_all(layout, formula, offsets)
        self._announced[which] = announced
        self._status[which[announced < 0]] = LENGTH

    def _evaluate_all(
        self, layout: Layout, formula: tree.Formula, offsets: Offsets
    ) -> NDArray[np.int64]:
        """Return the value of a formula for the part at each offset, (n,).

        The value is -1 if the formula raises an error.
        """
        asked = tree.refs(formula)
        is_simple = isinstance(formula, tree.Ref) or (
            isinstance(formula, tree.Op) and all(map(_fits_columns, tree.iter_subformulas(formula)))
        )
        if is_simple and all(
            ref.path in layout.leaves and ref.info.bits <= MAX_COLUMN_BITS for ref in asked
        ):
            columns = {
                ref.path: layout.leaves[ref.path].read(self._buffer, offsets)[1].astype(np.int64)
                for ref in asked
            }
            values = tree.evaluate_arrays(formula, columns, np.int64)
            return np.broadcast_to(values, len(offsets)).astype(np.int64)
        return np.array(
            [self._evaluate(layout, formula, offset) for offset in offsets.tolist()],
            np.int64,
        )

    def _evaluate(self, layout: Layout, formula: tree.Formula, offset: int) -> int:
        """Return the value of a formula in one part; -1 if the formula raises an error."""
        part = self._buffer[offset : offset + layout.size].tobytes()

        def read(path: str) -> int | None:
            if path.startswith("_."):
                return self._region.given[path[2:]]
            leaf = layout.leaves.get(path)
            if leaf is None:
                return None
            return leaf.read_scalar(part)

        try:
            return min(int(tree.evaluate(formula, read)), self._region.limit + 1)
        except Exception as error:
            self._errors.append(PluginError.of(error, "struct"))
            return -1


def _fits_columns(formula: tree.Formula) -> bool:
    """Return whether the value of an operand is exact in 64-bit columns."""
    if isinstance(formula, tree.Op):
        return formula.symbol in tree.COMPARISONS
    return not isinstance(formula, int) or abs(formula) < 1 << MAX_COLUMN_BITS


def match_constants_at(
    buffer: NDArray[np.uint8],
    offsets: Offsets,
    constants: tuple[Word, ...],
    stops: Offsets | None = None,
) -> NDArray[np.bool_] | None:
    """Return whether each candidate has these constants, (n,); None if all have them.

    In a truncated candidate, only the available bytes are compared.

    Args:
        stops: the end offset of each candidate; by default the end of the buffer.
    """
    matches: NDArray[np.bool_] | None = None
    for word in constants:
        position, dtype, _, _ = word
        room = len(buffer) - position - dtype.itemsize
        if bool((offsets <= (room if stops is None else stops - position - dtype.itemsize)).all()):
            windows: NDArray[Any] = np.ndarray((room + 1,), dtype, buffer.data, position, (1,))
            each = match_word(windows[offsets], word)
        else:
            if stops is None:
                ends = [len(buffer)] * len(offsets)
            else:
                ends = stops.tolist()
            parts = (
                buffer[start + position : min(start + position + dtype.itemsize, end)]
                for start, end in zip(offsets.tolist(), ends, strict=True)
            )
            each = np.array([_is_start_of(part.tobytes(), word) for part in parts], np.bool_)
        if np.count_nonzero(each) < len(each):
            matches = each if matches is None else matches & each
    return matches


def _is_start_of(data: bytes, word: Word) -> bool:
    """Return whether bytes match the first bytes of a constant."""
    mask, value = word[2:]
    every = (1 << 8 * len(data)) - 1
    return (
        int.from_bytes(data, "little") & every & (-1 if mask is None else int(mask))
        == int(value) & every
    )


@dataclass(frozen=True, eq=False)
class PartsSize(MeasuredSize):
    """The total size of the parts of a region."""

    region: Region

    @property
    def known(self) -> int | None:
        return self.region.size

    def read(
        self, buffer: NDArray[np.uint8], offsets: Offsets, stops: Offsets | None = None
    ) -> tuple[Offsets | None, NDArray[Any]]:
        walked = self.region.walk(buffer, offsets, stops)
        values = np.where(walked.status == FOUND, walked.sizes, -walked.status.astype(np.int64))
        cut_off = walked.status == CUT_OFF
        if not np.count_nonzero(cut_off):
            return None, values
        # These frames already have as many bytes as the longest frame.
        is_too_long = cut_off & (
            offsets + self.region.limit <= (len(buffer) if stops is None else stops)
        )
        values[is_too_long] = -LENGTH
        there = np.flatnonzero(~cut_off | is_too_long)
        return there, values[there]

    def load(self, rows: Bytes2D) -> NDArray[Any]:
        walked = self.region.find_parts(rows)[1]
        return np.where(walked.status == FOUND, walked.sizes, -walked.status.astype(np.int64))
