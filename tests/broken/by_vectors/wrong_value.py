"""A scale that differs from the manual's."""

from __future__ import annotations

from construct import Int16sl

from lidarspec.spec import Scaled, hookimpl
from tests.broken.sound import frame, make_frame, sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(make_frame(tilt=Scaled(Int16sl, 0.1, "deg"))))]
