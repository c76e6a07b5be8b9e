"""Tests of CSPC M1C1_Mini and COIN-D4: the manual's examples and calculated points."""

from __future__ import annotations

import math
import pickle
from typing import Any

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import simulate
from lidarspec.detect.identification import SampleBytes, identify_sample
from tests.agreement import assert_same_points
from tests.evidence import assert_points, clockwise, decode, vector_bytes, vectors

FILE = "vectors_serial2d.json"
SENSOR, COIN, COIN_D6 = (
    ls.sensor("cspc-m1c1-mini"),
    ls.sensor("cspc-coin-d4"),
    ls.sensor("cspc-coin-d6"),
)
V11 = ls.sensor("cspc-m1c1-mini-v11")

WHOLE = {
    "cspc_cmd_start": "command",
    "cspc_cmd_low_exposure": "command",
    "cspc_cmd_high_exposure": "command",
    "cspc_cmd_stop": "command",
    "cspc_cmd_get_version": "command",
    "cspc_ack_start": "ack",
    "cspc_ack_stop": "ack",
    "cspc_info_corrected": "info",
    "cspc_scan_start": "scan_start",
    "cspc_start_packet_synth": "data",
    "coin_d4_ack_capture": "ack",
}
STREAMS = {"cspc_stream_startup_synth", "coin_d4_startup_capture"}
WRONG = {"cspc_info_as_printed"}
EXCERPTS = {"cspc_angle_example"}
OLDER = {"cspc_v11_ack_start", "cspc_v11_ack_stop", "cspc_v11_si2"}  # of V11

# A start packet at 0.5 degrees: 500 mm, intensity 200, scans at 5.5 Hz.
START = bytes.fromhex("aa556f0141004100375321d307")
# The device information of the manual with the sum put right (0403): angles to be corrected, zero
# at 12 degrees.
INFO = bytes.fromhex("a55a14000304014d3143315f4d696e690000000c00000100000004")

# Four samples at 30, 120, 210 and 300 degrees, 1, 2, 4 and 8 m, intensity 100, low exposure:
#   FSA 0f01: >> 1 = 1920, / 64 = 30.   LSA 9601: >> 1 = 19200, / 64 = 300.   Step (300 - 30) / 3 =
# 90.
#   Samples 92 S1 S2: exposure 92 & 3 = 2; intensity (S1 & 3) * 64 + (92 >> 2) = 64 + 36 = 100;
#   distance S2 * 64 + (S1 >> 2): 15 * 64 + 40 = 1000, 31 * 64 + 16 = 2000, 62 * 64 + 32 = 4000, 125
# * 64 + 0 = 8000.
#   CS: 55aa ^ 0400 ^ 0f01 ^ 9601 = c8aa; the four 0092 cancel; ^ 0fa1 ^ 1f41 ^ 3e81 ^ 7d01 = 9bca.
QUADRANTS = bytes.fromhex("aa55 0004 010f 0196 ca9b 92a10f 92411f 92813e 92017d")


def packet(angles: tuple[float, float], distances: list[int], **more: Any) -> bytes:
    """Return a point packet with raw angles in degrees and distances in millimetres."""
    samples = [{"distance": distance, "intensity": 100, "exposure": 1} for distance in distances]
    raw = [{"angle": round(angle * 64)} for angle in angles]
    return SENSOR.build(
        "data",
        fsa=raw[0],
        lsa=raw[1],
        samples=samples,
        **{"mt": {"m": 0, "start": 0}, **more},
    )


def test_every_vector_of_the_family_is_used() -> None:
    known = {
        name
        for name, vector in vectors(FILE).items()
        if name.startswith(("cspc_", "coin_")) or "CSPC" in vector["sensor"]
    }
    assert known == WHOLE.keys() | STREAMS | WRONG | EXCERPTS | OLDER


