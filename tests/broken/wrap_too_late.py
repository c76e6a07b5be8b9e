"""A clock in milliseconds of 16 bits, with a declared wrap of 65,536 s."""

from __future__ import annotations

from lidarspec.spec import Clock, hookimpl
from tests.broken.sound import sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(clock=Clock("time", wraps_at=65_536.0))]
