"""Tests of Livox: published frames and commands, points, dates and start-up."""

from __future__ import annotations

import math
import struct
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.detect.identification import identify_sample
from lidarspec.detect.sample_bytes import SampleBytes
from tests.evidence import decode, vector_bytes, vectors

FILE = "vectors_udp3d.json"
MID360, HAP = ls.sensor("livox-mid360"), ls.sensor("livox-hap")
MID40, AVIA = ls.sensor("livox-mid40"), ls.sensor("livox-avia")
FIRST = ("livox-mid40", "livox-mid70", "livox-horizon", "livox-tele15", "livox-avia")
COMMANDS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "livox1_cmd_issue40": ("livox-avia", "set_returns", {"head.seq": 0, "returns": "first"}),
    "livox1_heartbeat": ("livox-mid40", "heartbeat", {"head.seq": 0}),
    "livox1_start_seq8": ("livox-mid40", "start", {"head.seq": 8}),
    "livox2_set_work_mode_sampling": ("livox-mid360", "start", {"head.seq": 1}),
    "livox2_set_point_host": (
        "livox-mid360",
        "set_point_host",
        {"head.seq": 3, "parameter.value.ip": "192.168.1.50"},
    ),
}
OTHERS = {
    "livox1_handshake",
    "livox1_data_type1_gps",
    "livox2_data_cart32",
    "livox2_data_spherical",
}


def test_every_vector_of_the_family_is_used() -> None:
    assert {name for name in vectors(FILE) if name.startswith("livox")} == {*COMMANDS, *OTHERS}


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_is_the_published_one(name: str) -> None:
    sensor, command, arguments = COMMANDS[name]
    assert ls.sensor(sensor).command(command, **arguments) == vector_bytes(FILE, name)


def test_the_handshake_is_the_published_one() -> None:
    data = vector_bytes(FILE, "livox1_handshake")
    parsed = MID40.parse(data, "handshake")
    assert (bytes(parsed.host), parsed.data_port, parsed.command_port, parsed.imu_port) == (
        bytes([192, 168, 1, 50]),
        55501,
        56001,
        56001,
    )
    assert MID40.build("handshake", parsed) == data


def test_published_points_of_the_second_generation() -> None:
    expected = vectors(FILE)["livox2_data_cart32"]["expected"]
    packets = decode(MID360, [vector_bytes(FILE, "livox2_data_cart32")])
    cloud = packets.points()
    assert len(cloud) == expected["dot_num"]
    assert cloud.xyz[0].tolist() == pytest.approx(expected["points"][0]["xyz"])
    assert cloud.intensity[0] == expected["points"][0]["reflectivity"]
    stamps = packets.time_ns[0] + np.rint(cloud.time[:2] * 1e9).astype(np.int64)
    assert stamps.tolist() == [point["t_ns"] for point in expected["points"][:2]]
    spherical = decode(MID360, [vector_bytes(FILE, "livox2_data_spherical")]).points()
    place = vectors(FILE)["livox2_data_spherical"]["expected"]["points"][0]["xyz"]
    assert spherical.xyz[0].tolist() == pytest.approx(place, abs=1e-4)


def test_published_points_of_the_first_generation_and_their_date() -> None:
    expected = vectors(FILE)["livox1_data_type1_gps"]["expected"]
    packets = decode(MID40, [vector_bytes(FILE, "livox1_data_type1_gps")])
    cloud = packets.points()
    assert packets.time_ns.tolist() == [expected["timestamp_ns"]]
    assert len(cloud) == expected["points_n"]
    assert [*cloud.xyz[0].tolist(), cloud.intensity[0]] == pytest.approx(
        expected["first"], abs=1e-4
    )


def header(kind: int, time_type: int, stamp: bytes) -> bytes:
    """Return the header of a packet of the first generation."""
    return struct.pack("<BBBBIBB", 5, 1, 1, 0, 0, time_type, kind) + stamp


