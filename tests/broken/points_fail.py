"""A `points` function with a misspelt field."""

from __future__ import annotations

from lidarspec.spec import Polar, hookimpl
from tests.broken.sound import sensor


def points(f):
    return Polar(f.samples.distnace, 0)


@hookimpl
def lidarspec_sensors():
    return [sensor(points=points)]
