"""A header that differs from the manual's."""

from __future__ import annotations

from construct import Const

from lidarspec.spec import hookimpl
from tests.broken.sound import frame, make_frame, sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(make_frame(header=Const(b"\xaa\x55\xc4"))))]
