"""Optional, which hides errors in the bytes."""

from __future__ import annotations

from construct import Int8ul, Optional

from lidarspec.spec import hookimpl
from tests.broken.sound import SIZE, frame, make_frame, sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(make_frame(extra=Optional(Int8ul)), max_length=SIZE + 8))]
