"""An intensity computed from the distance, though a quality field exists."""

from __future__ import annotations

from dataclasses import replace

from lidarspec.spec import hookimpl
from tests.broken import sound


def points(f):
    return replace(sound.points(f), intensity=f.samples.distance)


@hookimpl
def lidarspec_sensors():
    return [sound.sensor(points=points)]
