"""`configure` does not read an option."""

from __future__ import annotations

from lidarspec.spec import hookimpl
from tests.broken.sound import sensor


def configure(sensor, *, zero="data"):
    return sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(configure=configure)]