@pytest.mark.parametrize("name", WHOLE)
def test_a_whole_frame_is_parsed_and_built_to_the_same_bytes(name: str) -> None:
    data, frame = vector_bytes(FILE, name), WHOLE[name]
    parsed = SENSOR.parse(data)
    assert SENSOR.build(frame, parsed) == data
    assert SENSOR.parse(data, frame) == parsed
    for mine, printed in {
        "mode": "mode",
        "length": "length",
        "revision": "sw_rev",
        "correction": "needs_angle_correction",
    }.items():
        expected = vectors(FILE)[name]["expected"]
        assert mine not in parsed or parsed[mine] == expected.get(printed, parsed[mine])
    if frame != "command":
        found = SENSOR.split(data)
        assert [(item.frame, item.offset, item.data) for item in found] == [(frame, 0, data)]
        assert len(decode(SENSOR, data, frame)) == 1


def test_the_fields_of_the_answers_and_of_the_device_information() -> None:
    ack = SENSOR.parse(vector_bytes(FILE, "cspc_ack_start"))
    assert (ack.mode, ack.firmware, ack.reserved, ack.checksum) == (0x50, 3, bytes(6), 0xAB)
    info = SENSOR.parse(INFO)
    assert info.model == b"M1C1_Mini\0\0\0"  # nine characters, and 00 ends them
    assert info.reserved == bytes(3)
    assert (info.sum, info.zero_angle, info.direction, info.correction, info.revision) == (
        0x0403,
        12,
        0,
        1,
        4,
    )
    assert SENSOR.decode(INFO, "info")["zero_angle"].tolist() == [12]


def test_the_length_of_the_device_information_counts_the_data_only() -> None:
    assert SENSOR.parse(INFO).length == len(INFO[7:]) == 20
    assert INFO[2:4] == b"\x14\x00"  # the low byte is first


@pytest.mark.parametrize(
    "frame",
    [
        # the manual's example of a length: a5 + 5a + 05 + 02 + 1 + 2 + 3 + 4 + 5 = 115
        "a55a 0500 1501 02 0102030405",
        "a55a 0100 0401 01 03",  # a5 + 5a + 01 + 01 + 03 = 104
        "a55a 0100 8301 81 02",
    ],
)
def test_other_types_and_lengths_of_information_are_skipped(frame: str) -> None:
    data = bytes.fromhex(frame)
    assert sum(data[:4] + data[6:]) == int.from_bytes(data[4:6], "little")
    packets = decode(SENSOR, data + QUADRANTS)
    assert (len(packets), packets.stats.bytes_skipped) == (1, len(data))


def test_the_printed_sum_of_the_device_information_is_wrong() -> None:
    data = vector_bytes(FILE, "cspc_info_as_printed")
    with pytest.raises(ls.WireError) as caught:
        SENSOR.parse(data)
    fault = caught.value
    assert (fault.frame, fault.path, fault.offset, fault.expected, fault.got) == (
        "info",
        "sum",
        4,
        "0x0403",
        "0x0402",
    )
    assert SENSOR.parse(data, verify=False).model == b"M1C1_Mini\0\0\0"
    assert decode(SENSOR, data).stats.bad_checksum == 1


@pytest.mark.parametrize("name", ["cspc_v11_ack_start", "cspc_v11_ack_stop"])
def test_an_answer_of_the_older_generation_is_no_point_packet(name: str) -> None:
    data, expected = vector_bytes(FILE, name), vectors(FILE)[name]["expected"]
    parsed = V11.parse(data)
    assert (parsed.mode, parsed.length, parsed.checksum) == (expected["mode"], 7, expected["xor"])
    assert V11.build("ack", parsed) == data
    assert [(item.frame, item.data) for item in V11.split(data)] == [("ack", data)]
    for sensor in (SENSOR, V11):
        with pytest.raises(ls.WireError, match=r"fsa\.check") as caught:
            sensor.parse(data, "data")
        assert (caught.value.path, caught.value.offset) == ("fsa.check", 4)
    assert SENSOR.split(data + bytes(40)) == []


