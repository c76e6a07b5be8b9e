"""Find and check the candidates in a piece of a stream.

A candidate is an offset at which the constants of a frame type match. A type that is declared with
`after` is active only after a frame of another type, so the active types may change with every
frame. So that a change does not require further checks, all candidates of one type in a piece are
checked together, when the type first becomes active. For a weak type (`confirm` > 1), only the
first frame of each run is a candidate (`weak_frames`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import PluginError
from lidarspec.frames.arrays import repeat
from lidarspec.frames.layout import Marks, Sums, merge_constants
from lidarspec.framing.frame_codec import Codec
from lidarspec.framing.results import CONSTANT, COUNTERS_BY_STATUS, PLUGIN, SHORT, VALID, Frames
from lidarspec.framing.weak_frames import WeakRuns, find_runs

#: The maximum number of candidates of one type in a piece. A piece with more candidates is
#: shortened, so that memory is limited.
MAX_CANDIDATES = 1 << 15
#: The number of constants of a type that are compared at every offset. Two constants exclude nearly
#: all offsets. Types with equal constants share the result.
SHARED_MARKS = 2
#: The maximum number of types that are filtered together, which is the number of bits of an
#: integer.
MAX_TYPES = 64

Bytes1D = NDArray[np.uint8]
Offsets = NDArray[np.intp]


@dataclass
class SearchState:
    """The state of the search that is kept between the pieces of a stream.

    Attributes:
        after: the name of the frame type that last changed the active types; None at first.
        changed: the stream offset at which the active types last changed.
        run: the name of the weak type of the last accepted run.
        run_end: the stream offset of the end of this run.
        size: the size of the last frame in bytes.
        is_steady: whether the last frames had this size and no bytes between them.
    """

    after: str | None = None
    changed: float = -math.inf
    run: str | None = None
    run_end: int = -1
    size: int = 0
    is_steady: bool = True


@dataclass
class PieceResult:
    """The result for one piece of a stream.

    Attributes:
        frames: the accepted frames; their offsets count from the start of the piece.
        end: the offset at which the next search must start. All bytes before it are decided.
        is_waiting: whether more bytes are required to decide about the candidate at `end`.
        need: the number of bytes that the next search requires, counted from `end`; 0 if unknown.
        rejected: the number of rejected candidates, by the name of the counter.
        errors: the exceptions that plugin code has raised.
    """

    frames: Frames
    end: int
    is_waiting: bool = False
    need: int = 0
    rejected: dict[str, int] = field(default_factory=dict)
    errors: list[PluginError] = field(default_factory=list)

    def reject(self, numbers: Sequence[int], errors: Sequence[PluginError]) -> None:
        """Count rejected candidates.

        Args:
            numbers: the number of candidates with each status.
        """
        for reason, number in enumerate(numbers):
            name = COUNTERS_BY_STATUS.get(reason)
            if number and name:
                self.rejected[name] = self.rejected.get(name, 0) + number
                if reason == PLUGIN:
                    self.errors += errors[:1]


class Framing:
    """The frame types of one stream, prepared for searching.

    Args:
        codecs: the codecs of the incoming frame types by name. If several types match at one
            offset, the first one in this order is used.
    """

    def __init__(self, codecs: Mapping[str, Codec], sums: Sums | None = None) -> None:
        self.names = tuple(codecs)
        self.codecs = list(codecs.values())
        self.sums = sums
        self.named = {codec.frame.after for codec in self.codecs} - {None}
        self.marks = [codec.marks for codec in self.codecs]
        self.words = [merge_constants(marks) for marks in self.marks]
        #: The number of bytes up to the end of the last constant of each type.
        self.ends = [
            max((offset + dtype.itemsize for offset, dtype, _, _ in own), default=0)
            for own in self.words
        ]
        lengths = [codec.frame.max_length for codec in self.codecs]
        #: The maximum number of bytes that are required to decide about one candidate.
        self.reach = max(lengths) + max(
            codec.frame.max_length * codec.frame.confirm for codec in self.codecs
        )
        self._weak = {kind for kind, codec in enumerate(self.codecs) if codec.frame.confirm > 1}
        self.has_weak_types = bool(self._weak)
        self._active: dict[str | None, list[int]] = {}
        self._filters: dict[tuple[int, ...], ConstantFilter] = {}

    def active_types(self, state: SearchState) -> list[int]:
        """Return the indices of the active types, in order."""
        active = self._active.get(state.after)
        if active is None:
            active = [
                kind
                for kind, codec in enumerate(self.codecs)
                if codec.frame.after in (None, state.after)
            ]
            self._active[state.after] = active
        return active

    def filter(self, kinds: Sequence[int]) -> ConstantFilter:
        """Return a filter by the constants of some types."""
        key = tuple(kinds)
        if key not in self._filters:
            self._filters[key] = ConstantFilter([self.marks[kind][SHARED_MARKS:] for kind in key])
        return self._filters[key]

    def is_weak(self, kind: int) -> bool:
        """Return whether frames of a type are accepted only in runs."""
        return kind in self._weak

    def switches(self, kind: int, state: SearchState) -> bool:
        """Return whether a frame of a type changes the active types."""
        return self.names[kind] in self.named and self.names[kind] != state.after

    def find_switching_types(self, state: SearchState) -> NDArray[np.bool_]:
        """Return whether each frame type changes the active types, (types + 1,).

        The last value is False, for the kind -1 of data that is not a frame.
        """
        return np.array([*(self.switches(kind, state) for kind in range(len(self.names))), False])

    def survey(
        self,
        kind: int,
        buffer: Bytes1D,
        offsets: Offsets,
        stops: Offsets | None = None,
        *,
        gathered: bool = True,
    ) -> Frames:
        """Check the candidates of a type at these offsets.

        Args:
            offsets: offsets at which the constants of the type match.
            stops: the end offset of each candidate; by default the end of the buffer.
            gathered: whether the bytes of the candidates are copied to `Frames.rows`.

        Returns:
            The candidates, each with its layout and its status.
        """
        return self.codecs[kind].survey(
            buffer, offsets, stops, kind=kind, gathered=gathered, sums=self.sums
        )


def find_by_constants(buffer: Bytes1D, constants: Marks) -> Offsets:
    """Return the offsets at which the constants match, in ascending order.

    A constant beyond the end of the buffer counts as matching.

    Args:
        constants: one or two constants.
    """
    match: NDArray[np.bool_] | None = None
    for position, mask, value in constants:
        values = buffer[position:]
        if mask != 0xFF:
            values = values & np.uint8(mask)
        is_right = values == np.uint8(value)
        if match is None and position == 0:
            match = is_right
            continue
        if match is None:
            match = np.ones(len(buffer), np.bool_)
        inside = match[: len(is_right)]
        inside &= is_right
    if match is None:
        return np.arange(len(buffer))
    return np.flatnonzero(match)


class ConstantFilter:
    """Finds the offsets at which the constants of types match, for several types at once.

    Args:
        constants: the constants of each type, for at most `MAX_TYPES` types.
    """

    def __init__(self, constants: Sequence[Marks]) -> None:
        # A set of types is an integer with one bit for each type. For each
        # offset at which a frame has a constant, a table contains the set of types that allow each
        # value of the byte.
        self._all_types = np.uint64((1 << len(constants)) - 1)
        self._tables: dict[int, NDArray[np.uint64]] = {}
        for number, marks in enumerate(constants):
            for offset, mask, value in marks:
                table = self._tables.setdefault(offset, np.full(256, self._all_types))
                table[np.arange(256) & mask != value] &= ~np.uint64(1 << number)

    def group_by_type(self, buffer: Bytes1D, offsets: Offsets) -> dict[int, Offsets]:
        """Return the offsets at which the constants of each type match, by type index.

        Constants beyond the end of the buffer count as matching. Types without matches are left
        out.

        Args:
            offsets: the offsets to test, ascending.
        """
        if not self._tables:
            return dict.fromkeys(range(int(self._all_types).bit_length()), offsets)
        types = np.full(len(offsets), self._all_types)
        for position, table in self._tables.items():
            inside = int(offsets.searchsorted(len(buffer) - position))
            types[:inside] &= table[buffer[offsets[:inside] + position]]
        is_any = types != 0
        if not is_any.all():
            types = types[is_any]
            offsets = offsets[is_any]
        present = int(np.bitwise_or.reduce(types))
        return {
            number: offsets[(types & np.uint64(1 << number)) != 0]
            for number in range(present.bit_length())
            if present >> number & 1
        }


@dataclass(frozen=True, eq=False)
class LiveCandidates:
    """The candidates of a piece that may be accepted with one set of active types.

    Attributes:
        frames: the valid and incomplete candidates, sorted by offset, at most one at each offset.
        ends: the end offset of each candidate, (n,); for the first frame of a run, the end of the
            run.
        runs: the runs of each weak type, by type index.
    """

    frames: Frames
    ends: Offsets
    runs: dict[int, WeakRuns]


class Candidates:
    """The candidates in a piece of a stream.

    Args:
        state: the search state at the start of the buffer.
        final: whether no more bytes follow, so that incomplete candidates are rejected.

    Attributes:
        buffer: the bytes to search. If the piece has too many candidates, these are only the first
            bytes of the piece; the other bytes are searched in the next piece.
        is_whole: whether `buffer` is the whole piece.
        checked: the checked candidates of each type that was searched so far, by type index.
    """

    def __init__(
        self, framing: Framing, buffer: Bytes1D, state: SearchState, *, final: bool
    ) -> None:
        self._framing = framing
        self.buffer = buffer
        if not all(framing.marks[kind] for kind in framing.active_types(state)):
            self.buffer = buffer[: max(MAX_CANDIDATES, framing.reach)]  # each offset is one
        self._offsets_by_prefix: dict[Marks, Offsets] = {}
        self.checked: dict[int, Frames] = {}
        self._live: dict[int, Frames] = {}
        self._waiting: dict[int, list[int]] = {}
        self._known: set[int] = set()
        offsets_by_kind = self._find_by_type(state)
        limit = min(
            (
                int(offsets[MAX_CANDIDATES])
                for offsets in offsets_by_kind.values()
                if len(offsets) > MAX_CANDIDATES
            ),
            default=len(self.buffer),
        )
        if limit < len(self.buffer):
            self.buffer = self.buffer[: max(limit, framing.reach)]
            self._offsets_by_prefix.clear()
            offsets_by_kind = {
                kind: offsets[: int(np.searchsorted(offsets, len(self.buffer)))]
                for kind, offsets in offsets_by_kind.items()
            }
        self.is_whole = len(self.buffer) == len(buffer)
        self.final = final and self.is_whole
        self._check(offsets_by_kind)

    def find_live(self, state: SearchState) -> LiveCandidates | None:
        """Return the candidates of the active types that may be accepted.

        Returns None if there are too many candidates.
        """
        offsets_by_kind = self._find_by_type(state)
        if any(len(offsets) > MAX_CANDIDATES for offsets in offsets_by_kind.values()):
            return None
        self._check(offsets_by_kind)
        parts = list[Frames]()
        all_runs = dict[int, WeakRuns]()
        active = self._framing.active_types(state)
        for kind in active:
            own = self.checked.get(kind)
            if own is None:
                continue
            if self._framing.is_weak(kind):
                runs = find_runs(
                    own,
                    self._merge([*parts, *self._find_waiting(active[: active.index(kind)])]),
                    confirm=self._framing.codecs[kind].frame.confirm,
                    is_single=self._framing.switches(kind, state),
                    final=self.final,
                )
                all_runs[kind] = runs
                own = runs.heads
            elif kind in self._live:
                own = self._live[kind]
            else:
                own = self._live[kind] = select_live(own, final=self.final)
            parts.append(own)
        frames = self._merge([*parts, *self._find_waiting(active)])
        ends = frames.starts + frames.sizes
        for kind, runs in all_runs.items():
            is_own = frames.kinds == kind
            ends[is_own] = runs.ends[runs.frames.starts.searchsorted(frames.starts[is_own])]
        return LiveCandidates(frames, ends, all_runs)

    def _merge(self, parts: Sequence[Frames]) -> Frames:
        if parts:
            return merge_by_offset(parts)
        return Frames.make_empty(self.buffer)

    def _find_waiting(self, kinds: Sequence[int]) -> list[Frames]:
        """Return the candidates of these types whose last constant has not arrived yet."""
        first_kinds: dict[int, int] = {}
        for kind in reversed(kinds):
            first_kinds |= dict.fromkeys(self._waiting.get(kind, ()), kind)
        if not first_kinds:
            return []
        starts = np.array(sorted(first_kinds), np.intp)
        number = len(starts)
        return [
            Frames(
                self.buffer,
                np.array([first_kinds[start] for start in starts.tolist()], np.intp),
                starts,
                repeat(0, number),
                status=repeat(SHORT, number),
            )
        ]

    def _find_by_type(self, state: SearchState) -> dict[int, Offsets]:
        """Return the offsets of candidates of newly active types, by type index."""
        groups: dict[Marks, list[int]] = {}
        for kind in self._framing.active_types(state):
            if kind not in self._known:
                groups.setdefault(self._framing.marks[kind][:SHARED_MARKS], []).append(kind)
        offsets_by_kind: dict[int, Offsets] = {}
        for begin, kinds in groups.items():
            if begin not in self._offsets_by_prefix:
                self._offsets_by_prefix[begin] = find_by_constants(self.buffer, begin)
            offsets = self._offsets_by_prefix[begin]
            if not len(offsets):
                offsets_by_kind |= dict.fromkeys(kinds, offsets)
                continue
            for first in range(0, len(kinds), MAX_TYPES):
                some = kinds[first : first + MAX_TYPES]
                matching = self._framing.filter(some).group_by_type(self.buffer, offsets)
                offsets_by_kind |= {
                    kind: matching.get(index, offsets[:0]) for index, kind in enumerate(some)
                }
        return offsets_by_kind

    def _check(self, offsets_by_kind: Mapping[int, Offsets]) -> None:
        self._known |= offsets_by_kind.keys()
        for kind, offsets in offsets_by_kind.items():
            number = self._count_checkable(kind, offsets)
            self._waiting[kind] = offsets[number:].tolist()
            if not number:
                continue
            own = self._framing.survey(kind, self.buffer, offsets[:number])
            if not own.is_all_valid:
                is_right = own.status != CONSTANT
                own = own if is_right.all() else own.select(is_right)
            self.checked[kind] = own

    def _count_checkable(self, kind: int, offsets: Offsets) -> int:
        """Return how many candidates have arrived up to the last constant of their type."""
        if not len(offsets) or self.final or self._framing.is_weak(kind):
            return len(offsets)
        last = len(self.buffer) - self._framing.ends[kind]
        return int(offsets.searchsorted(last, "right"))


def select_live(candidates: Frames, *, final: bool) -> Frames:
    """Return the valid candidates, and the incomplete candidates if not `final`."""
    if candidates.is_all_valid:
        return candidates
    is_live = candidates.status <= (VALID if final else SHORT)
    number = np.count_nonzero(is_live)
    if number == len(candidates):
        return candidates
    if not number:
        return Frames.make_empty(candidates.buffer)
    return candidates.select(is_live)


def merge_by_offset(candidates: Sequence[Frames]) -> Frames:
    """Merge the valid and incomplete candidates of several types, sorted by offset.

    If there are several candidates at one offset, the type that is declared first is kept.
    """
    parts = [own for own in candidates if len(own)]
    if not parts:
        return Frames.make_empty(candidates[0].buffer)
    live = Frames.join(parts)
    if len(parts) == 1:
        return live
    order = np.lexsort((live.kinds, live.starts))
    is_first = np.diff(live.starts[order], prepend=-1) > 0
    return live.select(order[is_first])
