"""Tests of the sensor that `new --from-capture` writes."""

from __future__ import annotations

import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import UsageError, WireError
from lidarspec.drafting.checksum_search import ChecksumWithConstant
from lidarspec.drafting.distribution import DistributionNames
from lidarspec.drafting.draft import Draft, make_draft
from lidarspec.drafting.draft_code import make_template_values as text_of
from lidarspec.drafting.periods import find_rising_fields
from lidarspec.drafting.samples import ChecksumPlace
from lidarspec.expressions.columns import align
from lidarspec.simulation.simulator import simulate
from lidarspec.spec import Checksum, Crc, Fold15, PacketCounter, Sum, WordXor, Xor
from lidarspec.transports.open_url import open_transport
from tests.cli.running import ran
from tests.evidence import capture
from tests.shapes import SHAPES

LD06, COIN_D4 = (
    "ldrobot/ld06_3_consecutive_frames.bin",
    "cspc/coin_d4_ludovatech_issue2_partial.bin",
)
VLP16, VLP16_RAW, HELIOS = (
    "velodyne/vlp16_dual/packets.derived.pcap",
    "velodyne/vlp16_raw/recording.bin",
    "robosense/helios16p/packets.derived.pcap",
)


ROOT = Path(__file__).resolve().parents[2]


def draft_file(name: str) -> Draft:
    opened = open_transport(str(capture(name)))
    try:
        return make_draft([chunk.data for chunk in opened.chunks()], datagrams=opened.datagrams)
    finally:
        opened.close()


def rising(found: Draft) -> dict[str, tuple[int, str, int]]:
    inside = found.blocks.rising_fields if found.blocks else ()
    return {one.name: (one.size, one.order, one.circle) for one in (*found.rising_fields, *inside)}


def module(tmp_path: Path, source: Path, *more: str) -> ls.Sensor:
    """Return the sensor that `new --from-capture` writes."""
    ran("new", "acme-x9", "--into", tmp_path, "--from-capture", source, *more)
    return ls.sensor(
        tmp_path
        / DistributionNames("acme-x9").distribution
        / DistributionNames("acme-x9").package
        / "__init__.py"
    )


def share(sensor: ls.Sensor, source: Path) -> float:
    opened = open_transport(str(source))
    chunks = [chunk.data for chunk in opened.chunks()]
    opened.close()
    stats = sensor.decode(chunks if opened.datagrams else b"".join(chunks)).stats
    assert not stats.plugin_errors, stats.tracebacks
    return 1 - stats.bytes_skipped / stats.bytes_in


@pytest.mark.slow
def test_three_frames_of_one_length_and_a_crc() -> None:
    found = draft_file(LD06)
    assert (found.sync, found.size, len(found.frames), found.share) == (b"\x54\x2c", 47, 3, 1.0)
    assert found.checksum is not None
    assert (found.checksum.algorithm, found.checksum.place, found.checksum.right) == (
        Crc(8, 0x4D),
        ChecksumPlace(-1, 1),
        3,
    )
    assert rising(found) == {"rising_4": (2, "little", 0), "rising_42": (2, "little", 0)}


@pytest.mark.slow
def test_a_count_that_only_the_frame_cut_off_gives_away() -> None:
    found = draft_file(COIN_D4)
    assert (found.sync, found.size, str(found.length), len(found.frames)) == (
        b"\xaa\x55",
        None,
        "10 + 3 x byte at 3",
        4,
    )
    assert found.checksum is not None
    assert (found.checksum.algorithm, found.checksum.place) == (
        WordXor(head=8, groups=(1, 2)),
        ChecksumPlace(8, 2),
    )
    assert rising(found) == {"rising_4": (2, "little", 0), "rising_6": (2, "little", 0)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "frames", "clock"),
    [
        (VLP16, 603, "rising_1200"),
        pytest.param(VLP16_RAW, 1000, "rising_1200", marks=pytest.mark.slow),
    ],
)
def test_blocks_with_a_little_endian_angle_and_no_checksum(
    name: str, frames: int, clock: str
) -> None:
    found = draft_file(name)
    assert (found.sync, found.size, len(found.frames), found.checksum) == (
        b"\xff\xee",
        1206,
        frames,
        None,
    )
    assert found.blocks is not None
    assert (found.blocks.start, found.blocks.size, found.blocks.count, found.blocks.flag) == (
        0,
        100,
        12,
        b"\xff\xee",
    )
    assert rising(found) == {"angle_2": (2, "little", 36_000), clock: (4, "little", 0)}


