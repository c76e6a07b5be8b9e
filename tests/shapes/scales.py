"""Distances scaled, rotated and raised by floating-point fields of the header.

One far point is a float.
"""

from __future__ import annotations

import numpy as np
from construct import Array, Const, Float32b, Float64b, Int16ub, Struct

from lidarspec import Sensor
from lidarspec.spec import (
    Checksummed,
    Crc,
    Fields,
    Frame,
    OnWrap,
    Polar,
    Scaled,
    Serial,
    Simulation,
)

SAMPLES, STEP = 6, 1.5

DATA = Checksummed(
    Struct(
        "sync" / Const(b"\x02\x73"),
        "scale" / Float32b * "stretches all distances",
        "start" / Scaled(Float32b, 1, "deg"),
        "tilt" / Scaled(Float64b, 1, "rad"),
        "distances" / Array(SAMPLES, Scaled(Int16ub, 0.001, "m")),
        "strengths" / Array(SAMPLES, Float32b),
        "crc" / Int16ub,
    ),
    field="crc",
    algorithm=Crc(16, 0x8005),
)


def points(f: Fields) -> Polar:
    angles = np.deg2rad(f.start + STEP * np.arange(SAMPLES))
    return Polar(f.distances * f.scale, angles, f.tilt, intensity=f.strengths.on("distances") * 0.5)


def sweep(i: int) -> dict[str, float]:
    """Return the values of packet i, forty packets a turn."""
    return dict(scale=2.0, start=i * SAMPLES * STEP % 360, tilt=0.1)


SENSOR = Sensor(
    "shape-scales",
    vendor="Shapes",
    model="Scales",
    frames={"data": Frame(DATA, data=True, plausible=lambda f: (f.start >= 0) & (f.start < 360))},
    points=points,
    scan=OnWrap("azimuth"),
    links={"data": Serial(921_600)},
    simulation=Simulation(sweep),
    range_limits=(0.1, 100.0),
    status="manual",
    source="invented for the tests: a floating-point scale",
)
