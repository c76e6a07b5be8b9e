"""A checksum that does not cover one of the fields."""

from __future__ import annotations

from lidarspec.spec import Checksummed, Sum, hookimpl
from tests.broken.sound import frame, sensor, struct

DATA = Checksummed(
    struct(),
    field="sum",
    algorithm=Sum(16),
    over=("header", "number", "time", "tilt", "first", "last", "count"),
)


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(DATA))]
