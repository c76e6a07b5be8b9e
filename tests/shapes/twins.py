"""Two frame types with the same magic, different in length and checksum.

If both match, the first declared type is used.
"""

from __future__ import annotations

import numpy as np
from construct import Array, Const, Int8ul, Int16ul, Struct

from lidarspec import Sensor
from lidarspec.spec import Checksummed, Crc, Fields, Frame, OnWrap, Polar, Scaled, Serial, Xor

SAMPLES = 6
MAGIC = b"\x5a\xa5"

DATA = Checksummed(
    Struct(
        "magic" / Const(MAGIC),
        "angle" / Scaled(Int16ul, 0.01, "deg"),
        "distances" / Array(SAMPLES, Scaled(Int16ul, 0.001, "m")),
        "crc" / Int16ul,
    ),
    field="crc",
    algorithm=Crc(16, 0x8005, refin=True, refout=True),
)
INFO = Checksummed(
    Struct(
        "magic" / Const(MAGIC),
        "temperature" / Scaled(Int8ul, 1, "degC", offset=-40),
        "voltage" / Scaled(Int8ul, 1, "V"),
        "check" / Int8ul,
    ),
    field="check",
    algorithm=Xor(),
)


def points(f: Fields) -> Polar:
    return Polar(range=f.distances, azimuth=np.deg2rad(f.angle + np.arange(SAMPLES)))


SENSOR = Sensor(
    "shape-twins",
    vendor="Shapes",
    model="Twins",
    frames={
        "data": Frame(DATA, data=True, max_length=18),
        "info": Frame(INFO, max_length=5, plausible=lambda f: f.voltage < 200),
    },
    points=points,
    scan=OnWrap("angle"),
    links={"data": Serial(115_200)},
    range_limits=(0.05, 30.0),
    status="manual",
    source="invented for the tests: two types with one magic",
)