def test_times_of_the_first_generation_are_exact() -> None:
    points = bytes(100 * 13)
    for ns in (0, 1_700_000_000_123_456_789, 2**32 - 1, 2**61 + 1):
        assert decode(MID40, [header(0, 1, struct.pack("<Q", ns)) + points]).time_ns.tolist() == [
            ns
        ]
    for year, month, day in (
        (2000, 1, 1),
        (2000, 2, 29),
        (2023, 12, 31),
        (2024, 2, 29),
        (2024, 3, 1),
    ):
        stamp = struct.pack("<BBBBI", year - 2000, month, day, 23, 3_599_999_999)
        seconds = int(datetime(year, month, day, 23, tzinfo=UTC).timestamp())
        assert decode(MID40, [header(0, 3, stamp) + points]).time_ns.tolist() == [
            seconds * 10**9 + 3_599_999_999_000
        ]


def cartesian(x: int, y: int, z: int, *rest: int) -> bytes:
    return struct.pack("<iii", x, y, z) + bytes(rest)


def depth(value: int, *rest: int) -> bytes:
    return struct.pack("<I", value) + bytes(rest)


ANGLES = struct.pack("<HH", 6000, 22_500)  # 30 degrees up, back and right
SIDE = -math.cos(math.pi / 6) * math.sqrt(0.5)
#: type of data -> shots of a packet, the first of them, where its returns are, its tag.
TYPES: dict[int, tuple[int, bytes, list[list[float]], int | None]] = {
    0: (100, cartesian(1000, -2000, 500, 9), [[1, -2, 0.5]], None),
    1: (100, struct.pack("<I", 2000) + ANGLES + bytes([9]), [[2 * SIDE, 2 * SIDE, 1]], None),
    2: (96, cartesian(1000, -2000, 500, 9, 3), [[1, -2, 0.5]], 3),
    3: (96, struct.pack("<I", 2000) + ANGLES + bytes([9, 3]), [[2 * SIDE, 2 * SIDE, 1]], 3),
    4: (
        48,
        cartesian(1000, -2000, 500, 9, 3) + cartesian(2000, -4000, 1000, 8, 16),
        [[1, -2, 0.5], [2, -4, 1]],
        3,
    ),
    5: (
        48,
        ANGLES + depth(2000, 9, 3) + depth(4000, 8, 16),
        [[2 * SIDE, 2 * SIDE, 1], [4 * SIDE, 4 * SIDE, 2]],
        3,
    ),
    7: (
        30,
        b"".join(cartesian(at * 1000, 0, 0, 9, 3) for at in (1, 2, 3)),
        [[1, 0, 0], [2, 0, 0], [3, 0, 0]],
        3,
    ),
    8: (
        30,
        ANGLES + b"".join(depth(at * 2000, 9, 3) for at in (1, 2)) + bytes(6),
        [[2 * SIDE, 2 * SIDE, 1], [4 * SIDE, 4 * SIDE, 2]],
        3,
    ),
}


