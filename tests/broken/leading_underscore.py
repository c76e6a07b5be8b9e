"""A field name with a leading underscore: `==` of two Containers ignores the field."""

from __future__ import annotations

from construct import Int8ul

from lidarspec.spec import hookimpl
from tests.broken.sound import SIZE, frame, make_frame, sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(make_frame(_spare=Int8ul), max_length=SIZE + 8))]
