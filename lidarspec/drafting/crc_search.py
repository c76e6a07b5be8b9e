"""Find a CRC of 8, 16 or 32 bits by polynomial division.

Polynomials over GF(2) are integers: bit k is the coefficient of x**k. The XOR of two frames of the
same length is divisible by the polynomial of their CRC. The polynomial is therefore a divisor of
the greatest common divisor of such XORs.

The start value and the final XOR are calculated from the polynomial. If all frames have the same
length, many pairs of start value and final XOR are equivalent, and the most usual pair is returned.

If there are too few frames of the same length, the search assumes that the start value and the
final XOR are 0 or all ones.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, product, zip_longest

import numpy as np

from lidarspec.drafting.samples import (
    ChecksumMatch,
    ChecksumPlace,
    CoveredSpan,
    SampleFrames,
    accept_any_place,
    are_enough_valid,
    iter_spans,
    weigh_evidence,
)
from lidarspec.spec.checksums import (
    CRCS,
    KNOWN_POLYNOMIALS,
    MIRROR,
    ByteOrder,
    Crc,
    name_of,
    reflect,
)

#: The maximum degree of the cofactors that are tried to find a divisor.
MAX_COFACTOR_DEGREE = 11
#: Widths of CRCs in bits. The widest is first, because the polynomial of a narrow CRC may divide
#: the polynomial of a wide CRC.
WIDTHS = (32, 16, 8)
#: For longer frames, division is used only for a CRC at the end. At other offsets, only the CRCs of
#: the catalogue are tried.
MAX_DIVIDED_BYTES = 256
#: The cost of the division of one byte, in bytes of CRC computation.
DIVISION_WORK = 32
#: The limit of a quick search, in bytes of CRC computation. They take about one second.
QUICK_WORK = 1 << 23
#: The number of frames of the same length from which a polynomial is calculated.
FRAMES_PER_PICK = 4
#: The number of selections of frames to try at the usual offset, because some frames may be
#: damaged.
MAX_PICKS = 6
#: The maximum number of polynomials to test with all frames, for one offset and range of covered
#: bytes.
MAX_POLYNOMIALS = 64
#: For each frame: the number of covered bytes, and the polynomial of the message followed by its
#: checksum.
Codewords = list[tuple[int, int]]


def remainder(a: int, b: int) -> int:
    """Return polynomial a modulo polynomial b; b must not be 0."""
    size = b.bit_length()
    while (shift := a.bit_length() - size) >= 0:
        a ^= b << shift
    return a


def quotient(a: int, b: int) -> int:
    """Return polynomial a divided by b, without the remainder; b must not be 0."""
    size = b.bit_length()
    result = 0
    while (shift := a.bit_length() - size) >= 0:
        a ^= b << shift
        result |= 1 << shift
    return result


def find_common_divisor(polynomials: Iterable[int], *, floor: int = 0) -> int:
    """Return the greatest common divisor of polynomials; 0 if all are 0.

    Args:
        floor: the calculation stops if the degree of the divisor is less than this.
    """
    divisor = 0
    for polynomial in polynomials:
        other = polynomial
        while other:
            divisor, other = other, remainder(divisor, other) if divisor else 0
        if divisor and divisor.bit_length() <= floor:
            break
    return divisor


def find_divisors(polynomial: int, degree: int) -> list[int]:
    """Return a polynomial's divisors of the given degree that may be CRC polynomials.

    Returns:
        An empty list if too many polynomials would have to be tried.
    """
    if polynomial == 0:
        return []
    polynomial >>= (polynomial & -polynomial).bit_length() - 1
    spare = polynomial.bit_length() - 1 - degree
    if spare < 0:
        return []
    if spare <= MAX_COFACTOR_DEGREE:
        quotients = (
            quotient(polynomial, small)
            for small in range((1 << spare) | 1, 2 << spare, 2)
            if remainder(polynomial, small) == 0
        )
        if spare:
            return sorted(quotients)
        return [polynomial]
    if degree <= 16:
        return _find_small_divisors(polynomial, degree)
    return []


def _find_small_divisors(polynomial: int, degree: int) -> list[int]:
    """Return the divisors of a polynomial that have the given degree, which must be small."""
    candidates = np.arange((1 << degree) | 1, 2 << degree, 2, dtype=np.uint32)
    rest = np.zeros(len(candidates), np.uint32)
    top = np.uint32(degree)
    for bit in range(polynomial.bit_length() - 1, -1, -1):
        rest = rest << np.uint32(1) | np.uint32(polynomial >> bit & 1)
        rest ^= candidates * (rest >> top)
    return [int(divisor) for divisor in candidates[rest == 0]]


def solve(equations: Sequence[tuple[int, int]], width: int) -> tuple[int, list[int]] | None:
    """Solve linear equations over GF(2).

    Args:
        equations: pairs (mask, bit). For an unknown number x, the XOR of all bits of ``x & mask``
            must be `bit`.
        width: number of bits of x.

    Returns:
        One solution and a basis of the null space; None if there is no solution.
    """
    rows: dict[int, int] = {}
    for mask, bit in equations:
        row = mask | bit << width
        for lead, other in rows.items():
            if row >> lead & 1:
                row ^= other
        lead = (row & ((1 << width) - 1)).bit_length() - 1
        if lead < 0:
            if row:
                return None
            continue
        rows = {
            other_lead: other ^ row if other >> lead & 1 else other
            for other_lead, other in rows.items()
        }
        rows[lead] = row
    solution = sum(1 << lead for lead, row in rows.items() if row >> width & 1)
    free = [bit for bit in range(width) if bit not in rows]
    return solution, [
        1 << bit | sum(1 << lead for lead, row in rows.items() if row >> bit & 1) for bit in free
    ]


@dataclass(frozen=True)
class _BitOrder:
    """The bit and byte order in which frames are converted to polynomials.

    Attributes:
        width: width of the CRC, in bits.
        order: byte order of the stored CRC.
        refin: whether bytes begin with the lowest bit.
        refout: whether the register begins with the lowest bit.
    """

    width: int
    order: ByteOrder
    refin: bool
    refout: bool

    def message(self, data: bytes) -> int:
        return int.from_bytes(data.translate(MIRROR) if self.refin else data, "big") << self.width

    def register(self, value: int) -> int:
        if self.refout:
            return reflect(value, self.width)
        return value

    def init_term(self, init: int, size: int) -> int:
        """Return the polynomial that a start value adds to a message of `size` bytes."""
        return init << 8 * size

    def catalogue_crcs(self) -> list[Crc]:
        """Return the CRCs of the catalogue with this width and bit order."""
        return [
            crc
            for crc in CRCS.values()
            if (crc.width, crc.refin, crc.refout) == (self.width, self.refin, self.refout)
        ]

    def crc(self, poly: int, init: int, xorout: int) -> Crc:
        low = poly & ((1 << self.width) - 1)
        return Crc(self.width, low, init, self.refin, self.refout, self.register(xorout))


def iter_crc_matches(
    samples: SampleFrames,
    *,
    mixed: bool = False,
    quick: bool = False,
    is_possible_place: Callable[[ChecksumPlace], bool] = accept_any_place,
) -> Iterator[ChecksumMatch]:
    """Yield the CRCs that match, until a match is certain.

    Args:
        mixed: whether to search for CRCs with different `refin` and `refout`, instead of equal
            values.
        quick: whether to stop after a fixed amount of work.
        is_possible_place: a function that returns whether a CRC may be at a place.
    """
    if mixed:
        mirrors = [(False, True), (True, False)]
    else:
        mirrors = [(False, False), (True, True)]
    picks = [
        samples.select_of_usual_length(FRAMES_PER_PICK, pick)
        for pick in range(MAX_PICKS if len(samples) > 2 * FRAMES_PER_PICK else 1)
    ]
    by_width = [
        [
            place
            for place in filter(is_possible_place, samples.iter_places(width // 8))
            if _varies_like_crc(samples, place)
        ]
        for width in WIDTHS
    ]
    tried = 0
    sure = False
    work_left = QUICK_WORK if quick else math.inf
    for place in (
        place for places in zip_longest(*by_width) for place in places if place is not None
    ):
        width = 8 * place.size
        byte_orders: tuple[ByteOrder, ...] = ("little", "big") if width > 8 else ("little",)
        bit_orders = [
            _BitOrder(width, order, *mirror) for order in byte_orders for mirror in mirrors
        ]
        for span, bit_order in product(iter_spans(place, samples), bit_orders):
            tried += 1
            at_end = place.offset == -place.size
            by_catalogue = samples.shortest > MAX_DIVIDED_BYTES and (quick or not at_end)
            chosen = picks if at_end and span.covers_all else picks[:1]
            work_left -= sum(
                _estimate_cost(pick, bit_order, by_catalogue=by_catalogue) for pick in chosen
            )
            if work_left < 0:
                return
            results = (
                list(
                    _iter_matches(
                        samples, pick, place, span, bit_order, tried, by_catalogue=by_catalogue
                    )
                )
                for pick in chosen
            )
            for match in next((matches for matches in results if matches), []):
                sure = sure or match.is_sure
                yield match
        if sure:
            return


def _estimate_cost(subset: SampleFrames, bit_order: _BitOrder, *, by_catalogue: bool) -> int:
    """Return the estimated work of a search, in bytes of CRC computation."""
    if by_catalogue:
        return subset.shortest * len(bit_order.catalogue_crcs())
    return DIVISION_WORK * sum(map(len, subset.frames))


def _varies_like_crc(samples: SampleFrames, place: ChecksumPlace) -> bool:
    """Return whether each byte of a possible checksum varies enough for a CRC."""
    if len(samples) < 2:
        return True
    min_distinct = max(min(len(samples) // 2, 24), 2)
    columns = (
        samples.read_field(ChecksumPlace(place.offset + index, 1), "little")
        for index in range(place.size)
    )
    return all(len(np.unique(column)) >= min_distinct for column in columns)


def _make_codewords(
    samples: SampleFrames, place: ChecksumPlace, span: CoveredSpan, bit_order: _BitOrder
) -> Codewords:
    rows = [row.tobytes() for group in samples.cut_span(place, span) for row in group]
    stored = samples.read_field(place, bit_order.order).tolist()
    return [
        (len(row), bit_order.message(row) ^ bit_order.register(value))
        for row, value in zip(rows, stored, strict=True)
    ]


def _iter_matches(
    samples: SampleFrames,
    subset: SampleFrames,
    place: ChecksumPlace,
    span: CoveredSpan,
    bit_order: _BitOrder,
    tried: int,
    *,
    by_catalogue: bool,
) -> Iterator[ChecksumMatch]:
    """Yield the CRCs that match for one place, one span and one bit order.

    Args:
        subset: the frames from which candidates are calculated.
        bit_order: the bit order of the CRC.
        tried: number of checksums tried so far; it reduces the certainty of a match.
        by_catalogue: whether to try only the CRCs of the catalogue.
    """
    stored = samples.read_field(place, bit_order.order)
    if by_catalogue:
        candidates = _iter_catalogue(subset, place, span, bit_order)
    else:
        candidates = _iter_candidates(_make_codewords(subset, place, span, bit_order), bit_order)
    for crc, fitted, notes in candidates:
        right = samples.count_valid(crc, place, span, bit_order.order)
        is_known = crc.poly in KNOWN_POLYNOMIALS[crc.width]
        # An unknown polynomial is an additional fitted parameter. A known polynomial is one of many
        # that were tried.
        evidence_bits = weigh_evidence(
            crc.width, stored, fitted + (not is_known), tried * (len(CRCS) if is_known else 1)
        )
        if are_enough_valid(right, len(samples)) and evidence_bits > 0:
            yield ChecksumMatch(
                crc,
                place,
                span,
                bit_order.order,
                right,
                len(samples),
                evidence_bits,
                format_crc(crc),
                notes,
                name_of(crc),
                is_ambiguous=bool(notes),
            )


def _iter_candidates(
    words: Codewords, bit_order: _BitOrder
) -> Iterator[tuple[Crc, int, tuple[str, ...]]]:
    """Yield candidate CRCs.

    Yields:
        A CRC, the number of frames from which it was calculated, and notes about ambiguous
        parameters.
    """
    ones = (1 << bit_order.width) - 1
    lengths = {size for size, _ in words}
    differences = _find_differences(words)
    if len(differences) >= 2:
        for poly in _find_polynomials(differences, bit_order.width):
            yield from _iter_crcs(words, poly, bit_order, has_one_length=len(lengths) == 1)
        return
    for init, xorout in product((0, ones), repeat=2):
        absolute = [
            word ^ bit_order.init_term(init, size) ^ xorout
            for size, word in words
            if 8 * size >= bit_order.width
        ]
        if len(absolute) < 2:
            continue
        for poly in _find_polynomials(absolute, bit_order.width):
            yield bit_order.crc(poly, init, xorout), 0, ()
    if len(words) == 1:
        yield from ((crc, 0, ()) for crc in bit_order.catalogue_crcs())


def _iter_catalogue(
    subset: SampleFrames, place: ChecksumPlace, span: CoveredSpan, bit_order: _BitOrder
) -> Iterator[tuple[Crc, int, tuple[str, ...]]]:
    """Yield the CRCs of the catalogue that are valid for the first frame."""
    covered = subset.cut_span(place, span)[0][0].tobytes()
    stored = int(subset.read_field(place, bit_order.order)[0])
    yield from ((crc, 0, ()) for crc in bit_order.catalogue_crcs() if crc(covered) == stored)


def _find_differences(words: Codewords) -> list[int]:
    """Return the XOR of each frame with the first frame of the same length, without zeros."""
    first: dict[int, int] = {}
    return [word ^ first[size] for size, word in words if first.setdefault(size, word) != word]


def _find_polynomials(multiples: Sequence[int], width: int) -> list[int]:
    """Return the CRC polynomials that divide all multiples, known polynomials first."""
    xor_polynomial = (1 << width) | 1  # its CRC is a plain XOR, which is searched elsewhere
    polynomials = [
        poly
        for poly in find_divisors(find_common_divisor(multiples, floor=width), width)
        if poly != xor_polynomial
    ]
    catalogued = [
        poly for poly in polynomials if poly & ((1 << width) - 1) in KNOWN_POLYNOMIALS[width]
    ]
    return (catalogued + [poly for poly in polynomials if poly not in catalogued])[:MAX_POLYNOMIALS]


def _iter_crcs(
    words: Codewords, poly: int, bit_order: _BitOrder, *, has_one_length: bool
) -> Iterator[tuple[Crc, int, tuple[str, ...]]]:
    """Yield the likeliest CRC with a given polynomial; nothing if no CRC fits.

    Args:
        has_one_length: whether all frames have the same length.
    """
    first = dict(reversed(words))  # the first frame of each length
    remainders = {size: remainder(word, poly) for size, word in first.items()}
    ones = (1 << bit_order.width) - 1
    usual = [
        crc.init
        for crc in CRCS.values()
        if (crc.width, crc.refin, crc.poly) == (bit_order.width, bit_order.refin, poly & ones)
    ]
    consistent = []
    for init in dict.fromkeys((*usual, 0, ones)):
        finals = {
            rest ^ remainder(bit_order.init_term(init, size), poly)
            for size, rest in remainders.items()
        }
        if len(finals) == 1:
            consistent.append(bit_order.crc(poly, init, finals.pop()))
    plain = [crc for crc in consistent if name_of(crc)] + [
        crc for crc in consistent if crc.xorout in (0, ones)
    ]
    if plain:
        yield plain[0], 1, ()
    elif consistent and has_one_length:
        yield (
            consistent[0],
            1,
            (
                (
                    "all frames have the same length, so other pairs of init and xorout fit them"
                    " equally well"
                ),
            ),
        )
    elif consistent:
        yield consistent[0], 2, ()
    elif len(remainders) > 1:
        yield from _solve_registers(remainders, poly, bit_order)


def _solve_registers(
    remainders: dict[int, int], poly: int, bit_order: _BitOrder
) -> Iterator[tuple[Crc, int, tuple[str, ...]]]:
    """Yield the CRC whose start value and final XOR fit frames of several lengths.

    Yields nothing if no such values exist.

    Args:
        remainders: for each length, the remainder of a frame of this length modulo `poly`.
    """
    (size, rest), *others = remainders.items()
    equations = []
    bits = range(bit_order.width)
    for other, other_rest in others:
        columns = [
            remainder(
                bit_order.init_term(1 << bit, size) ^ bit_order.init_term(1 << bit, other), poly
            )
            for bit in bits
        ]
        difference = rest ^ other_rest
        equations += [
            (sum((columns[bit] >> row & 1) << bit for bit in bits), difference >> row & 1)
            for row in bits
        ]
    solution = solve(equations, bit_order.width)
    if solution is not None:
        first, free = solution
        basis = free[:4]  # enough solutions to find a usual one among them
        subsets = (
            subset for count in range(1 + len(basis)) for subset in combinations(basis, count)
        )
        inits = [functools.reduce(operator.xor, subset, first) for subset in subsets]
        pairs = [(init, rest ^ remainder(bit_order.init_term(init, size), poly)) for init in inits]
        init, xorout = min(
            pairs, key=lambda pair: (pair[1] not in (0, (1 << bit_order.width) - 1), pair[0])
        )
        notes: tuple[str, ...] = ()
        if free:
            notes = (f"{2 ** len(free)} pairs of init and xorout fit these frames equally well",)
        yield bit_order.crc(poly, init, xorout), 2, notes


def format_crc(crc: Crc) -> str:
    """Return the Python expression for a CRC in a plugin."""
    digits = crc.width // 4
    parts = [f"width={crc.width}", f"poly=0x{crc.poly:0{digits}X}"]
    parts += (
        [f"init=0x{crc.init:0{digits}X}"] * bool(crc.init)
        + ["refin=True"] * crc.refin
        + ["refout=True"] * crc.refout
    )
    parts += [f"xorout=0x{crc.xorout:0{digits}X}"] * bool(crc.xorout)
    return f"Crc({', '.join(parts)})"
