"""A FlagsEnum, which loses bits without a name."""

from __future__ import annotations

from construct import FlagsEnum, Int8ul

from lidarspec.spec import hookimpl
from tests.broken.sound import SIZE, frame, make_frame, sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(make_frame(flags=FlagsEnum(Int8ul, dirty=1, hot=2)), max_length=SIZE + 8))]
