"""Degrees instead of radians, in a function that is bound with partial."""

from __future__ import annotations

from functools import partial

from lidarspec.spec import Polar, hookimpl, spread
from tests.broken.sound import sensor


def points(f, full):
    return Polar(
        f.samples.distance, spread(f.first, f.last, f.count, full=full), intensity=f.samples.quality
    )


@hookimpl
def lidarspec_sensors():
    return [sensor(points=partial(points, full=360.0))]