def test_the_samples_of_the_older_generation_have_two_bytes() -> None:
    """The packet has four samples, at 30, 120, 210 and 300 degrees.

    Their distances are 1, 2, 7.161 and 8 m.
    """
    si = vector_bytes(FILE, "cspc_v11_si2")
    data = bytes.fromhex("aa55 0004 010f 0196 aeca a00f 401f") + si + bytes.fromhex("007d")
    packets = decode(
        V11,
        vector_bytes(FILE, "cspc_v11_ack_start")
        + b"\xfe\xff"
        + INFO
        + bytes.fromhex("a55a0000800181")
        + data,
    )
    assert packets.stats.frames == {"ack": 1, "info": 1, "scan_start": 1, "data": 1}
    assert packets["samples.distance"][0].tolist() == pytest.approx(
        [1, 2, vectors(FILE)["cspc_v11_si2"]["expected"]["mm"] / 1000, 8]
    )
    # corrected as by the newer manual, at 7161 mm by 11.852045 degrees: 198.147955
    assert_points(
        packets.points(),
        [(0, (0.94520, -0.32648, 0)), (2, (-6.80478, 2.23045, 0)), (3, (2.48973, 7.60271, 0))],
    )
    assert packets.points().intensity is None
    assert np.rad2deg(
        -V11.configure(zero="housing").decode(data).points().azimuth[0]
    ) == pytest.approx(19.055532 + 12, abs=1e-4)


def test_an_older_model_is_distinguished_from_a_ydlidar() -> None:
    """Both send packets with two bytes a sample.

    When started, the older model sends its name. A YDLIDAR sends its rotation rate.
    """
    own, other = (b"".join(simulate(ls.sensor(name), 60)) for name in (V11.id, "ydlidar-x4"))
    assert identify_sample(SampleBytes("", (INFO + own,))).sensor is V11
    assert V11.id not in {
        alike.sensor.id for alike in identify_sample(SampleBytes("", (other,))).candidates
    }


@pytest.mark.parametrize(
    "data",
    [
        bytes.fromhex("aa55") * 400,  # the 16-bit XOR of any even number of these words is right
        bytes.fromhex("aa55 0000 0100 0100 aa55"),  # no samples, and its checksum is the header
        packet((0.0, 0.0), []),
        packet((360.0, 10.0), [1000, 1000]),
        packet((10.0, 360.0), [1000, 1000]),
        # A start packet has one sample.
        packet((10.0, 20.0), [1000, 1000], mt={"m": 55, "start": 1}),
        bytes(200),
        b"\xff" * 200,
    ],
)
def test_implausible_bytes_are_no_frames(data: bytes) -> None:
    packets = decode(SENSOR, data)
    assert packets.stats.frames == {}
    assert packets.stats.bytes_skipped == len(data)


def test_a_packet_after_implausible_ones_is_found() -> None:
    noise = bytes.fromhex("aa55") * 7 + bytes.fromhex("aa55000001000100aa55")
    packets = decode(SENSOR, noise + QUADRANTS)
    assert packets.offset.tolist() == [len(noise)]


def test_the_first_fields_of_the_angle_example() -> None:
    expected = vectors(FILE)["cspc_angle_example"]["expected"]
    data = packet((expected["fsa_deg"], expected["lsa_deg"]), [1000, *[3000] * 23, 8000])
    assert data.startswith(vector_bytes(FILE, "cspc_angle_example"))
    packets = decode(SENSOR, data)
    assert packets.raw["lsn"].tolist() == [expected["lsn"]]
    assert packets["fsa.angle"].tolist() == [expected["fsa_deg"]]
    assert packets["lsa.angle"].tolist() == [expected["lsa_deg"]]
    angles = clockwise(packets.points())
    np.testing.assert_allclose(
        angles[[0, 24]], [expected["angle_fsa"], expected["angle_lsa"]], atol=2e-5
    )
    np.testing.assert_allclose(angles[[0, 24]], [37.4933, 59.3065], atol=0.003)  # as printed
    assert not np.isclose(angles[24], 59.3065, atol=1e-3)  # the printed one is 0.002 off


