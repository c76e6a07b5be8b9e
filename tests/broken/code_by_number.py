"""A condition on the number of a code, which construct compares by its name."""

from __future__ import annotations

from construct import Const, Enum, If, Int8ul, Struct, this

from lidarspec.spec import Frame, hookimpl
from tests.broken.sound import sensor

STATE = Struct(
    "header" / Const(b"\x17\x71\x44\x99"),
    "mode" / Enum(Int8ul, idle=1, fast=3),
    "speed" / If(this.mode == 3, Int8ul),
)


@hookimpl
def lidarspec_sensors():
    frames = {**sensor().frames, "state": Frame(STATE, max_length=6)}
    return [sensor(frames=frames)]
