"""Find the algorithm, the place and the covered bytes of the checksum of frames.

`search` tries all simple checksums, such as XORs and sums. If no simple checksum is certain,
`crc_search` calculates CRCs from the frames.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarspec.drafting.crc_search import iter_crc_matches
from lidarspec.drafting.samples import (
    ChecksumMatch,
    ChecksumPlace,
    CoveredSpan,
    SampleFrames,
    accept_any_place,
    are_enough_valid,
    iter_spans,
    sort_matches,
    weigh_evidence,
)
from lidarspec.frames.row_checksums import compute_checksums
from lidarspec.spec.checksums import (
    ByteOrder,
    Bytes,
    Checksum,
    Fletcher,
    Fold15,
    Sum,
    Values,
    WordXor,
    Xor,
)

#: The maximum number of matches to return.
MAX_MATCHES = 8
#: The number of frames on which a checksum is tried before all frames are used.
SCREENING_FRAMES = 16
#: The minimum share of valid frames for a checksum whose constant is fitted to the frames.
MIN_VALID_SHARE_WITH_CONSTANT = 0.95
#: A checksum in nibbles is searched at offsets less than this.
NIBBLE_SEARCH_BYTES = 3
#: The number of checksums in nibbles that are tried: one at offset 0, where no byte precedes the
#: checksum, and two at each other offset.
NIBBLE_TRIALS = 2 * NIBBLE_SEARCH_BYTES - 1
ANYWHERE_NOTE = (
    "an XOR over the whole frame fits at several offsets: the byte that varies most was chosen"
)
#: Values of `WordXor.head` to try.
WORD_XOR_HEADS = (0, 2, 4, 6, 8, 10, 12)
#: Values of `WordXor.groups` to try.
WORD_XOR_GROUPS = ((2,), (1, 2), (2, 1), (1, 1, 2))
#: Python source that appends the missing low byte of the last word, by the byte order of the words.
#: A little-endian word has its missing byte at the top, where it is zero anyway.
_PADDING_SOURCE = {"little": "", "big": '.ljust(2, b"\\0")'}


@dataclass(frozen=True)
class WordSum(Checksum):
    """The sum of two-byte words modulo 2**16.

    If the number of bytes is odd, a zero byte is appended.

    Attributes:
        words: the byte order of the words.
        carry: whether the carry out of bit 15 is added to the sum.
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
        if self.carry:
            total = _add_carry(_add_carry(total))  # the first addition may have a carry too
        return total & np.uint64(0xFFFF)


def _add_carry(total: Values) -> Values:
    """Add the bits above bit 15 of each sum to its low 16 bits."""
    return (total & np.uint64(0xFFFF)) + (total >> np.uint64(16))


#: Checksums of two bytes to try. With groups of one word, `WordXor.head` has no effect.
_TWO_BYTE_CHECKSUMS: tuple[Checksum, ...] = (
    Sum(16),
    *(WordSum(order, carry) for order in ("little", "big") for carry in (False, True)),
    *(
        WordXor(head, groups)
        for groups in WORD_XOR_GROUPS
        for head in (WORD_XOR_HEADS if groups != (2,) else (0,))
    ),
    Fletcher(),
    Fold15(),
)


