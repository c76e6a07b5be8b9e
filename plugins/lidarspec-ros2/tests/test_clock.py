"""Tests that stamps are in order and right within a millisecond.

This holds for every sensor clock and every delay of the connection.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
from clocks import BEGAN, JITTERS, SET, simulate_stamps
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray

from lidarspec.packets.clock_estimate import DeviceClock
from lidarspec.transports.host_clock import HostClock
from lidarspec_ros2.clock import MessageStamps
from lidarspec_ros2.parameters import PARAMETERS, Settings

SECOND = 1_000_000_000
#: all but the widest jitter, with which stamps are not within a millisecond.
SMALL_JITTERS = [name for name in JITTERS if name != "uniform, 0 to 10 ms"]


@pytest.mark.parametrize("jitter", SMALL_JITTERS)
@pytest.mark.parametrize(
    ("drift_ppm", "step"),
    [(50, 1.5), (-50, -1.5), (50, 3600), (-1000, -3600), (10_000, 0.02), (-10_000, 0.2)],
)
def test_stamps_are_within_a_millisecond_and_a_clock_that_is_set_is_reported(
    jitter: str, drift_ppm: float, step: float
) -> None:
    for seed in range(3):
        run = simulate_stamps(seed, jitter, drift_ppm=drift_ppm, step=step)
        assert np.abs(run.errors[run.is_settled]).max() < 1e-3
        assert (np.diff(run.stamps) > 0).all()
        assert (run.stamps <= run.host).all()
        assert run.clock.jumps == 2  # set, and started again
        assert [float(text.split()[-2]) for text in run.said] == pytest.approx(
            [step, -4294.967], abs=0.02
        )
        assert run.clock.jump is None  # and it is well again
        assert run.clock.drift_ppm == pytest.approx(drift_ppm, abs=100)


@pytest.mark.parametrize("jitter", SMALL_JITTERS)
def test_packets_improve_stamps_over_scans(jitter: str) -> None:
    alone, with_packets = (simulate_stamps(1, jitter, each=each) for each in (1, 40))
    errors = [np.abs(run.errors[run.is_settled]).mean() for run in (alone, with_packets)]
    assert errors[1] < errors[0] / 2
    assert with_packets.clock.jumps == 2


def make_stamps(wall: HostClock | None = None, **wanted: Any) -> NDArray[np.int64]:
    """Return the errors of the stamps of ten seconds of scans.

    Each scan arrived 3 ms after its measurement.
    """
    stamps, values = (
        MessageStamps(wall),
        Settings({parameter.name: parameter.default for parameter in PARAMETERS} | wanted),
    )
    found = []
    for at in range(0, 10 * SECOND, SECOND // 10):
        arrived = at + BEGAN + 3_000_000
        stamps.update_conversion(np.array([at]), np.array([arrived]))
        found.append(stamps.stamp_scan(at, arrived, values) - at - BEGAN)
    assert (
        abs(stamps.stamp_sample(5 * SECOND, values, by_clock=True) - 5 * SECOND - BEGAN - found[-1])
        < 1000
    )
    return np.array(found)


def test_a_constant_delay_is_subtracted_only_if_known() -> None:
    assert np.abs(make_stamps() - 3_000_000).max() < 1000
    assert np.abs(make_stamps(time_offset=-0.003)).max() < 1000
    assert (make_stamps(use_device_time=False) == 3_000_000).all()


def test_a_synchronized_sensor_clock_is_used_directly() -> None:
    assert (make_stamps(device_time_is_ros_time=True) == -BEGAN).all()
    assert (make_stamps(device_time_is_ros_time=True, use_device_time=False) == 3_000_000).all()


def test_stamps_follow_the_computers_clock_where_it_is_set() -> None:
    now = [0]
    wall = HostClock(lambda: time.time_ns() + now[0])
    assert np.abs(make_stamps(wall) - 3_000_000).max() < 1000
    now[0] = -3600 * SECOND
    assert np.abs(make_stamps(wall) - 3_000_000 + 3600 * SECOND).max() < 1_000_000


def test_stamps_do_not_jump_while_the_clock_is_not_set() -> None:
    run = simulate_stamps(0, "uniform, 0 to 5 ms", step=0, wraps=False)
    later = run.times > 10
    pace = np.diff(run.stamps[later]) / np.diff(run.times[later] * 1e9)
    assert np.abs(pace - 1).max() < 5e-3
    assert run.clock.jumps == 0


@pytest.mark.parametrize("stall", [0.1, 2.0])
def test_a_stalled_machine_is_not_a_clock_change(stall: float) -> None:
    times = np.arange(0, 40 * SECOND, SECOND // 100)
    host = times + np.random.default_rng(0).integers(0, 5_000_000, len(times))
    still = (times >= 20 * SECOND) & (times < (20 + stall) * SECOND)
    host[still] = int((20 + stall) * SECOND)
    clock = DeviceClock()
    stamps = np.array(
        [clock.stamp(int(device), int(at)) for device, at in zip(times, host, strict=True)]
    )
    assert clock.jumps == 0
    assert np.abs(stamps - times)[times > 10 * SECOND].max() < 1_000_000


def test_a_slower_line_is_not_a_clock_change() -> None:
    for seed in range(5):
        random, clock = np.random.default_rng(seed), DeviceClock()
        times = np.arange(0, 60 * SECOND, SECOND // 10)
        late = random.exponential(np.where(times < 20 * SECOND, 1e6, 30e6)).astype(np.int64)
        stamps = np.array(
            [
                clock.stamp(*pair)
                for pair in zip(times.tolist(), (times + late).tolist(), strict=True)
            ]
        )
        assert clock.jumps == 0
        assert np.abs(stamps - times)[times > 10 * SECOND].max() < 5_000_000


@pytest.mark.parametrize("step", [3600, 1.5, 0.5, -0.5, -1.5, -3600])
def test_until_it_is_sure_that_the_clock_was_set_stamps_are_no_worse_than_arrivals(
    step: float,
) -> None:
    run = simulate_stamps(0, "uniform, 0 to 5 ms", step=step, stalls=0)
    after = (run.times >= SET) & (run.times < SET + 2)
    assert np.abs(run.errors[after]).max() < 20e-3


@pytest.mark.parametrize("pause", [5, 600, 36_000])
def test_stamps_continue_after_a_pause(pause: int) -> None:
    random, clock = np.random.default_rng(2), DeviceClock()
    times = np.concatenate([np.arange(0, 40, 0.1), np.arange(0, 40, 0.1) + 40 + pause])
    device = (times * (1 - 50e-6) * SECOND).astype(np.int64).tolist()
    host = (times * SECOND).astype(np.int64) + random.integers(0, 5_000_000, len(times))
    stamps = np.array([clock.stamp(*pair) for pair in zip(device, host.tolist(), strict=True)])
    assert np.abs(stamps / SECOND - times)[times % (40 + pause) > 5].max() < 1e-3
    assert np.abs(stamps / SECOND - times)[times > 30].max() < 5e-3
    assert (clock.jumps, clock.jump) == (0, None)


@given(
    st.booleans(),
    st.sampled_from(SMALL_JITTERS),
    st.integers(0, 2**32),
    st.floats(-200, 200),
    st.floats(0.05, 100),
    st.sampled_from([-1, 1]),
)
@settings(max_examples=10, deadline=None)
def test_any_drift_and_step_is_followed(
    wraps: bool, jitter: str, seed: int, drift: float, step: float, sign: int
) -> None:
    run = simulate_stamps(seed, jitter, drift_ppm=drift, step=sign * step, wraps=wraps)
    assert np.abs(run.errors[run.is_settled]).max() < 2e-3
    assert (np.diff(run.stamps) > 0).all()
    assert run.clock.jumps == 1 + wraps


@given(
    st.lists(
        st.tuples(st.integers(-(2**60), 2**60), st.integers(0, 10 * SECOND)),
        min_size=1,
        max_size=60,
    ),
    st.integers(0, 2**60),
)
@settings(max_examples=100, deadline=None)
def test_whatever_a_damaged_clock_says_stamps_are_in_order_and_not_in_the_future(
    steps: list[tuple[int, int]], first: int
) -> None:
    clock, host, last = DeviceClock(), first, -(1 << 62)
    for device, passed in steps:
        host += passed
        stamp = clock.stamp(device, host)
        assert last < stamp <= max(host, last + 1)
        last = stamp


@given(st.integers(0, 2**32), st.integers(-(2**60), 2**60), st.integers(0, 2**60))
@settings(max_examples=10, deadline=None)
def test_it_does_not_matter_when_either_clock_began(
    seed: int, device_began: int, host_began: int
) -> None:
    random, plain, shifted = np.random.default_rng(seed), DeviceClock(), DeviceClock()
    for at in range(0, 100 * SECOND, SECOND // 4):  # a part each, so that the parts are the same
        late = int(random.exponential(5e6))
        assert (
            shifted.stamp(at + device_began // SECOND * SECOND, at + late + host_began)
            == plain.stamp(at, at + late) + host_began
        )


def test_packets_may_be_observed_in_batches_of_any_size() -> None:
    run = simulate_stamps(3, "uniform, 0 to 5 ms", step=0, wraps=False)
    lines = []
    for size in (1, 7, len(run.times)):
        clock = DeviceClock()
        for first in range(0, len(run.times), size):
            clock.observe(run.device[first : first + size], run.host[first : first + size])
        lines.append((clock.offset_ns, clock.drift_ppm))
    assert np.ptp([offset for offset, _ in lines]) < 200_000
    assert np.ptp([drift for _, drift in lines]) < 20
