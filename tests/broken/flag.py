"""A Flag on a whole byte, which keeps one bit of the byte."""

from __future__ import annotations

from construct import Flag

from lidarspec.spec import hookimpl
from tests.broken.sound import SIZE, frame, make_frame, sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(make_frame(dirty=Flag), max_length=SIZE + 8))]
