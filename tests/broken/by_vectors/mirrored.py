"""A clockwise sensor that is declared counter-clockwise, or the reverse."""

from __future__ import annotations

from lidarspec.spec import Polar, hookimpl
from tests.broken import sound


def points(f):
    return Polar(f.samples.distance, -sound.points(f).azimuth, intensity=f.samples.quality)


@hookimpl
def lidarspec_sensors():
    return [sound.sensor(points=points)]
