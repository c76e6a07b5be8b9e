"""Another scale than the manual's."""

from __future__ import annotations

from construct import Int16sl

from lidarspec.spec import Scaled, hookimpl
from tests.broken.sound import frame, sealed, sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(sealed(tilt=Scaled(Int16sl, 0.1, "deg"))))]
