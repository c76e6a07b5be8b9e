"""A table of 360 entries that is indexed by an angle of 360.0 degrees."""

from __future__ import annotations

import numpy as np

from lidarspec.spec import Polar, hookimpl, spread, take
from tests.broken.sound import LONGEST, WRAP, frame, sensor

OFFSETS = np.full(360, 0.25)  # degrees


def plausible(f):
    return (
        (f.count >= 1) & (f.count <= LONGEST) & (f.first <= 360) & (f.last <= 360) & (f.time < WRAP)
    )


def points(f):
    degrees = spread(f.first, f.last, f.count, full=360.0) + take(OFFSETS, np.floor(f.first))
    return Polar(f.samples.distance, np.deg2rad(degrees), intensity=f.samples.quality)


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(plausible=plausible), points=points)]
