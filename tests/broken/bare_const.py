"""A command that is a Const without a Struct around it."""

from __future__ import annotations

from construct import Const

from lidarspec.spec import Command, Frame, hookimpl
from tests.broken.sound import sensor

PLAIN = sensor()
FRAMES = {**PLAIN.frames, "order": Frame(Const(b"\x16\x61\x01\x76"), direction="out", max_length=4)}


@hookimpl
def lidarspec_sensors():
    return [sensor(frames=FRAMES, commands={"start": Command("order", reply="ack", starts=True)})]
