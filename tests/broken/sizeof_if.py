"""sizeof() of a struct with an If, which leaks a KeyError."""

from __future__ import annotations

from construct import If, Int8ul, this

from lidarspec import hookimpl
from tests.broken.sound import frame, sensor, struct

EXTENDED = struct(extra=If(this.number == 1, Int8ul))


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(EXTENDED, max_length=EXTENDED.sizeof()))]
