"""A distance with the empty string as its unit."""

from __future__ import annotations

from construct import Array, Int8ul, Int16ul, Struct, this

from lidarspec.spec import Scaled, hookimpl
from tests.broken.sound import frame, make_frame, sensor

SAMPLE = Struct("distance" / Scaled(Int16ul, 0.001, ""), "quality" / Int8ul)


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(make_frame(samples=Array(this.count, SAMPLE))))]
