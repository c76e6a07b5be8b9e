"""Tests of LDROBOT STL-27L, LD06 and LD14P: real frames, clock, calculated points."""

from __future__ import annotations

import dataclasses
import json
import re
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from construct import Array, Const, Int8ul, Int16ul, Struct

import lidarspec as ls
from lidarspec.packets.stream import PacketStream
from lidarspec.spec import Checksummed, Clock, Crc, Fields, Frame, Polar, Scaled, Serial, spread
from lidarspec_ldrobot import POINT_RATES_HZ, matches_rate
from tests.evidence import assert_points, capture, clockwise, decode, vector_bytes, vectors

FILE = "vectors_serial2d.json"
SENSOR, LD06, LD14P = (ls.sensor(f"ldrobot-{name}") for name in ("stl27l", "ld06", "ld14p"))

WHOLE = [
    "ld_manual_example",
    "ld_stl27l_10hz_synth",
    "ld06_capture_1",
    "ld06_capture_2",
    "ld06_capture_3",
    "ld06_capture_fsharp",
    "ld20_capture",
]
STREAMS = {"ld06_stream_3_capture"}
WRONG = {"ld_manual_table_variant"}
OF_THE_LD14P = {
    "ld14p_start",
    "ld14p_stop",
    "ld14p_speed_6hz",
    "ld14p_get_motor_fw",
    "ld_manufacture_synth",
}

# 30 to 277.5 degrees in steps of 22.5; point k at 1 + k / 2 metres with intensity 10 + k; 3600
# deg/s, 1 s.
#   b8 0b: 0bb8 = 3000, 0.01 deg = 30.   66 6c: 6c66 = 27750.   d0 07 0c: 07d0 = 2000 mm, intensity
# 12.   CRC 1f.
QUADRANTS = bytes.fromhex(
    "542c 100e b80b e8030a dc050b d0070c c4090d b80b0e ac0d0f a00f10 941111 881312 7c1513 701714"
    " 641915 666c e803 1f"
)


# The 244 entries of the CRC table that the manual prints (3.1), without entries 175 to 186.
PRINTED_CRCS = bytes.fromhex(
    "004d9ad77934e3aef2bf68258bc6115ca9e4337ed09d4a075b16c18c226fb8f5"
    "1f5285c8662bfcb1eda0773a94d90e43b6fb2c61cf8255184409de933d70a7ea"
    "3e73a4e9470add90cc81561bb5f82f6297da0d40eea374396528ffb21c5186cb"
    "216cbbf65815c28fd39e4904aae7307d88c5125ff1bc6b267a37e0ad034e99d4"
    "7c31e6ab05489fd28ec31459f7ba6d20d5984f02ace1367b276abdf05e13c489"
    "632ef9b41a5780cd91dc0b46e8a572ef410cdb96420fd8953b76a1ecb0fd2a67"
    "c984531eeba6713c92df0845195483ce602dfab75d10c78a2469bef3afe23578"
    "d69b4c01f4b96e238dc0175a064b9cd17f32e5a8"
)


def frame(
    start: float = 10.0, end: float = 12.0, seconds: float = 1.0, distance: float = 1.0, **more: Any
) -> bytes:
    """Return a frame with all points at one distance."""
    values: dict[str, Any] = dict(speed=3600, start_angle=start, end_angle=end, timestamp=seconds)
    return SENSOR.build(
        "data", units=True, points=[dict(distance=distance, intensity=7)] * 12, **values, **more
    )


def test_every_vector_of_the_family_is_used() -> None:
    known = {name for name in vectors(FILE) if re.match(r"ld(_|\d\d(_|p_))", name)}
    assert known == {*WHOLE} | STREAMS | WRONG | OF_THE_LD14P


