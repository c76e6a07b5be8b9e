"""Compares a counter that wraps at 100 as if it wrapped at 256."""

from __future__ import annotations

from lidarspec.spec import Simulation, hookimpl
from tests.broken import sound


def sweep(i):
    return {**sound.sweep(i), "number": i % 100}


@hookimpl
def lidarspec_sensors():
    return [sound.sensor(simulation=Simulation(sweep))]
