"""A range limit that the field cannot hold."""

from __future__ import annotations

from lidarspec.spec import hookimpl
from tests.broken.sound import sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(range_limits=(0.05, 100.0))]
