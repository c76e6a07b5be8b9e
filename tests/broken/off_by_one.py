"""Spreads angles over one step fewer than there are samples."""

from __future__ import annotations

import numpy as np

from lidarspec.spec import Polar, hookimpl, spread
from tests.broken.sound import sensor


def points(f):
    return Polar(
        f.samples.distance,
        np.deg2rad(spread(f.first, f.last, f.count - 1, full=360.0)),
        intensity=f.samples.quality,
    )


@hookimpl
def lidarspec_sensors():
    return [sensor(points=points)]
