"""Lines of text with a check character each.

Numbers are characters of six bits. Decimal digits give their count.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import Array, Const, Int8ub, Int24ub, Int32ub, Struct, this

from lidarspec import Sensor
from lidarspec.spec import (
    Clock,
    Fields,
    Frame,
    Lines,
    OnWrap,
    Polar,
    Scaled,
    Scip,
    Simulation,
    SixBits,
    Tcp,
    steps,
)

BEAMS = 40

DATA = Struct(
    "command" / Const(b"MD"),
    "tens" / Int8ub * "decimal digits of the number of ranges",
    "ones" / Int8ub,
    "status" / Const(b"99"),
    "time" / Scaled(Int32ub, 1, "ms"),
    "sector" / Scaled(Int8ub, 40, "deg"),
    "ranges" / Array(this.tens * 10 + this.ones, Scaled(Int24ub, 0.001, "m")),
)


def plausible(f: Fields) -> Any:
    return (f.tens < 10) & (f.ones < 10) & (f.sector < 360)


def points(f: Fields) -> Polar:
    return Polar(range=f.ranges, azimuth=np.deg2rad(f.sector + steps(f.tens * 10 + f.ones)))


def sweep(i: int) -> dict[str, Any]:
    """Return the values of packet i, nine sectors a turn."""
    return dict(tens=BEAMS // 10, ones=0, time=i * 10 % 2**24, sector=i % 9 * 40)


SENSOR = Sensor(
    "shape-lines",
    vendor="Shapes",
    model="Lines",
    frames={
        "data": Frame(
            DATA,
            data=True,
            max_length=400,
            plausible=plausible,
            wire=Lines(64, head=(4, 2, 4), bare=1, check=Scip()) | SixBits(),
        )
    },
    points=points,
    scan=OnWrap("azimuth"),
    links={"data": Tcp(10_940)},
    clock=Clock("time", wraps_at=2**24 * 1e-3),
    simulation=Simulation(sweep),
    range_limits=(0.05, 30.0),
    status="manual",
    source="invented for the tests: lines of characters of six bits",
)
