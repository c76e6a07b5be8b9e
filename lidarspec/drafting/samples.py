"""Sample frames of an unknown format, and the possible places of their checksum."""

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

#: The maximum length of frames that are searched at every offset.
MAX_FULLY_SEARCHED_BYTES = 64
#: Longer frames are searched at offsets up to this distance from each end.
MAX_END_DISTANCE_BYTES = 12
#: A checksum at the end of a frame may leave out at most this number of bytes at the start.
MAX_OMITTED_HEAD_BYTES = 6
#: A checksum is considered to be at the end if at most this number of bytes follow it.
MAX_TAIL_BYTES = 4
#: A byte varies widely if the range of its values is at least this.
MIN_WIDE_RANGE = 96
#: The factor that prefers the usual place of a checksum, the end of the frame.
USUAL_PLACE_WEIGHT = 1.1
#: The minimum share of frames with a valid checksum. The other frames may be damaged.
MIN_VALID_SHARE = 0.6
#: The bits of evidence at which the search ends. By coincidence, one in a million wrong checksums
#: has as much evidence.
SURE_EVIDENCE_BITS = 20


@dataclass(frozen=True)
class ChecksumPlace:
    """The place of a checksum in a frame: its offset and size, in bytes.

    A negative offset counts from the end of the frame.
    """

    offset: int
    size: int

    def start(self, length: int) -> int:
        """Return the offset of the checksum from the start of a frame of this length."""
        if self.offset < 0:
            return self.offset + length
        return self.offset

    def __str__(self) -> str:
        if self.offset == -self.size:
            if self.size > 1:
                return f"the last {self.size} bytes"
            return "the last byte"
        if self.offset < 0:
            where = f"beginning {-self.offset} bytes before the end"
        else:
            where = f"at byte {self.offset}"
        return f"{self.size} byte{'s' * (self.size > 1)} {where}"


@dataclass(frozen=True)
class CoveredSpan:
    """The bytes of a frame that a checksum covers.

    Attributes:
        part: "before" the checksum, "behind" the checksum, or "all" for both.
        head: the number of bytes at the start of this part that are not covered.
        tail: the number of bytes at the end of the frame that are not covered.
    """

    part: Part = "all"
    head: int = 0
    tail: int = 0

    @property
    def covers_all(self) -> bool:
        """Whether all bytes except the checksum are covered."""
        return self.part == "all" and self.head == 0 and self.tail == 0

    def ranges(self, place: ChecksumPlace, length: int) -> list[tuple[int, int]]:
        """Return the covered (start, end) offsets in a frame of this length."""
        start = place.start(length)
        end = start + place.size
        before = (self.head, start)
        behind = (end + (self.head if self.part == "behind" else 0), length - self.tail)
        chosen = {"all": [before, behind], "before": [before], "behind": [behind]}[self.part]
        return [(first, last) for first, last in chosen if last > first]

    def describe(self, place: ChecksumPlace, length: int) -> str:
        """Describe the covered bytes of a frame of this length as text."""
        covered_bytes = sum(end - start for start, end in self.ranges(place, length))
        if self.covers_all or covered_bytes == length - place.size:
            return "all other bytes"
        if self.part == "before":
            return f"the bytes from offset {self.head} up to the checksum"
        omitted = []
        if self.head > 0:
            omitted.append(f"the first {self.head}")
        if self.tail > 0:
            omitted.append(f"the last {self.tail}")
        if self.part == "all":
            *others, last = ["the checksum", *omitted]
            return f"all bytes except {', '.join(others)} and {last}"
        if omitted:
            return f"all bytes after the checksum, except {' and '.join(omitted)}"
        return "all bytes after the checksum"


