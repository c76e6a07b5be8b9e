"""Padding, whose bits come back as zeros."""

from __future__ import annotations

from construct import Padding

from lidarspec.spec import hookimpl
from tests.broken.sound import SIZE, frame, sealed, sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(sealed(spare=Padding(2)), max_length=SIZE + 8))]