@pytest.mark.parametrize("name", WHOLE)
def test_a_whole_frame_is_parsed_and_built_to_the_same_bytes(name: str) -> None:
    data, expected = vector_bytes(FILE, name), vectors(FILE)[name]["expected"]
    parsed = SENSOR.parse(data)
    assert SENSOR.build("data", parsed) == data
    packets = decode(SENSOR, data)
    known = {"speed_dps": "speed", "start_deg": "start_angle", "end_deg": "end_angle"}
    for printed, path in known.items():
        assert packets[path][0] == pytest.approx(expected[printed], abs=1e-9)
    assert parsed.timestamp == expected["timestamp_ms"]
    assert [point.distance for point in parsed.points] == expected.get(
        "dist_mm", [point.distance for point in parsed.points]
    )
    angles = clockwise(packets.points())
    step = expected.get("step_deg", (expected["end_deg"] - expected["start_deg"]) / 11)
    np.testing.assert_allclose(angles, expected["start_deg"] + step * np.arange(12), atol=1e-4)


def test_the_example_of_the_manual() -> None:
    data, expected = (
        vector_bytes(FILE, "ld_manual_example"),
        vectors(FILE)["ld_manual_example"]["expected"],
    )
    parsed = SENSOR.parse(data)
    assert [point.intensity for point in parsed.points] == expected["intensity"]
    assert parsed.points[1].distance == 220  # printed as 200
    assert (parsed.points[11].distance, parsed.points[11].intensity) == (
        192,
        229,
    )  # printed as 176 and 234
    assert parsed.crc == expected["crc"]


def test_the_decode_table_of_the_manual_is_wrong() -> None:
    data, expected = (
        vector_bytes(FILE, "ld_manual_table_variant"),
        vectors(FILE)["ld_manual_table_variant"]["expected"],
    )
    with pytest.raises(ls.WireError) as caught:
        SENSOR.parse(data)
    fault = caught.value
    assert (fault.path, fault.offset, fault.expected, fault.got) == (
        "crc",
        46,
        f"0x{expected['crc_calc']:02x}",
        f"0x{expected['crc']:02x}",
    )
    packets = decode(SENSOR, data + QUADRANTS)
    assert (len(packets), packets.stats.bad_checksum, packets.stats.bytes_skipped) == (1, 1, 47)


@pytest.mark.parametrize("name", sorted(OF_THE_LD14P))
def test_frames_of_the_ld14_are_not_ours(name: str) -> None:
    with pytest.raises(ls.WireError) as caught:
        SENSOR.parse(vector_bytes(FILE, name))
    assert caught.value.path == "header"


@pytest.mark.parametrize("name", sorted(OF_THE_LD14P))
def test_frames_of_the_ld14p_are_its_own(name: str) -> None:
    data, expected = vector_bytes(FILE, name), vectors(FILE)[name]["expected"]
    frame = "info" if name == "ld_manufacture_synth" else "command"
    parsed = LD14P.parse(data, frame)
    assert LD14P.build(frame, parsed) == data
    named = {"cmd": "command", "value": "speed", "sn_high": "serial_high", "sn_low": "serial_low"}
    known = {named.get(key, key): value for key, value in expected.items()}
    assert {key: parsed[key] for key in parsed if key in known} == {
        key: value for key, value in known.items() if key in parsed
    }


def test_an_ld14_looks_from_aside() -> None:
    # 1 m at 30 degrees: atan((0.11923 * 1000 - 18.975571) / 1005.9) = 5.69167 degrees less:
    # 24.30833. 3 m at 120 degrees: atan((357.69 - 18.975571) / 3005.9) = 6.42915 degrees less:
    # 113.57085.
    cloud = decode(LD14P, QUADRANTS).points()
    np.testing.assert_allclose(clockwise(cloud)[[0, 4]], [24.30833, 113.57085], atol=1e-4)
    assert_points(cloud, [(0, (0.91134, -0.41165, 0))])


@pytest.mark.parametrize(
    ("name", "owner"),
    [
        ("ld06_capture_1", "LD06"),
        ("ld06_capture_fsharp", "LD06"),
        ("ld20_capture", "LD20"),
        ("ld_manual_example", "LD14"),
    ],
)
def test_one_frame_shows_the_pace_of_its_lidar(name: str, owner: str) -> None:
    fields = Fields(SENSOR.decode(vector_bytes(FILE, name)).batch())
    assert [
        rate
        for rate in sorted({*POINT_RATES_HZ.values()})
        if np.all(np.asarray(matches_rate(fields, rate)))
    ] == [POINT_RATES_HZ[owner]]


