"""`parse` by generated code gives the very Container that construct gives."""

from __future__ import annotations

from typing import Any

import construct
import pytest

import lidarspec as ls
from lidarspec.codecs import CompiledCodec, codec
from lidarspec.construction import clean
from lidarspec.spec import Sensor
from tests.shapes import SHAPES

EVERY = {**ls.sensors(), **SHAPES}
CASES = [(sensor, name) for sensor in EVERY.values() for name, frame in sensor.frames.items() if isinstance(codec(frame), CompiledCodec)]


def same(one: Any, other: Any) -> None:
    """Equal values of equal types in equal order, NaNs by their bits."""
    assert type(one) is type(other)
    if isinstance(one, dict):
        assert list(one) == list(other)
        for name in one:
            same(one[name], other[name])
    elif isinstance(one, list):
        assert len(one) == len(other)
        for left, right in zip(one, other, strict=True):
            same(left, right)
    elif isinstance(one, float) and one != one:
        assert getattr(one, "raw", b"") == getattr(other, "raw", b"")
    else:
        assert one == other


@pytest.mark.parametrize(("sensor", "name"), CASES, ids=[f"{sensor.id} {name}" for sensor, name in CASES])
def test_every_frame_type_unpacks_to_what_construct_parses(sensor: Sensor, name: str) -> None:
    engine = codec(sensor.frames[name])
    assert isinstance(engine, CompiledCodec)
    for seed in range(12):
        data = sensor.example(name, seed=seed)
        found = engine.parse(data)
        assert found is not None, "left to construct"
        same(found, clean(sensor.frames[name].prepared.parse(data)))


@pytest.mark.parametrize(("sensor", "name"), CASES, ids=[f"{sensor.id} {name}" for sensor, name in CASES])
def test_damaged_frames_are_left_to_construct(sensor: Sensor, name: str) -> None:
    engine = codec(sensor.frames[name])
    assert isinstance(engine, CompiledCodec)
    data = bytearray(sensor.example(name))
    for spot in range(min(len(data), 60)):
        data[spot] ^= 0x41
        found = engine.parse(bytes(data))
        try:
            expected = clean(sensor.frames[name].prepared.parse(bytes(data)))
        except construct.ConstructError:
            assert found is None
        else:
            if found is not None:
                same(found, expected)
        data[spot] ^= 0x41
