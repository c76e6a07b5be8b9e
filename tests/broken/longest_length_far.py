"""A maximum length that is far longer than any frame."""

from __future__ import annotations

from lidarspec.spec import hookimpl
from tests.broken.sound import frame, sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(max_length=100_000))]
