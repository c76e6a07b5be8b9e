"""Two sensors with the same id."""

from __future__ import annotations

from lidarspec.spec import hookimpl
from tests.broken.sound import sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(), sensor()]