def test_the_crc_has_all_256_entries() -> None:
    # The manual's table lacks entries 175 to 186; the register after one byte from 0 is the entry
    # of that byte.
    crc = Crc(width=8, poly=0x4D)
    assert (
        bytes(crc(bytes([index])) for index in range(175, 187)).hex(" ")
        == "3f ca 87 50 1d b3 fe 29 64 38 75 a2"
    )
    printed = [index for index in range(256) if not 175 <= index <= 186]
    assert bytes(crc(bytes([index])) for index in printed) == PRINTED_CRCS
    assert crc(b"123456789") == 0xC3


def test_points_by_hand() -> None:
    cloud = decode(SENSOR, QUADRANTS).points()
    # Clockwise, so azimuth is the negative: x = d cos a, y = -d sin a.
    #   point 0:  30 deg, 1 m:      x = 0.86603,   y = -0.5        front right
    #   point 4:  120 deg, 3 m:     x = -1.5,      y = -2.59808    back right
    #   point 8:  210 deg, 5 m:     x = -4.33013,  y = +2.5        back left
    #   point 11: 277.5 deg, 6.5 m: x = 0.84842,   y = +6.44439    front left
    expected = [
        (0, (0.86603, -0.5, 0)),
        (4, (-1.5, -2.59808, 0)),
        (8, (-4.33013, 2.5, 0)),
        (11, (0.84842, 6.44439, 0)),
    ]
    assert_points(cloud, expected)
    assert_points(decode(LD06, QUADRANTS).points(), expected)
    assert_points(
        SENSOR.configure(frame="vendor").decode(QUADRANTS).points(),
        [(0, (0.86603, 0.5, 0)), (8, (-4.33013, -2.5, 0))],
    )
    assert cloud.intensity is not None
    assert cloud.intensity.tolist() == list(range(10, 22))


def test_points_of_real_frames_by_hand() -> None:
    # 86.76 deg, 01f2 = 498 mm: x = .498 cos = 0.02815, y = -0.49720.   114.35 deg, 0229 = 553 mm: x
    # = -0.22801, y = -0.50380. 324.27 deg, 00e0 = 224 mm (the manual): x = 0.18184, y = +0.13081.
    assert_points(
        decode(LD06, vector_bytes(FILE, "ld06_capture_1")).points(), [(0, (0.02815, -0.49720, 0))]
    )
    assert_points(
        decode(LD06, vector_bytes(FILE, "ld06_capture_3")).points(),
        [(11, (-0.22801, -0.50380, 0))],
    )
    assert_points(
        decode(LD06, vector_bytes(FILE, "ld_manual_example")).points(),
        [(0, (0.18184, 0.13081, 0))],
    )


def test_three_consecutive_frames() -> None:
    data = capture("ldrobot/ld06_3_consecutive_frames.bin").read_bytes()
    assert data == vector_bytes(FILE, "ld06_stream_3_capture")
    packets = decode(LD06, data)
    assert (packets.stats.frames, packets.stats.bytes_skipped) == ({"data": 3}, 0)
    assert np.diff(packets.time_ns).tolist() == [2_000_000, 3_000_000]
    angles = clockwise(packets.points())
    # The step is the same from one frame to the next.
    np.testing.assert_allclose(np.diff(angles), 0.79, atol=0.03)


def test_six_real_frames() -> None:
    expected = json.loads(capture("ldrobot/ld_frames.json").read_text())
    assert len(expected) == 6
    packets = decode(LD06, b"\x54".join(bytes.fromhex(item["hex"]) for item in expected))
    assert (len(packets), packets.stats.bytes_skipped) == (6, 5)
    assert packets.raw["points"]["distance"].tolist() == [
        [point[0] for point in item["pts"]] for item in expected
    ]
    assert packets.raw["points"]["intensity"].tolist() == [
        [point[1] for point in item["pts"]] for item in expected
    ]
    assert packets["start_angle"].tolist() == pytest.approx([item["start"] for item in expected])
    assert packets.raw["timestamp"].tolist() == [item["ts"] for item in expected]
    assert packets.raw["speed"].tolist() == [item["speed_dps"] for item in expected]


