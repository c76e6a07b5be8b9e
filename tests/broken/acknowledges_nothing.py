"""Acknowledges a finding that `check` does not report."""

from __future__ import annotations

from lidarspec.spec import hookimpl
from tests.broken.sound import sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(acknowledged={"LS202": "the manual is secret"})]
