"""A sweep that returns a raw number of steps where degrees are expected."""

from __future__ import annotations

from lidarspec.spec import Simulation, hookimpl
from tests.broken import sound


def sweep(i):
    return {**sound.sweep(i), "tilt": -500 + i * 100}  # hundredths of a degree


@hookimpl
def lidarspec_sensors():
    return [sound.sensor(simulation=Simulation(sweep))]