def test_points_without_a_return_have_no_coordinates() -> None:
    cloud = decode(LD06, vector_bytes(FILE, "ld20_capture")).points()
    assert cloud.intensity is not None
    assert not cloud.valid.any()
    assert np.isinf(cloud.range).all()
    assert np.isnan(cloud.xyz).all()
    assert cloud.intensity[6] == 213


@pytest.mark.parametrize(
    ("start", "end"), [(359.5, 1.33), (359.99, 0.0), (10.0, 10.0), (0.0, 359.99)]
)
def test_frames_that_cross_360_degrees_go_on_forward(start: float, end: float) -> None:
    angles = clockwise(decode(SENSOR, frame(start, end)).points())
    steps = (angles - start + 0.005) % 360 - 0.005
    np.testing.assert_allclose(steps, (end - start) % 360 * np.arange(12) / 11, atol=1e-4)


@pytest.mark.parametrize(
    "data",
    [
        frame(start=360.0),
        frame(end=360.0),
        frame(start=655.35),
        frame(seconds=30.001),
        bytes(200),
        b"\xff" * 200,
        b"\x54\x2c" * 100,
    ],
)
def test_implausible_bytes_are_no_frames(data: bytes) -> None:
    packets = decode(SENSOR, data)
    assert (packets.stats.frames, packets.stats.bytes_skipped) == ({}, len(data))


@pytest.mark.slow
def test_the_clock_runs_on_over_100_wraps() -> None:
    # 9.7 s apart, so that every part of the 30 s is met: 320 frames pass 30 s 103 times.
    milliseconds = np.arange(320) * 9_700
    packets = decode(
        SENSOR, b"".join(frame(seconds=float(now % 30_000) / 1000) for now in milliseconds)
    )
    assert milliseconds[-1] // 30_000 > 100
    assert (packets.time_ns - packets.time_ns[0]).tolist() == (milliseconds * 1_000_000).tolist()


def test_the_clock_runs_on_between_batches() -> None:
    decoder = SENSOR.decoder()
    stream = PacketStream(SENSOR, "data", decoder.stats)
    times = [
        stream.add(decoder.frames(frame(seconds=now % 30_000 / 1000))).time_ns
        for now in range(0, 400_000, 7_000)
    ]
    assert np.concatenate(times).tolist() == [now * 10**6 for now in range(0, 400_000, 7_000)]


@pytest.mark.parametrize(("sensor", "rate"), [(SENSOR, 21_600), (LD06, 4_500)])
def test_points_of_a_frame_are_apart_by_the_rate_of_the_model(sensor: ls.Sensor, rate: int) -> None:
    np.testing.assert_allclose(decode(sensor, QUADRANTS).points().time, np.arange(12) / rate)


