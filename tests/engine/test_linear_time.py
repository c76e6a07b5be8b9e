"""Tests that time grows linearly with the input (P5).

Twice the worst input takes about twice as long, as a ratio of CPU seconds within one run.
"""

from __future__ import annotations

import random
import time

import pytest

from lidarspec import Sensor
from tests.engine import mutants
from tests.engine.engines import is_compiled
from tests.engine.streams import worst
from tests.shapes import SHAPES

#: One shape of each way to find frames: counted, announced, up to a terminator, in runs.
QUICK_SHAPES = ("shape-count", "shape-modes", "shape-text", "shape-weak")
STREAM_SHAPES = [
    pytest.param(name, marks=() if name in QUICK_SHAPES else pytest.mark.slow)
    for name, sensor in SHAPES.items()
    if not sensor.datagrams
]
COMPILED_BYTES = 240_000
INTERPRETED_BYTES = 12_000
MUTANT_BYTES = 6_000
MAX_RATIO = 2.5
#: A run that is that good is not repeated.
GOOD_RATIO = 2.2
#: On a busy machine many runs are slowed down; the shortest of both lengths are compared.
MAX_TRIES = 15
MUTANT_TRIES = 5
#: Minimum CPU seconds of a meaningful ratio.
MIN_SECONDS = 0.05


def seconds(sensor: Sensor, data: bytes) -> float:
    """Return the CPU seconds of one run."""
    start = time.process_time()
    decoder = sensor.decoder()
    decoder.feed(data)
    decoder.finish()
    return time.process_time() - start


def grows_with_the_input(sensor: Sensor, data: bytes, tries: int = MAX_TRIES) -> bool:
    """Return whether the input takes about twice as long as half of it."""
    seconds(sensor, data[: len(data) // 16])
    half = float("inf")
    whole = float("inf")
    for _ in range(tries):
        half = min(half, seconds(sensor, data[: len(data) // 2]))
        whole = min(whole, seconds(sensor, data))
        if whole <= max(GOOD_RATIO * half, MIN_SECONDS):
            return True
    return whole <= max(MAX_RATIO * half, MIN_SECONDS)


@pytest.mark.parametrize("name", STREAM_SHAPES)
def test_time_grows_with_the_input_and_no_faster(name: str) -> None:
    sensor = SHAPES[name]
    length = COMPILED_BYTES if all(map(is_compiled, sensor.frames.values())) else INTERPRETED_BYTES
    assert grows_with_the_input(sensor, random.Random(1).randbytes(length))
    assert grows_with_the_input(sensor, worst(sensor, length))


@pytest.mark.slow
def test_a_buffer_copied_for_each_byte_is_caught() -> None:
    sensor = mutants.read_by(mutants.BufferCopied)
    data = random.Random(1).randbytes(MUTANT_BYTES)
    assert not all(grows_with_the_input(sensor, data, tries=1) for _ in range(MUTANT_TRIES))
