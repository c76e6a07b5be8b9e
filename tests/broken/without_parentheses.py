"""Comparisons joined by `&` without parentheses: Python evaluates `&` first."""

from __future__ import annotations

from lidarspec.spec import hookimpl
from tests.broken.sound import frame, sensor


def plausible(f):
    return f.first < 360 & f.last < 360


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(plausible=plausible))]
