"""int() where round() is meant, in an Adapter."""

from __future__ import annotations

from construct import ExprAdapter, Int16ul

from lidarspec import hookimpl
from tests.broken.sound import SIZE, frame, sealed, sensor

CENTIMETRES = ExprAdapter(Int16ul, lambda value, context: value * 0.01, lambda value, context: int(value / 0.01))


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(sealed(height=CENTIMETRES), max_length=SIZE + 2))]
