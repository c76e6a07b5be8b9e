"""Tests of a simulated sensor as a device without I/O.

They cover commands and documented replies, start-up, pace and faults.
"""

from __future__ import annotations

import dataclasses
import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from construct import Array, Bytes, Const, Enum, Int8ul, Struct

import lidarspec as ls
from lidarspec import Sensor, SpecError, UsageError
from lidarspec.errors import OutOfRange
from lidarspec.simulation.device import SECOND, SimulatedDevice
from lidarspec.simulation.faults import Faults, FaultyLink, parse_faults
from lidarspec.simulation.simulator import RestingImu
from lidarspec.spec import Command, Frame, Scaled, Serial, Simulation
from lidarspec.spec.fields import parse_duration
from lidarspec.testing.commands import the_simulated_sensor_answers
from lidarspec.testing.sensor_under_test import SensorUnderTest
from tests.broken import sound
from tests.shapes import SHAPES

MS = SECOND // 1000


def mini() -> Sensor:
    return ls.sensor("cspc-m1c1-mini")


def stl() -> Sensor:
    return ls.sensor("ldrobot-stl27l")


def a1() -> Sensor:
    return ls.sensor("slamtec-rplidar-a1")


def on(sensor: Sensor, **options: object) -> SimulatedDevice:
    device = SimulatedDevice(sensor, **options)  # type: ignore[arg-type]
    device.start(0)
    return device


def send_command(device: SimulatedDevice, name: str, now: int, **arguments: object) -> bytes:
    """Send a command; return the immediate replies."""
    command = device.sensor.commands[name]
    device.receive(device.sensor.command(name, **arguments), now, command.link)
    return b"".join(data for _, data in device.outgoing(now))


def passing(device: SimulatedDevice, start: int, end: int, step: int = 10 * MS) -> bytes:
    return b"".join(data for now in range(start, end, step) for _, data in device.outgoing(now))


def test_the_m1c1_mini_starts_as_its_manual_says() -> None:
    device = on(mini())
    assert passing(device, 0, 2 * SECOND) == b""
    assert send_command(device, "start", 2 * SECOND) == bytes.fromhex(
        "A55A 50 07 03 000000000000 AB"
    )
    settling = passing(device, 2 * SECOND, 3 * SECOND)
    assert len(settling) == 14
    assert set(settling) == {0xFE, 0xFF}
    rest = passing(device, 3 * SECOND, 4 * SECOND)
    information = bytes.fromhex("A55A 1400 0304 01 4D3143315F4D696E69000000 0C00 00 01 000000 04")
    assert rest.startswith(information + bytes.fromhex("A55A 0000 8001 81") + b"\xaa\x55")
    assert [item.frame for item in mini().split(rest)[:3]] == ["info", "scan_start", "data"]
    stop = send_command(device, "stop", 4 * SECOND)
    assert stop == bytes.fromhex("A55A 55 07 00000000000000 AD")
    assert passing(device, 4 * SECOND, 5 * SECOND) == b""
    assert device.commands_received == ["start", "stop"]


def test_a_simulated_coin_d4_starts_like_the_captured_one() -> None:
    device = on(ls.sensor("cspc-coin-d4"), seed=4)
    started = send_command(device, "start", 0) + passing(device, 0, SECOND + 5 * MS)
    captured = (
        bytes.fromhex("a55a500701000000000000a9 fafa a55a1400e30201")
        + b"COIN-D4"
        + bytes(12)
        + bytes.fromhex("01 a55a0000800181")
    )
    shown = started[:12] + started[26:]
    assert shown.startswith(captured)


def test_commands_without_an_answer_get_none_and_noise_is_ignored() -> None:
    device = on(mini())
    assert send_command(device, "low_exposure", 0) == b""
    device.receive(b"\x00\xaa\x55garbage", 0)
    assert send_command(device, "get_version", SECOND)[2] == 0xFC ^ 0xA0
    assert device.commands_received == ["low_exposure", "get_version"]


