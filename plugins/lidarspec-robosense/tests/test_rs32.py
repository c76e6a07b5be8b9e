"""Tests of RoboSense RS-LiDAR, RS-Bpearl, RS-Ruby and Airy.

They cover calculated points, the date, dual return and detection of the model.
"""

from __future__ import annotations

import datetime
import struct
from collections.abc import Mapping, Sequence

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import simulate
from lidarspec.detect.identification import identify_sample
from lidarspec.detect.sample_bytes import SampleBytes
from tests.evidence import assert_points, decode, vector_bytes, vectors
from tests.installed import sensor_ids

FILE = "vectors_udp3d.json"
RS32, RS16, BPEARL = (ls.sensor(f"robosense-{model}") for model in ("rs32", "rs16", "bpearl"))


def msop(
    azimuths: Sequence[int],
    channels: Mapping[tuple[int, int], tuple[int, int]],
    *,
    lidar_type: int = 2,
) -> bytes:
    """Return an MSOP packet; the offsets are those of rs_driver.

    Args:
        azimuths: raw values by block.
        channels: {(block, slot): (raw distance, intensity)}.
    """
    time = struct.pack(">6BHHB", 21, 10, 1, 1, 2, 3, 273, 546, lidar_type)
    body = b"".join(
        b"\xff\xee"
        + struct.pack(">H", azimuth)
        + b"".join(struct.pack(">HB", *channels.get((block, slot), (0, 0))) for slot in range(32))
        for block, azimuth in enumerate(azimuths)
    )
    return (
        bytes.fromhex("55aa050a5aa550a0")
        + bytes(12)
        + time
        + bytes(11)
        + body
        + bytes(4)
        + b"\x00\xff"
    )


def difop(*, mode: int = 1, vertical: bytes = b"", horizontal: bytes = b"") -> bytes:
    """Return a DIFOP packet.

    Args:
        mode: the return mode.
        vertical, horizontal: the bytes of the angles, from the first laser on; all other angles
            are 0.
    """
    data = bytearray(bytes.fromhex("a5ff005a11115555") + bytes(1238) + b"\x0f\xf0")
    data[8:10], data[300] = struct.pack(">H", 600), mode
    data[468 : 468 + len(vertical)], data[564 : 564 + len(horizontal)] = vertical, horizontal
    return bytes(data)


def test_points_of_an_rs32_by_hand() -> None:
    cells = {(0, 14): (2000, 9), (5, 16): (1000, 7)}
    cloud = decode(RS32, [msop([9000 + 20 * block for block in range(12)], cells)]).points()
    assert cloud.nominal
    # laser 14: 40.32 of 55.52 us, 0.14525 of 0.20: R 90.14525, E 15.0167, H = R - 6.9439 =
    # 83.20135; 10 m, the lens 39.97 mm out along R
    #   x = 10 * .965851 * .118398 + .03997 * -.002535 = 1.14345, y = -(9.58558 + .03997 * .999997)
    # = -9.63061, z = 2.59101 laser 16: 1.44 of 55.52: R 91.00519, E -25, H = R - 6.6968 = 84.30839;
    # 5 m
    #   x = 4.53154 * .099168 + .03997 * -.017543 = .44868, y = -(4.50920 + .03996) = -4.54921, z =
    # -2.11309
    assert_points(
        cloud,
        [(14, (1.14345, -9.63061, 2.59101)), (5 * 32 + 16, (0.44868, -4.54921, -2.11309))],
        atol=9e-4,
    )
    np.testing.assert_allclose(cloud.time[[14, 176]], [40.32e-6, 279.04e-6], atol=1e-12)
    assert cloud.ring is not None
    assert cloud.ring[[14, 16]].tolist() == [31, 0]


