"""The search for a CRC of 8, 16 or 32 bits: every polynomial at once, by division instead of by
trial.

Polynomials over GF(2) are integers here, bit k the coefficient of x**k. A CRC is the remainder of a
message by its polynomial. So the polynomial divides the message with its checksum behind it, and of
two frames of one length it divides the XOR of both, whatever register the CRC begins with and
whatever is XORed onto it: the greatest common divisor of such pairs is it. Start value and final
XOR then follow: where frames differ in length they are the solution of linear equations; where all
have one length, many pairs say the same, and the most usual of them is taken. Where no two frames
have one length, or there are few, the usual pairs are assumed first, so that every frame counts by
itself.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, product, zip_longest

import numpy as np

from lidarspec.drafting.samples import Match, Place, Samples, Span, anywhere, doubt, enough, spans
from lidarspec.spec.checksums import CRCS, KNOWN, MIRROR, ByteOrder, Crc, name_of, reflected

#: how much larger than sought a common divisor may be, where its divisors are tried one by one.
SPARE = 11
#: the widest first: the polynomial of a narrow one can be a divisor of that of a wide one.
WIDTHS = (32, 16, 8)
#: frames longer than this are divided for a checksum at their end alone; elsewhere the catalogue is
#: tried.
DIVIDED = 256
#: bytes of which a CRC is computed in the time in which one byte is divided.
DIVISION_WORK = 32
#: work of a quick search, in bytes of which a CRC is computed: about a second.
QUICK_WORK = 1 << 23
#: frames of one length that a polynomial is sought with; at the usual place other picks are tried
#: where one fails, in case of damage.
TAKEN = 4
PICKS = 6
#: most polynomials that are held against all frames for one place and span.
WEIGHED = 64
#: (size of what is covered, message with the checksum behind it) of each frame.
Codewords = list[tuple[int, int]]


def remainder(a: int, b: int) -> int:
    """a modulo b; b is not 0."""
    size = b.bit_length()
    while (shift := a.bit_length() - size) >= 0:
        a ^= b << shift
    return a


def quotient(a: int, b: int) -> int:
    """a divided by b, without the remainder; b is not 0."""
    size = b.bit_length()
    found = 0
    while (shift := a.bit_length() - size) >= 0:
        a ^= b << shift
        found |= 1 << shift
    return found


def common_divisor(polynomials: Iterable[int], *, floor: int = 0) -> int:
    """The largest polynomial that divides all of them; 0 for none but zeros, and early where its
    degree falls below `floor`.
    """
    found = 0
    for polynomial in polynomials:
        other = polynomial
        while other:
            found, other = other, remainder(found, other) if found else 0
        if found and found.bit_length() <= floor:
            break
    return found


def divisors(polynomial: int, degree: int) -> list[int]:
    """The divisors of this degree whose constant term is 1, as those of CRCs have; [] where there
    are too many to try.
    """
    if polynomial == 0:
        return []
    polynomial >>= (polynomial & -polynomial).bit_length() - 1
    spare = polynomial.bit_length() - 1 - degree
    if spare < 0:
        return []
    if spare <= SPARE:
        found = (
            quotient(polynomial, small)
            for small in range((1 << spare) | 1, 2 << spare, 2)
            if remainder(polynomial, small) == 0
        )
        if spare:
            return sorted(found)
        return [polynomial]
    if degree <= 16:
        return _tried(polynomial, degree)
    return []


def _tried(polynomial: int, degree: int) -> list[int]:
    """The divisors of a small degree: every polynomial of it at once."""
    candidates = np.arange((1 << degree) | 1, 2 << degree, 2, dtype=np.uint32)
    rest = np.zeros(len(candidates), np.uint32)
    top = np.uint32(degree)
    for bit in range(polynomial.bit_length() - 1, -1, -1):
        rest = rest << np.uint32(1) | np.uint32(polynomial >> bit & 1)
        rest ^= candidates * (rest >> top)
    return [int(one) for one in candidates[rest == 0]]


def solve(equations: Sequence[tuple[int, int]], width: int) -> tuple[int, list[int]] | None:
    """A solution of linear equations over GF(2), and what can be added to it; None where there is
    none.

    Args:
        equations: (mask, bit) each: the XOR of the unknown's bits under the mask is the bit.
        width: bits of the unknown.
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
        rows = {place: other ^ row if other >> lead & 1 else other for place, other in rows.items()}
        rows[lead] = row
    solution = sum(1 << lead for lead, row in rows.items() if row >> width & 1)
    free = [bit for bit in range(width) if bit not in rows]
    return solution, [
        1 << bit | sum(1 << lead for lead, row in rows.items() if row >> bit & 1) for bit in free
    ]


