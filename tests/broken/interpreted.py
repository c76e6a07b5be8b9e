"""A field that only construct can read."""

from __future__ import annotations

from construct import GreedyBytes, NullTerminated

from lidarspec import hookimpl
from tests.broken.sound import SIZE, frame, sealed, sensor

TEXT = NullTerminated(GreedyBytes)


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(sealed(name=TEXT), max_length=SIZE + 16))]
