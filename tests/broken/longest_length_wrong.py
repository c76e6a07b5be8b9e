"""A maximum length that differs from the frame's."""

from __future__ import annotations

from lidarspec.spec import Frame, hookimpl
from tests.broken.sound import ACK, sensor

PLAIN = sensor()


@hookimpl
def lidarspec_sensors():
    return [
        sensor(
            frames={**PLAIN.frames, "ack": Frame(ACK, max_length=8, plausible=lambda f: f.code < 8)}
        )
    ]
