"""A sum at the end of the frame that is read, and never checked."""

from __future__ import annotations

from lidarspec.spec import hookimpl
from tests.broken import sound


@hookimpl
def lidarspec_sensors():
    return [sound.sensor(sound.frame(sound.struct()))]
