"""A scan rule with a field that does not exist."""

from __future__ import annotations

from lidarspec.spec import OnFlag, hookimpl
from tests.broken.sound import sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(scan=OnFlag("new_scan"))]