@pytest.mark.parametrize("kind", TYPES)
def test_points_of_each_type_of_the_first_generation(kind: int) -> None:
    shots, first, places, tag = TYPES[kind]
    packet = header(kind, 0, bytes(8)) + first + bytes(len(first) * (shots - 1))
    cloud = decode(AVIA, [packet]).points()
    assert len(packet) == {0: 1318, 1: 918, 2: 1362, 3: 978, 4: 1362, 5: 786, 7: 1278, 8: 678}[kind]
    assert cloud.xyz[: len(places)] == pytest.approx(np.array(places, np.float32), abs=1e-5)
    assert int(cloud.valid.sum()) == len(places)
    assert (cloud.extra["tag"][0] if tag is not None else None) == tag
    assert cloud.time[len(cloud) // shots] == pytest.approx(1 / 240_000)


def test_a_crc_that_is_not_filled_in_is_no_fault_and_a_wrong_one_is() -> None:
    packet = bytearray(ls.simulate(MID360, 1)[0])
    packet[24:28] = bytes(4)
    assert len(MID360.decode([bytes(packet)])) == 1
    packet[24] = 1
    assert MID360.decode([bytes(packet)]).stats.bad_checksum == 1


def test_a_counter_that_starts_again_with_each_frame_is_no_loss() -> None:
    packets = ls.simulate(MID360, 1000)
    assert {MID360.parse(data).udp_cnt for data in packets} == set(range(208))
    assert MID360.decode(packets).stats.lost == 0
    assert MID360.decode(packets[:500] + packets[503:]).stats.lost == 3


@pytest.mark.parametrize("sensor", [MID360, AVIA], ids=["second", "first"])
def test_imu_samples_are_in_si_units(sensor: ls.Sensor) -> None:
    felt = sensor.decode([sensor.example("imu", seed=seed) for seed in range(3)], "imu")
    first = felt.raw[0]
    assert felt.imu().linear_acceleration[0].tolist() == pytest.approx(
        [first[f"acc_{axis}"] * 9.80665 for axis in "xyz"], nan_ok=True
    )
    assert felt.imu().angular_velocity[0].tolist() == pytest.approx(
        [first[f"gyro_{axis}"] for axis in "xyz"], nan_ok=True
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", [MID360.id, HAP.id, *FIRST])
def test_a_model_is_not_confused_with_related_models(name: str) -> None:
    found = identify_sample(
        SampleBytes("a wire", tuple(ls.simulate(ls.sensor(name), 40)), datagrams=True)
    )
    told = {one.sensor.id for one in found.candidates}
    same_pace = {"livox-mid40": FIRST[:2], "livox-mid70": FIRST[:2]}.get(name, FIRST[2:])
    assert told == ({name} if name in (MID360.id, HAP.id) else set(same_pace))


@pytest.mark.slow
@pytest.mark.parametrize("name", FIRST)
def test_broadcasts_name_the_model(name: str) -> None:
    sensor = ls.sensor(name)
    who = {"mid40": 1, "tele15": 2, "horizon": 3, "mid70": 6, "avia": 7}[
        name.removeprefix("livox-")
    ]
    said = sensor.build(
        "broadcast",
        head={"seq": 0},
        broadcast_code=b"0TESTLIDAR00001\0",
        device_type=who,
        data_reserved=0,
    )
    found = identify_sample(SampleBytes("a wire", (said, *ls.simulate(sensor, 40)), datagrams=True))
    assert [one.sensor.id for one in found.candidates] == [name]


@pytest.mark.slow
@pytest.mark.parametrize("name", [MID360.id, HAP.id, MID40.id])
def test_a_simulated_one_is_opened_started_and_read(name: str) -> None:
    # Simulating all of its points takes a whole processor.
    with ls.open(f"sim:{name}?rate=0.2") as device:
        scan = device.latest(timeout=30)
        assert len(scan.points)
        told = {
            "serial": "SIMULATED",
            "model": {MID360.id: "MID-360"}.get(name, "HAP"),
            "firmware": "13.18.2.40",
            "temperature": "41.50 degC",
        }
        if name == MID40.id:
            told = {"serial": "0TFSIMULATED001", "model": "Mid-40", "firmware": "4.11.0.6"}
        assert device.info == told
        reply = (
            device.send("set_detect_mode", timeout=30, detect_mode="sensitive")
            if name != MID40.id
            else device.send("get_information", timeout=30)
        )
        assert reply.confirmed
        if name != MID40.id:
            assert device.send("get", timeout=30, key=0).confirmed
            assert device.info == told, "an answer that leaves it out takes nothing back"


def test_note_on_acceleration_does_not_contradict_its_unit() -> None:
    text = str(ls.explain(MID360.example("imu"), MID360, frame="imu"))
    assert "m/s2" in text
    assert "; in g" not in text
