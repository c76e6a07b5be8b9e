"""Check candidates of many lengths together.

Random bytes that look like a header can contain any length. A noisy stream can therefore have
candidates of hundreds of layouts, and checking each layout alone would be slow.

`LayoutFamilies` finds layouts that differ only in the length of an array at their end. The
candidates of these layouts become the rows of one array, which are as long as the longest
candidate. The results are the same as those of `plausibility.CandidateChecker`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarspec.frames.layout import Bytes2D, FrameChecksum, Layout, Leaf, Sums, gather_rows
from lidarspec.framing.plausibility import CandidateChecker, Check, LookupCondition
from lidarspec.framing.results import CHECKSUM, IMPLAUSIBLE, VALID
from lidarspec.spec.checksums import Checksum, Sum, WordXor, Xor

Bytes1D = NDArray[np.uint8]
Offsets = NDArray[np.intp]
Status = NDArray[np.uint8]
#: A layout and the indices of its candidates.
LayoutGroup = tuple[Layout, Offsets]
#: A function that returns the checker of a layout.
MakeChecker = Callable[[Layout], CandidateChecker]

#: Layouts are checked together if at least `MANY_LAYOUTS` layouts have fewer than `MANY_CANDIDATES`
#: candidates each.
MANY_LAYOUTS = 4
MANY_CANDIDATES = 16
#: The checksums that do not change if zeros are appended to the data.
ZERO_EXTENDED: tuple[type[Checksum], ...] = (Sum, WordXor, Xor)
#: The longest candidate in an array of rows is at most `MAX_STRETCH` times as long as the shortest,
#: or has at most `SHORT_ROW_BYTES`.
MAX_STRETCH = 4
SHORT_ROW_BYTES = 64
#: The maximum number of stored keys, so that random input does not fill the memory.
MAX_KEYS = 1024
#: The maximum size of the rows that are checked together, in bytes.
BLOCK_BYTES = 1 << 19


@dataclass(frozen=True)
class LayoutFamily:
    """A family of layouts, which differ only in the length of an array.

    Attributes:
        lengths: the length of the outermost array of each test; 0 for a test outside of arrays.
    """

    number: int
    lengths: tuple[int, ...]


class LayoutFamilies:
    """Finds layouts of a frame type that differ only in the length of an array."""

    def __init__(self) -> None:
        self._numbers: dict[Hashable, int] = {}
        self._next = itertools.count()

    def split(
        self, groups: list[LayoutGroup], make_checker: MakeChecker
    ) -> tuple[list[JointChecker], list[LayoutGroup]]:
        """Return checkers for groups that can be checked together, and the remaining groups."""
        if len(groups) < MANY_LAYOUTS:
            return [], groups
        left = list[LayoutGroup]()
        alike = dict[int, list[tuple[LayoutGroup, LayoutFamily]]]()
        for layout, which in groups:
            if len(which) < MANY_CANDIDATES:
                likeness = self.find_family(layout, make_checker(layout))
            else:
                likeness = None
            if likeness is None:
                left.append((layout, which))
            else:
                alike.setdefault(likeness.number, []).append(((layout, which), likeness))
        together = []
        for some in alike.values():
            some_groups, families = zip(*some, strict=True)
            if len(some) < MANY_LAYOUTS:
                left += some_groups
            else:
                together.append(JointChecker(some_groups, families, make_checker))
        return together, left

    def find_family(self, layout: Layout, checker: CandidateChecker) -> LayoutFamily | None:
        """Return the family of a layout; None if its candidates must be checked alone."""
        if self not in layout.notes:  # decoders of one frame type share its layouts
            layout.notes[self] = self._make_family(layout, checker)
        family: LayoutFamily | None = layout.notes[self]
        return family

    def _make_family(self, layout: Layout, checker: CandidateChecker) -> LayoutFamily | None:
        if layout.regions or not all(
            _ignores_trailing_zeros(checksum) for checksum in layout.checksums
        ):
            return None
        constants = tuple(sorted(layout.constants.items()))
        lengths = tuple(sorted(layout.held.items()))
        checksums = tuple(
            _make_checksum_key(checksum, layout.size) for checksum in layout.checksums
        )
        tests = tuple(_make_test_key(check) for check in checker.checks)
        key = constants, lengths, checksums, tests, checker.is_complete
        if key not in self._numbers:
            if len(self._numbers) >= MAX_KEYS:
                self._numbers.clear()
            self._numbers[key] = next(self._next)
        return LayoutFamily(self._numbers[key], tuple(map(_find_length, checker.checks)))


def _ignores_trailing_zeros(checksum: FrameChecksum) -> bool:
    """Return whether zeros after the covered bytes leave a checksum unchanged."""
    return type(checksum.algorithm) in ZERO_EXTENDED and bool(checksum.spans)


def _make_checksum_key(checksum: FrameChecksum, size: int) -> Hashable:
    *spans, (start, stop) = checksum.spans
    leaves = tuple(
        (
            _find_checksum_position(leaf, checksum, size),
            leaf.size,
            leaf.shape,
            leaf.wire,
            leaf.elements,
        )
        for leaf in checksum.leaves
    )
    return checksum.algorithm, checksum.absent, tuple(spans), start, size - stop, leaves


def _find_checksum_position(leaf: Leaf, checksum: FrameChecksum, size: int) -> tuple[str, int]:
    """Return the position of a checksum, counted from the start or the end of the frame."""
    if leaf.offset >= checksum.spans[-1][1]:
        return ("end", size - leaf.offset)
    return ("start", leaf.offset)


def _make_test_key(check: Check) -> Hashable:
    if isinstance(check, LookupCondition):
        return (check.table, check.offset, check.shape[1:], check.strides)
    return None


class JointChecker:
    """Checks the candidates of the layouts of one family.

    Attributes:
        which: the indices of all candidates, (n,).
        forms: the index of each candidate's layout, (n,).
        is_complete: whether `check` applies all checks. If not, the candidates that pass have to be
            checked layout by layout.
    """

    def __init__(
        self,
        groups: Sequence[LayoutGroup],
        families: Sequence[LayoutFamily],
        make_checker: MakeChecker,
    ) -> None:
        self.layouts = [layout for layout, _ in groups]
        self.which = np.concatenate([which for _, which in groups])
        self.forms = np.repeat(np.arange(len(groups)), [len(which) for _, which in groups])
        self._make_checker = make_checker
        self._sizes = np.array([layout.size for layout in self.layouts], np.intp)
        self._lengths = np.array([family.lengths for family in families], np.intp).T
        first = make_checker(self.layouts[0])
        self.is_complete = first.is_complete and all(
            isinstance(check, LookupCondition) for check in first.checks
        )

    def group_by_layout(self, chosen: NDArray[np.bool_]) -> list[LayoutGroup]:
        """Return the chosen candidates, grouped by layout.

        Args:
            chosen: a mask that selects the candidates in `self.which`, (n,).
        """
        found = (
            (layout, self.which[chosen & (self.forms == form)])
            for form, layout in enumerate(self.layouts)
        )
        return [(layout, which) for layout, which in found if len(which)]

    def check(
        self, buffer: Bytes1D, offsets: Offsets, forms: Offsets, sums: Sums | None = None
    ) -> Status:
        """Check complete candidates, and return their status, (k,).

        Args:
            offsets: the offset of each candidate, (k,).
            forms: the index of each candidate's layout, (k,).
        """
        status = np.empty(len(offsets), np.uint8)
        sizes = self._sizes[forms]
        for which in _iter_by_size(sizes):
            longest = forms[which[-1]].item()
            rows = _gather_rows(buffer, offsets[which], self.layouts[longest].size)
            status[which] = self._check_rows(rows, sizes[which], forms[which], longest, sums)
        return status

    def _check_rows(
        self, rows: Bytes2D, sizes: Offsets, forms: Offsets, longest: int, sums: Sums | None
    ) -> Status:
        """Check candidates in rows of the longest layout, and return their status, (n,)."""
        checker = self._make_checker(self.layouts[longest])
        status = np.zeros(len(rows), np.uint8)
        checker.check_constants(status, rows)
        for checksum in self.layouts[longest].checksums:
            right = _have_valid_checksums(checksum, rows, sizes, sums)
            status[~right & (status == VALID)] = CHECKSUM
        for index, check in enumerate(checker.checks):
            if isinstance(check, LookupCondition):
                right = check.holds_within(rows, self._lengths[index, forms])
                status[~right & (status == VALID)] = IMPLAUSIBLE
        return status


def _find_length(check: Check) -> int:
    """Return the length of the outermost array that a test covers; 0 without an array."""
    if isinstance(check, LookupCondition) and check.shape:
        return check.shape[0]
    return 0


def _iter_by_size(sizes: Offsets) -> Iterator[Offsets]:
    """Yield the indices of candidates in groups of similar size."""
    order = np.argsort(sizes, kind="stable")
    ordered = sizes[order]
    start = 0
    while start < len(order):
        longest = max(MAX_STRETCH * ordered.item(start), SHORT_ROW_BYTES)
        stop = int(ordered.searchsorted(longest, side="right"))
        stop = min(stop, start + max(BLOCK_BYTES // min(longest, ordered.item(stop - 1)), 1))
        yield order[start:stop]
        start = stop


def _gather_rows(buffer: Bytes1D, offsets: Offsets, size: int) -> Bytes2D:
    """Return rows of `size` bytes, one for each start offset, (n, size).

    Bytes after the end of the buffer are 0.
    """
    first = int(offsets.min())
    if int(offsets.max()) + size > len(buffer):
        buffer = np.concatenate([buffer[first:], np.zeros(size, np.uint8)])
        offsets = offsets - first
    return np.ascontiguousarray(gather_rows(buffer, offsets, size))


def _have_valid_checksums(
    checksum: FrameChecksum, rows: Bytes2D, sizes: Offsets, sums: Sums | None
) -> NDArray[np.bool_]:
    """Return whether each candidate has the right checksum, (n,).

    Args:
        checksum: the checksum in the longest layout.
        rows: the candidates, in rows of the size of the longest layout.
    """
    # The bytes after the covered bytes, such as the stored checksum, move to the end of the row.
    # Zeros fill the gap. They do not change the result of the algorithms in `ZERO_EXTENDED`.
    size = rows.shape[1]
    tail = size - checksum.spans[-1][1]
    stops = sizes - tail
    moved = rows * (np.arange(size) < stops[:, None])
    if tail:
        moved[:, size - tail :] = gather_rows(
            rows.reshape(-1), np.arange(len(rows)) * size + stops, tail
        )
    return checksum.are_valid(moved, sums)