@dataclass(frozen=True)
class _Reading:
    """How frames are read as polynomials: bytes and register with the lowest bit first, or not."""

    width: int
    order: ByteOrder
    refin: bool
    refout: bool

    def message(self, data: bytes) -> int:
        return int.from_bytes(data.translate(MIRROR) if self.refin else data, "big") << self.width

    def register(self, value: int) -> int:
        if self.refout:
            return reflected(value, self.width)
        return value

    def started(self, init: int, size: int) -> int:
        """What a start value adds to the message of `size` bytes."""
        return init << 8 * size

    def known(self) -> list[Crc]:
        """The CRCs of the catalogue that are read like this."""
        return [
            crc
            for crc in CRCS.values()
            if (crc.width, crc.refin, crc.refout) == (self.width, self.refin, self.refout)
        ]

    def crc(self, poly: int, init: int, xorout: int) -> Crc:
        low = poly & ((1 << self.width) - 1)
        return Crc(self.width, low, init, self.refin, self.refout, self.register(xorout))


def crc_matches(
    samples: Samples,
    *,
    mixed: bool = False,
    quick: bool = False,
    stands: Callable[[Place], bool] = anywhere,
) -> Iterator[Match]:
    """Every CRC that fits, up to the first place with a sure one.

    Args:
        mixed: look for those whose bytes and register are not mirrored alike, in place of those
            where they are.
        quick: end after a fixed amount of work; the usual places come first.
        stands: whether a CRC may stand at a place.
    """
    if mixed:
        mirrors = [(False, True), (True, False)]
    else:
        mirrors = [(False, False), (True, True)]
    picks = [samples.alike(TAKEN, pick) for pick in range(PICKS if len(samples) > 2 * TAKEN else 1)]
    by_width = [
        [place for place in filter(stands, samples.places(width // 8)) if _random(samples, place)]
        for width in WIDTHS
    ]
    tried = 0
    sure = False
    work_left = QUICK_WORK if quick else math.inf
    for place in (
        place for places in zip_longest(*by_width) for place in places if place is not None
    ):
        width = 8 * place.size
        orders: tuple[ByteOrder, ...] = ("little", "big") if width > 8 else ("little",)
        readings = [_Reading(width, order, *mirror) for order in orders for mirror in mirrors]
        for span, reading in product(spans(place, samples), readings):
            tried += 1
            at_end = place.offset == -place.size
            by_catalogue = samples.shortest > DIVIDED and (quick or not at_end)
            chosen = picks if at_end and span == Span() else picks[:1]
            work_left -= sum(_work(some, reading, by_catalogue=by_catalogue) for some in chosen)
            if work_left < 0:
                return
            found = (
                list(
                    _fitting(samples, some, place, span, reading, tried, by_catalogue=by_catalogue)
                )
                for some in chosen
            )
            for match in next((matches for matches in found if matches), []):
                sure = sure or match.sure
                yield match
        if sure:
            return


def _work(few: Samples, reading: _Reading, *, by_catalogue: bool) -> int:
    """Return how much work one place, span and reading are, in bytes of which a CRC is computed."""
    if by_catalogue:
        return few.shortest * len(reading.known())
    return DIVISION_WORK * sum(map(len, few.frames))


def _random(samples: Samples, place: Place) -> bool:
    """Whether every byte of a place varies as those of a CRC do."""
    if len(samples) < 2:
        return True
    wanted = max(min(len(samples) // 2, 24), 2)
    columns = (
        samples.fields(Place(place.offset + spot, 1), "little") for spot in range(place.size)
    )
    return all(len(np.unique(column)) >= wanted for column in columns)


def _codewords(samples: Samples, place: Place, span: Span, reading: _Reading) -> Codewords:
    rows = [row.tobytes() for group in samples.covered(place, span) for row in group]
    there = samples.fields(place, reading.order).tolist()
    return [
        (len(row), reading.message(row) ^ reading.register(value))
        for row, value in zip(rows, there, strict=True)
    ]


def _fitting(
    samples: Samples,
    few: Samples,
    place: Place,
    span: Span,
    reading: _Reading,
    tried: int,
    *,
    by_catalogue: bool,
) -> Iterator[Match]:
    """The CRCs of one place, span and reading; of the catalogue alone, or any."""
    there = samples.fields(place, reading.order)
    if by_catalogue:
        candidates = _catalogued(few, place, span, reading)
    else:
        candidates = _candidates(_codewords(few, place, span, reading), reading)
    for crc, fitted, remarks in candidates:
        right = samples.right(crc, place, span, reading.order)
        known = crc.poly in KNOWN[crc.width]
        doubtful = doubt(
            crc.width, there, fitted + (not known), tried * (len(CRCS) if known else 1)
        )
        if enough(right, len(samples)) and doubtful > 0:
            open_ = bool(remarks)
            yield Match(
                crc,
                place,
                span,
                reading.order,
                right,
                len(samples),
                doubtful,
                pasted(crc),
                remarks,
                name_of(crc),
                open_,
            )


def _candidates(words: Codewords, reading: _Reading) -> Iterator[tuple[Crc, int, tuple[str, ...]]]:
    """CRCs to be tried, with how many values of the frames went into their parameters, and what
    remains open.
    """
    ones = (1 << reading.width) - 1
    lengths = {size for size, _ in words}
    same = _differences(words)
    if len(same) >= 2:
        for poly in _polynomials(same, reading.width):
            yield from _registers(words, poly, reading, open_=len(lengths) == 1)
        return
    for init, xorout in product((0, ones), repeat=2):
        absolute = [
            word ^ reading.started(init, size) ^ xorout
            for size, word in words
            if 8 * size >= reading.width
        ]
        if len(absolute) < 2:
            continue
        for poly in _polynomials(absolute, reading.width):
            yield reading.crc(poly, init, xorout), 0, ()
    if len(words) == 1:
        yield from ((crc, 0, ()) for crc in reading.known())


def _catalogued(
    few: Samples, place: Place, span: Span, reading: _Reading
) -> Iterator[tuple[Crc, int, tuple[str, ...]]]:
    """The CRCs of the catalogue that are right for one frame."""
    rows = few.covered(place, span)[0][0].tobytes()
    there = int(few.fields(place, reading.order)[0])
    yield from ((crc, 0, ()) for crc in reading.known() if crc(rows) == there)


def _differences(words: Codewords) -> list[int]:
    """The XOR of frames of one length."""
    first: dict[int, int] = {}
    return [word ^ first[size] for size, word in words if first.setdefault(size, word) != word]


def _polynomials(multiples: Sequence[int], width: int) -> list[int]:
    found = [
        poly
        for poly in divisors(common_divisor(multiples, floor=width), width)
        if poly != (1 << width) | 1
    ]  # that one is an XOR
    known = [poly for poly in found if poly & ((1 << width) - 1) in KNOWN[width]]
    return (known + [poly for poly in found if poly not in known])[:WEIGHED]


def _registers(
    words: Codewords, poly: int, reading: _Reading, *, open_: bool
) -> Iterator[tuple[Crc, int, tuple[str, ...]]]:
    """Start value and final XOR for a polynomial."""
    first = dict(reversed(words))  # one frame of each length
    left = {size: remainder(word, poly) for size, word in first.items()}
    ones = (1 << reading.width) - 1
    usual = [
        crc.init
        for crc in CRCS.values()
        if (crc.width, crc.refin, crc.poly) == (reading.width, reading.refin, poly & ones)
    ]
    consistent = []
    for init in dict.fromkeys((*usual, 0, ones)):
        finals = {
            rest ^ remainder(reading.started(init, size), poly) for size, rest in left.items()
        }
        if len(finals) == 1:
            consistent.append(reading.crc(poly, init, finals.pop()))
    plain = [crc for crc in consistent if name_of(crc)] + [
        crc for crc in consistent if crc.xorout in (0, ones)
    ]
    if plain:
        yield plain[0], 1, ()
    elif consistent and open_:
        yield (
            consistent[0],
            1,
            (
                (
                    "with frames of one length alone, init and xorout cannot be told apart: other"
                    " pairs do the same"
                ),
            ),
        )
    elif consistent:
        yield consistent[0], 2, ()
    elif len(left) > 1:
        yield from _solved(left, poly, reading)


def _solved(
    left: dict[int, int], poly: int, reading: _Reading
) -> Iterator[tuple[Crc, int, tuple[str, ...]]]:
    """Start value and final XOR from frames of several lengths, by linear equations."""
    (size, rest), *others = left.items()
    equations = []
    bits = range(reading.width)
    for other, other_rest in others:
        columns = [
            remainder(reading.started(1 << bit, size) ^ reading.started(1 << bit, other), poly)
            for bit in bits
        ]
        wanted = rest ^ other_rest
        equations += [
            (sum((columns[bit] >> row & 1) << bit for bit in bits), wanted >> row & 1)
            for row in bits
        ]
    found = solve(equations, reading.width)
    if found is not None:
        first, free = found
        some = (
            chosen for count in range(1 + len(free[:4])) for chosen in combinations(free[:4], count)
        )
        inits = [functools.reduce(operator.xor, chosen, first) for chosen in some]
        pairs = [(init, rest ^ remainder(reading.started(init, size), poly)) for init in inits]
        init, xorout = min(
            pairs, key=lambda pair: (pair[1] not in (0, (1 << reading.width) - 1), pair[0])
        )
        remarks = (f"{2 ** len(free)} pairs of init and xorout fit these frames",) if free else ()
        yield reading.crc(poly, init, xorout), 2, remarks


def pasted(crc: Crc) -> str:
    """A CRC as a plugin writes it."""
    digits = crc.width // 4
    parts = [f"width={crc.width}", f"poly=0x{crc.poly:0{digits}X}"]
    parts += (
        [f"init=0x{crc.init:0{digits}X}"] * bool(crc.init)
        + ["refin=True"] * crc.refin
        + ["refout=True"] * crc.refout
    )
    parts += [f"xorout=0x{crc.xorout:0{digits}X}"] * bool(crc.xorout)
    return f"Crc({', '.join(parts)})"
