"""A zero direction that differs from the manual's."""

from __future__ import annotations

import numpy as np

from lidarspec.spec import Polar, hookimpl
from tests.broken import sound


def points(f):
    return Polar(
        f.samples.distance, sound.points(f).azimuth + np.pi / 2, intensity=f.samples.quality
    )


@hookimpl
def lidarspec_sensors():
    return [sound.sensor(points=points)]
