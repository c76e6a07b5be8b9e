"""A `points` function that depends on the previous batch."""

from __future__ import annotations

from lidarspec.spec import Polar, hookimpl
from tests.broken import sound

SEEN = []


def points(f):
    SEEN.append(1)
    found = sound.points(f)
    return Polar(found.range, found.azimuth, time=0.001 * len(SEEN))


@hookimpl
def lidarspec_sensors():
    return [sound.sensor(points=points)]
