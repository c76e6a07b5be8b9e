"""Divides by count - 1, which is 0 for frames with one sample."""

from __future__ import annotations

import numpy as np

from lidarspec.spec import Polar, hookimpl, spread
from tests.broken.sound import sensor


def points(f):
    step = (f.last - f.first) % 360 / (f.count - 1)
    place = spread(f.count * 0, f.count - 1, f.count, full=1e9)
    return Polar(
        f.samples.distance, np.deg2rad(f.first + place * step), intensity=f.samples.quality
    )


@hookimpl
def lidarspec_sensors():
    return [sensor(points=points)]
