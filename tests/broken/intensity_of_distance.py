"""An intensity that comes from the distance, beside a field for the quality."""

from __future__ import annotations

from dataclasses import replace

from lidarspec.spec import hookimpl
from tests.broken import sound


def points(f):
    return replace(sound.points(f), intensity=f.samples.distance)


@hookimpl
def lidarspec_sensors():
    return [sound.sensor(points=points)]
