"""Uses `and` instead of `&` in `points`."""

from __future__ import annotations

import numpy as np

from lidarspec.spec import Polar, hookimpl, spread
from tests.broken.sound import sensor


def points(f):
    degrees = spread(f.first, f.last, f.count, full=360.0)
    good = f.samples.distance > 0.1 and f.samples.quality > 3
    return Polar(np.where(good, f.samples.distance, 0), np.deg2rad(degrees))


@hookimpl
def lidarspec_sensors():
    return [sensor(points=points)]
