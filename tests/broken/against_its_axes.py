"""The manual's angles run clockwise, but the points run counter-clockwise."""

from __future__ import annotations

from lidarspec.spec import hookimpl
from tests.broken import sound


@hookimpl
def lidarspec_sensors():
    return [sound.sensor(vendor_axes=("forward", "right", "up"))]
