"""Tests of the conversion of times to UTC, and of reports about its source."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lidarspec import UsageError, simulate
from lidarspec.leap_seconds import LeapSeconds
from lidarspec.packets import utc_times
from lidarspec.packets.clock_estimate import DeviceClock
from lidarspec.packets.packets import Packets
from lidarspec.packets.utc_times import UtcTimes
from lidarspec.simulation.clock_faults import parse_clock_faults
from lidarspec.spec import Clock
from tests.shapes import SHAPES
from tests.shapes.synced import FREE, HOLDOVER, LOCKED

SYNCED = SHAPES["shape-synced"]
SECOND = 1_000_000_000
NOW = 1_785_283_200 * SECOND  # 2026-07-29
LEAP_SECONDS = LeapSeconds((0, 1_483_228_800), (36, 37), 1_800_000_000, "/zoneinfo/leapseconds")


@pytest.fixture(autouse=True)
def leap_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use the leap seconds until 2026, whatever table this computer has."""
    monkeypatch.setattr(utc_times, "read_leap_seconds", lambda: LEAP_SECONDS)


def make_clock(epoch: str) -> Clock:
    return Clock("time", epoch=epoch, wraps_at=3600 if epoch == "hour" else None)


def make(epoch: str) -> UtcTimes:
    return UtcTimes("shape-synced", make_clock(epoch), "drive.lsr")


@pytest.mark.parametrize(("epoch", "ahead_s"), [("utc", 0), ("tai", 37), ("gps", 18)])
def test_a_clock_with_a_date_needs_no_arrival_times(epoch: str, ahead_s: int) -> None:
    times = make(epoch)
    assert times.to_utc(NOW + ahead_s * SECOND + 123_456_789, 0) == NOW + 123_456_789
    assert [change.source.kind for change in times.changes] == ["clock"]
    assert times.warnings == []


def test_leap_seconds_of_the_past_are_those_of_that_time() -> None:
    in_2016 = 1_483_228_799 * SECOND
    assert make("tai").to_utc(in_2016 + 36 * SECOND, 0) == in_2016
    assert make("gps").to_utc(in_2016 + 17 * SECOND, 0) == in_2016


