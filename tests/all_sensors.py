"""Every sensor there is, installed or an invented shape, and one of each kind: relatives that share their frames are read alike."""

from __future__ import annotations

import lidarspec
from lidarspec import Sensor
from tests.shapes import SHAPES


def distinct(sensors: dict[str, Sensor]) -> dict[str, Sensor]:
    """One sensor for each set of frames, by id."""
    return {sensor.id: sensor for sensor in {tuple(map(id, sensor.frames.values())): sensor for sensor in sensors.values()}.values()}


def streams(sensors: dict[str, Sensor]) -> dict[str, Sensor]:
    """One for each set of frames among those that send a stream of bytes, by id."""
    return distinct({name: sensor for name, sensor in sensors.items() if not sensor.datagrams})


EVERY: dict[str, Sensor] = {**lidarspec.sensors(), **SHAPES}
DISTINCT = distinct(EVERY)
#: (sensor, frame type), each frame once, whichever sensors have it.
FRAMES = list({id(frame): (sensor.id, name) for sensor in EVERY.values() for name, frame in sensor.frames.items()}.values())
STREAMS = streams(EVERY)
