"""Tests that a monitor names the faults of a clock, and nothing else."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.explaining.clock_text import describe_clock, iter_clock_rows
from lidarspec.packets.clock_findings import FINDING_TYPES, ClockFinding
from lidarspec.packets.clock_monitor import ClockMonitor
from tests.clock_runs import BEGAN_S, RATE_HZ, SYNCED, TAI_S, Run, make_run, watch
from tests.shapes import SHAPES
from tests.shapes.synced import HOLDOVER

FAULT_S = 20.0
END_S = 40.0
LEAP_S = 1_767_225_600.0 - FAULT_S  # the fault is at 2026-01-01, 00:00 UTC


def step(seconds: float) -> Callable[[Run], None]:
    """Return a fault that sets the clock by some seconds."""

    def set_clock(run: Run) -> None:
        run.clock_s[run.sent_s >= FAULT_S] += seconds

    return set_clock


def restart(run: Run) -> None:
    after = run.sent_s >= FAULT_S
    run.clock_s[after] = run.sent_s[after] - FAULT_S


def lose_lock(run: Run) -> None:
    run.status[run.sent_s >= FAULT_S] = HOLDOVER


@pytest.mark.parametrize(
    ("fault", "code"),
    [
        (step(0.2), "jump"),
        (step(-0.2), "jump"),
        (step(-37), "jump"),
        (step(1), "second_step"),
        (step(-1), "second_step"),
        (restart, "restart"),
        (lose_lock, "lock_lost"),
    ],
)
@pytest.mark.parametrize("ppm", [0, 50])
def test_an_event_is_named_within_two_seconds(
    fault: Callable[[Run], None], code: str, ppm: float
) -> None:
    run = make_run(END_S, ppm=ppm)
    fault(run)
    watched = watch(run.packets(), run.began_s)
    assert set(watched.events) == {code}
    assert FAULT_S < watched.events[code] < FAULT_S + 2
    (event,) = watched.monitor.report().events
    assert event.host_ns / 1e9 - run.began_s == pytest.approx(FAULT_S, abs=0.3)
    assert watched.monitor.report().late < RATE_HZ / 4  # those in the piece of the fault


def test_the_clock_of_a_frame_type_is_watched_if_the_sensor_has_none() -> None:
    frame = replace(SYNCED.frames["data"], data=False, clock=SYNCED.clock)
    without_points = {"points": None, "scan": None, "range_limits": None}
    sensor = replace(SYNCED, frames={"data": frame}, clock=None, sequence=None, **without_points)
    run = make_run(END_S)
    lose_lock(run)
    monitor = ClockMonitor(sensor)
    events = monitor.add(run.packets(sensor, "data"))
    assert [event.code for event in events] == ["lock_lost"]
    assert monitor.report().epoch == "tai"


def test_a_second_at_the_end_of_a_month_is_a_leap_second() -> None:
    run = make_run(END_S, began_s=LEAP_S)
    step(-1)(run)
    assert set(watch(run.packets(), run.began_s).events) == {"leap_second"}


@pytest.mark.parametrize(
    ("epoch", "ahead_s", "code"),
    [
        ("tai", TAI_S, "ok"),
        ("tai", 0, "utc"),
        ("tai", 18, "gps"),
        ("utc", 0, "ok"),
        ("utc", TAI_S, "tai"),
        ("utc", 18, "gps"),
        ("utc", -TAI_S, "behind_utc"),
        ("utc", 1, "second_off"),
        ("utc", -1, "second_off"),
        ("utc", 2.5, "offset"),
        ("utc", -1e8, "wrong_date"),
        ("utc", -1.7e9, "unsynchronized"),
        ("", 0, "ok"),
        ("", TAI_S, "tai"),
        ("", -1.7e9, "free_running"),
        ("boot", -1.7e9, "free_running"),
    ],
)
def test_the_offset_shows_what_the_clock_counts(epoch: str, ahead_s: float, code: str) -> None:
    run = make_run(2, ahead_s=ahead_s)
    packets = run.packets(SYNCED.configure(epoch=epoch))
    watched = watch(packets, run.began_s)
    assert watched.monitor.report().verdict.code == code
    assert watched.findings[code] < 2


@pytest.mark.parametrize("ahead_s", [0.0, 1.0, -12.909])
def test_one_line_about_a_clock_contains_the_offset_once(ahead_s: float) -> None:
    run = make_run(2, ahead_s=ahead_s)
    packets = run.packets(SYNCED.configure(epoch="utc"))
    text = describe_clock(watch(packets, run.began_s).monitor.report())
    assert text.count("the host's clock") == 1
    assert "this computer" not in text


def test_a_clock_that_counts_from_the_hour_is_compared_within_the_hour() -> None:
    clock = SYNCED.clock
    assert clock is not None
    sensor = replace(SYNCED, clock=replace(clock, epoch="hour", wraps_at=3600.0))
    for ahead_s, code in ((0, "ok"), (1, "second_off"), (18, "gps")):
        run = make_run(2, ahead_s=ahead_s)
        run.clock_s %= 3600
        report = watch(run.packets(sensor), run.began_s).monitor.report()
        assert report.verdict.code == code
        assert report.error_s == pytest.approx(ahead_s, abs=1e-3)


def test_a_state_without_a_lock_is_the_verdict_also_without_arrival_times() -> None:
    run = make_run(2)
    run.status[:] = HOLDOVER
    packets = run.packets()
    packets.host_ns = np.zeros(len(packets), np.int64)
    monitor = ClockMonitor(SYNCED)
    assert monitor.add(packets) == []
    report = monitor.report()
    assert (report.verdict.code, report.verdict.state) == ("not_locked", "holdover")
    assert (report.locked, report.packets) == (False, len(packets))
    assert math.isnan(report.offset_s)


def test_a_lock_that_returns_is_an_event_but_no_fault() -> None:
    run = make_run(END_S)
    run.status[run.sent_s < FAULT_S] = HOLDOVER
    watched = watch(run.packets(), run.began_s)
    assert set(watched.events) == {"lock_gained"}
    assert watched.monitor.report().verdict.code == "ok"
    assert watched.monitor.report().locked


def test_a_drift_above_the_limit_is_a_fault() -> None:
    packets = make_run(30, ppm=300).packets()
    for limit_ppm, code in ((100.0, "drift"), (400.0, "ok")):
        monitor = ClockMonitor(SYNCED, drift_limit_ppm=limit_ppm)
        monitor.add(packets)
        assert monitor.report().verdict.code == code
        assert monitor.report().drift_ppm == pytest.approx(300, abs=2)


def test_late_packets_are_counted() -> None:
    run = make_run(30)
    packets = run.packets()
    packets.host_ns[1000:1007] += 80_000_000
    monitor = ClockMonitor(SYNCED)
    monitor.add(packets)
    report = monitor.report()
    assert report.late == 7
    assert report.jitter_ms == pytest.approx(0.95 * 5, abs=0.2)
    assert report.verdict.code == "ok"
    assert 24 <= len(monitor.samples) <= 30


@pytest.mark.parametrize("piece", [1, 7, RATE_HZ * 100])
def test_pieces_of_any_length_give_the_same_report(piece: int) -> None:
    run = make_run(20, ppm=30)
    step(1)(run)
    packets = run.packets()
    monitor = ClockMonitor(SYNCED)
    for start in range(0, len(packets), piece):
        monitor.add(packets.take(slice(start, start + piece)))
    report = monitor.report()
    assert report.drift_ppm == pytest.approx(30, abs=3)
    assert report.error_s == pytest.approx(20 * 30e-6, abs=1e-3)


@pytest.mark.parametrize("undated", [1, 100, 3000])
def test_the_first_date_of_a_clock_is_no_step(undated: int) -> None:
    """A live VLP-16 sends its date in another frame, which may arrive after the first packets."""
    sensor = ls.sensor("velodyne-vlp16")
    packets = sensor.decode(ls.simulate(sensor, 4000))
    date_ns = int(BEGAN_S) * 10**9  # at a full hour, when the clock begins at 0
    packets.host_ns = packets.time_ns + date_ns
    packets.time_ns = np.where(np.arange(len(packets)) < undated, 0, date_ns) + packets.time_ns
    monitor = ClockMonitor(sensor)
    for start in range(0, len(packets), 70):
        assert monitor.add(packets.take(slice(start, start + 70))) == []
    report = monitor.report()
    assert report.verdict.code == "ok"
    assert report.jumps == report.late == 0
    assert report.offset_s == pytest.approx(0, abs=1e-3)
    assert all(abs(sample.offset_s) < 1e-3 for sample in monitor.samples)


def test_a_sensor_without_a_clock_is_no_fault() -> None:
    sensor = SHAPES["shape-count"]
    monitor = ClockMonitor(sensor)
    monitor.add(sensor.decode(sensor.example("data")))
    report = monitor.report()
    assert report.verdict.code == "no_clock"
    assert not report.verdict.is_fault


def test_every_fault_has_advice_and_every_text_its_values() -> None:
    for code, kind in FINDING_TYPES.items():
        finding = ClockFinding(code, value=1.0, state="a state", epoch="tai")
        assert "{" not in finding.text
        assert bool(kind.advice) or not kind.is_fault


@pytest.mark.parametrize("seed", range(8))
def test_impossible_times_do_not_raise(seed: int) -> None:
    random = np.random.default_rng(seed)
    packets = make_run(1).packets()
    packets.host_ns = random.integers(0, 2**63 - 1, len(packets))
    packets.time_ns = random.integers(-9 * 10**18, 9 * 10**18, len(packets))
    monitor = ClockMonitor(SYNCED)
    for start in range(0, len(packets), 37):
        monitor.add(packets.take(slice(start, start + 37)))
    report = monitor.report()
    json.dumps(report.to_dict(), allow_nan=False)
    assert all("{" not in text for _, text in iter_clock_rows(report))


def test_a_clock_without_its_date_is_described_as_such() -> None:
    """A sensor that sends year, month and day begins at 2000-01-01, not at 0."""
    run = make_run(2, ahead_s=-8.4e8)
    report = watch(run.packets(SYNCED.configure(epoch="utc")), run.began_s).monitor.report()
    rows = dict(iter_clock_rows(report))
    assert (
        rows["offset"]
        == "-840000000.000 s from the host's clock; the sensor's clock has no valid date"
    )
    assert rows["verdict"] == "the clock has no valid date, but the declared epoch is UTC"


@pytest.mark.slow
def test_nothing_is_named_in_an_hour_without_faults() -> None:
    run = make_run(3600, ppm=50)
    watched = watch(run.packets(), run.began_s, step_s=1.0)
    assert watched.faults == set()
    report = watched.monitor.report()
    assert report.drift_ppm == pytest.approx(50, abs=1)
