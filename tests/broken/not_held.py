"""A length computed from another field, which parsing does not verify."""

from __future__ import annotations

from construct import Int16ul, Rebuild, this

from lidarspec.spec import hookimpl
from tests.broken.sound import FIELDS, SIZE, frame, make_frame, sensor


@hookimpl
def lidarspec_sensors():
    return [
        sensor(
            frame(
                make_frame(count=FIELDS["count"], length=Rebuild(Int16ul, this.count * 3 + 17)),
                max_length=SIZE + 2,
            )
        )
    ]
