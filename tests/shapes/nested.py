"""A nested checksum: the header has one, and the frame another over named fields."""

from __future__ import annotations

import numpy as np
from construct import Array, Bytes, Const, Int8ub, Int16ub, Int32ub, Struct

from lidarspec import Sensor
from lidarspec.spec import Checksummed, Crc, Fields, Frame, OnWrap, Polar, Scaled, Serial, Sum

SAMPLES = 3

HEADER = Checksummed(
    Struct(
        "magic" / Const(0xC0DE, Int16ub), "angle" / Scaled(Int16ub, 0.01, "deg"), "sum" / Int8ub
    ),
    field="sum",
    algorithm=Sum(8),
)
DATA = Checksummed(
    Struct(
        "header" / HEADER,
        "distances" / Array(SAMPLES, Scaled(Int16ub, 0.001, "m")),
        "serial" / Bytes(3),
        "crc" / Int32ub,
        "trailer" / Const(b"\x0d\x0a"),
    ),
    field="crc",
    over=("header", "distances"),
    algorithm=Crc(
        32, 0x04C11DB7, init=0xFFFFFFFF, refin=True, refout=True, xorout=0xFFFFFFFF, order="big"
    ),
)


def points(f: Fields) -> Polar:
    return Polar(range=f.distances, azimuth=-np.deg2rad(f.header.angle + np.arange(SAMPLES) * 0.25))


SENSOR = Sensor(
    "shape-nested",
    vendor="Shapes",
    model="Nested",
    frames={
        "data": Frame(
            DATA,
            data=True,
            max_length=20,
            acknowledged={"LS205 serial": "`over` is what the shape is about"},
        )
    },
    points=points,
    scan=OnWrap("header.angle"),
    links={"data": Serial(230_400)},
    range_limits=(0.05, 60.0),
    status="manual",
    source="invented for the tests: a nested checksum",
)
