"""A variable number of samples, given in the header.

The angles are evenly spaced between the first and the last.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import Array, Const, Int8ul, Int16ul, Struct, this

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

LONGEST = 40

DATA = Checksummed(
    Struct(
        "header" / Const(b"\xaa\x55"),
        "count" / Int8ul,
        "first" / Scaled(Int16ul, 0.01, "deg"),
        "last" / Scaled(Int16ul, 0.01, "deg"),
        "samples"
        / Array(this.count, Struct("distance" / Scaled(Int16ul, 0.001, "m"), "quality" / Int8ul)),
        "sum" / Int16ul,
    ),
    field="sum",
    algorithm=Sum(16),
)


def plausible(f: Fields) -> Any:
    return (f.count >= 1) & (f.first < 360) & (f.last < 360)


def points(f: Fields) -> Polar:
    clockwise = spread(f.first, f.last, f.count, full=360.0)
    return Polar(
        range=f.samples.distance, azimuth=-np.deg2rad(clockwise), intensity=f.samples.quality
    )


def sweep(i: int) -> dict[str, float]:
    """Return the values of packet i, nine packets a turn."""
    return dict(count=LONGEST, first=i * 40.0 % 360, last=(i * 40 + 39.0) % 360)


SENSOR = Sensor(
    "shape-count",
    vendor="Shapes",
    model="Count",
    frames={"data": Frame(DATA, data=True, max_length=9 + 3 * LONGEST, plausible=plausible)},
    points=points,
    scan=OnWrap("azimuth"),
    links={"data": Serial(115_200)},
    simulation=Simulation(sweep),
    range_limits=(0.05, 30.0),
    status="manual",
    source="invented for the tests: a variable count",
)
