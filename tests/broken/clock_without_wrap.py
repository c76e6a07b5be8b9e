"""Ignores that the clock wraps after 65 s."""

from __future__ import annotations

from lidarspec.spec import Clock, hookimpl
from tests.broken.sound import sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(clock=Clock("time"))]
