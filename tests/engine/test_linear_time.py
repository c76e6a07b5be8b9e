"""Time grows with the input and no faster: twice the worst input takes about twice as long, as a ratio within one run."""

from __future__ import annotations

import random
import time

import pytest

from lidarspec import Sensor
from lidarspec.framing.frame_engine import CompiledCodec, codec
from tests.all_sensors import streams
from tests.engine import mutants
from tests.engine.streams import worst
from tests.shapes import SHAPES

SHAPED = streams(SHAPES)
#: bytes of the whole input, and of that of a sensor that is not compiled.
LENGTH, FEW = 240_000, 12_000
#: how many times as long twice the input may take, and how often it is tried.
RATIO, TRIES = 3.0, 5
#: CPU seconds below which a difference says nothing.
LEAST = 0.05


def seconds(sensor: Sensor, data: bytes) -> float:
    """CPU seconds of one run."""
    start = time.process_time()
    decoder = sensor.decoder()
    decoder.feed(data)
    decoder.finish()
    return time.process_time() - start


def grows_with_the_input(sensor: Sensor, data: bytes, tries: int = TRIES) -> bool:
    """Whether the input takes about twice as long as half of it."""
    seconds(sensor, data[: len(data) // 16])
    half = whole = float("inf")
    for _ in range(tries):
        half, whole = min(half, seconds(sensor, data[: len(data) // 2])), min(whole, seconds(sensor, data))
        if whole <= max(2.2 * half, LEAST):
            return True
    return whole <= max(RATIO * half, LEAST)


@pytest.mark.parametrize("sensor", SHAPED.values(), ids=SHAPED)
def test_time_grows_with_the_input_and_no_faster(sensor: Sensor) -> None:
    length = LENGTH if all(isinstance(codec(frame), CompiledCodec) for frame in sensor.frames.values()) else FEW
    assert grows_with_the_input(sensor, random.Random(1).randbytes(length))
    assert grows_with_the_input(sensor, worst(sensor, length))


def test_a_buffer_copied_for_each_byte_is_caught() -> None:
    assert not grows_with_the_input(mutants.read_by(mutants.BufferCopied), random.Random(1).randbytes(LENGTH), tries=1)