def test_answers_stand_in_the_form_of_their_frames() -> None:
    device = on(ls.sensor("hokuyo-ust10lx"))
    assert send_command(device, "stop", 0) == b"QT\n00P\n\n"
    assert send_command(device, "get_time", MS) == b"TM1\n00P\n00000\n\n"


def test_half_a_command_is_forgotten_when_the_line_falls_silent() -> None:
    device = on(a1())
    device.receive(b"\xa5\xa5\xff", 0)  # the beginning of a request with a long payload
    device.receive(a1().command("get_info"), 10 * MS)
    assert device.outgoing(10 * MS) == []
    assert a1().parse(send_command(device, "get_health", 200 * MS)).status == 0


def test_an_rplidar_reports_its_identity_and_scans_in_the_requested_mode() -> None:
    device = on(a1())
    info = a1().parse(send_command(device, "get_info", 0))
    assert (info.model, info.firmware_major, info.firmware_minor, info.hardware) == (0x18, 1, 29, 7)
    assert a1().parse(send_command(device, "get_mode_count", 0)).value.mode_count == 4
    assert (
        a1().parse(send_command(device, "get_us_per_sample", 0, mode=3)).value.us_per_sample
        == 127 * 256
    )
    assert (
        bytes(a1().parse(send_command(device, "get_mode_name", 0, mode=3)).value.data)
        == b"Sensitivity\0"
    )
    assert send_command(device, "get_mode_name", 0, mode=9) == b""
    types = [
        a1().parse(send_command(device, "get_answer_type", 0, mode=mode)).value.answer_type
        for mode in range(4)
    ]
    kinds = {}
    for mode, kind in enumerate(types):
        started = (
            send_command(device, "express_scan", mode * SECOND, mode=mode)
            if mode
            else send_command(device, "scan", 0)
        )
        started += passing(device, mode * SECOND, mode * SECOND + SECOND // 2)
        assert a1().parse(started[:7])["type"] == kind
        found = a1().decode(started).stats
        assert found.bytes_skipped == 0
        kinds[mode] = sorted(found.frames)
        passing(device, mode * SECOND + SECOND // 2, (mode + 1) * SECOND)
    assert kinds == {
        0: ["node", "scan_descriptor"],
        1: ["express", "express_descriptor"],
        2: ["ultra", "ultra_descriptor"],
        3: ["ultra", "ultra_descriptor"],
    }
    # Answered only while it does not scan.
    assert b"\xa5\x5a\x14" not in send_command(device, "get_info", 5 * SECOND)
    assert device.commands_received[-1] == "get_info"
    assert send_command(device, "stop", 5 * SECOND).count(b"\xa5\x5a") == 0
    assert a1().parse(send_command(device, "get_info", 5 * SECOND)).hardware == 7
    assert passing(device, 5 * SECOND, 6 * SECOND) == b""


def test_an_unsupported_scan_mode_starts_nothing() -> None:
    device = on(a1())
    assert send_command(device, "express_scan", 0, mode=9) + passing(device, 0, SECOND) == b""


def test_other_frames_come_at_their_own_rate_with_the_defaults_of_the_spec() -> None:
    helios = ls.sensor("robosense-helios16p")
    device = on(helios)
    out = [data for now in range(0, 3 * SECOND + MS, 5 * MS) for _, data in device.outgoing(now)]
    packets = helios.decode(out)
    assert (device.sent["difop"], packets.stats.frames["difop"]) == (4, 4)
    assert out[0] == next(data for data in out if data[:2] == b"\xa5\xff")
    assert not packets.points().nominal
    assert np.array_equal(
        helios.decode([data for data in out if data[:2] != b"\xa5\xff"]).points().xyz,
        packets.points().xyz,
    )


@pytest.mark.parametrize(
    ("name", "rate"),
    [
        ("ldrobot-stl27l", 0.5),
        pytest.param("ldrobot-stl27l", 4.0, marks=pytest.mark.slow),
        pytest.param("cspc-m1c1-mini", 1.0, marks=pytest.mark.slow),
        ("velodyne-vlp16", 0.5),
        pytest.param("velodyne-vlp16", 4.0, marks=pytest.mark.slow),
        ("slamtec-rplidar-s2", 0.5),
        pytest.param("slamtec-rplidar-s2", 1.0, marks=pytest.mark.slow),
    ],
)
def test_the_pace_is_independent_of_polling(name: str, rate: float) -> None:
    sensor, numbers, streams = ls.sensor(name), [], []
    for step in (3 * MS, 50 * MS):
        device = on(sensor, rate=rate)
        for command in sensor.on_open:
            device.receive(sensor.command(command), 0)
        streams.append(passing(device, 0, 2 * SECOND, step))
        numbers.append(device.sent[sensor.data_frame if name != "slamtec-rplidar-s2" else "node"])
    shorter = min(map(len, streams))
    assert streams[0][:shorter] == streams[1][:shorter]
    interval = {
        "ldrobot-stl27l": 12 / 21_600,
        "cspc-m1c1-mini": 1 / (17 * 5.5),
        "velodyne-vlp16": 1 / 753.5,
        "slamtec-rplidar-s2": 508e-6,
    }[name]
    settling = 1.0 if name == "cspc-m1c1-mini" else 0.0
    assert numbers[0] == pytest.approx((2 * rate - settling) / interval, rel=0.03)


def test_a_deadline_is_when_something_comes() -> None:
    device = on(stl())
    for _ in range(50):
        due = device.deadline
        assert due is not None
        assert device.outgoing(due - 1) == []
        assert device.outgoing(due) != []
    assert on(mini()).deadline is None


def test_the_end_of_a_delay_is_a_deadline() -> None:
    """The sensor waits for a command, so nothing else would wake it."""
    device = on(a1())
    device.delay_output(0.5, 0)
    assert send_command(device, "get_info", 10 * MS) == b""
    assert device.deadline == SECOND // 2
    assert device.outgoing(SECOND // 2 - 1) == []
    assert device.outgoing(SECOND // 2)
    assert device.deadline is None


def test_periodic_frames_are_made_in_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    filled = 0
    fill = RestingImu.fill

    def counting_fill(self: RestingImu, *arguments: Any) -> None:
        nonlocal filled
        filled += self._frame == "imu"
        fill(self, *arguments)

    monkeypatch.setattr(RestingImu, "fill", counting_fill)
    sensor = SHAPES["shape-inertia"]
    device = on(sensor)
    times = []
    for now in range(0, SECOND, 10 * MS):
        sent = [data for _, frame, data in device.outgoing_with_types(now) if frame == "imu"]
        times += [sensor.parse(data, frame="imu").felt_at for data in sent]
    assert len(times) > 50
    assert times == sorted(set(times))
    assert filled * 20 < len(times)


def test_the_frames_of_a_logger_are_numbered_from_its_start_command_on() -> None:
    report = Struct("head" / Const(b"\xc5\x02\x03"), "number" / Int8ul)
    order = Struct("head" / Const(b"\xc5\x09\x09"), "code" / Int8ul)
    logger = Sensor(
        "test-logger",
        vendor="Test",
        model="Logger",
        frames={
            "data": Frame(report, simulation=Simulation(lambda i: {"number": i}, rate=100.0)),
            "order": Frame(order, direction="out"),
        },
        commands={"go": Command("order", {"code": 1}, starts=True)},
        on_open=("go",),
        links={"data": Serial(115200)},
        status="manual",
        source="invented for the tests",
    )
    device = on(logger)
    assert passing(device, 0, 200 * MS) == b""
    assert send_command(device, "go", 200 * MS) == logger.build("data", number=0)
    later = passing(device, 210 * MS, 260 * MS)
    assert later == b"".join(logger.build("data", number=number) for number in range(1, 6))


def test_a_device_that_was_not_polled_does_not_flood() -> None:
    device = on(stl())
    device.outgoing(0)
    device.outgoing(3600 * SECOND)
    assert 1700 < device.sent["data"] < 1900
    assert device.deadline is not None
    assert device.deadline > 3600 * SECOND


def test_without_a_pace_data_is_always_available() -> None:
    device = on(mini(), rate=math.inf)
    device.receive(mini().command("start"), 0)
    out = b"".join(data for _ in range(12) for _, data in device.outgoing(0))
    assert len([scan for scan in mini().scans(out) if scan.complete]) > 8
    assert out[:27].count(b"\xa5\x5a") == 1


@pytest.mark.parametrize("name", ["ldrobot-stl27l", "velodyne-vlp16"])
def test_the_same_seed_does_the_same_harm(name: str) -> None:
    sensor = ls.sensor(name)
    faults = Faults(errors=0.001, loss=0.02, reorder=4 if sensor.datagrams else 0)
    first, second, other = (
        passing(on(sensor, faults=faults, seed=seed), 0, SECOND, step)
        for seed, step in ((1, MS), (1, 7 * MS), (2, MS))
    )
    shorter = min(len(first), len(second))
    assert first[:shorter] == second[:shorter]
    assert first[:shorter] != other[:shorter]


def test_the_error_rate_is_met_and_valid_frames_arrive() -> None:
    device = on(stl(), faults=Faults(errors=0.002))
    data = passing(device, 0, 3 * SECOND)
    line, stats = device.lines["data"], stl().decode(data).stats
    assert line.sent == device.sent["data"] == pytest.approx(5400, abs=20)
    assert line.intact / line.sent == pytest.approx((1 - 0.002) ** 47, abs=0.02)
    chance_matches = stats.frames["data"] - line.intact  # damaged, with a CRC-8 that matches
    assert 0 <= chance_matches <= 2


def test_lost_packets_are_missing_and_reordered_ones_are_late() -> None:
    m1 = ls.sensor("robosense-m1")
    clean, harmed = on(m1), on(m1, faults=Faults(loss=0.01, reorder=5))
    sound, out = (
        [data for now in range(0, SECOND // 2, 2 * MS) for _, data in device.outgoing(now)]
        for device in (clean, harmed)
    )
    line, places = harmed.lines["data"], {data: place for place, data in enumerate(sound)}
    assert 0.005 < line.lost / line.sent < 0.02
    order = [places[data] for data in out]
    late = [max(order[: index + 1]) - place for index, place in enumerate(order)]
    assert 0 < max(late) <= 5
    assert 0.03 < np.mean(np.array(late) > 0) < 0.12
    stats = m1.decode(out).stats
    assert stats.lost == pytest.approx(line.lost, abs=8)
    assert stats.late > 50


def test_damage_in_datagrams_keeps_their_length() -> None:
    line = FaultyLink(Faults(errors=0.1), stream=False)
    out = line.transmit([("data", bytes(100))] * 50)
    assert [len(data) for _, data in out] == [100] * 50
    assert 0.07 < np.mean([sum(map(bool, data)) for _, data in out]) / 100 < 0.13


def test_every_byte_of_a_line_can_be_damaged() -> None:
    out = FaultyLink(Faults(errors=1.0), stream=True).transmit([("", bytes(300))])
    assert 150 < len(out[0][1]) < 450
    assert all(
        a or b
        for a, b in pairwise(
            FaultyLink(Faults(errors=1.0), stream=False).transmit([("", bytes(300))])[0][1]
        )
    )


def test_the_plug_is_pulled_and_put_in_again() -> None:
    device = on(mini(), faults=Faults(unplug=3.0, absent=1.0))
    device.receive(mini().command("start"), 0)
    assert passing(device, 0, 3 * SECOND)
    assert device.outgoing(3 * SECOND) == []
    assert not device.present
    assert device.deadline == 4 * SECOND
    device.receive(mini().command("start"), 3 * SECOND + SECOND // 2)
    assert passing(device, 3 * SECOND, 6 * SECOND) == b""
    assert device.present
    assert send_command(device, "start", 6 * SECOND + 10 * MS)
    assert passing(device, 6 * SECOND + 20 * MS, 7 * SECOND)
    assert device.outgoing(7 * SECOND) == []


def test_a_start_begins_anew() -> None:
    device = on(a1())
    first = send_command(device, "scan", 0) + passing(device, 0, SECOND)
    again = send_command(device, "scan", SECOND) + passing(device, SECOND, 2 * SECOND)
    assert again[:7] == first[:7]
    assert a1().decode(first + again).stats.bytes_skipped == 0


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"errors": "2"}, OutOfRange),
        ({"loss": "-0.1"}, OutOfRange),
        ({"errors": "nan"}, OutOfRange),
        ({"reorder": "x"}, UsageError),
        ({"unplug": "soon"}, UsageError),
        ({"unplug": "-3s"}, UsageError),
    ],
)
def test_faults_that_cannot_be_are_refused(options: dict[str, str], error: type[Exception]) -> None:
    with pytest.raises(error):
        parse_faults(options)


def test_faults_by_text() -> None:
    asked_for = {
        "errors": "0.01",
        "loss": "0.02",
        "reorder": "4",
        "unplug": "30s",
        "absent": "500ms",
    }
    assert parse_faults(asked_for) == Faults(0.01, 0.02, 4, 30.0, 0.5)
    durations = [parse_duration(text) for text in ("2min", "1.5h", "7", "20us")]
    assert durations == pytest.approx([120, 5400, 7, 20e-6])
    with pytest.raises(UsageError, match="reorder requires datagrams"):
        on(stl(), faults=Faults(reorder=2))


@pytest.mark.parametrize(
    "told",
    [
        {"echoes": ("key", "mode", "rates")},
        {"matches": {"key": b"abc", "mode": "fast", "rates": [20, 30]}},
    ],
)
def test_a_reply_matches_bytes_names_and_arrays(told: dict[str, Any]) -> None:
    fields = {
        "key": Bytes(3),
        "mode": Enum(Int8ul, slow=1, fast=7),
        "rates": Array(2, Scaled(Int8ul, 0.1, "Hz")),
    }
    order, ack = (
        Struct("header" / Const(head), *(name / con for name, con in fields.items()))
        for head in (b"\x16\x61", b"\x17\x71")
    )
    sensor = sound.sensor(
        frames={"data": sound.frame(), "ack": Frame(ack), "order": Frame(order, direction="out")},
        commands={
            "start": Command(
                "order",
                {"key": b"abc", "mode": "fast", "rates": [20, 30]},
                reply="ack",
                starts=True,
                **told,
            )
        },
    )
    the_simulated_sensor_answers(SensorUnderTest(sensor), "start")


def double_speed(sweep: Any, number: int) -> Any:
    return lambda i: {"angle": (number + 2 * i) * 3.0 % 360}


def test_the_effect_of_a_command_changes_what_is_sent() -> None:
    sensor = SHAPES["shape-commands"]
    simulation = Simulation(
        lambda i: {"angle": i * 3.0 % 360}, rate=100, effects={"speed": double_speed}
    )
    device = on(dataclasses.replace(sensor, simulation=simulation))
    send_command(device, "start", 0)
    passing(device, 0, 1100 * MS)
    send_command(device, "speed", 1100 * MS, rate=5.0, trim=0)  # within a batch of frames
    angles = sensor.decode(passing(device, 1100 * MS, 2 * SECOND))["angle"]
    steps = (angles[1:] - angles[:-1]) % 360
    assert (steps[0], steps[-1]) == (3, 6)
    assert sorted(steps) == steps.tolist(), "it changes once, without a jump of the angle"
    send_command(device, "stop", 2 * SECOND)
    send_command(device, "start", 2 * SECOND)
    angles = sensor.decode(passing(device, 2 * SECOND, 3 * SECOND))["angle"]
    assert (angles[1] - angles[0]) % 360 == 6, "the effect outlasts a stop"
    device.start(3 * SECOND)
    send_command(device, "start", 3 * SECOND)
    angles = sensor.decode(passing(device, 3 * SECOND, 4 * SECOND))["angle"]
    assert (angles[1] - angles[0]) % 360 == 3, "the effect ends at power-off"


def test_an_effect_belongs_to_a_command() -> None:
    sensor = SHAPES["shape-commands"]
    with pytest.raises(SpecError):
        dataclasses.replace(sensor, simulation=Simulation(effects={"fly": double_speed}))
