"""Tests of limits for any input: memory (P4), and the delay of a frame (P6)."""

from __future__ import annotations

import random

import numpy as np
import pytest

from lidarspec import Sensor
from lidarspec.testing.sensor_under_test import SensorUnderTest
from tests.engine.engines import is_compiled
from tests.engine.streams import MEGABYTE, cut_randomly, peak, worst
from tests.installed import distinct_sensors_in, sensor_modules
from tests.representatives import STREAM_REPRESENTATIVES, load_sensor
from tests.shapes import SHAPES

STREAM_SHAPES = [name for name, sensor in SHAPES.items() if not sensor.datagrams]
STREAMS = (*STREAM_SHAPES, *STREAM_REPRESENTATIVES)
#: Sensors of which a stream of some frames takes seconds.
LONG_FRAMES = ("shape-joined", "shape-channels", "hokuyo-ust10lx")
#: Sensors whose peak memory is measured in the quick tier, one of each way to make frames: of one
#: size, counted, announced, text.
MEASURED = (
    "shape-middle",
    "shape-count",
    "shape-modes",
    "shape-tokens",
    "ldrobot-stl27l",
    "cspc-m1c1-mini",
    "slamtec-rplidar-a1",
)


def garbage(length: int, seed: int = 0) -> bytes:
    return np.random.default_rng(seed).bytes(length)


def feed(sensor: Sensor, data: bytes, times: int = 1, chunk: int = 4096) -> None:
    decoder = sensor.decoder()
    for _ in range(times):
        for start in range(0, len(data), chunk):
            decoder.feed(data[start : start + chunk])
    decoder.finish()


def pending_bound(sensor: Sensor) -> int:
    """Return the limit for pending bytes.

    It is the size of the longest frame, times `confirm` for a weak frame.
    """
    return max(frame.max_length * frame.confirm for frame in sensor.incoming.values())


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow if name in LONG_FRAMES else ()) for name in STREAMS],
)
def test_a_decoder_holds_less_than_its_longest_frame(name: str) -> None:
    sensor = load_sensor(name)
    for data in (
        garbage(2_000),
        worst(sensor, 2_000),
        SensorUnderTest(sensor).stream(rounds=1)[:6_000],
    ):
        decoder = sensor.decoder()
        for chunk in cut_randomly(data, random.Random(1)):
            decoder.feed(chunk)
            assert decoder.stats.pending < pending_bound(sensor)


@pytest.mark.parametrize("name", MEASURED)
def test_garbage_and_the_worst_stream_take_little_memory(name: str) -> None:
    sensor = load_sensor(name)
    assert_takes_little_memory(sensor, garbage(MEGABYTE // 8), MEGABYTE // 2)
    assert_takes_little_memory(sensor, worst(sensor, MEGABYTE // 32), MEGABYTE)


def assert_takes_little_memory(sensor: Sensor, data: bytes, bound: int) -> None:
    feed(sensor, data)  # imports, and tables that are made once, some of them for larger inputs
    assert peak(lambda: feed(sensor, data)) < bound


@pytest.mark.soak
@pytest.mark.parametrize("module", ["", *sensor_modules()])
def test_garbage_and_the_worst_stream_take_little_memory_on_every_sensor(module: str) -> None:
    for sensor in distinct_sensors_in(module) if module else SHAPES.values():
        if sensor.datagrams:
            continue
        assert_takes_little_memory(sensor, garbage(MEGABYTE // 8), MEGABYTE // 2)
        if is_compiled(sensor.frames[sensor.main_frames[0]]):
            assert_takes_little_memory(sensor, worst(sensor, MEGABYTE // 16), MEGABYTE)


@pytest.mark.parametrize("times", [4, pytest.param(50, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", ["ldrobot-stl27l", "shape-count"])
def test_garbage_needs_no_memory(name: str, times: int) -> None:
    sensor = load_sensor(name)
    data = garbage(MEGABYTE)
    assert peak(lambda: feed(sensor, data, times=times, chunk=MEGABYTE)) < MEGABYTE


@pytest.mark.parametrize("name", STREAMS)
def test_a_frame_is_returned_within_one_maximum_length(name: str) -> None:
    """Count the bytes after a frame that are fed before the frame is returned.

    Each piece has two percent of the size of the longest frame.
    """
    sensor = load_sensor(name)
    data = b"".join(part for _, part in SensorUnderTest(sensor).conversation(rounds=1))
    bound = pending_bound(sensor)
    decoder = sensor.decoder()
    step = max(bound // 50, 1)
    for offset in range(0, len(data), step):
        for found in decoder.feed(data[offset : offset + step]):
            assert offset + 1 - (found.offset + len(found.data)) < bound
