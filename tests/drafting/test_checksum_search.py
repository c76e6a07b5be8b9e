"""Tests of the search for a checksum: results and cost on frames with a known one."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import lidarspec
import lidarspec.spec
from lidarspec.drafting.checksum_search import ChecksumWithConstant, WordSum, search
from lidarspec.drafting.crc_search import (
    find_common_divisor,
    find_divisors,
    iter_crc_matches,
    quotient,
    remainder,
    solve,
)
from lidarspec.drafting.samples import ChecksumMatch, ChecksumPlace, SampleFrames, sort_matches
from lidarspec.simulation.simulator import simulate
from lidarspec.spec import Checksum, Crc, Fletcher, Fold15, Sum, WordXor, Xor
from lidarspec.spec.checksums import CRCS, name_of

HEAD = b"\xaa\x55"


def make_frames_with_checksum(
    checksum: Checksum,
    number: int = 12,
    length: int = 30,
    *,
    order: str = "little",
    skip: int = 0,
    vary: int = 1,
) -> list[bytes]:
    """Return frames with a header, random content, and a checksum at the end.

    The checksum covers all but the first `skip` bytes.
    """
    source = random.Random(number * length)
    bodies = [HEAD + source.randbytes(length + source.randrange(vary)) for _ in range(number)]
    return [
        body + checksum(body[skip:]).to_bytes(-(-checksum.width // 8), order) for body in bodies
    ]  # type: ignore[arg-type]


def find_best(frames: list[bytes]) -> ChecksumMatch:
    return search(frames)[0]


def found_among_crcs(frames: list[bytes]) -> ChecksumMatch:
    """Search only the CRCs, without trying plain checksums first."""
    samples = SampleFrames(frames)
    return sort_matches(
        list(iter_crc_matches(samples)) or list(iter_crc_matches(samples, mixed=True))
    )[0]


def assert_found_by_name(
    find: Callable[[list[bytes]], ChecksumMatch], name: str, length: int
) -> None:
    crc = CRCS[name]
    match = find(
        make_frames_with_checksum(
            crc, length=length, order="big" if len(name) % 2 else "little", vary=3
        )
    )
    assert (match.algorithm, match.name, match.place) == (
        crc,
        name,
        ChecksumPlace(-crc.width // 8, crc.width // 8),
    )
    assert (match.right, match.total) == (12, 12)
    assert match.order == ("big" if len(name) % 2 and crc.width > 8 else "little")


#: those of the catalogue that a search tells from others; one in six in the quick tier.
TOLD_APART = [
    name for name in CRCS if name not in ("CRC-8/I-CODE", "CRC-16/AUG-CCITT", "CRC-8/ITU")
]


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if index % 6 else ())
        for index, name in enumerate(TOLD_APART)
    ],
)
def test_every_crc_of_the_catalogue_is_found_by_name(name: str) -> None:
    assert_found_by_name(found_among_crcs, name, 16)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["CRC-16/MODBUS", "CRC-8", "CRC-32/BZIP2"])
def test_a_crc_is_found_behind_the_plain_checksums(name: str) -> None:
    assert_found_by_name(find_best, name, 30)


def test_the_catalogue_agrees_with_crccheck() -> None:
    others = {
        (c._width, c._poly, c._initvalue, c._reflect_input, c._reflect_output, c._xor_output)
        for c in pytest.importorskip("crccheck.crc").ALLCRCCLASSES
    }
    for crc in CRCS.values():
        assert (crc.width, crc.poly, crc.init, crc.refin, crc.refout, crc.xorout) in others


@pytest.mark.parametrize(
    ("width", "reflected"),
    [
        (16, True),
        *(
            pytest.param(*pair, marks=pytest.mark.slow)
            for pair in ((8, False), (8, True), (16, False), (32, False), (32, True))
        ),
    ],
)
def test_a_crc_that_no_catalogue_knows(width: int, *, reflected: bool) -> None:
    source = random.Random(width)
    poly, init, xorout = (source.getrandbits(width) | 1 for _ in range(3))
    crc = Crc(width, poly, init, reflected, reflected, xorout)
    assert name_of(crc) == ""
    frames = make_frames_with_checksum(crc, 24, 25, vary=5)
    match = found_among_crcs(frames)
    assert isinstance(match.algorithm, Crc)
    assert (match.algorithm.poly, match.algorithm.refin, match.right) == (poly, reflected, 24)
    assert all(
        match.algorithm(frame[: -width // 8]) == crc(frame[: -width // 8]) for frame in frames
    )
    # Several pairs of init and xorout can be the same function.
    assert match.algorithm == crc or match.is_ambiguous


@pytest.mark.slow
def test_init_and_xorout_are_undetermined_for_frames_of_one_length() -> None:
    crc = Crc(16, 0x755B, 0x1234, xorout=0x4321)
    frames = make_frames_with_checksum(crc)
    match = find_best(frames)
    assert isinstance(match.algorithm, Crc)
    assert match.algorithm.poly == crc.poly
    assert match.is_ambiguous
    assert "other pairs of init and xorout fit" in match.remarks[0]
    assert all(match.algorithm(frame[:-2]) == crc(frame[:-2]) for frame in frames)


@pytest.mark.slow
def test_a_checksum_that_skips_the_first_bytes() -> None:
    match = find_best(make_frames_with_checksum(CRCS["CRC-16/MODBUS"], skip=2))
    assert (match.name, match.span.head, match.span.describe(match.place, 34)) == (
        "CRC-16/MODBUS",
        2,
        "all bytes except the checksum and the first 2",
    )


@pytest.mark.parametrize(
    "checksum",
    [
        pytest.param(Xor(), marks=pytest.mark.slow),
        pytest.param(Sum(8), marks=pytest.mark.slow),
        Sum(16),
        Sum(32),
        Fletcher(),
        Fold15(),
        pytest.param(WordXor(), marks=pytest.mark.slow),
        WordSum("little"),
        WordSum("big", carry=True),
        pytest.param(ChecksumWithConstant(Sum(8), 0xFF, negative=True), marks=pytest.mark.slow),
    ],
    ids=lambda checksum: checksum.describe(),
)
def test_plain_checksums(checksum: Checksum) -> None:
    frames = make_frames_with_checksum(
        checksum, length=27 if not isinstance(checksum, WordXor) else 28
    )
    at_end = [match for match in search(frames) if match.place.offset == -match.place.size]
    assert checksum in [match.algorithm for match in at_end]
    assert at_end[0].right == 12


@pytest.mark.parametrize(
    "checksum",
    [
        WordSum("big", carry=True),
        *(
            pytest.param(checksum, marks=pytest.mark.slow)
            for checksum in (
                ChecksumWithConstant(Sum(8), 0x5A),
                ChecksumWithConstant(Sum(16), 0, negative=True),
                ChecksumWithConstant(Sum(16), 0x1234),
            )
        ),
    ],
)
def test_the_printed_python_computes_the_same_checksum(checksum: Checksum) -> None:
    frames = make_frames_with_checksum(checksum, 40, 27)
    match = find_best(frames)
    scope: dict[str, Any] = vars(lidarspec) | {
        name: getattr(lidarspec.spec, name) for name in ("Checksum", "Xor", "WordXor")
    }
    exec(match.source, scope)
    pasted = scope["Check"]()
    for frame in frames:
        first, last = match.span.ranges(match.place, len(frame))[0]
        assert (
            pasted(frame[first:last])
            == match.algorithm(frame[first:last])
            == int.from_bytes(frame[-match.place.size :], match.order)
        )


@pytest.mark.parametrize("number", [5, pytest.param(40, marks=pytest.mark.slow)])
def test_grouped_words_around_a_field(number: int) -> None:
    match = find_best(simulate(lidarspec.sensor("cspc-m1c1-mini"), 40)[-number:])
    assert (match.algorithm, match.place) == (WordXor(head=8, groups=(1, 2)), ChecksumPlace(8, 2))
    assert match.source == "WordXor(head=8, groups=(1, 2))"


@pytest.mark.slow
def test_an_xor_with_a_constant_is_found_and_its_place_a_guess() -> None:
    frames = make_frames_with_checksum(ChecksumWithConstant(Xor(), 0x33), 40, 27)
    matches = search(frames)
    assert {match.algorithm for match in matches} == {ChecksumWithConstant(Xor(), 0x33)}
    assert ChecksumPlace(-1, 1) in [match.place for match in matches]
    assert all(
        "at several offsets" in match.remarks[-1] for match in matches if match.span.head == 0
    )


def test_an_xor_in_two_nibbles_is_searched_only_at_possible_places() -> None:
    source = random.Random(1)
    frames = []
    for _ in range(20):
        content = source.randbytes(10)
        checksum = Xor()(content)
        frames.append(bytes([0xA0 | checksum & 15, 0x50 | checksum >> 4]) + content)
    match = find_best(frames)
    assert (match.algorithm, match.place) == (Xor(), ChecksumPlace(0, 2))
    assert match.is_in_nibbles
    number_of_checksums = len({frame[:2] for frame in frames})
    trials = 1 + 2 + 2  # at the offsets 0, 1 and 2
    assert match.evidence_bits == 8 * number_of_checksums - np.log2(trials)
    assert search(frames, is_possible_place=lambda place: place.offset == 0) == [match]
    assert search(frames, is_possible_place=lambda place: place.offset == 1) == []


@pytest.mark.slow
def test_an_xor_in_two_nibbles() -> None:
    match = find_best(
        simulate(lidarspec.sensor("slamtec-rplidar-a1").configure(answer="express"), 20)
    )
    assert (match.algorithm, match.place) == (Xor(), ChecksumPlace(0, 2))
    assert "low nibbles" in match.remarks[0]


@pytest.mark.slow
def test_damaged_frames_do_not_hide_it() -> None:
    frames = make_frames_with_checksum(Crc(8, 0x4D), 60, 44)
    damaged = [
        bytes([*frame[:9], frame[9] ^ 0x40, *frame[10:]]) if index % 5 == 0 else frame
        for index, frame in enumerate(frames)
    ]
    match = find_best(damaged)
    assert (match.algorithm, match.right, match.total) == (Crc(8, 0x4D), 48, 60)


@pytest.mark.slow
@pytest.mark.parametrize("length", [20, 300])
def test_random_bytes_have_none(length: int) -> None:
    source = random.Random(length)
    assert search([source.randbytes(length) for _ in range(20)]) == []


def test_empty_input_gives_empty_output() -> None:
    assert search([]) == []
    assert search([b"\x01"]) == []
    assert search([bytes(20)] * 30) == []


def test_division() -> None:
    source = random.Random(1)
    for _ in range(50):
        a, b = source.getrandbits(60), source.getrandbits(20) | 1
        q, r, product = quotient(a, b), remainder(a, b), 0
        for bit in range(q.bit_length()):
            product ^= (b << bit) * (q >> bit & 1)
        assert product ^ r == a
        assert r.bit_length() < b.bit_length()


def test_divisors_of_a_common_multiple() -> None:
    poly, source = 0x18005, random.Random(2)

    def times(other: int) -> int:
        product = 0
        for bit in range(other.bit_length()):
            product ^= (poly << bit) * (other >> bit & 1)
        return product

    multiples = [times(source.getrandbits(200)) for _ in range(4)]
    assert find_divisors(find_common_divisor(multiples), 16) == [poly]
    assert poly in find_divisors(times(0b1011), 16)
    assert poly in find_divisors(multiples[0], 16)  # every polynomial of degree 16 is tried at once
    assert find_divisors(0, 8) == []


def test_linear_equations_and_their_freedom() -> None:
    unknown = 0b1011
    equations = [(mask, bin(mask & unknown).count("1") & 1) for mask in (0b0001, 0b0011, 0b0111)]
    solution, free = solve(equations, 4) or (0, [])
    assert len(free) == 1
    assert unknown in (solution, solution ^ free[0])
    assert solve([*equations, (0b0001, 0)], 4) is None


def test_batches_of_the_checksums_without_a_name() -> None:
    rows = np.frombuffer(random.Random(3).randbytes(60), np.uint8).reshape(4, 15)
    for checksum in (
        WordSum("big"),
        WordSum("little", carry=True),
        ChecksumWithConstant(Sum(8), 7, negative=True),
        ChecksumWithConstant(Xor(), 9),
    ):
        assert checksum.batch(rows).tolist() == [checksum(row.tobytes()) for row in rows]
        assert checksum.describe()