@pytest.mark.slow
def test_blocks_with_a_big_endian_angle_among_packets_of_another_kind() -> None:
    found = draft_file(HELIOS)
    assert (found.sync, found.size, len(found.frames), found.checksum) == (
        b"\x55\xaa\x05\x5a",
        1248,
        750,
        None,
    )
    assert found.blocks is not None
    assert (found.blocks.start, found.blocks.size, found.blocks.count) == (42, 100, 12)
    assert rising(found) == {
        "angle_2": (2, "big", 36_000),
        "counter_14": (2, "big", 0),
        "rising_26": (4, "big", 0),
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "least"),
    [
        (LD06, 1.0),
        (COIN_D4, 0.85),
        pytest.param(VLP16, 1.0, marks=pytest.mark.slow),
        pytest.param(VLP16_RAW, 1.0, marks=pytest.mark.slow),
        pytest.param(HELIOS, 0.998, marks=pytest.mark.slow),
    ],
)
def test_the_draft_reads_the_capture_that_it_came_from(
    tmp_path: Path, name: str, least: float
) -> None:
    sensor = module(tmp_path, capture(name))
    assert share(sensor, capture(name)) >= least
    assert len(sensor.decode(transport_data(name)).points()) > 0
    text = (tmp_path / "lidarspec-acme-x9" / "lidarspec_acme_x9" / "__init__.py").read_text(
        encoding="utf-8"
    )
    assert "unknown_" in text
    assert capture(name).name in text
    assert ("# No checksum was found" in text) == ("Checksummed" not in text)


def transport_data(name: str) -> bytes | list[bytes]:
    opened = open_transport(str(capture(name)))
    chunks = [chunk.data for chunk in opened.chunks()]
    opened.close()
    return chunks if opened.datagrams else b"".join(chunks)


@pytest.mark.slow
def test_each_field_has_its_evidence_in_a_comment(tmp_path: Path) -> None:
    (tmp_path / "some.bin").write_bytes(b"".join(simulate(ls.sensor("ldrobot-stl27l"), 400)))
    sensor = module(tmp_path, tmp_path / "some.bin")
    text = (tmp_path / "lidarspec-acme-x9" / "lidarspec_acme_x9" / "__init__.py").read_text(
        encoding="utf-8"
    )
    assert (
        "# rises by 200 from frame to frame, in 399 of 399 steps, and wraps at 36000, so the"
        in text
    )
    assert "# the value is between angle_4 of this frame and angle_4 of" in text
    assert "# correct in 256 of 256 frames, probability of a coincidence: 1 in " in text
    assert "algorithm=Crc(width=8, poly=0x4D),\n" in text
    assert 'scan=OnWrap("angle_4"),' in text
    assert len(list(sensor.scans((tmp_path / "some.bin").read_bytes()))) == 3


