"""Uses int() instead of round() in an Adapter."""

from __future__ import annotations

from construct import Const, ExprAdapter, Int16ul, Struct

from lidarspec.spec import Frame, hookimpl
from tests.broken.sound import sensor

CENTIMETRES = ExprAdapter(
    Int16ul, lambda value, context: value * 0.01, lambda value, context: int(value / 0.01)
)


ACK = Struct("header" / Const(b"\x17\x71\x44\x99"), "height" / CENTIMETRES)


@hookimpl
def lidarspec_sensors():
    frames = {**sensor().frames, "ack": Frame(ACK, max_length=6)}
    return [sensor(frames=frames, commands={})]
