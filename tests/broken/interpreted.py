"""A field that only construct can read."""

from __future__ import annotations

from construct import Const, ExprAdapter, Int8ul, Struct

from lidarspec.spec import Frame, hookimpl
from tests.broken.sound import sensor

WHITENED = ExprAdapter(
    Int8ul, lambda value, context: value ^ 0x55, lambda value, context: value ^ 0x55
)


ACK = Struct("header" / Const(b"\x17\x71\x44\x99"), "name" / WHITENED)


@hookimpl
def lidarspec_sensors():
    frames = {**sensor().frames, "ack": Frame(ACK, max_length=5)}
    return [sensor(frames=frames, commands={})]
