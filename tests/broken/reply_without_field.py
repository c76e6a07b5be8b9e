"""A reply that is matched by a field that it does not have."""

from __future__ import annotations

from lidarspec.spec import Command, hookimpl
from tests.broken.sound import sensor


@hookimpl
def lidarspec_sensors():
    return [
        sensor(
            commands={
                "start": Command(
                    "order", {"code": 1}, reply="ack", matches={"mode": 1}, starts=True
                )
            }
        )
    ]
