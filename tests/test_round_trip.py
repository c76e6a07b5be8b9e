"""build(parse(b)) == b and parse(build(x)) == x, for many random valid frames of every distinct struct.

Each struct gets SECONDS by default. With LIDARSPEC_EXAMPLES those below 256 bytes get so many frames, however long that takes.
"""

from __future__ import annotations

import os
import random
import time

import pytest

import lidarspec as ls
from lidarspec.examples import examples
from lidarspec.spec import Sensor
from tests.shapes import SHAPES

EXAMPLES = int(os.environ.get("LIDARSPEC_EXAMPLES", "0"))
SECONDS = 0.5

DISTINCT: dict[int, tuple[Sensor, str]] = {}
for _sensor in (*ls.sensors().values(), *SHAPES.values()):
    for _name, _frame in _sensor.frames.items():
        DISTINCT.setdefault(id(_frame.struct), (_sensor, _name))


@pytest.mark.parametrize(("sensor", "name"), DISTINCT.values(), ids=[f"{sensor.id} {name}" for sensor, name in DISTINCT.values()])
def test_bytes_and_values_survive(sensor: Sensor, name: str) -> None:
    source = random.Random(f"{sensor.id} {name}")
    wanted = EXAMPLES if sensor.frames[name].max_length < 256 else 0
    end, tried = time.monotonic() + SECONDS, 0
    while tried < wanted if wanted else time.monotonic() < end:
        for data in examples(sensor, name, source):
            value = sensor.parse(data, name)
            assert sensor.build(name, value) == data
            tried += 1
            if tried % 8 == 0 and not wanted and time.monotonic() > end:
                break
        rebuilt = sensor.parse(sensor.build(name, value), name)
        assert sensor.build(name, rebuilt) == data
    assert tried
