"""Tests that no stream costs much more than frames do (P20).

They count function calls and memory for each byte.
"""

from __future__ import annotations

import pytest

from lidarspec.testing.sensor_under_test import SensorUnderTest
from tests.engine.cost import (
    MAX_CALLS_PER_BYTE,
    MAX_KEPT_PER_BYTE,
    MAX_REJECTING_CALLS_PER_BYTE,
    calls_per_byte,
    kept_per_byte,
)
from tests.engine.streams import hostile_streams
from tests.representatives import load_sensor
from tests.shapes import SHAPES

STREAM_BYTES = 1500
#: Shapes that differ in how their layouts are found: counted, switched, tagged, up to a terminator.
QUICK = {"shape-count", "shape-modes", "shape-tags", "shape-text"}
#: Representatives that send streams of compiled frames.
REPRESENTATIVES = ("ldrobot-stl27l", "cspc-m1c1-mini", "slamtec-rplidar-a1")
#: Shapes and sensors of lines, of texts up to a terminator, and of many types that begin alike.
REJECTED_IN_BULK = ("shape-lines", "shape-joined", "hokuyo-utm30lxew", "sick-lms511")
NAMES = [name for name, sensor in SHAPES.items() if not sensor.datagrams]
CASES = [
    pytest.param(name, marks=() if name in QUICK else pytest.mark.slow)
    for name in (*NAMES, *REPRESENTATIVES)
]


@pytest.mark.parametrize("name", CASES)
def test_no_stream_costs_much_more_than_frames(name: str) -> None:
    sensor = load_sensor(name)
    for description, data in hostile_streams(SensorUnderTest(sensor), STREAM_BYTES):
        calls = calls_per_byte(sensor, data)
        if calls >= MAX_CALLS_PER_BYTE:  # layouts that the engine remembers are made only once
            calls = calls_per_byte(sensor, data)
        assert calls < MAX_CALLS_PER_BYTE, description
        assert kept_per_byte(sensor, data) < MAX_KEPT_PER_BYTE, description


@pytest.mark.parametrize("name", REJECTED_IN_BULK)
def test_headers_without_a_frame_are_rejected_in_bulk(name: str) -> None:
    sensor = load_sensor(name)
    for description, data in hostile_streams(SensorUnderTest(sensor), STREAM_BYTES):
        if description.startswith("headers of"):
            sensor.decoder().feed(data)  # layouts that the engine remembers are made only once
            assert calls_per_byte(sensor, data) < MAX_REJECTING_CALLS_PER_BYTE, description
