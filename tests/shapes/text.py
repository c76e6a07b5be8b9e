"""Lines of text up to a terminator: "$L" angle "," distance "," strength line-feed.

Only construct can parse them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import Adapter, Const, GreedyBytes, NullTerminated, Struct, ValidationError

from lidarspec import Sensor
from lidarspec.spec import Fields, Frame, OnWrap, Polar, Scaled, Serial


class Decimal(Adapter):  # type: ignore[misc]
    """A decimal number as text, without a sign and leading zeros."""

    def _decode(self, obj: bytes, context: Any, path: str) -> int:
        if not obj.isdigit() or str(int(obj)).encode() != obj:
            raise ValidationError("not a decimal number", path=path)
        return int(obj)

    def _encode(self, obj: int, context: Any, path: str) -> bytes:
        return str(obj).encode()


def number(end: bytes) -> Decimal:
    """Return a field with a decimal number up to a terminator."""
    return Decimal(NullTerminated(GreedyBytes, term=end))


DATA = Struct(
    "header" / Const(b"$L"),
    "angle" / Scaled(number(b","), 0.01, "deg"),
    "distance" / Scaled(number(b","), 0.001, "m"),
    "strength" / number(b"\n"),
)


def points(f: Fields) -> Polar:
    return Polar(range=f.distance, azimuth=np.deg2rad(f.angle), intensity=f.strength)


SENSOR = Sensor(
    "shape-text",
    vendor="Shapes",
    model="Text",
    frames={
        "data": Frame(
            DATA,
            data=True,
            max_length=24,
            plausible=lambda f: f.angle < 360,
            acknowledged={"LS116": "numbers in text have no place that a header tells"},
        )
    },
    points=points,
    scan=OnWrap("azimuth"),
    links={"data": Serial(9_600)},
    range_limits=(0.05, 30.0),
    status="manual",
    source="invented for the tests: a terminator",
)
