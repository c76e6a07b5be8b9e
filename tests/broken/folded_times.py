"""Computes times with `spread`, which folds full revolutions: each time is 0."""

from __future__ import annotations

import numpy as np

from lidarspec.spec import Polar, hookimpl, spread
from tests.broken.sound import sensor


def points(f):
    degrees = spread(f.first, f.last, f.count, full=360.0)
    return Polar(
        f.samples.distance,
        np.deg2rad(degrees),
        time=spread(0, f.count - 1, f.count, full=1.0) / 4000,
    )


@hookimpl
def lidarspec_sensors():
    return [sensor(points=points)]
