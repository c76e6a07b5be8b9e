"""Every sensor there is, installed or an invented shape, and one of each kind: relatives that share their frames are read alike."""

from __future__ import annotations

import functools
from collections.abc import Hashable
from typing import Any

import lidarspec
from lidarspec import Sensor
from tests.shapes import SHAPES


def distinct(sensors: dict[str, Sensor]) -> dict[str, Sensor]:
    """One sensor for each set of frames, by id."""
    return {sensor.id: sensor for sensor in {tuple(map(id, sensor.frames.values())): sensor for sensor in sensors.values()}.values()}


def streams(sensors: dict[str, Sensor]) -> dict[str, Sensor]:
    """One for each set of frames among those that send a stream of bytes, by id."""
    return distinct({name: sensor for name, sensor in sensors.items() if not sensor.datagrams})


def _same(function: Any) -> Hashable:
    """What tells one function from another; a partial by what it is of and by its arguments."""
    if not isinstance(function, functools.partial):
        return id(function)
    given = (*function.args, *function.keywords.values())
    return id(function.func), *(value if isinstance(value, int | float | str) else id(value) for value in given)


def _way(sensor: Sensor, frame: str) -> Hashable:
    """What decides how data are simulated and read: relatives in which it is the same prove the same."""
    simulation = sensor.simulation_of(frame)
    functions = sensor.points, simulation.sweep, simulation.encode, simulation.directions
    return id(sensor.frames[frame]), *map(_same, functions)


EVERY: dict[str, Sensor] = {**lidarspec.sensors(), **SHAPES}
DISTINCT = distinct(EVERY)
#: (sensor, frame type), each frame once, whichever sensors have it.
FRAMES = list({id(frame): (sensor.id, name) for sensor in EVERY.values() for name, frame in sensor.frames.items()}.values())
#: (sensor, type of its data), one of each way in which installed ones are simulated and read: the first that goes it.
WAYS = [
    *{_way(sensor, name): (sensor.id, name) for sensor in reversed(lidarspec.sensors().values()) for name in sensor.data_frames}.values()
]
#: those of them whose usual data go a way of their own.
READERS = [name for name, frame in WAYS if frame == EVERY[name].data_frame]
STREAMS = streams(EVERY)
