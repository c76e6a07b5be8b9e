"""Angles without a wrap, and a sweep in which no packet crosses 360 degrees."""

from __future__ import annotations

from lidarspec.spec import Simulation, hookimpl
from tests.broken import sound
from tests.broken.no_wrap import points
from tests.broken.sound import sensor


def sweep(i):
    first = i % 10 * 36.0
    return {**sound.sweep(i), "first": first, "last": first + 34.5}


@hookimpl
def lidarspec_sensors():
    return [sensor(points=points, simulation=Simulation(sweep))]