def test_points_by_hand_with_the_correction() -> None:
    cloud = decode(SENSOR, INFO + QUADRANTS).points()
    # Clockwise angle = raw - atan(19.16 (d - 90.15) / (90.15 d)), azimuth its negative:
    #   1000: 30 - 10.944468 = 19.055532;    x = cos = 0.94520,      y = -sin = -0.32648   front
    # right
    #   2000: 120 - 11.472618 = 108.527382;  x = 2 cos = -0.63552,   y = -1.89634          back
    # right
    #   4000: 210 - 11.735960 = 198.264040;  x = 4 cos = -3.79849,   y = +1.25359          back left
    #   8000: 300 - 11.867443 = 288.132557;  x = 8 cos = 2.48973,    y = +7.60271          front
    # left
    expected = [
        (0.94520, -0.32648, 0),
        (-0.63552, -1.89634, 0),
        (-3.79849, 1.25359, 0),
        (2.48973, 7.60271, 0),
    ]
    assert_points(cloud, enumerate(expected))
    assert cloud.intensity is not None
    assert cloud.intensity.tolist() == [100] * 4
    assert cloud.valid.all()


def test_the_auxiliary_frame_of_a_coin_d6_is_no_noise() -> None:
    data = bytes.fromhex("a55a0400fe 3a 06 39 000000")  # a5 ^ 5a ^ 04 ^ fe ^ 06 ^ 39 = 3a
    parsed = COIN_D6.parse(data)
    assert (parsed.value, COIN_D6.build("auxiliary", parsed)) == (0x39, data)
    found = COIN_D6.decode(START + data + QUADRANTS)
    assert (found.stats.frames, found.stats.bytes_skipped) == ({"data": 2, "auxiliary": 1}, 0)
    assert COIN.decode(START + data + QUADRANTS).stats.bytes_skipped == len(data)


def test_points_by_hand_without_the_correction() -> None:
    # The raw angles 30, 120, 210, 300, clockwise: cos 30 = 0.86603, sin 30 = 0.5.
    expected = [(0.86603, -0.5, 0), (-1.0, -1.73205, 0), (-3.46410, 2.0, 0), (4.0, 6.92820, 0)]
    assert_points(decode(COIN, QUADRANTS).points(), enumerate(expected))
    assert COIN.parse(QUADRANTS).samples[3] == {"distance": 8000, "intensity": 100, "exposure": 2}


def test_the_device_information_decides_about_the_correction() -> None:
    off = SENSOR.build("info", {**SENSOR.parse(INFO), "correction": 0, "sum": None})
    corrected, raw = (
        decode(SENSOR, INFO + QUADRANTS).points(),
        decode(SENSOR, off + QUADRANTS).points(),
    )
    np.testing.assert_allclose(clockwise(raw), [30, 120, 210, 300], atol=1e-4)
    both = decode(SENSOR, INFO + QUADRANTS + off + QUADRANTS).points()
    np.testing.assert_array_equal(both.azimuth, np.concatenate([corrected.azimuth, raw.azimuth]))
    assert_points(decode(COIN, INFO + QUADRANTS).points(), [(0, corrected.xyz[0])])


def test_nominal_until_the_device_information_is_known() -> None:
    assert SENSOR.decode(QUADRANTS).points().nominal
    assert not SENSOR.decode(INFO + QUADRANTS).points().nominal
    # If the whole input is decoded at once, the first info frame applies from the start.
    assert not SENSOR.decode(QUADRANTS + INFO).points().nominal
    assert_same_points(
        decode(SENSOR, INFO + QUADRANTS).points()[:2],
        decode(SENSOR, QUADRANTS + INFO).points()[:2],
    )
    np.testing.assert_array_equal(
        SENSOR.decode(QUADRANTS).points().xyz, SENSOR.decode(INFO + QUADRANTS).points().xyz
    )


