"""Uses the wall clock for a duration."""

from __future__ import annotations

import time

from lidarspec.spec import Polar, hookimpl
from tests.broken import sound

STARTED = time.time()


def points(f):
    return Polar(f.samples.distance, sound.points(f).azimuth, time=time.time() - STARTED)


@hookimpl
def lidarspec_sensors():
    return [sound.sensor(points=points)]
