"""A field that only construct can read."""

from __future__ import annotations

from construct import ExprAdapter, Int8ul

from lidarspec import hookimpl
from tests.broken.sound import SIZE, frame, sealed, sensor

WHITENED = ExprAdapter(Int8ul, lambda value, context: value ^ 0x55, lambda value, context: value ^ 0x55)


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(sealed(name=WHITENED), max_length=SIZE + 1))]
