"""A big-endian field for a little-endian value."""

from __future__ import annotations

from construct import Int16sb

from lidarspec.spec import Scaled, hookimpl
from tests.broken.sound import frame, make_frame, sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(make_frame(tilt=Scaled(Int16sb, 0.01, "deg"))))]
