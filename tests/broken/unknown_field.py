"""A command that sets a field that its frame does not have."""

from __future__ import annotations

from lidarspec.spec import Command, hookimpl
from tests.broken.sound import sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(commands={"start": Command("order", {"mode": 1}, reply="ack", starts=True)})]
