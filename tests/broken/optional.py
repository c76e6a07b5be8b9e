"""Optional, which hides errors in the bytes."""

from __future__ import annotations

from construct import Int8ul, Optional

from lidarspec.spec import hookimpl
from tests.broken.sound import SIZE, frame, sealed, sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(sealed(extra=Optional(Int8ul)), max_length=SIZE + 8))]
