"""Scans that end by a field that is not there."""

from __future__ import annotations

from lidarspec.spec import OnFlag, hookimpl
from tests.broken.sound import sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(scan=OnFlag("new_scan"))]
