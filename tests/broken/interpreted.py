"""A field that only construct can read."""

from __future__ import annotations

from construct import Const, Int8ul, RepeatUntil, Struct, obj_

from lidarspec.spec import Frame, hookimpl
from tests.broken.sound import sensor

ACK = Struct("header" / Const(b"\x17\x71\x44\x99"), "name" / RepeatUntil(obj_ == 0, Int8ul))


@hookimpl
def lidarspec_sensors():
    frames = {**sensor().frames, "ack": Frame(ACK, max_length=12)}
    return [sensor(frames=frames, commands={})]