def test_the_correction_where_the_formula_is_delicate() -> None:
    # 90.15 mm would be corrected by nothing, less by a negative angle; 0 is not corrected at all,
    # nor divided by.
    cloud = decode(SENSOR, packet((100.0, 100.0), [0, 90, 1, 16383])).points()
    expected = [
        0.0,
        *(math.degrees(math.atan(19.16 * (d - 90.15) / (90.15 * d))) for d in (90, 1, 16383)),
    ]
    np.testing.assert_allclose(
        clockwise(cloud), [100 - correction for correction in expected], atol=1e-4
    )
    assert expected[1] < 0
    assert expected[2] < -86
    assert cloud.valid.tolist() == [False, True, True, True]
    assert np.isinf(cloud.range[0])
    assert np.isnan(cloud.x[0])


def test_one_sample_has_the_first_angle() -> None:
    packets = decode(SENSOR, vector_bytes(FILE, "cspc_start_packet_synth"))
    expected = vectors(FILE)["cspc_start_packet_synth"]["expected"]
    cloud = packets.points()
    # 0.5 - 9.883 is negative.
    np.testing.assert_allclose(clockwise(cloud), [expected["first_angle_deg"]], atol=2e-5)
    assert packets["frequency"].tolist() == [pytest.approx(expected["scan_freq_hz"])]
    assert (round(float(cloud.range[0]) * 1000), packets.raw["samples"]["intensity"][0, 0]) == (
        500,
        200,
    )
    # LSA of a single sample does not count.
    apart = decode(SENSOR, packet((40.0, 80.0), [0])).points()
    np.testing.assert_allclose(clockwise(apart), [40])


def test_packets_that_cross_360_degrees_go_on_forward() -> None:
    # FSA b181: >> 1 = 22720, / 64 = 355.   LSA 0281: >> 1 = 320, / 64 = 5.   Step (5 + 360 - 355) /
    # 4 = 2.5.
    data = bytes.fromhex("aa550005 81b1 8102 59cd 920100 92a10f 92411f 920100 92813e")
    cloud = decode(COIN, data).points()
    np.testing.assert_allclose(clockwise(cloud), [355, 357.5, 0, 2.5, 5], atol=1e-5)
    assert cloud.valid.tolist() == [False, True, True, False, True]
    # Corrected: 357.5 - 10.944468 = 346.555532; 1 m: x = cos = 0.97260, y = -sin = +0.23249.
    assert_points(decode(SENSOR, data).points(), [(1, (0.97260, 0.23249, 0))])


def test_angles_from_the_mark_on_the_housing() -> None:
    housing = SENSOR.configure(zero="housing")
    turned = (
        clockwise(housing.decode(INFO + QUADRANTS).points())
        - clockwise(SENSOR.decode(INFO + QUADRANTS).points())
    ) % 360
    np.testing.assert_allclose(turned, 12, atol=1e-4)
    other = SENSOR.build(
        "info", {**SENSOR.parse(INFO), "zero_angle": 20, "correction": 0, "sum": None}
    )
    np.testing.assert_allclose(
        clockwise(decode(housing, other + QUADRANTS).points()), [50, 140, 230, 320], atol=1e-4
    )
    np.testing.assert_allclose(
        clockwise(COIN.configure(zero="housing").decode(QUADRANTS).points())[0], 30, atol=1e-4
    )
    assert_same_points(
        pickle.loads(pickle.dumps(housing)).decode(QUADRANTS).points(),
        housing.decode(QUADRANTS).points(),
    )
    assert_same_points(
        SENSOR.configure(zero="data").decode(QUADRANTS).points(), SENSOR.decode(QUADRANTS).points()
    )
    with pytest.raises(ls.UsageError, match="'data' or 'housing'"):
        SENSOR.configure(zero="motor")


def test_the_vendors_axes_are_left_handed() -> None:
    cloud = COIN.configure(frame="vendor").decode(QUADRANTS).points()
    assert_points(cloud, [(0, (0.86603, 0.5, 0)), (1, (-1.0, 1.73205, 0))])