def test_an_hour_is_completed_by_the_arrival_time() -> None:
    times = make("hour")
    # NOW is a full hour. The packet of 3599.9 s arrives after it.
    assert times.to_utc(3_599_900_000_000, NOW + 5_000_000) == NOW - SECOND // 10
    assert times.to_utc(100_000_000, NOW + SECOND // 10) == NOW + SECOND // 10
    # The clock of this computer may be behind, also at a full hour.
    assert times.to_utc(200_000_000, NOW - SECOND // 10) == NOW + SECOND // 5
    assert times.changes[0].source.kind == "hour"
    assert times.warnings == []
    # Another frame dates the clock.
    assert times.to_utc(NOW + SECOND, NOW + SECOND) == NOW + SECOND
    assert [change.source.kind for change in times.changes] == ["hour", "clock"]


@pytest.mark.parametrize("epoch", ["boot", "", "tai"])
def test_a_clock_without_a_date_is_mapped_by_arrival(epoch: str) -> None:
    """At 50 ppm, and with delays of up to 5 ms, the error is below a millisecond."""
    times = make(epoch)
    random = np.random.default_rng(0)
    true_s = np.arange(0, 40, 0.01)
    readings = np.rint(true_s * (1 + 50e-6) * 1e9).astype(np.int64)
    arrivals = NOW + np.rint((true_s + random.uniform(0, 0.005, len(true_s))) * 1e9).astype(int)
    errors = []
    for index in range(0, len(true_s), 10):
        piece = slice(index, index + 10)
        times.observe(readings[piece], arrivals[piece])
        utc_ns = times.to_utc(readings.item(index), arrivals.item(index))
        errors.append((utc_ns - NOW) * 1e-9 - true_s[index])
    assert np.abs(errors[100:]).max() < 1e-3
    assert [change.source.kind for change in times.changes] == ["arrival"]
    assert len(times.warnings) == 1


@pytest.mark.parametrize("epoch", ["boot", "", "tai", "hour"])
def test_without_arrival_times_utc_is_unknown(epoch: str) -> None:
    with pytest.raises(UsageError, match="no arrival times"):
        make(epoch).to_utc(5 * SECOND, 0)
    with pytest.raises(UsageError, match="has no clock"):
        UtcTimes("shape-synced", None).to_utc(NOW, NOW)


@pytest.mark.parametrize("epoch", ["boot", "", "tai"])
def test_warning_and_error_give_the_same_reason(epoch: str) -> None:
    with pytest.raises(UsageError) as error:
        make(epoch).to_utc(5 * SECOND, 0)
    times = make(epoch)
    times.to_utc(5 * SECOND, NOW)
    (change,) = times.changes
    assert str(error.value).endswith(f"no arrival times, and {change.source.reason}")
    assert times.warnings[0].endswith(f"because {change.source.reason}")


def test_each_change_of_the_source_is_reported_once_with_its_time() -> None:
    times = UtcTimes("shape-synced", SYNCED.clock, "drive.lsr")
    statuses = [FREE] * 5 + [LOCKED] * 5 + [HOLDOVER] * 5 + [np.nan] * 5
    for second, status in enumerate(statuses):
        reading = second if status == FREE else second + 37 + NOW // SECOND
        utc_ns = times.to_utc(reading * SECOND, NOW + second * SECOND, status)
        assert utc_ns == NOW + second * SECOND
    assert [change.utc_ns - NOW for change in times.changes] == [0, 5 * SECOND, 10 * SECOND]
    assert [change.source.kind for change in times.changes] == ["arrival", "clock", "clock"]
    assert [change.source.locked for change in times.changes] == [False, True, False]
    assert "2026-07-29T00:00:05.000Z" in times.warnings[1]
    assert len(times.warnings) == 3


def test_many_changes_are_counted() -> None:
    times = UtcTimes("shape-synced", SYNCED.clock, "drive.lsr")
    for second in range(40):
        status = (LOCKED, HOLDOVER)[second % 2]
        times.to_utc(NOW + second * SECOND, 0, status)
    # The first source is locked, and not worth a warning.
    assert len(times.changes) == 40
    assert len(times.warnings) == utc_times.MAX_DESCRIBED_CHANGES + 1
    assert "29 more" in times.warnings[-1]


def test_an_expired_table_is_reported_once() -> None:
    times = make("tai")
    times.to_utc(NOW, 0)
    assert times.warnings == []
    for second in range(3):
        times.to_utc((1_800_000_100 + second) * SECOND, 0)
    (warning,) = times.warnings
    assert LEAP_SECONDS.path in warning


def test_packets_are_converted_with_their_status() -> None:
    faults = parse_clock_faults("restart@0.5s")
    dated = replace(SYNCED, simulation=replace(SYNCED.simulation, sweep=sweep_now))
    packets = dated.decode(simulate(dated, 500, clock=faults))
    packets.host_ns = NOW + np.arange(500) * 2_000_000
    times = UtcTimes("shape-synced", SYNCED.clock)
    utc_ns = times.convert(packets)
    # The sweep gives floats, which are exact to 128 ns at such a date.
    np.testing.assert_allclose(utc_ns[:250] - NOW, np.arange(250) * 2_000_000, atol=128)
    assert [change.source.kind for change in times.changes] == ["clock", "arrival"]
    assert times.changes[1].utc_ns == utc_ns[250]


@pytest.mark.parametrize("epoch", ["utc", "tai", "gps", "boot", "hour", ""])
def test_many_packets_get_the_utc_that_each_alone_gets(epoch: str) -> None:
    """The clock is 50 ppm fast, loses its date, and receives it again.

    Some packets are late.
    """
    seconds = np.arange(0, 60, 0.01)
    random = np.random.default_rng(1)
    drifted_ns = np.rint(seconds * (1 + 50e-6) * 1e9).astype(np.int64)
    start_ns = NOW if epoch in ("utc", "tai", "gps") else 0
    readings = np.where((seconds < 25) | (seconds > 40), drifted_ns + start_ns, drifted_ns)
    late_s = random.uniform(0, 0.005, len(seconds)) + 0.05 * (random.random(len(seconds)) < 0.02)
    arrivals = NOW + np.rint((seconds + late_s) * 1e9).astype(np.int64)
    one_by_one = make(epoch)
    expected = [
        one_by_one.to_utc(*row) for row in zip(readings.tolist(), arrivals.tolist(), strict=True)
    ]
    together = make(epoch)
    found = []
    for start in range(0, len(seconds), 700):
        piece = slice(start, start + 700)
        packets = make_packets(epoch, readings[piece], arrivals[piece])
        found.append(together.convert(packets))
    np.testing.assert_allclose(np.concatenate(found), expected, rtol=0, atol=300_000)
    assert [change.source for change in together.changes] == [
        change.source for change in one_by_one.changes
    ]
    times_ns = [[change.utc_ns for change in each.changes] for each in (together, one_by_one)]
    np.testing.assert_allclose(*times_ns, rtol=0, atol=300_000)


def make_packets(epoch: str, readings: np.ndarray, arrivals: np.ndarray) -> Packets:
    sensor = replace(SYNCED, clock=make_clock(epoch))
    frame = SYNCED.build("data", number=0, sync=0, time=0, azimuth=0, distances=[0] * 4)
    packets = sensor.decode([frame] * len(readings)).with_times(readings)
    packets.host_ns = arrivals
    return packets


def test_stamps_of_many_packets_are_evenly_spaced_and_ascend(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls = []
    stamp = DeviceClock.stamp

    def count_calls(self: DeviceClock, device_ns: int, host_ns: int) -> int:
        calls.append(device_ns)
        return stamp(self, device_ns, host_ns)

    monkeypatch.setattr(DeviceClock, "stamp", count_calls)
    device = np.arange(0, 40 * SECOND, SECOND // 200)
    random = np.random.default_rng(3)
    host = NOW + device + random.integers(0, 5_000_000, len(device))
    clock = DeviceClock()
    stamps = np.concatenate([clock.stamp_packets(*part) for part in split(device, host)])
    assert len(calls) < len(device) // 3  # those of the first ten seconds
    settled = device > 15 * SECOND
    assert np.abs(stamps - NOW - device)[settled].max() < 100_000
    assert np.abs(np.diff(stamps) - SECOND // 200)[settled[1:]].max() < 20_000
    assert (np.diff(stamps) > 0).all()


def split(*columns: np.ndarray) -> list[tuple[np.ndarray, ...]]:
    """Return pieces of 130 rows."""
    starts = range(0, len(columns[0]), 130)
    return [tuple(column[start : start + 130] for column in columns) for start in starts]


def sweep_now(i: int) -> dict[str, object]:
    assert SYNCED.simulation.sweep is not None
    return {**SYNCED.simulation.sweep(i), "time": NOW + 37 * SECOND + i * 2_000_000}
