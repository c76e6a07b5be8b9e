"""Pickled, which runs code from the wire."""

from __future__ import annotations

from construct import Pickled

from lidarspec.spec import hookimpl
from tests.broken.sound import SIZE, frame, make_frame, sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(make_frame(extra=Pickled), max_length=SIZE + 8))]
