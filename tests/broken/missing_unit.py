"""A distance without a unit."""

from __future__ import annotations

from construct import Array, Int8ul, Int16ul, Struct, this

from lidarspec.spec import hookimpl
from tests.broken.sound import frame, make_frame, sensor

SAMPLE = Struct("distance" / Int16ul, "quality" / Int8ul)


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(make_frame(samples=Array(this.count, SAMPLE))))]
