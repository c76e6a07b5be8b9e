"""Find the checksum of sample frames: algorithm, place and covered bytes.

The plain checksums are tried one by one, the usual ones first: XOR, sums of bytes and words, their
complements, words in groups, folded sums, split nibbles. CRCs are found without trial
(`crc_search`), and only if no plain checksum is certain.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarspec.drafting.crc_search import crc_matches
from lidarspec.drafting.samples import (
    ChecksumMatch,
    ChecksumPlace,
    CoveredSpan,
    SampleFrames,
    accept_any_place,
    are_enough,
    iter_spans,
    sort_matches,
    weigh_evidence,
)
from lidarspec.frames.row_checksums import compute_checksums
from lidarspec.spec.checksums import ByteOrder, Bytes, Checksum, Fold15, Sum, Values, WordXor, Xor

#: Maximum number of matches to return.
TOLD = 8
#: Number of frames on which a guess is tried before all frames are used.
SCREENED = 16
#: Minimum share of frames with a valid checksum, if it has a constant of its own.
CERTAIN = 0.95
ANYWHERE = (
    "an XOR of a whole frame fits at several offsets: this is the one with the most varying bytes"
)
#: Heads and groups of words that are tried.
HEADS = (0, 2, 4, 6, 8, 10, 12)
GROUPS = ((2,), (1, 2), (2, 1), (1, 1, 2))
_PADDED = {"little": "", "big": '.ljust(2, b"\\0")'}


@dataclass(frozen=True)
class WordSum(Checksum):
    """The sum of two-byte words modulo 2**16; an odd last byte is extended by zeros.

    Attributes:
        words: byte order of the words.
        carry: whether carries are added back.
    """

    words: ByteOrder = "little"
    carry: bool = False
    width = 16

    def __call__(self, data: Bytes) -> int:
        return int(self.batch(np.frombuffer(data, np.uint8).reshape(1, -1))[0])

    def describe(self) -> str:
        return f"16-bit sum of {self.words}-endian words" + (
            " with carries added back" if self.carry else ""
        )

    def batch(self, rows: NDArray[np.uint8]) -> Values:
        if self.words == "little":
            low = rows[:, 0::2]
            high = rows[:, 1::2]
        else:
            low = rows[:, 1::2]
            high = rows[:, 0::2]
        total: NDArray[np.uint64] = low.sum(axis=1, dtype=np.uint64) + (
            high.sum(axis=1, dtype=np.uint64) << np.uint64(8)
        )
        for _ in range(2 if self.carry else 0):
            total = (total & np.uint64(0xFFFF)) + (total >> np.uint64(16))
        return total & np.uint64(0xFFFF)


@dataclass(frozen=True)
class MaskedChecksum(Checksum):
    """Another checksum with a constant.

    It is ``constant - value`` with `negative`, else ``constant + value``; for XORs
    ``constant ^ value``.
    """

    of: Checksum
    constant: int
    negative: bool = False
    width = 8

    def __post_init__(self) -> None:
        object.__setattr__(self, "width", self.of.width)

    def __call__(self, data: Bytes) -> int:
        return int(self._add_constant(np.array([self.of(data)], np.uint64))[0])

    def describe(self) -> str:
        digits = self.width // 4
        if self.negative and self.constant in (0, self._mask):
            return f"{self.of.describe()}, {'negated' if self.constant == 0 else 'complemented'}"
        return (
            f"{self.of.describe()}, {'taken from' if self.negative else 'and'}"
            f" 0x{self.constant:0{digits}x}"
        )

    def batch(self, rows: NDArray[np.uint8]) -> Values:
        return self._add_constant(compute_checksums(self.of, rows))

    @property
    def _mask(self) -> int:
        return (1 << self.width) - 1

    def _add_constant(self, values: Values) -> Values:
        constant = np.uint64(self.constant)
        if isinstance(self.of, Xor | WordXor):
            return values ^ constant
        return ((constant - values) if self.negative else (constant + values)) & np.uint64(
            self._mask
        )


def search(
    frames: Iterable[bytes],
    *,
    quick: bool = False,
    stands: Callable[[ChecksumPlace], bool] = accept_any_place,
) -> list[ChecksumMatch]:
    """Return the checksums that match the frames, the simplest and surest first.

    Returns an empty list if there is none.

    Args:
        frames: whole frames; more and more different frames give a surer result; some may be
            damaged, and lengths may differ.
        quick: end after about a second: search for CRCs at the usual places only, and for CRCs of
            long frames in the catalogue only.
        stands: returns whether a checksum may be at a place.
    """
    samples = SampleFrames(frames)
    if samples.shortest < 3 or not any(map(any, samples.frames)):
        return []
    matches = list(plain_matches(samples, stands))
    if not any(match.sure for match in matches):
        matches += crc_matches(samples, quick=quick, stands=stands)
    if not matches and not quick:
        matches += crc_matches(samples, mixed=True, stands=stands)
    return sort_matches(matches)[:TOLD]


def format_algorithm(algorithm: Checksum) -> str:
    """Return the algorithm as Python source; a class if the package has none."""
    if isinstance(algorithm, MaskedChecksum | WordSum):
        return _class(algorithm)
    if isinstance(algorithm, Sum):
        return f"Sum({algorithm.width})"
    if isinstance(algorithm, WordXor):
        return f"WordXor(head={algorithm.head}, groups={algorithm.groups})"
    return f"{type(algorithm).__name__}()"


def plain_matches(
    samples: SampleFrames, stands: Callable[[ChecksumPlace], bool] = accept_any_place
) -> Iterator[ChecksumMatch]:
    """Yield every plain checksum that matches, in no special order."""
    few = samples.take_spread(SCREENED)
    tried = 0
    sure = False
    certain = False
    longest = len(few.frames[-1])
    for size, algorithms in ((4, (Sum(32),)), (2, _WIDE), (1, (Xor(), Sum(8)))):
        for place in filter(stands, few.places(size)):
            for span in iter_spans(place, few):
                if 2 * sum(b - a for a, b in span.ranges(place, longest)) < longest - size:
                    continue
                for algorithm in algorithms:
                    if isinstance(algorithm, WordXor) and (span.head or span.tail):
                        continue
                    tried += 1
                    for match in _iter_matches(samples, few, algorithm, place, span, tried):
                        sure = sure or match.sure
                        certain = certain or (
                            match.sure and not isinstance(match.algorithm, Xor | WordXor)
                        )
                        yield match
            if certain:
                return
        if sure:
            return
    yield from _nibbles(samples)


def _iter_matches(
    samples: SampleFrames,
    few: SampleFrames,
    algorithm: Checksum,
    place: ChecksumPlace,
    span: CoveredSpan,
    tried: int,
) -> Iterator[ChecksumMatch]:
    """Yield an algorithm and its complements if they match.

    A constant is fitted only if there are several frames to prove it.
    """
    computed = few.compute_checksums(algorithm, place, span)
    mask = np.uint64((1 << 8 * place.size) - 1)
    orders: tuple[ByteOrder, ...] = ("little", "big") if place.size > 1 else ("little",)
    for order in orders:
        there = few.fields(place, order)
        algorithms: list[Checksum]
        if isinstance(algorithm, Fold15):
            if are_enough(int((there == computed).sum()), len(few)):
                algorithms = [algorithm]
            else:
                algorithms = []
        elif isinstance(algorithm, Xor | WordXor):
            algorithms = [_change(algorithm, constant) for constant in _constant(there ^ computed)]
        elif few.is_single:
            if not there.any():
                return
            algorithms = [algorithm, MaskedChecksum(algorithm, int(mask), negative=True)]
        else:
            algorithms = [
                _change(algorithm, constant) for constant in _constant((there - computed) & mask)
            ]
            algorithms += [
                MaskedChecksum(algorithm, constant, negative=True)
                for constant in _constant((there + computed) & mask)
            ]
        for one in algorithms:
            constant = one.constant if isinstance(one, MaskedChecksum) else 0
            fitted = int(constant not in (0, int(mask)))
            right = samples.count_valid(one, place, span, order)
            doubtful = weigh_evidence(one.width, there, fitted, tried)
            if not fitted:
                proven = are_enough(right, len(samples))
            else:
                proven = right >= CERTAIN * len(samples)
            if proven and doubtful > 0 and not (few.is_single and fitted):
                remarks: tuple[str, ...] = (
                    ("it contains a constant: fields outside the covered bytes, or a start value",)
                    if fitted
                    else ()
                )
                varied = 0.0
                if isinstance(algorithm, Xor | WordXor) and span == CoveredSpan():
                    remarks = (*remarks, ANYWHERE)
                    varied = samples.measure_variation(place)
                yield ChecksumMatch(
                    one,
                    place,
                    span,
                    order,
                    right,
                    len(samples),
                    doubtful,
                    format_algorithm(one),
                    remarks,
                    "",
                    bool(fitted),
                    varied,
                )


def _change(algorithm: Checksum, constant: int) -> Checksum:
    if constant:
        return MaskedChecksum(algorithm, constant)
    return algorithm


def _constant(values: NDArray[np.uint64]) -> list[int]:
    """Return the value that nearly all elements have, if there is one."""
    distinct, counts = np.unique(values, return_counts=True)
    most = int(counts.argmax())
    if are_enough(int(counts[most]), len(values)):
        return [int(distinct[most])]
    return []


def _nibbles(samples: SampleFrames) -> Iterator[ChecksumMatch]:
    """Yield an XOR that is stored in the low nibbles of two adjacent bytes."""
    for front in range(min(3, samples.shortest - 4)):
        place = ChecksumPlace(front, 2)
        there = samples.fields(place, "little")
        halves = (there & np.uint64(15)) | (there >> np.uint64(4)) & np.uint64(0xF0)
        for span in (CoveredSpan("behind"), CoveredSpan("all"))[: 1 + (front > 0)]:
            right = int((samples.compute_checksums(Xor(), place, span) == halves).sum())
            if are_enough(right, len(samples)) and weigh_evidence(8, halves, 0, 8) > 0:
                remark = (
                    "its halves are the low nibbles of two bytes, low half first:"
                    " name both in Checksummed(field=(...))"
                )
                yield ChecksumMatch(
                    Xor(),
                    place,
                    span,
                    "little",
                    right,
                    len(samples),
                    weigh_evidence(8, halves, 0, 8),
                    "Xor()",
                    (remark,),
                )


_WIDE: tuple[Checksum, ...] = (
    Sum(16),
    *(WordSum(order, carry) for order in ("little", "big") for carry in (False, True)),
    *(WordXor(head, groups) for groups in GROUPS for head in (HEADS if groups != (2,) else (0,))),
    Fold15(),
)


def _class(algorithm: Checksum) -> str:
    """Return the source of a class for a checksum that the package does not have."""
    if isinstance(algorithm, MaskedChecksum):
        changed = algorithm
    else:
        changed = MaskedChecksum(algorithm, 0)
    base = changed.of
    steps = []
    if isinstance(base, Xor | WordXor):
        value = f"{format_algorithm(base)}(data) ^ 0x{changed.constant:X}"
    elif isinstance(base, WordSum):
        steps = [
            f'words = [int.from_bytes(data[i : i + 2]{_PADDED[base.words]}, "{base.words}")'
            " for i in range(0, len(data), 2)]"
        ]
        value = "sum(words)"
        if base.carry:
            steps += ["total = sum(words)", *["total = (total & 0xFFFF) + (total >> 16)"] * 2]
            value = "total"
    else:
        value = "sum(data)"
    if not isinstance(base, Xor | WordXor) and (changed.constant or changed.negative):
        value = f"0x{changed.constant:X} {'-' if changed.negative else '+'} {value}"
    body = "".join(
        f"        {line}\n"
        for line in (*steps, f"return ({value}) & 0x{(1 << changed.width) - 1:X}")
    )
    return (
        f"class Check(Checksum):\n    width = {changed.width}\n\n"
        f"    def __call__(self, data):\n{body}\n"
        f'    def describe(self):\n        return "{algorithm.describe()}"'
    )
