"""`plausible` with construct's `this`, an expression that is always true."""

from __future__ import annotations

from construct import this

from lidarspec.spec import hookimpl
from tests.broken.sound import frame, sensor


def plausible(f):
    return this.first == this.last


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(plausible=plausible))]
