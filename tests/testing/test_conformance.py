"""The test kit over the invented shapes, and the frames that only construct can read."""

from __future__ import annotations

import pytest

import lidarspec as ls
from lidarspec.framing.frame_engine import InterpretedCodec, codec
from lidarspec.testing import assert_conformance
from tests.installed import CONFORMANCE_EXAMPLES
from tests.shapes import SHAPES

#: frames that only construct can read: they lack a fast path, see `lidarspec show`.
INTERPRETED = {"shape-text data"}
INTERPRETED_OF_HOKUYO = ("version", "parameters", "state")

#: shapes whose examples are long, or that construct reads: over one second of processor time each.
COSTLY = {
    "shape-channels",
    "shape-columns",
    "shape-conversation",
    "shape-escaped",
    "shape-fragments",
    "shape-headed",
    "shape-joined",
    "shape-lines",
    "shape-measured",
    "shape-millimetres",
    "shape-modes",
    "shape-options",
    "shape-segments",
    "shape-sized",
    "shape-tags",
    "shape-text",
    "shape-tokens",
}
CASES = [pytest.param(name, marks=pytest.mark.slow if name in COSTLY else ()) for name in SHAPES]


@pytest.mark.parametrize("name", CASES)
def test_shape_conforms(name: str) -> None:
    assert_conformance(SHAPES[name], examples=CONFORMANCE_EXAMPLES)


def _interpreted(sensors: dict[str, ls.Sensor]) -> set[str]:
    return {
        f"{sensor_id} {name}"
        for sensor_id, sensor in sensors.items()
        for name, frame in sensor.frames.items()
        if isinstance(codec(frame), InterpretedCodec)
    }


def test_frames_of_shapes_compile_except_those_named_here() -> None:
    assert _interpreted(SHAPES) == INTERPRETED


@pytest.mark.slow
def test_frames_of_installed_sensors_compile_except_those_named_here() -> None:
    sensors = dict(ls.sensors())
    assert _interpreted(sensors) == {
        f"{sensor_id} {name}" for sensor_id in sensors if sensor_id.startswith("hokuyo-") for name in INTERPRETED_OF_HOKUYO
    }
