"""GreedyBytes, which also reads the frames that follow."""

from __future__ import annotations

from construct import GreedyBytes

from lidarspec.spec import hookimpl
from tests.broken.sound import SIZE, frame, make_frame, sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(make_frame(extra=GreedyBytes), max_length=SIZE + 8))]
