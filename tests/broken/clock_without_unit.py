"""A clock whose field has no unit of time."""

from __future__ import annotations

from construct import Int16ul

from lidarspec.spec import hookimpl
from tests.broken import sound


@hookimpl
def lidarspec_sensors():
    return [sound.sensor(sound.frame(sound.make_frame(time=Int16ul)))]
