"""Two related lengths: the frame's follows from the samples' and is always computed."""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import Array, Const, Int8ub, Int16ub, Rebuild, Struct, this

from lidarspec import Sensor
from lidarspec.spec import (
    Checksummed,
    Fields,
    Frame,
    OnWrap,
    Polar,
    Scaled,
    Serial,
    Simulation,
    Sum,
    spread,
)

LONGEST = 30

DATA = Checksummed(
    Struct(
        "header" / Const(b"\xab"),
        "length" / Rebuild(Int16ub, this.size + 5) * "all bytes before the sum",
        "size" / Int16ub * "bytes of the angle and the samples",
        "angle" / Scaled(Int16ub, 0.01, "deg"),
        "samples"
        / Array(
            (this.size - 2) // 3,
            Struct("quality" / Int8ub, "distance" / Scaled(Int16ub, 0.001, "m")),
        ),
        "sum" / Int16ub,
    ),
    field="sum",
    algorithm=Sum(16),
)


def plausible(f: Fields) -> Any:
    return (f.angle < 360) & (f.length == f.size + 5) & (f.size % 3 == 2)


def points(f: Fields) -> Polar:
    count = (f.size - 2) / 3
    return Polar(
        range=f.samples.distance,
        azimuth=np.deg2rad(spread(f.angle, f.angle + 20 - 20 / count, count, full=360.0)),
    )


def sweep(i: int) -> dict[str, float]:
    """Return the values of packet i, eighteen packets a turn, of different lengths."""
    return dict(size=2 + 3 * (LONGEST - i % 4), angle=i * 20.0 % 360)


SENSOR = Sensor(
    "shape-sized",
    vendor="Shapes",
    model="Sized",
    frames={"data": Frame(DATA, data=True, max_length=9 + 3 * LONGEST, plausible=plausible)},
    points=points,
    scan=OnWrap("azimuth"),
    links={"data": Serial(115_200)},
    simulation=Simulation(sweep),
    range_limits=(0.05, 30.0),
    status="manual",
    source="invented for the tests: a length that follows from another",
)
