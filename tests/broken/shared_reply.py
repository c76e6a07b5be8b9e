"""Two commands with the same reply, of which neither compares the code in the reply."""

from __future__ import annotations

from lidarspec.spec import Command, hookimpl
from tests.broken.sound import sensor


@hookimpl
def lidarspec_sensors():
    return [
        sensor(
            commands={
                "start": Command("order", {"code": 1}, reply="ack", starts=True),
                "stop": Command("order", {"code": 2}, reply="ack", stops=True),
            }
        )
    ]