@dataclass(frozen=True)
class ChecksumMatch:
    """A checksum that matches sample frames.

    Attributes:
        place: the offset and size of the checksum in the frames.
        right: the number of frames with a valid checksum.
        evidence_bits: the certainty: of 2**evidence_bits wrong checksums, one matches by
            coincidence.
        name: the name of a CRC in the catalogue; "" if it has none.
        is_ambiguous: whether the frames leave a choice of parameters.
        has_constant: whether the checksum includes a constant that was calculated from the frames.
        is_in_nibbles: whether the checksum is stored in the low nibbles of two bytes.
        variation: the result of `SampleFrames.measure_variation` for `place`.
    """

    algorithm: Checksum
    place: ChecksumPlace
    span: CoveredSpan
    order: ByteOrder
    right: int
    total: int
    evidence_bits: float
    source: str
    notes: tuple[str, ...] = ()
    name: str = ""
    is_ambiguous: bool = False
    has_constant: bool = False
    is_in_nibbles: bool = False
    variation: float = 0.0

    @property
    def remarks(self) -> tuple[str, ...]:
        """All remarks for the user."""
        if self.has_constant:
            constant = (
                "the checksum differs from the algorithm by a constant: a start value, or the share"
                " of bytes that are equal in all frames"
            )
            return (constant, *self.notes)
        return self.notes

    @property
    def odds(self) -> str:
        """The number of wrong checksums of which one matches by chance, e.g. "1e+09"."""
        return f"1e+{int(self.evidence_bits * np.log10(2)):02}"

    @property
    def is_sure(self) -> bool:
        """Whether the search can end with this match."""
        at_end = self.place.offset < 0 and self.place.offset + self.place.size == 0
        return (
            self.evidence_bits >= SURE_EVIDENCE_BITS
            and not self.is_ambiguous
            and ((self.span.part, self.span.tail) == ("all", 0) or at_end)
        )


def read_values(
    rows: NDArray[np.uint8], offset: int, size: int, order: ByteOrder
) -> NDArray[np.int64]:
    """Return the unsigned value at an offset in each row, (n,).

    Args:
        rows: the frames, (n, length).
        size: number of bytes, at most 7.
    """
    columns = rows[:, offset : offset + size].astype(np.int64)
    shifts = 8 * np.arange(size, dtype=np.int64)
    total: NDArray[np.int64] = (columns << (shifts if order == "little" else shifts[::-1])).sum(
        axis=1
    )
    return total


