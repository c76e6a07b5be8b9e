"""GreedyBytes, which takes the next frames along."""

from __future__ import annotations

from construct import GreedyBytes

from lidarspec.spec import hookimpl
from tests.broken.sound import SIZE, frame, sealed, sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(sealed(extra=GreedyBytes), max_length=SIZE + 8))]
