"""Tests of checksums: check values, a bitwise oracle, another library, real frames."""

from __future__ import annotations

import dataclasses
import pickle
import random
import re
import tracemalloc
import zlib
from collections.abc import Collection, Iterable
from itertools import product
from operator import methodcaller
from typing import Any

import numpy as np
import pytest
from construct import BitsInteger, BitStruct, Const, Int8ub, Struct
from numpy.typing import NDArray

from lidarspec import SpecError
from lidarspec.frames.row_checksums import compute_checksums, compute_over_spans
from lidarspec.spec import (
    Checksum,
    Checksummed,
    Crc,
    Fletcher,
    Fold15,
    Sum,
    WordXor,
    Xor,
    ZeroPadded,
)
from tests.engine import against_construct
from tests.evidence import vector_bytes

VECTORS = "vectors_serial2d.json"

CRC8_LDROBOT = Crc(8, 0x4D)
CRC16_MODBUS = Crc(16, 0x8005, init=0xFFFF, refin=True, refout=True)
CRC32 = Crc(32, 0x04C11DB7, init=0xFFFFFFFF, refin=True, refout=True, xorout=0xFFFFFFFF)
M1C1 = WordXor(head=8, groups=(1, 2))

# The checksum of b"123456789", as catalogues print it.
CHECK_VALUES = [
    (CRC8_LDROBOT, 0xC3),
    (CRC16_MODBUS, 0x4B37),
    (Crc(16, 0x1021, init=0xFFFF), 0x29B1),  # CCITT-FALSE
    (Crc(32, 0x04C11DB7, init=0xFFFFFFFF), 0x0376E6E7),  # MPEG-2, Hesai
    (CRC32, 0xCBF43926),
    (
        Crc(32, 0xF4ACFB13, init=0xFFFFFFFF, refin=True, refout=True, xorout=0xFFFFFFFF),
        0x1697D06A,
    ),  # AUTOSAR P4
    (
        Crc(64, 0x42F0E1EBA9EA3693, init=2**64 - 1, refin=True, refout=True, xorout=2**64 - 1),
        0x995DC9BBDF1939FA,
    ),  # XZ
    (Crc(24, 0x864CFB, init=0xB704CE), 0x21CF02),  # OpenPGP
    (Crc(12, 0x80F, refout=True), 0xDAF),  # UMTS
    (Crc(5, 0x05, init=0x1F, refin=True, refout=True, xorout=0x1F), 0x19),  # USB
    (Crc(3, 0x3, xorout=0x7), 0x4),  # GSM
]
ALGORITHMS: list[Checksum] = [
    *(crc for crc, _ in CHECK_VALUES),
    Crc(12, 0x80F, init=0x5A3, refin=True, xorout=0x0F1),
    Crc(1, 1, init=1),
    Crc(40, 0x0004820009, init=0x123456789A, refin=True),
    Xor(),
    *(Sum(width) for width in (1, 7, 8, 16, 20, 64)),
    *(
        WordXor(head, groups)
        for head, groups in [(0, (2,)), (0, (1,)), (8, (1, 2)), (3, (2, 1)), (5, (1, 2, 2, 1))]
    ),
    Fletcher(),
    Fold15(),
    *(
        ZeroPadded(inner, to)
        for inner, to in [(CRC32, 4), (Crc(16, 0x1021, order="big"), 3), (Fold15(), 8)]
    ),
]
#: Algorithms tried at length in the quick tier: of each kind, and CRCs of few bits, of whole bytes,
#: reflected and not.
QUICK_ALGORITHMS = [
    CRC8_LDROBOT,
    CRC16_MODBUS,
    CRC32,
    Crc(64, 0x42F0E1EBA9EA3693, init=2**64 - 1, refin=True, refout=True, xorout=2**64 - 1),
    Crc(12, 0x80F, init=0x5A3, refin=True, xorout=0x0F1),
    Crc(3, 0x3, xorout=0x7),
    Xor(),
    Sum(8),
    Sum(20),
    M1C1,
    WordXor(3, (2, 1)),
    Fletcher(),
    Fold15(),
    ZeroPadded(CRC32, 4),
]
QUICK_WIDTHS = (1, 3, 7, 8, 12, 16, 31, 32, 64)
name_of = methodcaller("describe")


