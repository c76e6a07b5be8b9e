"""A clock that wraps after 50 s, with a declared wrap of 3 s."""

from __future__ import annotations

from lidarspec.spec import Clock, hookimpl
from tests.broken.sound import sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(clock=Clock("time", wraps_at=3.0))]
