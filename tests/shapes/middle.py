"""A checksum in the middle of the frame: it covers the bytes before and after it."""

from __future__ import annotations

import numpy as np
from construct import Array, Const, Int8ul, Int16ub, Int16ul, Struct

from lidarspec import Sensor
from lidarspec.spec import Checksummed, Fields, Frame, OnWrap, Polar, Scaled, Serial, WordXor

SAMPLES = 4

DATA = Checksummed(
    Struct(
        "header" / Const(b"\x12\x34"),
        "angle" / Scaled(Int16ub, 0.01, "deg"),
        "check" / Int16ul,
        "samples"
        / Array(SAMPLES, Struct("quality" / Int8ul, "distance" / Scaled(Int16ub, 0.0005, "m"))),
    ),
    field="check",
    algorithm=WordXor(head=4, groups=(1, 2)),
)


def points(f: Fields) -> Polar:
    angle = f.angle + np.arange(SAMPLES) * 0.5
    return Polar(
        range=f.samples.distance,
        azimuth=np.deg2rad(angle),
        intensity=f.samples.quality,
        invalid=f.samples.quality == 0,
    )


SENSOR = Sensor(
    "shape-middle",
    vendor="Shapes",
    model="Middle",
    frames={"data": Frame(DATA, data=True, max_length=18, plausible=lambda f: f.angle < 360)},
    points=points,
    scan=OnWrap("angle"),
    links={"data": Serial(115_200)},
    fillers=b"\xfe\xff",
    range_limits=(0.05, 30.0),
    status="manual",
    source="invented for the tests: a checksum in the middle",
)