@dataclass(frozen=True)
class ChecksumWithConstant(Checksum):
    """A checksum that is calculated from the value of a base checksum and a constant.

    The result is ``constant ^ value`` if the base is an XOR, ``constant - value`` if `negative` is
    set, and ``constant + value`` in all other cases.

    Attributes:
        negative: whether the value is subtracted from the constant.
    """

    base: Checksum
    constant: int
    negative: bool = False
    width = 8  # replaced by the width of `base`

    def __post_init__(self) -> None:
        object.__setattr__(self, "width", self.base.width)

    def __call__(self, data: Bytes) -> int:
        return int(self._combine(np.array([self.base(data)], np.uint64))[0])

    def describe(self) -> str:
        digits = self.width // 4
        if self.negative and self.constant in (0, self._mask):
            return f"{self.base.describe()}, {'negated' if self.constant == 0 else 'complemented'}"
        if isinstance(self.base, Xor | WordXor):
            operation = "xor"
        elif self.negative:
            operation = "subtracted from"
        else:
            operation = "plus"
        return f"{self.base.describe()}, {operation} 0x{self.constant:0{digits}x}"

    def batch(self, rows: NDArray[np.uint8]) -> Values:
        return self._combine(compute_checksums(self.base, rows))

    @property
    def _mask(self) -> int:
        return (1 << self.width) - 1

    def _combine(self, values: Values) -> Values:
        """Combine each value of the base checksum with the constant; return the results."""
        constant = np.uint64(self.constant)
        if isinstance(self.base, Xor | WordXor):
            return values ^ constant
        if self.negative:
            result = constant - values
        else:
            result = constant + values
        return result & np.uint64(self._mask)


def search(
    frames: Iterable[bytes],
    *,
    quick: bool = False,
    is_possible_place: Callable[[ChecksumPlace], bool] = accept_any_place,
) -> list[ChecksumMatch]:
    """Return the checksums that match the frames, the simplest and likeliest first.

    Args:
        frames: whole frames of any lengths; some may be damaged.
        quick: whether to stop after about a second. Fewer offsets and fewer CRCs are tried.
        is_possible_place: a function that returns whether a checksum may be at a place.
    """
    samples = SampleFrames(frames)
    has_content = any(any(frame) for frame in samples.frames)  # a byte that is not zero
    if samples.shortest < 3 or not has_content:
        return []
    matches = list(iter_plain_matches(samples, is_possible_place))
    if not any(match.is_sure for match in matches):
        matches += iter_crc_matches(samples, quick=quick, is_possible_place=is_possible_place)
    if not matches and not quick:
        # CRCs with different `refin` and `refout` are rare
        matches += iter_crc_matches(samples, mixed=True, is_possible_place=is_possible_place)
    return sort_matches(matches)[:MAX_MATCHES]


def format_algorithm(algorithm: Checksum) -> str:
    """Return the Python source of an algorithm: an expression or a class."""
    if needs_class(algorithm):
        return format_class(algorithm)
    if isinstance(algorithm, Sum):
        return f"Sum({algorithm.width})"
    if isinstance(algorithm, WordXor):
        return f"WordXor(head={algorithm.head}, groups={algorithm.groups})"
    return f"{type(algorithm).__name__}()"


def needs_class(algorithm: Checksum) -> bool:
    """Return whether `lidarspec.spec` has no class for an algorithm."""
    return isinstance(algorithm, ChecksumWithConstant | WordSum)


def iter_plain_matches(
    samples: SampleFrames, is_possible_place: Callable[[ChecksumPlace], bool] = accept_any_place
) -> Iterator[ChecksumMatch]:
    """Yield the simple checksums that match, the widest first."""
    subset = samples.select_of_all_lengths(SCREENING_FRAMES)
    tried = 0
    has_sure = False
    for size, algorithms in ((4, (Sum(32),)), (2, _TWO_BYTE_CHECKSUMS), (1, (Xor(), Sum(8)))):
        for place in filter(is_possible_place, subset.iter_places(size)):
            has_sure_sum = False
            for algorithm, span in _iter_checksums(subset, place, algorithms):
                tried += 1
                for match in _iter_matches(samples, subset, algorithm, place, span, tried):
                    if match.is_sure:
                        has_sure = True
                        if not isinstance(match.algorithm, Xor | WordXor):
                            has_sure_sum = True
                    yield match
            # If only XORs match, the search continues: an XOR may fit at several offsets.
            if has_sure_sum:
                return
        if has_sure:
            return
    yield from _iter_nibble_matches(samples, is_possible_place)


