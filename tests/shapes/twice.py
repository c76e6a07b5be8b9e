"""Two checksums around one struct, each with its own field.

One covers a whole bit block and the angle, the other all other fields.
"""

from __future__ import annotations

import numpy as np
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Const,
    If,
    Int8ub,
    Int16ub,
    Int16ul,
    Struct,
    this,
)

from lidarspec import Sensor
from lidarspec.spec import Checksummed, Crc, Fields, Frame, OnWrap, Polar, Scaled, Serial, Xor

SAMPLES = 3

FIELDS = Struct(
    "magic" / Const(b"\x2a\x2b"),
    "status" / BitStruct("marked" / BitsInteger(1), "speed" / BitsInteger(7)),
    "angle" / Scaled(Int16ub, 0.01, "deg"),
    "check" / Int8ub,
    "mark"
    / If(this.status.marked == 1, BitStruct("kind" / BitsInteger(4), "level" / BitsInteger(4))),
    "distances" / Array(SAMPLES, Scaled(Int16ul, 0.001, "m")),
    "crc" / Int16ul,
)
DATA = Checksummed(
    Checksummed(FIELDS, "check", Xor(), over=("status", "angle")), "crc", Crc(16, 0x1021)
)


def points(f: Fields) -> Polar:
    return Polar(range=f.distances, azimuth=np.deg2rad(f.angle + np.arange(SAMPLES)))


SENSOR = Sensor(
    "shape-twice",
    vendor="Shapes",
    model="Twice",
    frames={"data": Frame(DATA, data=True, max_length=15, plausible=lambda f: f.angle < 360)},
    points=points,
    scan=OnWrap("angle"),
    links={"data": Serial(115_200)},
    range_limits=(0.05, 60.0),
    status="manual",
    source="invented for the tests: two checksums around one struct",
)
