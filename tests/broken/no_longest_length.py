"""A frame without a maximum length."""

from __future__ import annotations

from lidarspec.spec import Frame, hookimpl
from tests.broken.sound import make_frame, sensor

DATA = Frame(make_frame(), data=True)


@hookimpl
def lidarspec_sensors():
    return [sensor(DATA)]