@pytest.mark.parametrize(("sensor", "number"), [(SENSOR, 2160), (LD06, 450)])
def test_turns_are_cut_where_the_angle_passes_zero(sensor: ls.Sensor, number: int) -> None:
    assert sensor.simulation.sweep is not None
    points = [dict(distance=2.0, intensity=9)] * 12
    frames = [
        sensor.build("data", units=True, points=points, **sensor.simulation.sweep(i))
        for i in range(5 * number // 24)
    ]
    scans = list(sensor.scans(b"".join(frames)))
    assert scans[1].complete
    assert not scans[-1].complete
    assert len(scans[1]) == pytest.approx(number, abs=1)
    assert scans[1].rate_hz == pytest.approx(10, rel=0.03)
    assert sum(map(len, scans)) == 12 * len(frames)


def scans_at(hertz: float) -> list[ls.Scan]:
    """Return the scans of 3.5 revolutions at this speed."""
    assert SENSOR.simulation.sweep is not None
    sweep = partial(SENSOR.simulation.sweep, turns=hertz)
    points = [dict(distance=2.0, intensity=9)] * 12
    frames = [
        SENSOR.build("data", units=True, points=points, **sweep(i))
        for i in range(round(3.5 * 1800 / hertz))
    ]
    return list(SENSOR.scans(b"".join(frames)))


@pytest.mark.parametrize("hertz", [0.5, 2, 4, 6, 10, 13])
def test_scans_are_complete_at_each_speed_of_external_control(hertz: float) -> None:
    scans = scans_at(hertz)
    assert [scan.complete for scan in scans] == [False, True, True, False]
    assert [len(scan) for scan in scans[1:3]] == [pytest.approx(21_600 / hertz, abs=2)] * 2
    assert [scan.rate_hz for scan in scans[1:3]] == [pytest.approx(hertz, rel=0.03)] * 2


def test_other_types_and_numbers_of_points_are_rejected() -> None:
    for version_and_length in range(256):  # type in the upper three bits, points in the lower five
        data = QUADRANTS[:1] + bytes([version_and_length]) + QUADRANTS[2:46]
        data += bytes([Crc(width=8, poly=0x4D)(data)])
        frames = [found.frame for found in SENSOR.split(data)]
        if (version_and_length >> 5, version_and_length & 31) == (1, 12):
            assert frames == ["data"]
        else:
            assert frames == []


def test_stats_have_the_values_of_the_vendors_viewer(tmp_path: Path) -> None:
    file = tmp_path / "a.bin"
    file.write_bytes(b"".join(ls.simulate(SENSOR, 600)))
    command = [sys.executable, "-m", "lidarspec", "stats", str(file), "-s", SENSOR.id, "--json"]
    text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    values = json.loads(text)
    assert values["speed_hz"] == pytest.approx(10, rel=0.01)
    assert values["packet_rate_hz"] == pytest.approx(1800, rel=0.01)
    assert values["valid"] == 2160


def test_speed_and_links() -> None:
    assert SENSOR.decode(QUADRANTS)["speed"].tolist() == [3600]  # degrees per second: 10 Hz
    assert (SENSOR.links["data"], LD06.links["data"]) == (Serial(921_600), Serial(230_400))
    assert not SENSOR.commands


def test_decoding_follows_a_struct_with_renamed_and_reordered_fields() -> None:
    struct = Checksummed(
        Struct(
            "header" / Const(b"\x54\x2c"),
            "crc" / Int8ul,
            "clock" / Scaled(Int16ul, 0.001, "s"),
            "echoes" / Array(12, Struct("strength" / Int8ul, "far" / Scaled(Int16ul, 0.001, "m"))),
            "to" / Scaled(Int16ul, 0.01, "deg"),
            "since" / Scaled(Int16ul, 0.01, "deg"),
            "speed" / Scaled(Int16ul, 1, "deg/s"),
        ),
        field="crc",
        algorithm=Crc(width=8, poly=0x4D),
    )

    def points(f: Fields) -> Polar:
        return Polar(
            f.echoes.far,
            -np.deg2rad(spread(f.since, f.to, 12, full=360.0)),
            intensity=f.echoes.strength,
        )

    other = dataclasses.replace(
        SENSOR,
        frames={"data": Frame(struct, data=True, max_length=47)},
        points=points,
        clock=Clock("clock", wraps_at=30.0),
    )
    echoes = [dict(far=1 + k / 2, strength=10 + k) for k in range(12)]
    data = other.build("data", units=True, clock=1.0, since=30, to=277.5, speed=3600, echoes=echoes)
    assert (len(data), data[3:5]) == (47, (1000).to_bytes(2, "little"))
    cloud, same = decode(other, data).points(), decode(SENSOR, QUADRANTS).points()
    np.testing.assert_array_equal(cloud.xyz, same.xyz)
    np.testing.assert_array_equal(cloud.intensity, same.intensity)
    assert cloud.stamp_ns == same.stamp_ns == 10**9
