"""sizeof() of a struct with an If, which raises a KeyError."""

from __future__ import annotations

from construct import Const, If, Int8ul, Struct, this

from lidarspec.spec import hookimpl
from tests.broken.sound import frame, sensor

EXTENDED = Struct(
    "header" / Const(b"\xaa\x55"), "kind" / Int8ul, "extra" / If(this.kind == 1, Int8ul)
)


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(EXTENDED, max_length=EXTENDED.sizeof()))]