def test_the_angles_of_a_unit_come_with_difop() -> None:
    data = [
        difop(vertical=bytes.fromhex("0003e8"), horizontal=bytes.fromhex("0107d0")),
        msop([0] * 12, {(0, 0): (1000, 1)}),
    ]
    # 1000 and -2000 steps of 0.001 degrees from an RS32: E 1, H -2; of 0.01 from a Bpearl: E 10, H
    # -20, and z 94.27 mm higher
    for sensor, lidar_type, vertical, horizontal, lens, height in (
        (RS32, 2, 1, -2, 0.03997, 0),
        (BPEARL, 0, 10, -20, 0.01473, 0.09427),
    ):
        cloud = decode(
            sensor, [data[0], msop([0] * 12, {(0, 0): (1000, 1)}, lidar_type=lidar_type)]
        ).points()
        e, h = np.deg2rad([vertical, horizontal])
        assert not cloud.nominal
        assert_points(
            cloud,
            [
                (
                    0,
                    (
                        5 * np.cos(e) * np.cos(h) + lens,
                        -5 * np.cos(e) * np.sin(h),
                        5 * np.sin(e) + height,
                    ),
                )
            ],
        )


def test_pairs_of_blocks_are_the_two_returns() -> None:
    cells = {(block, 0): (1000, 1) for block in range(12)}
    data = [difop(mode=0), msop([20 * (block // 2) for block in range(12)], cells)]
    cloud = decode(RS32, data).points()
    assert cloud.return_index is not None
    assert cloud.return_index[::32].tolist() == [0, 1] * 6
    np.testing.assert_allclose(cloud.time[::32], np.repeat(np.arange(6), 2) * 55.52e-6, atol=1e-12)


def test_the_packet_of_the_vectors() -> None:
    start, expected = (
        vector_bytes(FILE, "rsbp_msop_unit"),
        vectors(FILE)["rsbp_msop_unit"]["expected"],
    )
    blocks = b"\xff\xee" + bytes(98)
    parsed = BPEARL.parse(start[:142] + blocks * 11 + bytes(4) + b"\x00\xff", "data", units=True)
    assert parsed.temperature.magnitude == expected["temp_c"]
    assert [
        parsed.blocks[0].channels[0].distance,
        parsed.blocks[0].channels[0].intensity,
    ] == expected["b0c0"]
    colder = (
        start[:38]
        + vector_bytes(FILE, "rs_temp_le_1801")
        + start[40:142]
        + blocks * 11
        + bytes(4)
        + b"\x00\xff"
    )
    assert (
        BPEARL.parse(colder, "data", units=True).temperature.magnitude
        == vectors(FILE)["rs_temp_le_1801"]["expected"]["celsius"]
    )


def test_the_steps_of_the_angles_of_an_rs16_and_the_end_of_an_e1_are_those_of_the_vectors() -> None:
    parsed, pitch = RS16.parse(difop(), "difop"), vectors(FILE)["rs16_pitch"]["expected"]
    parsed.pitch[0] = pitch["raw"]
    data = RS16.build("difop", parsed)
    assert vector_bytes(FILE, "rs16_pitch") in data
    assert RS16.parse(data, "difop", units=True).pitch[0] == pytest.approx(pitch["deg"])
    tail, expected = (
        ls.sensor("robosense-e1").parse(vector_bytes(FILE, "rs_e1_e2e_tail")),
        vectors(FILE)["rs_e1_e2e_tail"]["expected"],
    )
    assert all(tail[name] == expected[name] for name in ("data_length", "counter", "data_id"))


def test_the_date_is_read_as_utc() -> None:
    moment = datetime.datetime(2021, 10, 1, 1, 2, 3, tzinfo=datetime.UTC)
    data = msop([0] * 12, {})
    assert vector_bytes(FILE, "rs_time_ymd") in data
    packets = decode(RS32, [data])
    assert packets.time_ns.tolist() == [int(moment.timestamp()) * 10**9 + 273_546_000]


@pytest.mark.slow
@pytest.mark.parametrize("sensor_id", sensor_ids("lidarspec-robosense"))
def test_every_model_is_identified(sensor_id: str) -> None:
    sensor = ls.sensor(sensor_id)
    assert (
        identify_sample(SampleBytes("", tuple(simulate(sensor, 20)), datagrams=True)).sensor
        is sensor
    )


@pytest.mark.slow
def test_helios_16_and_32_are_distinguished_also_in_dual_return() -> None:
    """Both models have the same type byte.

    With two returns, 16 lasers send as many values as 32 lasers with one return, but the second
    half of each block repeats the first half.
    """
    small, large = ls.sensor("robosense-helios16p"), ls.sensor("robosense-helios32")
    twice, pairs = [], []
    for frame in simulate(large, 20):
        packet = large.parse(frame)
        for block in packet.blocks:
            block.channels[16:] = block.channels[:16]
        twice.append(large.build("data", packet))
        packet = large.parse(frame)
        packet.blocks[1::2] = packet.blocks[::2]
        pairs.append(large.build("data", packet))
    assert identify_sample(SampleBytes("", tuple(twice), datagrams=True)).sensor is small
    assert identify_sample(SampleBytes("", tuple(pairs), datagrams=True)).sensor is large


def ruby(azimuths: Sequence[int], distances: Sequence[int], *, returns: int) -> bytes:
    """Return a packet of three blocks (Table 5-2); only the first laser has echoes."""
    head = (
        bytes.fromhex("55aa055a010200") + bytes([returns]) + bytes(23) + bytes([5, 1]) + bytes(47)
    )
    cells = zip(azimuths, distances, strict=True)
    return (
        head
        + b"".join(
            b"\xfe\x01" + struct.pack(">HHB", azimuth, raw, 7) + bytes(381)
            for azimuth, raw in cells
        )
        + bytes(4)
    )


def test_three_blocks_of_dual_return_are_a_shot_and_a_half() -> None:
    sensor = ls.sensor("robosense-ruby-plus-128")
    cloud = decode(
        sensor,
        [
            ruby([0, 0, 40], [200, 400, 600], returns=3),
            ruby([40, 80, 80], [800, 1000, 1200], returns=3),
        ],
    ).points()
    assert cloud.return_index is not None
    assert cloud.return_index[::128].tolist() == [0, 1, 0, 1, 0, 1]
    np.testing.assert_allclose(
        cloud.time[::128], np.array([0, 0, 1, 0, 1, 1]) * 55.56e-6, atol=1e-12
    )
    assert cloud.range[::128].tolist() == [1, 2, 3, 4, 5, 6]
    single = decode(sensor, [ruby([0, 40, 80], [200, 400, 600], returns=1)]).points()
    assert single.return_index is not None
    assert not single.return_index.any()
    # the last laser fires 53.771 us of 55.56 after its block: 0.4 degrees on by the step to the
    # next block, from the last one as before it
    np.testing.assert_allclose(
        -np.rad2deg(single.azimuth[127::128]),
        np.array([0, 0.4, 0.8]) + 0.4 * 53.771 / 55.56,
        atol=1e-5,
    )


def test_pairs_of_blocks_of_an_airy_are_one_shot_and_its_imu_is_in_steps_of_its_ranges() -> None:
    sensor = ls.sensor("robosense-airy")
    packet = sensor.parse(simulate(sensor, 1)[0])
    for number, block in enumerate(packet.blocks):
        block.azimuth = 40 * (number // 4)
    cloud = decode(sensor, [sensor.build("data", {**packet, "returns": 3})]).points()
    assert cloud.return_index is not None
    assert cloud.ring is not None
    assert cloud.return_index[::48].tolist() == [0, 0, 1, 1] * 2
    assert cloud.ring[::48].tolist() == [0, 48] * 4
    np.testing.assert_allclose(cloud.time[:: 4 * 48], [0, 111.08e-6], atol=1e-12)
    axes = [f"{kind}_{axis}" for kind in ("acceleration", "rotation") for axis in "xyz"]
    still = dict.fromkeys(axes, 0) | {
        "seconds": 5,
        "microseconds": 0,
        "temperature": 0,
        "data_rate": 3,
        "count": 1,
    }
    data = sensor.build(
        "imu",
        **{
            **still,
            "acceleration_z": 8192,
            "rotation_x": -16384,
            "acceleration_range": 1,
            "rotation_range": 2,
        },
    )
    felt = sensor.decode([data], "imu").imu()
    np.testing.assert_allclose(felt.linear_acceleration, [[0, 0, 9.80665]])
    np.testing.assert_allclose(felt.angular_velocity, [[np.deg2rad(-500), 0, 0]])
    assert felt.time_ns.tolist() == [5_000_000_000]
