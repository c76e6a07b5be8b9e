"""A `plausible` test that random frames never pass, without a sweep."""

from __future__ import annotations

from lidarspec.spec import Simulation, hookimpl
from tests.broken.sound import frame, sensor


def plausible(f):
    return (f.first == 123.45) & (f.last == 234.56) & (f.time == 1.234)


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(plausible=plausible), simulation=Simulation())]
