"""Sample frames of an unknown format, with possible places of a checksum."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lidarspec.frames.row_checksums import compute_checksums
from lidarspec.spec.checksums import ByteOrder, Checksum

Part = Literal["all", "before", "behind"]

#: Maximum length of frames that are searched at every offset, and the distance from both ends at
#: which longer ones are searched.
SHORT = 64
NEAR = 12
#: Maximum number of first bytes that a checksum at the end may omit, and its distance from the end.
HEAD = 6
TAIL = 4
#: Minimum range of the values of each byte of a checksum, and the weight of the usual place.
APART = 96
USUAL = 1.1
#: Minimum share of frames with a valid checksum: some may be damaged.
ENOUGH = 0.6
#: Bits of evidence at which a match ends the search: one in a million wrong guesses reaches it.
SURE = 20


@dataclass(frozen=True)
class ChecksumPlace:
    """The place of a checksum: `size` bytes from `offset` on.

    A negative offset counts from the end of the frame.
    """

    offset: int
    size: int

    def start(self, length: int) -> int:
        """Return the offset in a frame of this length."""
        if self.offset < 0:
            return self.offset + length
        return self.offset

    def __str__(self) -> str:
        if self.offset == -self.size:
            if self.size > 1:
                return f"the last {self.size} bytes"
            return "the last byte"
        if self.offset < 0:
            where = f"{-self.offset} before the end"
        else:
            where = f"at byte {self.offset}"
        return f"{self.size} byte{'s' * (self.size > 1)} {where}"


@dataclass(frozen=True)
class CoveredSpan:
    """The bytes that a checksum covers: before its place, behind it, or both.

    The first `head` and the last `tail` bytes are omitted.
    """

    part: Part = "all"
    head: int = 0
    tail: int = 0

    def ranges(self, place: ChecksumPlace, length: int) -> list[tuple[int, int]]:
        """Return the byte ranges in a frame of this length."""
        start = place.start(length)
        end = start + place.size
        before = (self.head, start)
        behind = (end + (self.head if self.part == "behind" else 0), length - self.tail)
        chosen = {"all": [before, behind], "before": [before], "behind": [behind]}[self.part]
        return [(first, last) for first, last in chosen if last > first]

    def describe(self, place: ChecksumPlace, length: int) -> str:
        """Describe the bytes in words."""
        if (self.part, self.head, self.tail) == ("all", 0, 0) or sum(
            b - a for a, b in self.ranges(place, length)
        ) == length - place.size:
            return "all other bytes"
        if self.part == "before":
            return f"bytes {self.head} up to the checksum"
        if self.part == "behind":
            return f"all bytes from {self.head} after the checksum" + (
                f" except the last {self.tail}" if self.tail else ""
            )
        return f"all other bytes except the first {self.head}" + (
            f" and the last {self.tail}" if self.tail else ""
        )


@dataclass(frozen=True)
class ChecksumMatch:
    """A checksum that matches.

    Attributes:
        algorithm: the algorithm.
        place, span, order: its place, covered bytes, and byte order.
        right, total: number of frames with a valid checksum, and of all.
        doubt: bits of evidence: one of 2**doubt wrong checksums would match as well by chance.
        paste: the Python source of the algorithm.
        remarks: further remarks.
        name: its name in the catalogue.
        open: whether other parameters match these frames as well.
        varied: the variation of its place, as from `SampleFrames.measure_variation`.
    """

    algorithm: Checksum
    place: ChecksumPlace
    span: CoveredSpan
    order: ByteOrder
    right: int
    total: int
    doubt: float
    paste: str
    remarks: tuple[str, ...] = ()
    name: str = ""
    open: bool = False
    varied: float = 0.0

    @property
    def odds(self) -> str:
        """The number of wrong checksums for each accidental match, as a power of ten."""
        return f"1e+{int(self.doubt * np.log10(2)):02}"

    @property
    def sure(self) -> bool:
        """Whether the search can end.

        The match is certain, and the checksum is at an end or covers all other bytes, or all but a
        header.
        """
        at_end = self.place.offset < 0 and self.place.offset + self.place.size == 0
        return (
            self.doubt >= SURE
            and not self.open
            and ((self.span.part, self.span.tail) == ("all", 0) or at_end)
        )


def values(rows: NDArray[np.uint8], offset: int, size: int, order: ByteOrder) -> NDArray[np.int64]:
    """Return the values at a place in each row, (n,); at most 7 bytes."""
    columns = rows[:, offset : offset + size].astype(np.int64)
    shifts = 8 * np.arange(size, dtype=np.int64)
    total: NDArray[np.int64] = (columns << (shifts if order == "little" else shifts[::-1])).sum(
        axis=1
    )
    return total


class SampleFrames:
    """Distinct frames, grouped by length."""

    def __init__(self, frames: Iterable[bytes], *, most: int = 256) -> None:
        distinct = list(dict.fromkeys(frame for frame in frames if frame))[:most]
        self.frames: list[bytes] = sorted(distinct, key=len)
        groups = (list(group) for _, group in itertools.groupby(self.frames, len))
        self.groups: list[NDArray[np.uint8]] = [
            np.frombuffer(b"".join(group), np.uint8).reshape(len(group), -1) for group in groups
        ]
        # The same fields are read for each algorithm that is tried.
        self._fields: dict[tuple[ChecksumPlace, ByteOrder], NDArray[np.uint64]] = {}

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def shortest(self) -> int:
        """The length of the shortest frame."""
        if self.frames:
            return len(self.frames[0])
        return 0

    def take_spread(self, number: int) -> SampleFrames:
        """Return `number` frames, spread over all of them."""
        step = max(1, len(self.frames) // number)
        return SampleFrames(self.frames[::step][:number])

    def take_similar(self, number: int, pick: int) -> SampleFrames:
        """Return `number` frames of the most frequent length, and two of other lengths.

        Args:
            number: also the maximum number of other lengths.
            pick: selects different frames.
        """
        largest = max(self.groups, key=len)
        step = max(1, len(largest) // number)
        others = [
            group[2 * pick % len(group) :][:2] for group in self.groups if group is not largest
        ][:number]
        return SampleFrames(
            row.tobytes()
            for rows in (largest[pick % step :: step][:number], *others)
            for row in rows
        )

    def fields(self, place: ChecksumPlace, order: ByteOrder) -> NDArray[np.uint64]:
        """Return the values at a place in each frame, (n,)."""
        if (place, order) not in self._fields:
            columns = [
                values(group, place.start(group.shape[1]), place.size, order)
                for group in self.groups
            ]
            self._fields[place, order] = np.concatenate(columns).view(np.uint64)
        return self._fields[place, order]

    def cut_span(self, place: ChecksumPlace, span: CoveredSpan) -> list[NDArray[np.uint8]]:
        """Return the bytes that a span covers, group by group: (frames, bytes) each."""
        return [
            np.concatenate([group[:, a:b] for a, b in span.ranges(place, group.shape[1])], axis=1)
            for group in self.groups
        ]

    def compute_checksums(
        self, algorithm: Checksum, place: ChecksumPlace, span: CoveredSpan
    ) -> NDArray[np.uint64]:
        """Return the checksum of each frame, (n,)."""
        return np.concatenate(
            [
                compute_checksums(algorithm, np.ascontiguousarray(rows))
                for rows in self.cut_span(place, span)
            ]
        )

    def count_valid(
        self, algorithm: Checksum, place: ChecksumPlace, span: CoveredSpan, order: ByteOrder
    ) -> int:
        """Return the number of frames with a valid checksum."""
        return int(
            (self.compute_checksums(algorithm, place, span) == self.fields(place, order)).sum()
        )

    def places(self, size: int) -> Iterator[ChecksumPlace]:
        """Yield the possible places of a checksum: at the end, in front, elsewhere.

        Places with constant values are omitted.
        """
        last = self.shortest - size
        first = last if self.is_single else 0
        near = (
            range(first, last + 1)
            if self.is_single or self.shortest <= SHORT
            else [*range(NEAR), *range(last - NEAR, last + 1)]
        )
        by_front = sorted(
            (place for place in near if place >= 0),
            key=lambda place: min(last - place, place + 0.5),
        )
        for front in dict.fromkeys(by_front):
            from_end = len(self.groups) > 1 or front > last // 2
            if from_end:
                places = [ChecksumPlace(front - self.shortest, size)]
            else:
                places = []
            if not from_end or (len(self.groups) > 1 and front < NEAR):
                places.append(ChecksumPlace(front, size))
            yield from (
                place
                for place in places
                if self.is_single
                or len(np.unique(self.fields(place, "little"))) > len(self) // 8 + 1
            )

    @property
    def is_single(self) -> bool:
        """Whether there is only one frame, for which only the usual places are searched."""
        return len(self) == 1

    def measure_variation(self, place: ChecksumPlace) -> float:
        """Return the variation of the byte of a place that varies least.

        It depends on the range and on the number of distinct values. The usual place, at the end,
        has a larger weight.
        """
        columns = [
            self.fields(ChecksumPlace(place.offset + index, 1), "little")
            for index in range(place.size)
        ]
        distinct = min(len(np.unique(column)) for column in columns) / min(len(self), 256)
        apart = min(int(np.ptp(column)) for column in columns) >= APART
        return 2 * apart + min(1.0, distinct * (USUAL if place.offset == -place.size else 1))


def accept_any_place(_: ChecksumPlace) -> bool:
    """Return True: a checksum may stand at every place."""
    return True


def iter_spans(place: ChecksumPlace, samples: SampleFrames) -> Iterator[CoveredSpan]:
    """Yield the spans of a checksum at a place, the usual first.

    Spans that cover the same bytes of these frames are omitted.
    """
    start = place.start(samples.shortest)
    before = start
    behind = samples.shortest - start - place.size
    at_end = behind <= TAIL
    seen: set[tuple[tuple[int, int], ...]] = set()
    parts: tuple[tuple[Part, int, int], ...] = (
        ("all", HEAD if at_end else 2, 1),
        ("before", HEAD if at_end else 2, 0),
        ("behind", 0, 1),
    )
    parts = (("all", 2, 0),) if samples.is_single else parts
    for head in range(HEAD + 1):
        for part, heads, tails in parts:
            for tail in range(tails + 1) if head <= heads else ():
                span = CoveredSpan(part, head, tail)
                ranges = tuple(span.ranges(place, samples.shortest))
                fits = (part == "behind" or head < before or head == 0) and (
                    tail == 0 or tail < behind
                )
                if fits and ranges not in seen and sum(b - a for a, b in ranges) >= 2:
                    seen.add(ranges)
                    yield span


def weigh_evidence(width: int, values: NDArray[np.uint64], fitted: int, tried: int) -> float:
    """Return the bits of evidence of a match.

    One of 2**bits wrong checksums would match as well by chance.

    Args:
        width: width of the checksum, in bits.
        values: the values of the frames in its place, (n,).
        fitted: number of distinct values that determined the parameters.
        tried: number of checksums that were tried.
    """
    return width * (len(np.unique(values)) - fitted) - float(np.log2(max(tried, 1)))


def are_enough(right: int, total: int) -> bool:
    """Return whether enough frames are valid for the others to be damaged ones."""
    return right >= max(1, ENOUGH * total)


def sort_matches(matches: Sequence[ChecksumMatch]) -> list[ChecksumMatch]:
    """Return the matches, the simplest and surest first."""

    def key(match: ChecksumMatch) -> tuple[object, ...]:
        span = match.span
        return (
            -round(match.right / match.total, 2),
            match.doubt < match.algorithm.width,
            -match.place.size,  # a divisor of a wide CRC's polynomial fits at its end
            match.open,
            -match.varied,
            not match.sure,
            not match.name,
            span.part != "all",
            span.head + span.tail,
            len(match.paste),
        )

    unique = dict[object, ChecksumMatch]()
    for match in sorted(matches, key=key):
        unique.setdefault((match.paste, match.place, match.order), match)
    return list(unique.values())
