"""Pickled, which runs code from the wire."""

from __future__ import annotations

from construct import Pickled

from lidarspec.spec import hookimpl
from tests.broken.sound import SIZE, frame, sealed, sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(sealed(extra=Pickled), max_length=SIZE + 8))]