class SampleFrames:
    """Distinct frames, grouped by length.

    Args:
        frames: the frames; duplicates and empty frames are dropped.
        max_frames: maximum number of distinct frames; further frames are dropped.

    Attributes:
        frames: the distinct frames, shortest first.
        groups: the frames of each length, (n, length), shortest first.
    """

    def __init__(self, frames: Iterable[bytes], *, max_frames: int = 256) -> None:
        distinct = list(dict.fromkeys(frame for frame in frames if frame))[:max_frames]
        self.frames: list[bytes] = sorted(distinct, key=len)
        groups = (list(group) for _, group in itertools.groupby(self.frames, len))
        self.groups: list[NDArray[np.uint8]] = [
            np.frombuffer(b"".join(group), np.uint8).reshape(len(group), -1) for group in groups
        ]
        # The stored values are the same for each algorithm that is tried.
        self._fields: dict[tuple[ChecksumPlace, ByteOrder], NDArray[np.uint64]] = {}

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def shortest(self) -> int:
        """The length of the shortest frame."""
        if self.frames:
            return len(self.frames[0])
        return 0

    def select_of_all_lengths(self, number: int) -> SampleFrames:
        """Return at most `number` frames, at equal steps from the shortest to the longest."""
        step = max(1, len(self.frames) // number)
        return SampleFrames(self.frames[::step][:number])

    def select_of_usual_length(self, number: int, pick: int) -> SampleFrames:
        """Return frames of the most frequent length, and a few frames of other lengths.

        Args:
            number: maximum number of frames of the most frequent length. The result also has up to
                two frames of each of up to `number` other lengths.
            pick: the number of the selection, from 0. With another number, other frames of the same
                lengths are selected if there are enough.
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

    def read_field(self, place: ChecksumPlace, order: ByteOrder) -> NDArray[np.uint64]:
        """Return the value at a place in each frame, (n,)."""
        if (place, order) not in self._fields:
            columns = [
                read_values(group, place.start(group.shape[1]), place.size, order)
                for group in self.groups
            ]
            self._fields[place, order] = np.concatenate(columns).view(np.uint64)
        return self._fields[place, order]

    def cut_span(self, place: ChecksumPlace, span: CoveredSpan) -> list[NDArray[np.uint8]]:
        """Return the covered bytes of all frames: one array (frames, bytes) for each length."""
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
            (self.compute_checksums(algorithm, place, span) == self.read_field(place, order)).sum()
        )

    def iter_places(self, size: int) -> Iterator[ChecksumPlace]:
        """Yield the possible places of a checksum, from both ends of the frame inwards."""
        last = self.shortest - size
        first = last if self.is_single else 0
        near = (
            range(first, last + 1)
            if self.is_single or self.shortest <= MAX_FULLY_SEARCHED_BYTES
            else [*range(MAX_END_DISTANCE_BYTES), *range(last - MAX_END_DISTANCE_BYTES, last + 1)]
        )
        by_distance = sorted(
            (offset for offset in near if offset >= 0),
            key=lambda offset: min(last - offset, offset + 0.5),
        )
        for offset in dict.fromkeys(by_distance):
            from_end = len(self.groups) > 1 or offset > last // 2
            if from_end:
                places = [ChecksumPlace(offset - self.shortest, size)]
            else:
                places = []
            if not from_end or (len(self.groups) > 1 and offset < MAX_END_DISTANCE_BYTES):
                places.append(ChecksumPlace(offset, size))
            yield from (
                place
                for place in places
                if self.is_single
                or len(np.unique(self.read_field(place, "little"))) > len(self) // 8 + 1
            )

    @property
    def is_single(self) -> bool:
        """Whether there is only one frame."""
        return len(self) == 1

    def measure_variation(self, place: ChecksumPlace) -> float:
        """Return a measure of how much the bytes at a place vary."""
        columns = [
            self.read_field(ChecksumPlace(place.offset + index, 1), "little")
            for index in range(place.size)
        ]
        distinct = min(len(np.unique(column)) for column in columns) / min(len(self), 256)
        if place.offset == -place.size:
            distinct *= USUAL_PLACE_WEIGHT
        variation = min(1.0, distinct)
        if min(int(np.ptp(column)) for column in columns) >= MIN_WIDE_RANGE:
            variation += 2
        return variation


def accept_any_place(_: ChecksumPlace) -> bool:
    """Return True: a checksum is possible at every place."""
    return True


def iter_spans(place: ChecksumPlace, samples: SampleFrames) -> Iterator[CoveredSpan]:
    """Yield the possible spans of covered bytes, the most usual first."""
    start = place.start(samples.shortest)
    before = start
    behind = samples.shortest - start - place.size
    at_end = behind <= MAX_TAIL_BYTES
    seen: set[tuple[tuple[int, int], ...]] = set()
    parts: tuple[tuple[Part, int, int], ...] = (
        ("all", MAX_OMITTED_HEAD_BYTES if at_end else 2, 1),
        ("before", MAX_OMITTED_HEAD_BYTES if at_end else 2, 0),
        ("behind", 0, 1),
    )
    parts = (("all", 2, 0),) if samples.is_single else parts
    for head in range(MAX_OMITTED_HEAD_BYTES + 1):
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
    """Return the evidence for a match, in bits.

    Evidence of k bits means that of 2**k wrong checksums, one matches by coincidence.

    Args:
        values: the values of the frames at the place of the checksum, (n,).
        fitted: number of distinct values that were used to determine parameters.
        tried: number of checksums that were tried so far.
    """
    return width * (len(np.unique(values)) - fitted) - float(np.log2(max(tried, 1)))


def are_enough_valid(valid_count: int, total: int) -> bool:
    """Return whether enough frames are valid to assume that the others are damaged."""
    return valid_count >= max(1, MIN_VALID_SHARE * total)


def sort_matches(matches: Sequence[ChecksumMatch]) -> list[ChecksumMatch]:
    """Return the matches, the simplest and likeliest first, without duplicates."""

    def key(match: ChecksumMatch) -> tuple[object, ...]:
        span = match.span
        return (
            -round(match.right / match.total, 2),
            match.evidence_bits < match.algorithm.width,
            -match.place.size,  # a divisor of a wide CRC's polynomial fits too
            match.is_ambiguous,
            -match.variation,
            not match.is_sure,
            not match.name,
            span.part != "all",
            span.head + span.tail,
            len(match.source),
        )

    unique = dict[object, ChecksumMatch]()
    for match in sorted(matches, key=key):
        unique.setdefault((match.source, match.place, match.order), match)
    return list(unique.values())
