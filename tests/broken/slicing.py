"""Slicing, which keeps only some elements."""

from __future__ import annotations

from construct import Array, Int8ul, Slicing

from lidarspec.spec import hookimpl
from tests.broken.sound import SIZE, frame, make_frame, sensor


@hookimpl
def lidarspec_sensors():
    return [
        sensor(frame(make_frame(spare=Slicing(Array(2, Int8ul), 2, 0, 1)), max_length=SIZE + 8))
    ]
