"""Degrees where radians are due."""

from __future__ import annotations

from lidarspec.spec import Polar, hookimpl, spread
from tests.broken.sound import sensor


def points(f):
    return Polar(f.samples.distance, spread(f.first, f.last, f.count, full=360.0), intensity=f.samples.quality)


@hookimpl
def lidarspec_sensors():
    return [sensor(points=points)]