def slow_unless(values: Iterable[Any], quick: Collection[Any]) -> list[Any]:
    """Return test parameters; all that are not in `quick` are marked as slow."""
    return [
        pytest.param(value, marks=() if value in quick else pytest.mark.slow) for value in values
    ]


def bitwise_crc(crc: Crc, data: bytes) -> int:
    """Return the CRC by its definition: one bit at a time through a shift register."""
    register = crc.init
    for byte in data:
        for bit in range(8) if crc.refin else range(7, -1, -1):
            feedback = register >> (crc.width - 1) & 1 ^ byte >> bit & 1
            register = register << 1 & (1 << crc.width) - 1
            if feedback:
                register ^= crc.poly
    if crc.refout:
        register = sum((register >> bit & 1) << (crc.width - 1 - bit) for bit in range(crc.width))
    return register ^ crc.xorout


def random_rows(count: int, length: int, seed: int = 0) -> NDArray[np.uint8]:
    rows = np.random.default_rng((seed, count, length)).integers(0, 256, (count, length), np.uint8)
    rows.setflags(write=False)
    return rows


def singly(algorithm: Checksum, rows: NDArray[np.uint8]) -> list[int]:
    return [algorithm(row.tobytes()) for row in rows]


@pytest.mark.parametrize(("crc", "check"), CHECK_VALUES, ids=str)
def test_catalogue_check_values(crc: Crc, check: int) -> None:
    # The reference implementation is tested as well.
    assert crc(b"123456789") == bitwise_crc(crc, b"123456789") == check
    rows = np.tile(np.frombuffer(b"123456789", np.uint8), (1000, 1))
    assert compute_checksums(crc, rows).tolist() == [check] * 1000


@pytest.mark.parametrize("length", [0, 1, 46, 1040, 5000, 300_001])
def test_crc32_is_that_of_zlib(length: int) -> None:
    data = random_rows(1, length).tobytes()
    assert CRC32(data) == zlib.crc32(data)


@pytest.mark.parametrize("length", [128, 129, 781])
@pytest.mark.parametrize("refout", [False, True])
def test_rows_of_the_polynomial_of_zlib_agree_with_the_bitwise_oracle(
    length: int, refout: bool
) -> None:
    crc = Crc(32, 0x04C11DB7, 0x12345678, True, refout, 0x9ABCDEF0)
    wide = random_rows(200, length + 9)
    for rows in (wide[:, 4:-5], np.asfortranarray(wide[:, 4:-5])):
        assert compute_checksums(crc, rows)[::13].tolist() == [
            bitwise_crc(crc, row.tobytes()) for row in rows[::13]
        ]


