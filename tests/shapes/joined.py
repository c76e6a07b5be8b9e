"""Lines of steps with one to three echoes each, joined by a separator.

Distance and strength are characters of six bits each.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import Array, Const, Int8ub, Int16ub, Int24ub, Struct, this

from lidarspec import Sensor
from lidarspec.spec import (
    Clock,
    Echoes,
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
)

ECHOES, BEAMS = 3, 30

ECHO = Struct("range" / Scaled(Int24ub, 0.001, "m"), "strength" / Int16ub)
DATA = Struct(
    "command" / Const(b"NE"),
    "tens" / Int8ub * "decimal digits of the number of steps",
    "ones" / Int8ub,
    "time" / Scaled(Int16ub, 10, "ms"),
    "sector" / Scaled(Int8ub, 40, "deg"),
    "steps" / Array(this.tens * 10 + this.ones, Struct("echoes" / Array(ECHOES, ECHO))),
)


def plausible(f: Fields) -> Any:
    return (f.tens < 10) & (f.ones < 10) & (f.sector < 360)


def points(f: Fields) -> Polar:
    return Polar(
        range=f.steps.echoes.range,
        azimuth=np.deg2rad(f.sector + f.steps.index),
        intensity=f.steps.echoes.strength,
        return_index=np.arange(ECHOES),
    )


def sweep(i: int) -> dict[str, Any]:
    """Return the values of packet i, nine sectors a turn."""
    return dict(tens=BEAMS // 10, ones=0, time=i % 2**12, sector=i % 9 * 40)


SENSOR = Sensor(
    "shape-joined",
    vendor="Shapes",
    model="Joined",
    frames={
        "data": Frame(
            DATA,
            data=True,
            max_length=900,
            plausible=plausible,
            wire=Lines(32, head=(4, 3), bare=1, check=Scip()) | SixBits(echoes=Echoes(5, ECHOES)),
        )
    },
    points=points,
    scan=OnWrap("azimuth"),
    links={"data": Tcp(10_940)},
    clock=Clock("time", wraps_at=2**12 * 10e-3),
    simulation=Simulation(sweep),
    range_limits=(0.05, 30.0),
    status="manual",
    source="invented for the tests: steps with echoes in lines of characters of six bits",
)