def _iter_checksums(
    samples: SampleFrames, place: ChecksumPlace, algorithms: Sequence[Checksum]
) -> Iterator[tuple[Checksum, CoveredSpan]]:
    """Yield the algorithms and covered bytes to try for a place."""
    longest = len(samples.frames[-1])  # the frames are sorted by length
    for span in iter_spans(place, samples):
        covered_bytes = sum(end - start for start, end in span.ranges(place, longest))
        if 2 * covered_bytes < longest - place.size:
            continue
        for algorithm in algorithms:
            # There are many variants of `WordXor`, which are tried only without omitted bytes.
            if isinstance(algorithm, WordXor) and (span.head or span.tail):
                continue
            yield algorithm, span


def _iter_matches(
    samples: SampleFrames,
    subset: SampleFrames,
    algorithm: Checksum,
    place: ChecksumPlace,
    span: CoveredSpan,
    tried: int,
) -> Iterator[ChecksumMatch]:
    """Yield the matches of an algorithm, alone and combined with a constant.

    Args:
        subset: some of the frames, on which the algorithm is tried first.
        tried: number of checksums tried so far; it reduces the certainty of a match.
    """
    computed = subset.compute_checksums(algorithm, place, span)
    byte_orders: tuple[ByteOrder, ...] = ("little", "big") if place.size > 1 else ("little",)
    max_value = (1 << 8 * place.size) - 1
    for order in byte_orders:
        stored = subset.read_field(place, order)
        for variant in _list_variants(algorithm, computed, stored, max_value):
            constant = variant.constant if isinstance(variant, ChecksumWithConstant) else 0
            has_constant = constant not in (0, max_value)
            valid_count = samples.count_valid(variant, place, span, order)
            evidence_bits = weigh_evidence(variant.width, stored, int(has_constant), tried)
            if has_constant:
                min_count = MIN_VALID_SHARE_WITH_CONSTANT * len(samples)
                is_proven = valid_count >= min_count and not subset.is_single
            else:
                is_proven = are_enough_valid(valid_count, len(samples))
            if not is_proven or evidence_bits <= 0:
                continue
            notes: tuple[str, ...] = ()
            variation = 0.0
            if isinstance(algorithm, Xor | WordXor) and span.covers_all:
                notes = (ANYWHERE_NOTE,)
                variation = samples.measure_variation(place)
            yield ChecksumMatch(
                algorithm=variant,
                place=place,
                span=span,
                order=order,
                right=valid_count,
                total=len(samples),
                evidence_bits=evidence_bits,
                source=format_algorithm(variant),
                notes=notes,
                is_ambiguous=has_constant,
                has_constant=has_constant,
                variation=variation,
            )


def _list_variants(
    algorithm: Checksum, computed: Values, stored: Values, max_value: int
) -> list[Checksum]:
    """Return the variants of an algorithm that make most frames valid.

    A variant is the algorithm alone, or combined with a constant.

    Args:
        computed: the result of the algorithm for each frame, (n,).
        stored: the value at the place of the checksum in each frame, (n,).
    """
    mask = np.uint64(max_value)
    if isinstance(algorithm, Fletcher | Fold15):
        # A start value would change the result by an amount that depends on the length.
        if are_enough_valid(int((stored == computed).sum()), len(stored)):
            return [algorithm]
        return []
    if isinstance(algorithm, Xor | WordXor):
        return [
            _include_constant(algorithm, constant) for constant in _find_constant(stored ^ computed)
        ]
    if len(stored) == 1:
        if not stored.any():
            return []
        return [algorithm, ChecksumWithConstant(algorithm, max_value, negative=True)]
    added = _find_constant((stored - computed) & mask)
    negated = _find_constant((stored + computed) & mask)
    return [
        *(_include_constant(algorithm, constant) for constant in added),
        *(ChecksumWithConstant(algorithm, constant, negative=True) for constant in negated),
    ]


