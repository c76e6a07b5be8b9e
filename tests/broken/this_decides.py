"""A Python condition on `this.count == 1`, an expression that is always true."""

from __future__ import annotations

from construct import Int8ul, Int16ul, this

from lidarspec.spec import hookimpl
from tests.broken.sound import SIZE, frame, make_frame, sensor

QUALITY = Int8ul if this.count == 1 else Int16ul


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(make_frame(quality=QUALITY), max_length=SIZE + 1))]
