"""A weak frame of five bytes: a start bit, its inverse and a check bit.

At least three weak frames must follow one another. The info frame has a checksum and is declared
first. Its bytes would also match as a weak frame, but it ends a run of weak frames.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import BitsInteger, BitStruct, ByteSwapped, Const, Int8ul, Int16ul, Struct

from lidarspec import Sensor
from lidarspec.spec import Checksummed, Fields, Frame, OnFlag, Polar, Scaled, Serial, Sum

DATA = Struct(
    "head"
    / BitStruct("quality" / BitsInteger(6), "inverse" / BitsInteger(1), "start" / BitsInteger(1)),
    "beam"
    / ByteSwapped(
        BitStruct("angle" / Scaled(BitsInteger(15), 1 / 64, "deg"), "check" / BitsInteger(1))
    ),
    "distance" / Scaled(Int16ul, 0.00025, "m"),
)
INFO = Checksummed(
    Struct(
        "header" / Const(b"\x3e\x01"),
        "revision" / Int8ul,
        "temperature" / Scaled(Int8ul, 1, "degC"),
        "sum" / Int8ul,
    ),
    field="sum",
    algorithm=Sum(8),
)


def plausible(f: Fields) -> Any:
    return (f.head.start != f.head.inverse) & (f.beam.check == 1) & (f.beam.angle < 360)


def points(f: Fields) -> Polar:
    return Polar(range=f.distance, azimuth=-np.deg2rad(f.beam.angle), intensity=f.head.quality)


SENSOR = Sensor(
    "shape-weak",
    vendor="Shapes",
    model="Weak",
    frames={
        "info": Frame(INFO, max_length=5),
        "data": Frame(
            DATA,
            data=True,
            max_length=5,
            plausible=plausible,
            confirm=3,
            acknowledged={"LS212": "one bit, held by `plausible`"},
        ),
    },
    points=points,
    scan=OnFlag("head.start"),
    links={"data": Serial(115_200)},
    range_limits=(0.15, 16.0),
    status="manual",
    source="invented for the tests: a weak frame",
)