def _include_constant(algorithm: Checksum, constant: int) -> Checksum:
    """Return an algorithm with a constant; the algorithm itself if the constant is 0."""
    if constant:
        return ChecksumWithConstant(algorithm, constant)
    return algorithm


def _find_constant(values: NDArray[np.uint64]) -> list[int]:
    """Return [value] if nearly all elements have the same value, otherwise []."""
    distinct, counts = np.unique(values, return_counts=True)
    most_frequent = int(counts.argmax())
    if are_enough_valid(int(counts[most_frequent]), len(values)):
        return [int(distinct[most_frequent])]
    return []


def _iter_nibble_matches(
    samples: SampleFrames, is_possible_place: Callable[[ChecksumPlace], bool]
) -> Iterator[ChecksumMatch]:
    """Yield the match of an XOR that is stored in the low nibbles of two bytes."""
    offsets = range(min(NIBBLE_SEARCH_BYTES, samples.shortest - 4))
    for place in filter(is_possible_place, (ChecksumPlace(offset, 2) for offset in offsets)):
        both_bytes = samples.read_field(place, "little")
        low_half = both_bytes & np.uint64(0x0F)
        high_half = (both_bytes >> np.uint64(4)) & np.uint64(0xF0)
        stored = low_half | high_half
        spans = [CoveredSpan("behind")]
        if place.offset > 0:
            spans.append(CoveredSpan("all"))
        for span in spans:
            valid_count = int((samples.compute_checksums(Xor(), place, span) == stored).sum())
            evidence_bits = weigh_evidence(8, stored, 0, NIBBLE_TRIALS)
            if are_enough_valid(valid_count, len(samples)) and evidence_bits > 0:
                note = (
                    "the checksum is stored in the low nibbles of two bytes, low half first:"
                    " name both bytes in Checksummed(field=(...))"
                )
                yield ChecksumMatch(
                    algorithm=Xor(),
                    place=place,
                    span=span,
                    order="little",
                    right=valid_count,
                    total=len(samples),
                    evidence_bits=evidence_bits,
                    source="Xor()",
                    notes=(note,),
                    is_in_nibbles=True,
                )


def format_class(algorithm: Checksum, *, is_typed: bool = False) -> str:
    """Return the Python source of a class `Check` for a checksum.

    Args:
        algorithm: a `ChecksumWithConstant` or a `WordSum`.
        is_typed: whether the methods have annotations.
    """
    if isinstance(algorithm, ChecksumWithConstant):
        with_constant = algorithm
    else:
        with_constant = ChecksumWithConstant(algorithm, 0)
    base = with_constant.base
    steps = []
    if isinstance(base, Xor | WordXor):
        value = f"{format_algorithm(base)}(data) ^ 0x{with_constant.constant:X}"
    elif isinstance(base, WordSum):
        steps = [
            f'words = [int.from_bytes(data[i : i + 2]{_PADDING_SOURCE[base.words]}, "{base.words}")'
            " for i in range(0, len(data), 2)]"
        ]
        value = "sum(words)"
        if base.carry:
            steps += ["total = sum(words)", *["total = (total & 0xFFFF) + (total >> 16)"] * 2]
            value = "total"
    else:
        value = "sum(data)"
    if not isinstance(base, Xor | WordXor) and (with_constant.constant or with_constant.negative):
        value = f"0x{with_constant.constant:X} {'-' if with_constant.negative else '+'} {value}"
    max_value = (1 << with_constant.width) - 1
    body = "".join(f"        {line}\n" for line in (*steps, f"return ({value}) & 0x{max_value:X}"))
    if is_typed:
        call = "def __call__(self, data: Any) -> int:"
        describe = "def describe(self) -> str:"
    else:
        call = "def __call__(self, data):"
        describe = "def describe(self):"
    return (
        f"class Check(Checksum):\n    width = {with_constant.width}\n\n"
        f"    {call}\n{body}\n"
        f'    {describe}\n        return "{algorithm.describe()}"'
    )
