"""Tests of the test kit with the invented shapes, and with frames of construct only."""

from __future__ import annotations

import pytest

import lidarspec as ls
from lidarspec.framing.frame_engine import get_codec
from lidarspec.testing import assert_conformance
from tests.installed import CONFORMANCE_EXAMPLES
from tests.shapes import SHAPES

#: frames that only construct can read: they lack a fast path, see `lidarspec show`.
INTERPRETED = {"shape-text data"}

#: Shapes that are held to all properties in the quick tier: one for each way to find, to check and
#: to cut frames.
QUICK = {
    "shape-ahead",
    "shape-bits",
    "shape-calibration",
    "shape-clock",
    "shape-commands",
    "shape-count",
    "shape-datagrams",
    "shape-floats",
    "shape-middle",
    "shape-nested",
    "shape-nibbles",
    "shape-weak",
}
CASES = [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in SHAPES]


@pytest.mark.parametrize("name", CASES)
def test_shape_conforms(name: str) -> None:
    assert_conformance(SHAPES[name], examples=CONFORMANCE_EXAMPLES)


def _list_plain_frames(sensors: dict[str, ls.Sensor]) -> set[str]:
    return {
        f"{sensor_id} {name}"
        for sensor_id, sensor in sensors.items()
        for name, frame in sensor.frames.items()
        if not get_codec(frame).is_compiled
    }


def test_frames_of_shapes_compile_except_those_named_here() -> None:
    assert _list_plain_frames(SHAPES) == INTERPRETED


@pytest.mark.slow
def test_all_frames_of_installed_sensors_compile() -> None:
    assert _list_plain_frames(dict(ls.sensors())) == set()
