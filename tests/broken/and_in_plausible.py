"""Uses `and` instead of `&` in `plausible`."""

from __future__ import annotations

from lidarspec.spec import hookimpl
from tests.broken.sound import LONGEST, frame, sensor


def plausible(f):
    return f.count >= 1 and f.count <= LONGEST and f.first < 360


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(plausible=plausible))]
