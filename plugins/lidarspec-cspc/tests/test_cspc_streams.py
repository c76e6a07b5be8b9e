"""Tests of CSPC streams: start-up, revolutions, commands and a modified struct."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import numpy as np
import pytest
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    ByteSwapped,
    Const,
    Int8ul,
    Int16ul,
    Struct,
    this,
)

import lidarspec as ls
from lidarspec.spec import Checksummed, Fields, Frame, OnFlag, Polar, Scaled, WordXor, spread
from tests.evidence import capture, clockwise, decode, vector_bytes, vectors

FILE = "vectors_serial2d.json"
SENSOR, COIN = ls.sensor("cspc-m1c1-mini"), ls.sensor("cspc-coin-d4")
EVENTS = {"ack": "ack_50", "info": "info_01", "scan_start": "info_81"}


def turn(*, start: int = 0, number: int = 17) -> bytes:
    """Return `number` simulated packets from packet `start` on, all at 1 m."""
    frames = []
    for i in range(start, start + number):
        values = SENSOR.simulation.sweep(i) if SENSOR.simulation.sweep else {}
        samples = [{"distance": 1.0, "intensity": 7, "exposure": values["samples.exposure"]}] * int(
            values["lsn"]
        )
        nested: dict[str, Any] = {"samples": samples}
        for path in ("mt.m", "mt.start", "fsa.angle", "lsa.angle"):
            nested.setdefault(path.partition(".")[0], {})[path.partition(".")[2]] = values[path]
        frames.append(SENSOR.build("data", units=True, **nested))
    return b"".join(frames)


def name_event(found: ls.Found) -> str:
    """Return the name that the vectors use for a frame."""
    if found.frame != "data":
        return EVENTS[found.frame]
    parsed = SENSOR.parse(found.data)
    return "start" if parsed.mt.start else f"points_{parsed.lsn}"


@pytest.mark.parametrize("name", ["cspc_stream_startup_synth", "coin_d4_startup_capture"])
def test_a_start_up_in_order(name: str) -> None:
    sensor = SENSOR if name.startswith("cspc") else COIN
    data, expected = vector_bytes(FILE, name), vectors(FILE)[name]["expected"]
    assert [name_event(found) for found in sensor.split(data)] == expected["events"]
    stats = decode(sensor, data).stats
    assert (stats.bytes_filler, stats.bytes_skipped - stats.bytes_filler) == (
        expected["fill"],
        expected["skipped"],
    )
    assert stats.bytes_in == len(data)
    assert not stats.pending
    for found in sensor.split(data):
        assert sensor.build(found.frame, sensor.parse(found.data)) == found.data


def test_the_scan_of_the_start_up_vector() -> None:
    data = vector_bytes(FILE, "cspc_stream_startup_synth")
    (scan,) = SENSOR.scans(data)
    assert (len(scan), scan.complete, scan.points.nominal) == (26, False, np.False_)
    first, second = SENSOR.scans(data + turn())
    assert (len(first), len(second)) == (26, 380)
    np.testing.assert_allclose(clockwise(scan.points)[:2], [350.61742, 37.49303], atol=2e-5)


def test_a_captured_start_up() -> None:
    data = capture("cspc/coin_d4_ludovatech_issue2_partial.bin").read_bytes()
    expected = json.loads(capture("cspc/coin_d4_ludovatech_issue2_expected.json").read_text())
    packets = decode(COIN, data)
    assert packets.stats.frames == {"info": 1, "scan_start": 1, "data": 4}
    assert [found.frame for found in COIN.split(data)] == ["info", "scan_start", *["data"] * 4]
    assert packets.stats.bytes_skipped == 2 + 20  # FA FA in front, and a packet that is cut off
    assert packets.offset.tolist() == [item["offset"] for item in expected]
    distances = np.array(
        [[distance for _, distance in item["lds2d_angle_dist"]] for item in expected]
    )
    angles = np.array([[angle for angle, _ in item["lds2d_angle_dist"]] for item in expected])
    np.testing.assert_array_equal(packets.raw["samples"]["distance"], distances)
    np.testing.assert_array_equal(
        packets.raw["samples"]["intensity"], [item["vendor_quality"] for item in expected]
    )
    np.testing.assert_array_equal(packets["fsa.angle"], [item["fsa_deg"] for item in expected])
    np.testing.assert_array_equal(packets["lsa.angle"], [item["lsa_deg"] for item in expected])
    cloud = packets.points()
    # The other reader cuts the step to whole 1/64 degrees, which adds up to a fifth of a degree
    # over a packet.
    np.testing.assert_allclose(clockwise(cloud), angles.ravel(), atol=0.25)
    np.testing.assert_allclose(clockwise(cloud)[::25], angles[:, 0], atol=1e-4)
    np.testing.assert_allclose(clockwise(cloud)[24::25], packets["lsa.angle"], atol=1e-4)
    np.testing.assert_array_equal(cloud.valid, distances.ravel() > 0)
    assert int((~cloud.valid).sum()) == 3
    assert not cloud.nominal
    assert COIN.parse(data[2:29]).model == b"COIN-D4\0\0\0\0\0"


def test_points_of_the_capture_by_hand() -> None:
    data = capture("cspc/coin_d4_ludovatech_issue2_partial.bin").read_bytes()
    cloud = decode(COIN, data).points()
    # Packet 1, cb 6f 77 76: FSA 6fcb >> 1 = 14309, / 64 = 223.578125; LSA 7677 >> 1 = 15163, / 64 =
    # 236.921875.
    #   Sample 24, f4 e6 0a: 10 * 64 + (e6 >> 2 = 57) = 697 mm at the LSA: x = .697 cos = -0.38041,
    # y = -.697 sin = +0.58403. Packet 4, 99 84 43 8b: FSA 8499 >> 1 = 16972, / 64 = 265.1875;
    # sample 0, bc 8e 08: 8 * 64 + (8e >> 2 = 35) = 547 mm:
    #   x = .547 cos 265.1875 = -0.04589, y = +0.54507.
    #   LSA 8b43 >> 1 = 17825, / 64 = 278.515625; sample 24, 50 d3 09: 9 * 64 + 52 = 628 mm: x =
    # +0.09300, y = +0.62108.
    expected = {24: (-0.38041, 0.58403, 0), 75: (-0.04589, 0.54507, 0), 99: (0.09300, 0.62108, 0)}
    for index, xyz in expected.items():
        np.testing.assert_allclose(cloud.xyz[index], xyz, atol=2e-5)


def test_turns_are_cut_at_start_packets() -> None:
    data = turn(start=5, number=12) + turn() + turn(number=17) + turn(number=3)
    scans = list(SENSOR.scans(data))
    assert [(len(scan), scan.complete) for scan in scans] == [
        (279, False),
        (380, True),
        (380, True),
        (51, False),
    ]
    angles = np.sort(clockwise(SENSOR.configure(zero="data").decode(turn()).points()))
    np.testing.assert_allclose(np.diff(angles), 360 / 380, atol=0.02)


def test_points_of_a_packet_are_apart_by_the_scan_frequency() -> None:
    # 5.5 Hz in the start packet: 25 samples over 24 * 360 / 380 degrees take 24 / 380 / 5.5 s;
    # before it no rate is known.
    cloud = decode(SENSOR, turn(start=1, number=1) + turn(number=2)).points()
    assert cloud.time[:26].tolist() == [0.0] * 26
    assert cloud.time[50] == pytest.approx(24 / 380 / 5.5, rel=1e-3)
    np.testing.assert_allclose(np.diff(cloud.time[26:]), 1 / 380 / 5.5, rtol=1e-2)


def test_the_command_vectors() -> None:
    for name in SENSOR.commands:
        assert SENSOR.command(name) == vector_bytes(FILE, f"cspc_cmd_{name}")
        assert COIN.command(name) == SENSOR.command(name)
    assert set(SENSOR.commands) == {"start", "stop", "low_exposure", "high_exposure", "get_version"}


def test_which_commands_are_answered_and_by_what() -> None:
    for name, vector in {"start": "cspc_ack_start", "stop": "cspc_ack_stop"}.items():
        command = SENSOR.commands[name]
        assert command.reply == "ack"
        assert dict(command.matches) == {"mode": SENSOR.parse(vector_bytes(FILE, vector)).mode.name}
    assert dict(SENSOR.commands["get_version"].matches) == {"mode": "version"}
    assert [SENSOR.commands[name].reply for name in ("low_exposure", "high_exposure")] == [
        None,
        None,
    ]
    assert (SENSOR.commands["start"].starts, SENSOR.commands["stop"].stops) == (True, True)


def test_a_command_seen_on_the_line_is_no_frame_of_the_sensor() -> None:
    assert SENSOR.split(SENSOR.command("start") + SENSOR.command("stop")) == []


def changed_struct() -> Checksummed:
    """Return the point packet with renamed and reordered fields.

    The distance and the intensity are separate bytes.
    """
    angle = ByteSwapped(
        BitStruct(
            "value" / Scaled(BitsInteger(15), 1 / 64, "deg"), "check" / Const(1, BitsInteger(1))
        )
    )
    sample = Struct("strength" / Int8ul, "far" / Scaled(Int16ul, 0.001, "m"))
    return Checksummed(
        Struct(
            "header" / Const(b"\xaa\x55"),
            "number" / Int8ul,
            "turn"
            / BitStruct("begins" / BitsInteger(1), "hertz" / Scaled(BitsInteger(7), 0.1, "Hz")),
            "last" / angle,
            "first" / angle,
            "returns" / Array(this.number, sample),
            "checksum" / Int16ul,
        ),
        field="checksum",
        algorithm=WordXor(),
    )


def changed_points(f: Fields) -> Polar:
    """Return the points of `changed_struct`, without the correction."""
    angles = spread(f.first.value, f.last.value, f.number, full=360.0)
    return Polar(range=f.returns.far, azimuth=-np.deg2rad(angles), intensity=f.returns.strength)


def test_decoding_follows_a_struct_with_renamed_and_reordered_fields() -> None:
    frame = Frame(changed_struct(), data=True, max_length=1000)
    other = dataclasses.replace(
        COIN,
        frames={**COIN.frames, "data": frame},
        points=changed_points,
        scan=OnFlag("turn.begins"),
    )
    samples = [
        {"far": 1.0, "strength": 5},
        {"far": 2.0, "strength": 6},
        {"far": 4.0, "strength": 7},
        {"far": 8.0, "strength": 8},
    ]
    turn = {"begins": 0, "hertz": 0}
    data = other.build(
        "data", units=True, turn=turn, first={"value": 30}, last={"value": 300}, returns=samples
    )
    assert data[2:4] == b"\x04\x00"
    assert other.build("data", other.parse(data)) == data
    cloud = decode(other, b"\xfe" + data + data).points()
    np.testing.assert_allclose(clockwise(cloud), [30, 120, 210, 300] * 2, atol=1e-4)
    assert cloud.range.tolist() == [1, 2, 4, 8] * 2
    with pytest.raises(ls.WireError) as caught:
        other.parse(data[:-1] + bytes([data[-1] ^ 1]))
    assert caught.value.path == "checksum"
