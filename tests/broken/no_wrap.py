"""Angles without a wrap: they run backwards in the packet that crosses 360 degrees."""

from __future__ import annotations

import numpy as np

from lidarspec.spec import Polar, hookimpl, spread
from tests.broken.sound import sensor


def points(f):
    share = spread(f.first * 0, f.first * 0 + 1, f.count, full=1e9)
    return Polar(
        f.samples.distance,
        np.deg2rad(f.first + (f.last - f.first) * share),
        intensity=f.samples.quality,
    )


@hookimpl
def lidarspec_sensors():
    return [sensor(points=points)]
