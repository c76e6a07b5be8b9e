"""All sensors, installed and invented, for the long tests.

They are loaded when a test runs.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable

import lidarspec
from lidarspec import Sensor
from tests.shapes import SHAPES


@functools.cache
def every_sensor() -> dict[str, Sensor]:
    """Return all sensors by id."""
    return {**lidarspec.sensors(), **SHAPES}


def distinct_sensors(sensors: Iterable[Sensor]) -> list[Sensor]:
    """Return one sensor for each set of frames: related models share theirs."""
    return list({tuple(map(id, sensor.frames.values())): sensor for sensor in sensors}.values())


def distinct_frames(sensors: Iterable[Sensor]) -> list[tuple[Sensor, str]]:
    """Return each frame type once, by its name in one of the sensors that have it."""
    return list(
        {
            id(frame): (sensor, name) for sensor in sensors for name, frame in sensor.frames.items()
        }.values()
    )


def stream_sensors(sensors: Iterable[Sensor]) -> list[Sensor]:
    """Return one sensor for each set of frames among the sensors that send a byte stream."""
    return distinct_sensors(sensor for sensor in sensors if not sensor.datagrams)