@pytest.mark.parametrize("width", slow_unless(range(1, 65), QUICK_WIDTHS))
def test_every_width_agrees_with_the_bitwise_oracle(width: int) -> None:
    rng, top = random.Random(width), 2**width - 1
    for refin, refout in product((False, True), repeat=2):
        crc = Crc(
            width, rng.randint(1, top), rng.randint(0, top), refin, refout, rng.randint(0, top)
        )
        for data in (
            rng.randbytes(length) for length in (0, 1, 2, 3, 7, 8, 9, rng.randint(10, 100), 2500)
        ):
            assert crc(data) == bitwise_crc(crc, data), (crc, len(data))
        shapes = [
            (2100, 1),
            (450, 5),
            (270, 8),
            (30, 77),
            (5, rng.randint(500, 700)),
            (1024, 17),
            (1030, rng.randint(20, 90)),
        ]
        for count, length in shapes:
            rows = random_rows(count, length, seed=width)
            values = compute_checksums(crc, rows)
            for row in (0, count // 2, count - 1):
                assert values[row] == bitwise_crc(crc, rows[row].tobytes()), (crc, length)


def test_agrees_with_crccheck() -> None:
    others = [
        other for other in pytest.importorskip("crccheck.crc").ALLCRCCLASSES if other._width <= 64
    ]
    assert len(others) > 100
    rng = random.Random(1)
    for other in others:
        crc = Crc(
            other._width,
            other._poly,
            other._initvalue,
            other._reflect_input,
            other._reflect_output,
            other._xor_output,
        )
        assert crc(b"123456789") == other._check_result, other
        for length in (*range(20), 300):
            data = rng.randbytes(length)
            assert crc(data) == other.calc(data), (other, length)
        rows = random_rows(90, 31)
        assert compute_checksums(crc, rows).tolist() == [
            other.calc(row.tobytes()) for row in rows
        ], other


@pytest.mark.parametrize("algorithm", slow_unless(ALGORITHMS, QUICK_ALGORITHMS), ids=name_of)
class TestBatch:
    """Tests that a batch gives the same results as its rows, however it is computed."""

    def test_every_short_length(self, algorithm: Checksum) -> None:
        for length in range(71):
            for count in (
                0,
                3,
                2048 // max(1, length) + 2,
            ):  # the last is past the point where CRCs leave the loop over bytes
                values = compute_checksums(algorithm, random_rows(count, length))
                assert values.dtype == np.uint64
                assert values.tolist() == singly(algorithm, random_rows(count, length)), (
                    count,
                    length,
                )

    @pytest.mark.parametrize(
        ("count", "length"),
        [(3, 1039), (40, 128), (9, 1210), (2, 24_832), (300, 1217), (11_000, 48)],
    )
    def test_long_rows_and_several_blocks(
        self, algorithm: Checksum, count: int, length: int
    ) -> None:
        rows = random_rows(count, length)
        values = compute_checksums(algorithm, rows)
        for row in {*range(0, count, 211), count - 1}:
            # At this length, a single CRC is computed as a batch: it is no independent reference.
            data = rows[row].tobytes()
            assert values[row] == (
                bitwise_crc(algorithm, data)
                if isinstance(algorithm, Crc) and length > 2000
                else algorithm(data)
            )

    def test_bytes_anywhere_in_the_rows(self, algorithm: Checksum) -> None:
        for spans in [
            ((0, 8), (10, 85)),
            ((3, 5),),
            ((1, 2), (4, 9), (9, 30)),
            ((5, 5), (7, 7)),
            ((80, 88), (0, 3)),
            ((2, 3), (85, 88)),
        ]:
            for count in (3, 300 if spans[0] == (0, 8) else 60):
                rows = random_rows(count, 88)
                joined = np.concatenate([rows[:, start:stop] for start, stop in spans], axis=1)
                assert compute_over_spans(algorithm, rows, spans).tolist() == singly(
                    algorithm, joined
                ), (
                    spans,
                    count,
                )
        short = random_rows(400, 5)
        assert compute_over_spans(algorithm, short, ((0, 1), (3, 5))).tolist() == singly(
            algorithm, short[:, [0, 3, 4]]
        )

    def test_any_strides(self, algorithm: Checksum) -> None:
        for length in (13, 46):
            buffer = random_rows(400, 3 * length)
            for rows in (
                buffer[::2, 5 : 5 + length],
                buffer[::-1, ::3],
                buffer[:, length::-1],
                np.asfortranarray(buffer[:, :length]),
            ):
                assert not rows.flags.c_contiguous
                assert compute_checksums(algorithm, rows).tolist() == singly(algorithm, rows)


@pytest.mark.parametrize(
    "algorithm", [CRC8_LDROBOT, CRC32, Xor(), Sum(), Sum(64), M1C1, Fold15()], ids=name_of
)
def test_temporary_memory_is_bounded(algorithm: Checksum) -> None:
    rows = random_rows(200_000, 47)
    compute_checksums(algorithm, rows[:100])  # tables are not temporary
    tracemalloc.start()
    compute_checksums(algorithm, rows)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # The memory of a few result columns and one block.
    assert peak < 4 * 8 * len(rows) + 3_000_000


def test_sums_and_xors_by_hand() -> None:
    data = bytes([0x12, 0x34, 0xFF, 0x80, 0x07])
    assert Xor()(data) == WordXor(groups=(1,))(data) == 0x12 ^ 0x34 ^ 0xFF ^ 0x80 ^ 0x07
    assert Sum()(data) == 0xCC
    assert Sum(16)(data) == Sum(16, "big")(data) == 0x01CC
    assert Sum(16)(b"\xff" * 258) == 258 * 255 - 65536
    # The last word is cut short.
    assert WordXor(groups=(1, 2))(data) == 0x0012 ^ 0xFF34 ^ 0x0080 ^ 0x0007
    assert WordXor(head=3, groups=(2, 1))(data) == 0x3412 ^ 0x00FF ^ 0x0780  # so is the head's
    assert WordXor()(data) == WordXor(head=8, groups=(1,))(data) == 0x3412 ^ 0x80FF ^ 0x0007


def test_fletcher_by_its_formula() -> None:
    # 1 + 2 + 3, and 1 + (1 + 2) + (1 + 2 + 3); then with sums above 255.
    assert Fletcher()(bytes([1, 2, 3])) == 6 | 10 << 8
    assert Fletcher()(b"\xff" * 300) == (300 * 255) % 256 | (300 * 301 // 2 * 255) % 256 << 8


@pytest.mark.parametrize("length", [5, 58, 60, 61, 63, 64, 99, 3000])
def test_fold15_by_its_formula_in_whole_numbers(length: int) -> None:
    data, total = random_rows(1, length).tobytes(), 0
    for at in range(0, length, 2):
        total = (total << 1) + int.from_bytes(data[at : at + 2], "little")
    assert Fold15()(data) == ((total & 0x7FFF) + (total >> 15)) & 0x7FFF


@pytest.mark.parametrize("algorithm", [CRC8_LDROBOT, CRC32, Xor(), Sum(), M1C1], ids=name_of)
def test_every_single_bit_error_is_seen(algorithm: Checksum) -> None:
    frame = random_rows(1, 46)
    flipped = frame ^ np.packbits(np.eye(8 * 46, dtype=np.uint8), axis=1)
    assert not np.any(compute_checksums(algorithm, flipped) == algorithm(frame.tobytes()))
    assert algorithm(frame.tobytes()) not in singly(algorithm, flipped)


# Algorithm, where the field stands that holds the checksum of all other bytes, and the frames.
OWN_FRAMES = [
    (Xor(), -1, "AA 55 F0 0F"),
    (M1C1, 8, "AA 55 6F 01 41 00 41 00 37 53 21 D3 07"),
    (M1C1, 8, "AA 55 00 05 81 B1 81 02 59 CD 92 01 00 92 A1 0F 92 41 1F 92 01 00 92 81 3E"),
    (Sum(16), 4, "A5 5A 00 00 80 01 81"),
    (Fold15(), -2, "FA A0 00 4B E8 03 64 00 D0 47 0A 00 35 80 00 00 B8 0B 2C 01 1C 19"),
]
VECTOR_FRAMES = [
    (Xor(), -1, "cspc_cmd_stop cspc_ack_start cspc_v11_ack_stop coin_d4_ack_capture"),
    (Sum(16), 4, "cspc_info_corrected cspc_scan_start"),
    (M1C1, 8, "cspc_start_packet_synth yd_tmini_16pt"),
    (WordXor(), 8, "yd_40pt_wrap_capture yd_tg15_capture"),
    (
        CRC8_LDROBOT,
        -1,
        "ld_manual_example ld_stl27l_10hz_synth ld14p_start ld06_capture_1 ld20_capture",
    ),
    (
        Fold15(),
        -2,
        (
            "camsense_x1_capture camsense_x1_wrap_capture neato_synth lds08rr_capture_1"
            " lds08rr_capture_2"
        ),
    ),
    (Sum(16, order="big"), -2, "delta_2a_data_capture"),
    (Sum(), -1, "lslidar_n10_synth tfmini_frame_synth tfmini_set_rate_1000"),
    (CRC16_MODBUS, -2, "wt53r_read wt53r_answer"),
]


def stored_and_computed(algorithm: Checksum, at: int, frame: bytes) -> tuple[int, int]:
    start = at % len(frame)
    end = start + (algorithm.width + 7) // 8
    return int.from_bytes(frame[start:end], algorithm.order), algorithm(frame[:start] + frame[end:])


def test_frames_of_the_fact_sheets() -> None:
    for algorithm, at, frame in OWN_FRAMES:
        stored, computed = stored_and_computed(algorithm, at, bytes.fromhex(frame))
        assert computed == stored, frame


def test_frames_of_the_vectors() -> None:
    for algorithm, at, names in VECTOR_FRAMES:
        for name in names.split():
            stored, computed = stored_and_computed(algorithm, at, vector_bytes(VECTORS, name))
            assert computed == stored, name
    misprints = (
        (Sum(16), 4, vector_bytes(VECTORS, "cspc_info_as_printed")),
        (CRC8_LDROBOT, -1, vector_bytes(VECTORS, "ld_manual_table_variant")),
    )
    assert [stored_and_computed(*misprint) for misprint in misprints] == [
        (0x0402, 0x0403),
        (0x50, 0xD0),
    ]


def test_coin_d4_packets_of_a_capture() -> None:
    packets = np.frombuffer(
        vector_bytes(VECTORS, "coin_d4_startup_capture")[62:], np.uint8
    ).reshape(2, 85)
    stored, covered = (
        packets[:, 8] + 256 * packets[:, 9].astype(int),
        np.delete(packets, [8, 9], axis=1),
    )
    assert (
        compute_checksums(M1C1, covered).tolist()
        == stored.tolist()
        != WordXor().batch(covered).tolist()
    )


def test_algorithms_are_equal_and_hashed_by_their_parameters() -> None:
    assert len(set(ALGORITHMS)) == len(ALGORITHMS)
    assert {Crc(8, 0x4D), Crc(width=8, poly=0x4D, init=0), Xor(), Xor(), Sum(), Sum(8)} == {
        CRC8_LDROBOT,
        Xor(),
        Sum(8),
    }
    assert Sum(16) != Sum(16, "big")
    assert [(each.width, each.order) for each in (Xor(), M1C1, Fold15())] == [
        (8, "little"),
        (16, "little"),
        (15, "little"),
    ]
    with pytest.raises(AttributeError):
        CRC8_LDROBOT.poly = 0x07  # type: ignore[misc]


@pytest.mark.parametrize("algorithm", ALGORITHMS, ids=name_of)
def test_takes_every_kind_of_bytes_and_pickles(algorithm: Checksum) -> None:
    for data in (random_rows(1, length).tobytes() for length in (46, 47, 3000)):
        assert (
            algorithm(bytearray(data)) == algorithm(memoryview(data[::-1])[::-1]) == algorithm(data)
        )
        copy = pickle.loads(pickle.dumps(algorithm))
        assert (copy, hash(copy), copy(data)) == (algorithm, hash(algorithm), algorithm(data))


def test_padding_with_zeros_to_whole_words() -> None:
    for data in (b"", b"1", b"1234", b"123456789"):
        assert ZeroPadded(CRC32, 4)(data) == CRC32(data.ljust(-(-len(data) // 4) * 4, b"\0"))
    padded = ZeroPadded(Crc(16, 0x1021, order="big"), 4)
    assert (padded.width, padded.order) == (16, "big")


def test_describe() -> None:
    assert CRC8_LDROBOT.describe() == "CRC-8 poly 0x4d"
    assert CRC16_MODBUS.describe() == "CRC-16 poly 0x8005 init 0xffff reflected"
    assert (
        Crc(12, 0x80F, refout=True, xorout=1).describe() == "CRC-12 poly 0x80f xorout 0x001 refout"
    )
    assert (Xor().describe(), Sum(16).describe(), Fold15().describe()) == (
        "XOR-8",
        "16-bit sum",
        "15-bit folded sum",
    )
    assert (
        ZeroPadded(Xor(), 4).describe()
        == "XOR-8 of the bytes, padded with zeros to a multiple of 4"
    )
    assert M1C1.describe() == "XOR-16 of 1+2-byte words after a head of 8 bytes"


@pytest.mark.parametrize(
    ("right", "name", "wrong_values"),
    [
        (CRC8_LDROBOT, "width", [0, 65, -8, 8.0, True, "8"]),
        (CRC8_LDROBOT, "poly", [0, 0x14D, -1, None]),
        (CRC8_LDROBOT, "init", [-1, 256, 1.0]),
        (CRC8_LDROBOT, "xorout", [-1, 256]),
        (CRC8_LDROBOT, "refin", [1, None]),
        (CRC8_LDROBOT, "refout", [0, "yes"]),
        (CRC8_LDROBOT, "order", ["middle", None]),
        (Sum(), "width", [0, 65, 8.0]),
        (Sum(), "order", [">"]),
        (M1C1, "head", [-1, 1.0]),
        (M1C1, "groups", [(), [1, 2], (1, 3), (0,), (1.0, 2), 2, None]),
    ],
)
def test_wrong_parameters_are_refused(right: Any, name: str, wrong_values: list[object]) -> None:
    for value in wrong_values:
        with pytest.raises(
            ValueError, match=rf"{type(right).__name__}: {name} .*{re.escape(repr(value))}"
        ):
            dataclasses.replace(right, **{name: value})


def test_an_algorithm_of_a_plugin_gets_its_batch_for_free() -> None:
    class Scip(Checksum):
        width = 7

        def __call__(self, data: bytes | bytearray | memoryview) -> int:
            return (sum(data) & 0x3F) + 0x30

        def describe(self) -> str:
            return "the sum that Hokuyo sends as one printable character"

    rows = np.frombuffer(b"00P99b0Ee", np.uint8).reshape(3, 3)[:, :2]
    assert bytes(Scip().batch(rows).tolist()) == b"Pbe"


@pytest.mark.parametrize(("init", "xorout"), [(0xFFFFFFFF, 0xFFFFFFFF), (0x12345678, 0x9ABCDEF0)])
def test_long_rows_of_zlibs_polynomial_have_its_values_wherever_they_stand(
    init: int, xorout: int
) -> None:
    crc = Crc(32, 0x04C11DB7, init, True, True, xorout)
    rows = np.random.default_rng(5).integers(0, 256, (9, 3001), dtype=np.uint8)
    parts = [row[2:1400].tobytes() + row[1404:].tobytes() for row in rows]
    begin, end = int(f"{init:032b}"[::-1], 2) ^ 2**32 - 1, 2**32 - 1 ^ xorout
    assert compute_over_spans(crc, rows, ((2, 1400), (1404, 3001))).tolist() == [
        zlib.crc32(part, begin) ^ end for part in parts
    ]


@dataclasses.dataclass(frozen=True)
class Attentive(Checksum):
    """The sum of all bytes; it records its arguments."""

    asked: list[bytes] = dataclasses.field(default_factory=list, compare=False)
    width = 8

    def __call__(self, data: Any) -> int:
        self.asked.append(bytes(data))
        return sum(data) & 0xFF

    def describe(self) -> str:
        return "a sum that remembers"


def test_an_absent_checksum_is_not_computed() -> None:
    attentive = Attentive()
    sensor = against_construct.sensor(
        Checksummed(
            Struct("header" / Const(b"\x55\x66"), "value" / Int8ub, "sum" / Int8ub),
            field="sum",
            algorithm=attentive,
            absent=[0],
        )
    )
    frames = [
        bytes([0x55, 0x66, value, total])
        for value, total in ((1, 0), (2, 0xBD), (3, 0), (4, 0xFF), (5, 0))
    ]
    packets = sensor.decode(b"".join(frames))
    assert (packets["value"].tolist(), packets.stats.bad_checksum) == ([1, 2, 3, 5], 1)
    assert {data[2] for data in attentive.asked} == {2, 4}
    attentive.asked.clear()
    assert sensor.parse(frames[0]).value == 1
    assert not attentive.asked


def test_two_checksums_around_one_struct_are_made_in_the_order_in_which_they_need_each_other() -> (
    None
):
    fields = Struct(
        "header" / Const(b"\x55\x66"),
        "value" / Int8ub,
        "check" / Int8ub,
        "rest" / Int8ub,
        "sum" / Int8ub,
    )
    inside_first = Checksummed(
        Checksummed(fields, "check", Xor(), over=("header", "value")), "sum", Sum(8)
    )
    outside_first = Checksummed(
        Checksummed(fields, "sum", Sum(8)), "check", Xor(), over=("header", "value")
    )
    for struct in (inside_first, outside_first):
        sensor = against_construct.sensor(struct)
        frame = sensor.build("data", value=7, rest=9)
        assert frame == bytes(
            [0x55, 0x66, 7, 0x55 ^ 0x66 ^ 7, 9, sum([0x55, 0x66, 7, 0x55 ^ 0x66 ^ 7, 9]) & 0xFF]
        )
        assert sensor.parse(sensor.example("data"))
        damaged = [frame[:3] + b"\0" + frame[4:], frame[:-1] + b"\0"]
        assert [sensor.decode(data).stats.bad_checksum for data in (frame, *damaged)] == [0, 1, 1]
    with pytest.raises(SpecError, match="'check' and 'sum'"):
        Checksummed(Checksummed(fields, "check", Xor()), "sum", Sum(8))


def test_a_checksum_over_a_whole_bit_block_covers_its_bytes() -> None:
    block = BitStruct("high" / BitsInteger(4), "low" / BitsInteger(4))
    sensor = against_construct.sensor(
        Checksummed(Struct("k" / Int8ub, "bits" / block, "sum" / Int8ub), "sum", Xor(), over="bits")
    )
    assert sensor.build("data", k=1, bits={"high": 5, "low": 6}) == b"\x01\x56\x56"
    assert sensor.parse(b"\x01\x56\x56").sum == 0x56
