"""A checksum hook that raises for the sensors that it does not know."""

from __future__ import annotations

from lidarspec.spec import Xor, hookimpl
from tests.broken import sound

ALGORITHMS = {"other-one": Xor()}


@hookimpl
def lidarspec_checksum(sensor, frame):
    return ALGORITHMS[sensor.id]


@hookimpl
def lidarspec_sensors():
    return [sound.sensor()]
