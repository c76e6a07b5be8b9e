"""A sweep that returns one value more than the array of its field has."""

from __future__ import annotations

import numpy as np

from lidarspec.spec import Simulation, hookimpl
from tests.broken import sound


def sweep(i):
    return {**sound.sweep(i), "samples.quality": np.arange(sound.LONGEST + 1)}


@hookimpl
def lidarspec_sensors():
    return [sound.sensor(simulation=Simulation(sweep))]
