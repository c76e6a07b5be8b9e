"""Uses hasattr(this, ...), which is always true."""

from __future__ import annotations

from construct import Int8ul, Int16ul, this

from lidarspec.spec import hookimpl
from tests.broken.sound import SIZE, frame, make_frame, sensor

EXTRA = Int8ul if hasattr(this, "extended") else Int16ul


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(make_frame(extra=EXTRA), max_length=SIZE + 1))]
