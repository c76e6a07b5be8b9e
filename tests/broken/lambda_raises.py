"""A lambda that raises a KeyError for some headers."""

from __future__ import annotations

from construct import Bytes, Int8ul

from lidarspec.spec import hookimpl
from tests.broken.sound import SIZE, frame, make_frame, sensor

LENGTHS = {1: 1, 2: 2, 3: 3}


@hookimpl
def lidarspec_sensors():
    return [
        sensor(
            frame(
                make_frame(kind=Int8ul, extra=Bytes(lambda this: LENGTHS[this.kind])),
                max_length=SIZE + 4,
            )
        )
    ]
