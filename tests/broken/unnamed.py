"""A field without a name, so its value is lost."""

from __future__ import annotations

from construct import Const, Int8ul, Int16ul, Struct

from lidarspec.spec import Scaled, hookimpl
from tests.broken.sound import frame, sensor

DATA = Struct("header" / Const(b"\xaa\x55"), Int8ul, "distance" / Scaled(Int16ul, 0.001, "m"))


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(DATA, max_length=5))]
