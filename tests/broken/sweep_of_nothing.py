"""A sweep that sets a field that the frame does not have."""

from __future__ import annotations

from lidarspec.spec import Simulation, hookimpl
from tests.broken import sound


def sweep(i):
    return {**sound.sweep(i), "speed": 10}


@hookimpl
def lidarspec_sensors():
    return [sound.sensor(simulation=Simulation(sweep))]
