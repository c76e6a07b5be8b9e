"""Unsigned where the wire is signed."""

from __future__ import annotations

from construct import Int16ul

from lidarspec.spec import Scaled, hookimpl
from tests.broken.sound import frame, sealed, sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(sealed(tilt=Scaled(Int16ul, 0.01, "deg"))))]
