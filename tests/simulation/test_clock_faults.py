"""Tests of the faults of a simulated clock."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Const,
    Int8ul,
    Int16ul,
    Int32ul,
    Int64ul,
    Struct,
)
from numpy.typing import NDArray

import lidarspec as ls
from lidarspec import Sensor, UsageError, simulate
from lidarspec.packets.clock_monitor import ClockMonitor
from lidarspec.packets.clock_status import read_clock_status
from lidarspec.simulation.clock_faults import ClockFaults, parse_clock_faults
from lidarspec.simulation.device import SECOND, SimulatedDevice
from lidarspec.simulation.faults import Faults
from lidarspec.simulation.simulator import find_followed_scale
from lidarspec.spec import (
    Clock,
    ClockState,
    ClockStatus,
    Fields,
    Frame,
    Scaled,
    Simulation,
    unix_time,
)
from lidarspec.spec.timing import DATED_EPOCHS
from tests.shapes import SHAPES
from tests.shapes.receiver import SENSOR as RECEIVER
from tests.shapes.synced import FREE, HOLDOVER, LOCKED, PERIOD_NS, STATES

SYNCED = SHAPES["shape-synced"]
PACKETS = 500  # a second of the shape

DATED = Struct(
    "magic" / Const(b"\x5c\x03"),
    "year" / Int8ul * "since 1900",
    "month" / Int8ul,
    "day" / Int8ul,
    "hour" / Int8ul,
    "minute" / Int8ul,
    "second" / Int8ul,
    "micros" / Scaled(Int32ul, 1e-6, "s"),
    "azimuth" / Scaled(Int16ul, 0.01, "deg"),
    "distances" / Array(4, Scaled(Int16ul, 0.002, "m")),
)


def read_date(f: Fields) -> Any:
    return unix_time(f.year + 1900, f.month, f.day, f.hour, f.minute, f.second), f.micros


def sweep_date(i: int) -> dict[str, Any]:
    micros = {"micros": i * PERIOD_NS * 1e-9 % 1, "second": i // 500 % 60}
    return {"year": 124, "month": 2, "day": 28, "hour": 23, "minute": 59, "azimuth": 0.0, **micros}


def make_dated() -> Sensor:
    """Return the shape with the fields of a date in place of a counter."""
    frames = {"data": Frame(DATED, data=True)}
    clock = Clock(read_date)
    return replace(
        SYNCED, frames=frames, clock=clock, sequence=None, simulation=Simulation(sweep_date)
    )


def read_times(sensor: Sensor, clock: str | None, packets: int = PACKETS) -> NDArray[np.int64]:
    """Return the times of simulated packets, ns."""
    faults = parse_clock_faults(clock) if clock else None
    return sensor.decode(simulate(sensor, packets, clock=faults)).time_ns


def find_offsets(sensor: Sensor, clock: str, packets: int = PACKETS) -> NDArray[np.float64]:
    """Return the seconds by which faults change the times of packets, without wraps."""
    offsets = read_times(sensor, clock, packets) - read_times(sensor, None, packets)
    if sensor.clock is not None and sensor.clock.wraps_at is not None:
        period = round(sensor.clock.wraps_at * 1e9)
        offsets = (offsets + period // 2) % period - period // 2
    return offsets * 1e-9


@pytest.mark.parametrize(
    ("text", "faults"),
    [
        ("drift=50ppm", ClockFaults(drift_ppm=50)),
        ("drift=-50", ClockFaults(drift_ppm=-50)),
        ("step=0.2s@10s", ClockFaults(steps=((10, 0.2),))),
        ("step=-200ms", ClockFaults(steps=((0, -0.2),))),
        ("pps@1min", ClockFaults(steps=((60, 1),))),
        ("pps=-1s", ClockFaults(steps=((0, -1),))),
        ("leap@5s", ClockFaults(steps=((5, -1),))),
        ("unlock=5s@10s", ClockFaults(unlocked=((10, 15),))),
        ("unlock", ClockFaults(unlocked=((0, float("inf")),))),
        ("restart@3s,restart@6s", ClockFaults(restarts=(3, 6))),
        ("tai, step=1s", ClockFaults(follows="tai", steps=((0, 1),))),
    ],
)
def test_faults_are_parsed(text: str, faults: ClockFaults) -> None:
    assert parse_clock_faults(text) == faults


@pytest.mark.parametrize(
    "text",
    [
        *("", "stp=1s", "step", "step=1m/s", "step=1s@", "drift=fast", "drift=50ppm@1s"),
        *("drift=3e4", "restart=1s@2s", "utc@1s", "utc=1", "unlock=-1s"),
    ],
)
def test_invalid_faults_are_refused(text: str) -> None:
    with pytest.raises(UsageError):
        parse_clock_faults(text)


def test_faults_change_the_times_from_their_beginning_on() -> None:
    seconds = np.arange(PACKETS) * PERIOD_NS * 1e-9
    late = seconds >= 0.5
    expected = {
        "drift=100ppm": seconds * 1e-4,
        "step=0.2s@0.5s": late * 0.2,
        "step=-0.2s@0.5s,step=0.1s@0.5s": late * -0.1,
        "pps@0.5s": late * 1.0,
        "leap@0.5s": late * -1.0,
        "restart@0.5s": late * -0.5,
        "drift=1000ppm,restart@0.5s": np.where(late, (seconds - 0.5) * 1e-3 - 0.5, seconds * 1e-3),
        "step=1s@0.2s,restart@0.5s": np.where(late, -0.5, (seconds >= 0.2) * 1.0),
    }
    shape = replace(SYNCED, simulation=Simulation(sweep_from_ten_seconds))
    for text, offsets in expected.items():
        np.testing.assert_allclose(find_offsets(shape, text), offsets, atol=2e-9, err_msg=text)


EPOCH_2024_NS = 1_704_067_200 * SECOND


def sweep_from_2024(i: int) -> dict[str, Any]:
    assert SYNCED.simulation.sweep is not None
    return {**SYNCED.simulation.sweep(i), "time": i * PERIOD_NS + EPOCH_2024_NS}


def make_counting(epoch: str) -> Sensor:
    """Return the shape with a clock of an epoch; a clock with a date begins in 2024."""
    wraps_at = 3600 if epoch == "hour" else None
    simulation = Simulation(sweep_from_2024 if epoch in DATED_EPOCHS else SYNCED.simulation.sweep)
    return replace(SYNCED, clock=Clock("time", wraps_at, epoch=epoch), simulation=simulation)


@pytest.mark.parametrize("epoch", ["utc", "tai", "gps", "boot", "hour", ""])
def test_a_restarted_clock_begins_without_its_date(epoch: str) -> None:
    sensor = make_counting(epoch)
    times = read_times(sensor, "restart@0.5s")
    np.testing.assert_array_equal(times[:250], read_times(sensor, None)[:250])
    np.testing.assert_array_equal(times[250:], np.arange(250) * PERIOD_NS)


def test_a_restarted_clock_with_a_calendar_begins_in_2000() -> None:
    packets = make_dated().decode(
        simulate(make_dated(), PACKETS, clock=parse_clock_faults("restart@0.5s"))
    )
    date = [packets[name].tolist()[250] for name in ("year", "month", "day", "hour", "minute")]
    assert date == [100, 1, 1, 0, 0]
    np.testing.assert_array_equal(
        packets.time_ns[250:], 946_684_800 * SECOND + np.arange(250) * PERIOD_NS
    )


@pytest.mark.parametrize(
    "sensor",
    [
        *map(make_counting, ("utc", "tai", "gps", "boot", "hour", "")),
        make_dated(),  # begins in 2000
        ls.sensor("hesai-xt32"),
    ],
    ids=["utc", "tai", "gps", "boot", "hour", "undeclared", "calendar", "hesai-xt32"],
)
def test_a_restart_of_a_sensor_is_named(sensor: Sensor) -> None:
    """It is neither a step of the clock nor a wrong date."""
    sent_ns = read_times(sensor, None, 2000)
    sent_ns -= sent_ns[0]
    half_s = sent_ns[-1] / 2e9
    packets = sensor.decode(simulate(sensor, 2000, clock=parse_clock_faults(f"restart@{half_s}s")))
    packets.host_ns = 1_785_283_200 * SECOND + sent_ns
    monitor = ClockMonitor(sensor)
    monitor.add(packets)
    report = monitor.report()
    assert [event.code for event in report.events if event.code != "lock_lost"] == ["restart"]
    assert not {"jump", "wrong_date"} & {finding.code for finding in report.findings}


def sweep_from_ten_seconds(i: int) -> dict[str, Any]:
    assert SYNCED.simulation.sweep is not None
    return {**SYNCED.simulation.sweep(i), "time": i * PERIOD_NS + 10 * SECOND}


@pytest.mark.parametrize(
    "sensor",
    [
        SYNCED,
        make_dated(),
        SHAPES["shape-paced"],  # two fields that wrap at a minute
        SHAPES["shape-columns"],  # an array of columns
        SHAPES["shape-segments"],  # parts of a frame
        *map(ls.sensor, ("velodyne-vlp16", "robosense-m1", "ldrobot-stl27l")),
    ],
    ids=lambda sensor: sensor.id,
)
def test_every_form_of_a_clock_can_be_written(sensor: Sensor) -> None:
    offsets = find_offsets(sensor, "step=1.7s@1ms", 20)
    (jump,) = np.flatnonzero(np.diff(offsets, prepend=0.0))
    assert jump > 0
    # The coarsest of these clocks counts milliseconds.
    np.testing.assert_allclose(offsets[jump:], 1.7, atol=1e-3)


def test_times_within_a_packet_stay_the_same() -> None:
    for sensor in (SHAPES["shape-columns"], ls.sensor("sick-multiscan136")):
        clean = sensor.decode(simulate(sensor, 20)).points()
        faulty = sensor.decode(simulate(sensor, 20, clock=parse_clock_faults("step=1s"))).points()
        np.testing.assert_allclose(faulty.time, clean.time, atol=1e-9)


def test_fields_that_add_up_wrap_together() -> None:
    paced = SHAPES["shape-paced"]  # its seconds count to 59
    packets = paced.decode(simulate(paced, 40, clock=parse_clock_faults("step=59.9s")))
    assert packets["seconds"].tolist() == [59.0] * 20 + [0.0] * 20


def test_a_date_is_carried_into_the_next_month() -> None:
    dated = make_dated()
    packets = dated.decode(simulate(dated, 2, clock=parse_clock_faults("step=61s")))
    names = ("year", "month", "day", "hour", "minute", "second")
    # 2024 is a leap year, so that a minute after 28 February, 23:59:00, is 29 February.
    assert [packets[name].tolist()[0] for name in names] == [124, 2, 29, 0, 0, 1]
    packets = dated.decode(simulate(dated, 1, clock=parse_clock_faults("step=24.5h")))
    assert [packets[name].tolist()[0] for name in names] == [124, 3, 1, 0, 29, 0]


def test_a_clock_that_cannot_be_written_is_refused_with_the_reason() -> None:
    sensor = replace(SYNCED, clock=Clock(lambda f: f.distances[0]))
    with pytest.raises(UsageError, match="no field outside of arrays"):
        simulate(sensor, 1, clock=parse_clock_faults("drift=1ppm"))
    sensor = replace(SYNCED, clock=Clock(lambda f: np.floor(f.number / 500)))
    with pytest.raises(UsageError):
        simulate(sensor, 1, clock=parse_clock_faults("drift=1ppm"))
    with pytest.raises(UsageError, match="has no clock"):
        simulate(replace(SYNCED, clock=None), 1, clock=parse_clock_faults("drift=1ppm"))


def test_a_lost_lock_is_in_the_status() -> None:
    packets = SYNCED.decode(simulate(SYNCED, 500, clock=parse_clock_faults("unlock=0.2s@0.4s")))
    lost = (np.arange(500) >= 200) & (np.arange(500) < 300)
    np.testing.assert_array_equal(read_clock_status(packets), np.where(lost, HOLDOVER, LOCKED))
    packets = SYNCED.decode(simulate(SYNCED, 500, clock=parse_clock_faults("restart@0.4s")))
    assert read_clock_status(packets).tolist() == [LOCKED] * 200 + [FREE] * 300


def test_a_status_in_reports_and_from_two_fields() -> None:
    """The status is calculated, and in a frame that is sent ten times a second."""
    assert SYNCED.clock is not None
    report = replace(SYNCED.frames["report"], simulation=Simulation(rate=10))
    status = ClockStatus(lambda f: f.sync + 0 * f.load, STATES, frame="report")
    sensor = replace(
        SYNCED,
        frames={**SYNCED.frames, "report": report},
        clock=replace(SYNCED.clock, status=status),
    )
    device = SimulatedDevice(sensor, faults=Faults(clock=parse_clock_faults("unlock@0.5s")))
    device.start(0)
    found = sensor.split([data for _, data in device.outgoing(SECOND - 1)])
    values = [sensor.parse(item.data).sync for item in found if item.frame == "report"]
    assert values == [LOCKED] * 5 + [HOLDOVER] * 5


def test_a_status_from_three_bits_follows_the_faults() -> None:
    flags = ("date", "time", "resolved")
    data = Struct(
        "magic" / Const(b"\x5c\x04"),
        "time" / Scaled(Int64ul, 1, "ns"),
        "valid" / BitStruct(*(name / BitsInteger(1) for name in flags), "rest" / BitsInteger(5)),
        "azimuth" / Scaled(Int16ul, 0.01, "deg"),
        "distances" / Array(4, Scaled(Int16ul, 0.002, "m")),
    )
    states = {0: ClockState("not valid", False), 1: ClockState("valid", True)}
    status = ClockStatus(
        lambda f: (f.valid.date == 1) & (f.valid.time == 1) & (f.valid.resolved == 1), states
    )
    valid = {f"valid.{name}": 1 for name in flags}
    sensor = replace(
        SYNCED,
        frames={"data": Frame(data, data=True)},
        clock=Clock("time", status=status),
        sequence=None,
        simulation=Simulation(lambda i: {"time": i * PERIOD_NS, "azimuth": 0.0, **valid}),
    )
    for faults in ("unlock@0.4s", "restart@0.4s"):
        packets = sensor.decode(simulate(sensor, 500, clock=parse_clock_faults(faults)))
        assert read_clock_status(packets).tolist() == [1] * 200 + [0] * 300


def test_a_sensor_without_a_lock_cannot_lose_it() -> None:
    for sensor, faults in (
        (ls.sensor("ldrobot-stl27l"), "unlock@1s"),
        (replace(SYNCED, clock=Clock("time")), "unlock@1s"),
        (with_states({0: ClockState("free-running", False)}), "unlock@1s"),
    ):
        with pytest.raises(UsageError):
            simulate(sensor, 1, clock=parse_clock_faults(faults))
    # A restart only sets the status if there is one.
    simulate(ls.sensor("ldrobot-stl27l"), 1, clock=parse_clock_faults("restart@1s"))


def make_receiver(status: ClockStatus) -> Sensor:
    """Return a sensor without points; one of its frame types has a clock and this status."""
    shape = RECEIVER
    assert shape.clock is not None
    fix = replace(shape.frames["fix"], clock=replace(shape.clock, status=status))
    return replace(shape, frames={**shape.frames, "fix": fix}, clock=None)


@pytest.mark.parametrize("source", ["quality", lambda f: f.quality])
def test_the_status_of_a_frame_without_points_follows_the_faults(source: Any) -> None:
    states = {0: ClockState("no fix", False), 3: ClockState("fix", True)}
    sensor = make_receiver(ClockStatus(source, states))
    for faults in ("unlock@1s", "restart@1s"):
        frames = simulate(sensor, 24, clock=parse_clock_faults(faults))
        packets = sensor.decode([data for data in frames if data[1] == 1], frame="fix")
        assert read_clock_status(packets).tolist() == [3] * 10 + [0] * 10


def test_a_frame_without_points_cannot_lose_a_lock_that_it_does_not_report() -> None:
    states = {0: ClockState("no fix", False), 3: ClockState("fix", True)}
    for sensor, reason in (
        (make_receiver(ClockStatus("rate", states, frame="rate_reply")), "does not send"),
        (make_receiver(ClockStatus("quality", {3: ClockState("fix", True)})), "must have values"),
        (RECEIVER, "does not declare the status"),
    ):
        with pytest.raises(UsageError, match=reason):
            simulate(sensor, 1, clock=parse_clock_faults("unlock@1s"))


def with_states(states: dict[int, ClockState]) -> Sensor:
    assert SYNCED.clock is not None
    return replace(SYNCED, clock=replace(SYNCED.clock, status=ClockStatus("sync", states)))


@pytest.mark.parametrize(("scale", "ahead_s"), [("utc", 0), ("tai", 37), ("gps", 18)])
def test_a_clock_follows_the_computer(scale: str, ahead_s: int) -> None:
    switched_on = 1_785_283_200 * SECOND  # 2026-07-29
    device = SimulatedDevice(SYNCED, faults=Faults(clock=parse_clock_faults(scale)))
    device.utc_offset_ns = switched_on - 5 * SECOND
    device.start(5 * SECOND)
    times = SYNCED.decode([data for _, data in device.outgoing(6 * SECOND)]).time_ns
    assert times[0] == switched_on + ahead_s * SECOND
    assert times[500] == switched_on + (1 + ahead_s) * SECOND


@pytest.mark.parametrize(
    ("sensor", "ahead_s"),
    [
        (replace(SYNCED, clock=Clock("time", epoch="tai")), 37),
        (with_states({LOCKED: ClockState("locked", True, "utc")}), 0),
        (with_states({LOCKED: ClockState("not locked", False)}), None),
        (replace(SYNCED, clock=Clock("time", epoch="boot")), None),
        (replace(SYNCED, clock=Clock("time")), None),
        (replace(SYNCED, clock=Clock("time", wraps_at=7.0, epoch="utc")), None),
    ],
    ids=["declared", "locked", "not locked", "since power-up", "not declared", "seven seconds"],
)
def test_only_a_synchronized_clock_shows_the_current_date(
    sensor: Sensor, ahead_s: int | None
) -> None:
    switched_on = 1_785_283_200 * SECOND  # 2026-07-29
    device = SimulatedDevice(sensor)
    device.utc_offset_ns = switched_on
    device.start(0)
    first = sensor.decode([data for _, data in device.outgoing(SECOND)]).time_ns[0]
    declared = sensor.decode(simulate(sensor, 1)).time_ns[0]
    assert first == (declared if ahead_s is None else switched_on + ahead_s * SECOND)
    device.utc_offset_ns = None
    device.start(SECOND)
    again = sensor.decode([data for _, data in device.outgoing(2 * SECOND)]).time_ns[0]
    assert again == declared


def test_a_synchronized_clock_shows_the_current_date_after_a_stall() -> None:
    device = SimulatedDevice(replace(SYNCED, clock=Clock("time", epoch="utc")))
    device.utc_offset_ns = 1_785_283_200 * SECOND
    device.start(0)
    device.outgoing(SECOND)
    device.outgoing(60 * SECOND)
    frames = [data for _, data in device.outgoing(61 * SECOND)]
    last = SYNCED.decode(frames).time_ns[-1]
    assert last == pytest.approx((1_785_283_200 + 61) * SECOND, abs=SECOND // 10)


@pytest.mark.parametrize(
    ("name", "scale"),
    [
        ("velodyne-vlp16", "utc"),  # the hour; the status is in frames without points
        ("ublox-gnss", "utc"),  # no points
        ("robosense-m2", "tai"),
        ("robosense-helios32", ""),  # its clock is not locked
        ("ldrobot-stl27l", ""),  # it counts from power-up
    ],
)
def test_the_scale_that_a_simulated_clock_follows(name: str, scale: str) -> None:
    assert find_followed_scale(ls.sensor(name)) == scale


def test_a_clock_that_wraps_follows_if_its_period_is_a_share_of_a_day() -> None:
    vlp16 = ls.sensor("velodyne-vlp16")
    device = SimulatedDevice(vlp16, faults=Faults(clock=parse_clock_faults("utc")))
    device.utc_offset_ns = 1_785_283_205 * SECOND
    device.start(0)
    found = vlp16.split([data for _, data in device.outgoing(SECOND // 10)])
    first = next(vlp16.parse(item.data) for item in found if item.frame == "data")
    assert first.timestamp == 5_000_000
    # 1,785,283,205 s since 1970 are 29 July 2026, 00:00:05.
    position = next(vlp16.parse(item.data) for item in found if item.frame == "position")
    assert bytes(position.nmea).startswith(b"$GPRMC,000005,A,,,,,,,290726,")
    with pytest.raises(UsageError, match="a day is not a multiple of this time, so"):
        simulate(SHAPES["shape-columns"], 1, clock=parse_clock_faults("utc"))


def test_a_jump_adds_to_the_faults() -> None:
    device = SimulatedDevice(SYNCED, faults=Faults(clock=parse_clock_faults("step=1s")))
    device.start(0)
    before = SYNCED.decode([data for _, data in device.outgoing(SECOND // 10)]).time_ns
    device.jump_clock(2.0)
    after = SYNCED.decode([data for _, data in device.outgoing(SECOND)]).time_ns
    assert before[0] == SECOND
    assert after[-1] == SECOND + 3 * SECOND
