"""A counter that starts again at 100, compared with < as if it went on to 255."""

from __future__ import annotations

from lidarspec.spec import Simulation, hookimpl
from tests.broken import sound


def sweep(i):
    return {**sound.sweep(i), "number": i % 100}


@hookimpl
def lidarspec_sensors():
    return [sound.sensor(simulation=Simulation(sweep))]
