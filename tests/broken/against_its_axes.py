"""Axes of a manual whose angles run clockwise, and points that run the other way."""

from __future__ import annotations

from lidarspec.spec import hookimpl
from tests.broken import sound


@hookimpl
def lidarspec_sensors():
    return [sound.sensor(vendor_axes=("forward", "right", "up"))]
