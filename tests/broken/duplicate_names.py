"""Two fields with the same name: only the last value is kept."""

from __future__ import annotations

from construct import Const, Int8ul, Int16ul, Struct

from lidarspec.spec import Scaled, hookimpl
from tests.broken.sound import frame, sensor

DATA = Struct(
    "header" / Const(b"\xaa\x55"),
    "reserved" / Int8ul,
    "distance" / Scaled(Int16ul, 0.001, "m"),
    "reserved" / Int8ul,
)


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(DATA, max_length=6))]
