"""Floats, 64-bit integers, reserved bytes that are kept, and unset checksums."""

from __future__ import annotations

import numpy as np
from construct import (
    Array,
    Bytes,
    Const,
    Float32b,
    Float64l,
    Int8ul,
    Int16sl,
    Int16ul,
    Int32sb,
    Int64sb,
    Int64ul,
    Struct,
)

from lidarspec import Sensor
from lidarspec.spec import Checksummed, Clock, Crc, Fields, Frame, OnWrap, Polar, Scaled, Serial

SAMPLES = 3

DATA = Checksummed(
    Struct(
        "header" / Const(b"\xf1\x0a\x7d"),
        "reserved" / Bytes(3),
        "stamp" / Scaled(Int64ul, 1e-9, "s"),
        "serial" / Int64sb,
        "offset" / Int32sb,
        "azimuth" / Scaled(Float64l, 1, "rad"),
        "samples"
        / Array(
            SAMPLES,
            Struct(
                "range" / Scaled(Float32b, 1, "m"),
                "elevation" / Scaled(Int16sl, 0.01, "deg"),
                "spare" / Int8ul,
            ),
        ),
        "crc" / Int16ul,
    ),
    field="crc",
    algorithm=Crc(16, 0x1021, init=0xFFFF),
    absent=(0, 0xFFFF),
)


def points(f: Fields) -> Polar:
    """Return points; a range of nan stays nan, and a direction of nan is invalid."""
    return Polar(
        range=f.samples.range, azimuth=f.azimuth, elevation=np.deg2rad(f.samples.elevation)
    )


SENSOR = Sensor(
    "shape-numbers",
    vendor="Shapes",
    model="Numbers",
    frames={"data": Frame(DATA, data=True, max_length=57)},
    points=points,
    scan=OnWrap("azimuth"),
    links={"data": Serial(921_600)},
    clock=Clock("stamp"),
    range_limits=(0.1, 10.0),
    status="manual",
    source="invented for the tests: floats, 64-bit integers, reserved bytes and absent checksums",
)
