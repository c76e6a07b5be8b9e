"""GreedyRange, which has no end on a stream."""

from __future__ import annotations

from construct import GreedyRange, Struct

from lidarspec.spec import hookimpl
from tests.broken.sound import SIZE, frame, make_frame, sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(make_frame(extra=GreedyRange(Struct())), max_length=SIZE + 8))]
