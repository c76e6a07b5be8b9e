"""Bounds that hold on any input: memory, and how long a frame is kept back."""

from __future__ import annotations

import random

import numpy as np
import pytest

import lidarspec
from lidarspec import Sensor
from lidarspec.framing.frame_engine import CompiledCodec, codec
from lidarspec.testing import subject as material
from lidarspec.testing.subject import Subject
from tests.all_sensors import STREAMS
from tests.engine.streams import MEGABYTE, peak, worst
from tests.shapes import SHAPES

COMPILED = {name: sensor for name, sensor in STREAMS.items() if isinstance(codec(sensor.frames[sensor.data_frame]), CompiledCodec)}

#: installed sensors whose memory is measured in every run, one of each way to make frames: of one size, counted, announced, masked, text.
MEASURED = ("ldrobot-stl27l", "cspc-m1c1-mini", "slamtec-rplidar-t1", "ydlidar-x4", "sick-lms511", "quanergy-m8")
each_stream = pytest.mark.parametrize("sensor", STREAMS.values(), ids=STREAMS)


def of_each_kind(sensors: dict[str, Sensor]) -> pytest.MarkDecorator:
    """The shapes and some installed sensors; the others in the long run."""
    marked = [
        pytest.param(sensor, id=name, marks=() if name in (*SHAPES, *MEASURED) else pytest.mark.soak) for name, sensor in sensors.items()
    ]
    return pytest.mark.parametrize("sensor", marked)


def garbage(length: int, seed: int = 0) -> bytes:
    return np.random.default_rng(seed).bytes(length)


def fed(sensor: Sensor, data: bytes, times: int = 1, chunk: int = 4096) -> None:
    decoder = sensor.decoder()
    for _ in range(times):
        for start in range(0, len(data), chunk):
            decoder.feed(data[start : start + chunk])
    decoder.finish()


@each_stream
def test_a_decoder_holds_less_than_its_longest_frame(sensor: Sensor) -> None:
    bound = max(frame.max_length * frame.confirm for frame in sensor.frames.values() if frame.direction == "in")
    for data in (garbage(8_000), worst(sensor, 8_000), Subject(sensor).stream(rounds=1)):
        decoder, source = sensor.decoder(), random.Random(1)
        for chunk in material.pieces(data, source):
            decoder.feed(chunk)
            assert decoder.stats.pending < bound


@of_each_kind(STREAMS)
def test_garbage_takes_no_memory(sensor: Sensor) -> None:
    data = garbage(MEGABYTE // 8)
    fed(sensor, data)  # what is imported and made once, for all decoders
    assert peak(lambda: fed(sensor, data)) < MEGABYTE // 2


@pytest.mark.parametrize("sensor", [lidarspec.sensor("ldrobot-stl27l"), SHAPES["shape-count"]], ids=lambda sensor: sensor.id)
def test_fifty_megabytes_of_garbage_take_no_memory(sensor: Sensor) -> None:
    data = garbage(MEGABYTE)
    assert peak(lambda: fed(sensor, data, times=50, chunk=MEGABYTE)) < MEGABYTE


@of_each_kind(COMPILED)
def test_the_worst_stream_takes_little_memory(sensor: Sensor) -> None:
    data = worst(sensor, MEGABYTE // 16)
    fed(sensor, data[:8192])
    assert peak(lambda: fed(sensor, data)) < MEGABYTE


@each_stream
def test_a_frame_is_out_before_one_longest_frame_more_has_come(sensor: Sensor) -> None:
    """The first frame found by an endless stream, in pieces of two percent of it: how many bytes after its own last one."""
    frames = Subject(sensor).conversation(rounds=3)
    data = b"".join(part for _, part in frames)
    bound = max(frame.max_length * frame.confirm for frame in sensor.frames.values() if frame.direction == "in")
    decoder = sensor.decoder()
    step = max(bound // 50, 1)
    for spot in range(0, len(data), step):
        for found in decoder.feed(data[spot : spot + step]):
            assert spot + 1 - (found.offset + len(found.data)) < bound
