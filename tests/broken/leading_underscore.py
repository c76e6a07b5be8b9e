"""A name with a leading underscore, which == ignores."""

from __future__ import annotations

from construct import Int8ul

from lidarspec.spec import hookimpl
from tests.broken.sound import SIZE, frame, sealed, sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(sealed(_spare=Int8ul), max_length=SIZE + 8))]