@pytest.mark.slow
def test_a_draft_is_written_as_the_projects_own_sensors_are(tmp_path: Path) -> None:
    """The draft has everything that a draft can have.

    These are blocks, a count, a class for the checksum, angles and a counter.
    """
    sources = {
        "blocks": b"".join(simulate(ls.sensor("velodyne-vlp16"), 60)),
        "count": b"".join(simulate(ls.sensor("cspc-coin-d4"), 60)),
        "class": make_frames(b"\x5a\xc3", ChecksumWithConstant(Sum(8), 0x55), skip=1),
        "over": make_frames(b"\x5a\xc3", Crc(16, 0x1021), skip=3),
        "angles": b"".join(simulate(ls.sensor("ldrobot-ld06"), 300)),
    }
    for name, data in sources.items():
        (tmp_path / f"{name}.bin").write_bytes(data)
        ran("new", f"acme-{name}", "--into", tmp_path, "--from-capture", tmp_path / f"{name}.bin")
    text = "".join(
        path.read_text(encoding="utf-8") for path in tmp_path.glob("*/lidarspec_acme_*/__init__.py")
    )
    for mark in (
        "/ Array(\n        12,",
        "this.count",
        "class Check(Checksum):",
        "deg2rad(f.angle_4)",
        "PacketCounter(",
        "confirm=2",
        "over=(",
    ):
        assert mark in text
    config = ["--config", str(ROOT / "pyproject.toml")]
    for words in (["check"], ["format", "--check"]):
        ruff = [sys.executable, "-m", "ruff", *words, *config, str(tmp_path)]
        # In this folder, ruff sorts lidarspec as first party.
        done = subprocess.run(ruff, cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout


def make_frames(
    body: bytes,
    checksum: Checksum,
    *,
    number: int = 60,
    skip: int = 0,
    order: str = "little",
    vary: int = 0,
) -> bytes:
    """Return frames with a header, a counter, random content and a checksum."""
    source = random.Random(number)
    counts = [source.randrange(vary + 1) for _ in range(number)]
    frames = [
        body + bytes([i % 256, 9 + count]) + source.randbytes(27 + 3 * count)
        for i, count in enumerate(counts)
    ]
    return b"".join(
        one + checksum(one[skip:]).to_bytes(checksum.width // 8, order) for one in frames
    )  # type: ignore[arg-type]


CHECKSUMMED = [
    (Crc(16, 0x8005, init=0xFFFF, refin=True, refout=True), 0, "little"),
    (Xor(), 2, "little"),
    (Sum(16), 0, "big"),
    (Crc(16, 0x1021), 2, "big"),
    (Crc(32, 0x04C11DB7, 0xFFFFFFFF, True, True, 0xFFFFFFFF), 1, "little"),
    (ChecksumWithConstant(Sum(8), 0xFF, negative=True), 3, "little"),
]


@pytest.mark.parametrize(
    ("checksum", "skip", "order", "vary"),
    [
        (*CHECKSUMMED[0], 0),
        *(pytest.param(*one, 0, marks=pytest.mark.slow) for one in CHECKSUMMED[1:]),
        *(pytest.param(*one, 3, marks=pytest.mark.slow) for one in CHECKSUMMED[:3]),
    ],
    ids=lambda value: value.describe() if isinstance(value, Checksum) else str(value),
)
def test_made_frames_are_drafted_to_a_module_that_reads_them(
    tmp_path: Path, checksum: Checksum, skip: int, order: str, vary: int
) -> None:
    (tmp_path / "some.bin").write_bytes(
        b"\x00\x11"
        + make_frames(b"\x5a\xc3", checksum, skip=skip, order=order, vary=vary)
        + b"\x5a\xc3\x01"
    )
    sensor = module(tmp_path, tmp_path / "some.bin")
    data = (tmp_path / "some.bin").read_bytes()
    found = sensor.split(data)
    assert len(found) == 60
    damaged = bytearray(data)
    damaged[found[5].offset + len(found[5].data) - 8] ^= 0x10
    assert [one.offset for one in sensor.split(bytes(damaged))] == [
        one.offset for one in found if one is not found[5]
    ]
    assert sensor.build("data", sensor.parse(found[5].data)) == found[5].data


def test_an_index_that_starts_again_is_a_counter_with_its_limits(tmp_path: Path) -> None:
    source = random.Random(3)
    frames = [bytes([0xFA, 0xA0 + i % 90]) + source.randbytes(18) for i in range(200)]
    data = b"".join(frame + Sum(16)(frame).to_bytes(2, "little") for frame in frames)
    (tmp_path / "some.bin").write_bytes(data)
    sensor = module(tmp_path, tmp_path / "some.bin")
    assert (sensor.sequence, share(sensor, tmp_path / "some.bin")) == (
        PacketCounter("counter_1", first=0xA0, last=0xF9),
        1.0,
    )
    assert sensor.decode(data[: 22 * 50] + data[22 * 53 :]).stats.lost == 3


@pytest.mark.slow
def test_a_wrapping_index_does_not_make_a_longer_frame(tmp_path: Path) -> None:
    """Ninety packets a turn begin with one constant byte, as in old vacuum cleaners.

    The scene does not change.
    """
    rows = [
        np.array([1500 + 40 * (i % 90) + j for j in range(8)], "<u2").tobytes() for i in range(900)
    ]
    frames = [bytes([0xFA, 0xA0 + i % 90, 0x00, 0x4B]) + row for i, row in enumerate(rows)]
    data = b"".join(frame + Fold15()(frame).to_bytes(2, "little") for frame in frames)
    found = make_draft([data[9:]], datagrams=False)
    assert (found.sync[:1], found.size, len(found.frames)) == (b"\xfa", 22, 899)
    assert found.checksum is not None
    assert (found.checksum.algorithm, found.checksum.place) == (Fold15(), ChecksumPlace(-2, 2))
    assert [
        (one.name, one.first, one.circle) for one in found.rising_fields if one.kind == "counter"
    ] == [("counter_1", 0xA0, 0xFA)]


@pytest.mark.slow
def test_a_length_in_bytes_with_short_frames_of_another_kind_between(tmp_path: Path) -> None:
    """Frames have a header of fields, samples of three bytes, and a big-endian sum.

    Sometimes a frame of eleven bytes is between them.
    """
    source = random.Random(7)

    def frame(i: int) -> bytes:
        samples = source.randbytes(3 * source.randrange(40, 44))
        data = (
            bytes([130])
            if i % 50 == 49
            else bytes([130, 0, 0]) + (i % 16 * 2250).to_bytes(2, "big") + samples
        )
        head = (
            b"\xaa"
            + (8 + len(data)).to_bytes(2, "big")
            + b"\x01\x61"
            + (b"\xae" if len(data) == 1 else b"\xad")
        )
        whole = head + len(data).to_bytes(2, "big") + data
        return whole + Sum(16)(whole).to_bytes(2, "big")

    (tmp_path / "some.bin").write_bytes(b"".join(map(frame, range(300))))
    found = make_draft([(tmp_path / "some.bin").read_bytes()], datagrams=False)
    assert (found.sync, str(found.length), len(found.frames)) == (
        b"\xaa\x00",
        "2 + 1 x byte at 2",
        294,
    )
    assert found.checksum is not None
    assert (found.checksum.algorithm, found.checksum.place, found.checksum.order) == (
        Sum(16),
        ChecksumPlace(-2, 2),
        "big",
    )
    assert rising(found) == {"angle_11": (2, "big", 36_000)}
    assert share(module(tmp_path, tmp_path / "some.bin"), tmp_path / "some.bin") > 0.99


@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize("circle", [3_600, 23_040, 36_000])
def test_angles_are_recognized_by_their_wrap(circle: int, order: str) -> None:
    source = random.Random(circle)
    turned = np.cumsum([circle // 40 + source.randrange(-1, 2) for _ in range(300)]) % circle
    rows = [
        source.randbytes(5) + int(value).to_bytes(2, order) + source.randbytes(6)
        for value in turned
    ]  # type: ignore[arg-type]
    (one,) = find_rising_fields(np.frombuffer(b"".join(rows), np.uint8).reshape(300, 13))
    assert (one.name, one.size, one.order, one.circle, one.kind) == (
        "angle_5",
        2,
        order,
        circle,
        "angle",
    )


def test_noise_has_no_candidates() -> None:
    rows = np.random.default_rng(1).integers(0, 256, (400, 60), np.uint8)
    assert not find_rising_fields(rows)


@pytest.mark.parametrize(
    "data",
    [random.Random(1).randbytes(5000), bytes(3000), b"\x55"],
    ids=["noise", "zeros", "a byte"],
)
def test_bytes_without_frames_are_refused(tmp_path: Path, data: bytes) -> None:
    with pytest.raises(WireError, match="no repeated frame structure"):
        make_draft([data], datagrams=False)
    (tmp_path / "some.bin").write_bytes(data)
    assert (
        "no repeated frame structure"
        in ran(
            "new", "acme-x9", "--into", tmp_path, "--from-capture", tmp_path / "some.bin", code=4
        ).stderr
    )
    assert not (tmp_path / "lidarspec-acme-x9").exists()


def test_a_missing_capture_is_named(tmp_path: Path) -> None:
    assert (
        "no.bin"
        in ran(
            "new", "acme-x9", "--into", tmp_path, "--from-capture", tmp_path / "no.bin", code=3
        ).stderr
    )


def test_names_are_refused_before_a_capture_is_read() -> None:
    with pytest.raises(UsageError):
        DistributionNames("X9")


def test_points_may_depend_on_no_field() -> None:
    """The points of a draft without an angle are constant."""
    shape = SHAPES["shape-count"]
    batch = shape.decode(shape.example("data") * 3).batch()
    arrays, axes, ready = align((np.zeros(1), 0.0), batch)
    assert ([array.tolist() for array in arrays], axes, ready) == ([[0.0], 0.0], (), 3)


def write_draft(frames: list[bytes], *, datagrams: bool = False) -> dict[str, str]:
    """Return the texts of a draft of these frames."""
    return text_of(
        make_draft(frames if datagrams else [b"".join(frames)], datagrams=datagrams),
        origin="the tests",
        link_code="",
    )


@pytest.mark.slow
def test_similar_fields_at_equal_distances_are_an_array() -> None:
    struct = write_draft(simulate(ls.sensor("hesai-xt16"), 300), datagrams=True)["struct"]
    assert "# 8 blocks of 66 bytes that begin with the same field" in struct
    assert struct.count('Scaled(Int16ul, 0.01, "deg")') == 1
    assert "the value is between" not in struct


@pytest.mark.slow
def test_the_counter_that_never_jumps_is_taken_and_the_others_are_offered() -> None:
    draw = random.Random(1)
    frames = [
        b"\x0f\x55"
        + bytes([(i + i // 50 * 3) % 256, 0])
        + i.to_bytes(2, "little")
        + draw.randbytes(10)
        for i in range(200)
    ]
    assert (
        'sequence=PacketCounter("counter_4"),  # a jump means lost packets; or counter_2'
        in write_draft(frames)["arguments"]
    )


@pytest.mark.slow
def test_other_checksums_that_fit_and_other_angles_are_offered() -> None:
    text = write_draft(simulate(ls.sensor("ldrobot-ld06"), 300))
    assert "# also possible: Crc(width=8, poly=0x4D, xorout=0x18) at byte 46," in text["struct"]
    assert 'scan=OnWrap("angle_4"),  # or angle_42' in text["arguments"]


def test_a_nearly_constant_field_is_not_a_checksum() -> None:
    draw = random.Random(1)
    bodies = [b"\x0f\x55\x07\x09\x01\x02" + bytes([draw.randrange(2)]) for _ in range(200)]
    frames = [body + Xor()(body).to_bytes(1) for body in bodies]
    assert make_draft([b"".join(frames)], datagrams=False).checksum is None
