"""Tests of promise P17: late and duplicate packets do not change the scans."""

from __future__ import annotations

import dataclasses
import random
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from lidarspec import Packets, Scan, Sensor, simulate
from lidarspec.packets.reorder import WINDOW, Reorder
from lidarspec.packets.stream import PacketStream
from lidarspec.scans.stream import ScanStream
from tests.installed import distinct_sensors_in, sensor_modules
from tests.representatives import load_sensor
from tests.shapes.paced import FAST_S

#: a clock without a declared pace, which does not show that packets are missing.
UNPACED = "shape-columns"
#: datagrams ordered by a counter, a counter and a clock, a clock with a declared pace, and one
#: without.
SHAPES = ["shape-headed", "shape-extras", "shape-paced", UNPACED]
#: float32 columns of one packet may differ in the last bit between batches of different sizes.
LAST_BIT = 2e-6


def disturb(frames: Sequence[bytes], seed: str) -> list[bytes]:
    """Return the frames with some doubled, and all moved by up to three places.

    One frame in ten is doubled.
    """
    draw = random.Random(seed)
    doubled = [frame for frame in frames for _ in range(2 if draw.random() < 0.1 else 1)]
    order = sorted(range(len(doubled)), key=lambda index: index + draw.uniform(0, 3))
    return [doubled[index] for index in order]


def assert_same_scans(scans: Sequence[Scan], expected: Sequence[Scan]) -> None:
    """Compare the facts and all columns of scans."""
    assert len(scans) == len(expected)
    for scan, same in zip(scans, expected, strict=True):
        assert (len(scan), scan.complete, scan.whole, scan.stamp_ns) == (
            len(same),
            same.complete,
            same.whole,
            same.stamp_ns,
        )
        assert scan.rate_hz == pytest.approx(same.rate_hz, nan_ok=True)
        for column in scan.points.columns:
            np.testing.assert_allclose(
                scan.points.columns[column],
                same.points.columns[column],
                rtol=LAST_BIT,
                atol=LAST_BIT,
            )


def assert_order_does_not_matter(sensor: Sensor, frames: Sequence[bytes], first: int) -> None:
    """Compare the scans and counters of a disturbed stream with those of a stream in order.

    Args:
        first: frames at the start that come in order.
    """
    changed = [*frames[:first], *disturb(frames[first:], sensor.id)]
    stats = sensor.decode(changed).stats
    assert (stats.plugin_errors, stats.lost, stats.duplicates) == (0, 0, len(changed) - len(frames))
    assert stats.late > len(frames) / 10
    assert_same_scans(list(sensor.scans(changed)), list(sensor.scans(list(frames))))


@pytest.mark.parametrize("first", [0, 10])
@pytest.mark.parametrize("name", SHAPES)
def test_doubled_and_displaced_packets_make_the_same_scans(name: str, first: int) -> None:
    sensor = load_sensor(name)
    frames = simulate(sensor, 300)
    assert_order_does_not_matter(sensor, frames, first)


@pytest.mark.slow
@pytest.mark.parametrize("module", sensor_modules())
def test_every_sensor_that_sends_datagrams_keeps_the_promise(module: str) -> None:
    """Of the models that share all frames, one is tested.

    Packets without a counter and a clock have no order, so no packet is late or a duplicate.
    """
    for sensor in distinct_sensors_in(module):
        if not sensor.datagrams:
            continue
        frames = simulate(sensor, 800)
        if sensor.sequence or sensor.clock:
            assert_order_does_not_matter(sensor, frames, 0)
        else:
            stats = sensor.decode(disturb(frames, sensor.id)).stats
            assert (stats.plugin_errors, stats.lost, stats.duplicates, stats.late) == (0, 0, 0, 0)


def with_sweep(name: str, change: Callable[[int, Mapping[str, Any]], Mapping[str, Any]]) -> Sensor:
    """Return a shape whose sweep is changed by a function of the packet's number and its values."""
    sensor = load_sensor(name)
    simulation = sensor.simulation
    assert simulation is not None
    sweep = simulation.sweep
    changed = dataclasses.replace(simulation, sweep=lambda i: change(i, sweep(i)))
    return dataclasses.replace(sensor, simulation=changed)


def test_a_counter_that_starts_again_while_packets_are_late() -> None:
    """The counter has 65,536 values, and starts again with each frame of 40 packets."""
    sensor = with_sweep("shape-extras", lambda i, values: {**values, "number": i % 40})
    assert_order_does_not_matter(sensor, simulate(sensor, 300), 100)


def test_a_late_packet_between_unevenly_timed_ones_is_no_loss() -> None:
    """Each packet is up to 40 % of its pace late by the clock."""
    draw = random.Random(1)
    delays = [draw.uniform(0, 0.4) * FAST_S for _ in range(97)]
    sensor = with_sweep(
        "shape-paced", lambda i, values: {**values, "micros": values["micros"] + delays[i % 97]}
    )
    assert_order_does_not_matter(sensor, simulate(sensor, 120), 0)


def pieces(sensor: Sensor, frames: Sequence[bytes], size: int) -> list[Packets]:
    """Return the packets of datagrams that arrive some at a time."""
    decoder = sensor.decoder()
    stream = PacketStream(sensor, str(sensor.data_frame), decoder.stats)
    parts = [frames[start : start + size] for start in range(0, len(frames), size)]
    return [stream.add([decoder.datagrams(part, [None] * len(part))]) for part in parts]


@pytest.mark.parametrize("name", SHAPES)
def test_the_sizes_of_batches_do_not_matter(name: str) -> None:
    sensor = load_sensor(name)
    frames = disturb(simulate(sensor, 100), name)
    stream = ScanStream(sensor)
    scans = [scan for packets in pieces(sensor, frames, 3) for scan in stream.add(packets)]
    assert_same_scans([*scans, *stream.finish()], list(sensor.scans(frames)))


@pytest.mark.parametrize("name", SHAPES)
def test_packets_in_order_are_held_at_the_start_alone(name: str) -> None:
    sensor = load_sensor(name)
    reorder = Reorder()
    released = [
        sum(map(len, reorder.push(packets))) for packets in pieces(sensor, simulate(sensor, 60), 1)
    ]
    first = 1 if name == UNPACED else WINDOW + 1
    assert released == [0] * WINDOW + [first] + [1] * (59 - WINDOW)
    assert sum(map(len, reorder.finish())) == 60 - sum(released)


@pytest.mark.parametrize("name", SHAPES)
def test_a_lost_packet_holds_no_more_than_a_window(name: str) -> None:
    sensor = load_sensor(name)
    frames = simulate(sensor, 100)
    reorder = Reorder()
    arrived = released = 0
    most_held = 0
    for packets in pieces(sensor, frames[:50] + frames[51:], 1):
        arrived += 1
        released += sum(map(len, reorder.push(packets)))
        most_held = max(most_held, arrived - released if arrived > 40 else 0)
    assert most_held == WINDOW
    assert released == arrived - (WINDOW if name == UNPACED else 0)
    assert arrived == 99
