"""A checksum in two nibbles, low bits first, in bytes that contain other bits."""

from __future__ import annotations

import numpy as np
from construct import Array, BitsInteger, BitStruct, Const, Int16ul, Struct

from lidarspec import Sensor
from lidarspec.spec import Checksummed, Fields, Frame, OnWrap, Polar, Scaled, Serial, Xor

SAMPLES = 5

DATA = Checksummed(
    Struct(
        "first" / BitStruct("sync" / Const(0xA, BitsInteger(4)), "check" / BitsInteger(4)),
        "second" / BitStruct("sync" / Const(0x5, BitsInteger(4)), "check" / BitsInteger(4)),
        "angle" / Scaled(Int16ul, 1 / 64, "deg"),
        "distances" / Array(SAMPLES, Scaled(Int16ul, 0.002, "m")),
    ),
    field=("first.check", "second.check"),
    algorithm=Xor(),
)


def points(f: Fields) -> Polar:
    return Polar(range=f.distances, azimuth=np.deg2rad(f.angle + np.arange(SAMPLES)))


SENSOR = Sensor(
    "shape-nibbles",
    vendor="Shapes",
    model="Nibbles",
    frames={"data": Frame(DATA, data=True, max_length=14, plausible=lambda f: f.angle < 360)},
    points=points,
    scan=OnWrap("azimuth"),
    links={"data": Serial(115_200)},
    range_limits=(0.1, 40.0),
    status="manual",
    source="invented for the tests: a checksum in two nibbles",
)
