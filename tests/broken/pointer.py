"""Pointer, which reads outside the frame."""

from __future__ import annotations

from construct import Int8ul, Pointer

from lidarspec.spec import hookimpl
from tests.broken.sound import SIZE, frame, make_frame, sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(make_frame(extra=Pointer(200, Int8ul)), max_length=SIZE + 8))]
