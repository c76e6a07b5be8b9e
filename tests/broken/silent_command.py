"""A documented reply that the simulated sensor does not give."""

from __future__ import annotations

from lidarspec import Command, hookimpl
from tests.broken.sound import sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(commands={"start": Command("order", {"code": 1}, reply="ack", answers=(), starts=True)})]
