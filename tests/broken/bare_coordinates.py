"""Coordinates without a unit, and simulated directions in degrees."""

from __future__ import annotations

import numpy as np
from construct import Array, Int8ul, Int16sl, Struct, this

from lidarspec.spec import Cartesian, Every, Simulation, hookimpl
from tests.broken.sound import LONGEST, SIZE, frame, make_frame, sensor, sweep

SAMPLE = Struct("x" / Int16sl, "y" / Int16sl, "quality" / Int8ul)


def points(f):
    return Cartesian(f.samples.x, f.samples.y, 0, intensity=f.samples.quality)


def directions(i):
    return np.linspace(0, 90, LONGEST), 0


@hookimpl
def lidarspec_sensors():
    placed = frame(make_frame(samples=Array(this.count, SAMPLE)), max_length=SIZE + 2 * LONGEST)
    return [
        sensor(
            placed,
            points=points,
            scan=Every(0.1),
            simulation=Simulation(sweep, directions=directions),
        )
    ]
