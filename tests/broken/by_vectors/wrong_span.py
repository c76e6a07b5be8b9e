"""A checksum over the wrong bytes: without the header."""

from __future__ import annotations

from lidarspec.spec import Checksummed, Sum, hookimpl
from tests.broken.sound import frame, sensor, struct

COVERED = ("number", "time", "tilt", "first", "last", "count", "samples")
DATA = Checksummed(struct(), field="sum", algorithm=Sum(16), over=COVERED)


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(DATA))]
