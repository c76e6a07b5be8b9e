"""Channels of different lengths, each with its own checksum, that fill their frame.

The header gives the width of their values.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import Array, Const, IfThenElse, Int8ub, Int16ub, Struct, this

from lidarspec import Sensor
from lidarspec.spec import (
    Checksummed,
    Fields,
    Frame,
    OnWrap,
    Parts,
    Polar,
    Scaled,
    Serial,
    Simulation,
    Xor,
    steps,
)

CHANNEL = Checksummed(
    Struct(
        "ring" / Int8ub,
        "count" / Int8ub,
        "distances"
        / Array(this.count, Scaled(IfThenElse(this._.wide == 1, Int16ub, Int8ub), 0.05, "m")),
        "check" / Int8ub,
    ),
    field="check",
    algorithm=Xor(),
)
DATA = Struct(
    "header" / Const(b"\xca\x5c"),
    "wide" / Int8ub,
    "length" / Int16ub * "bytes of all channels",
    "azimuth" / Scaled(Int16ub, 0.01, "deg"),
    "channels" / Parts(CHANNEL, within=this.length),
)


def plausible(f: Fields) -> Any:
    return (f.wide <= 1) & (f.azimuth < 360)


def points(f: Fields) -> Polar:
    return Polar(
        range=f.distances,
        azimuth=np.deg2rad(f.frame.azimuth + steps(f.count)),
        elevation=np.deg2rad(f.ring),
        ring=f.ring,
    )


def sweep(i: int) -> dict[str, Any]:
    """Return the values of packet i, twelve packets a turn.

    The channels have two lengths.
    """
    return dict(
        wide=1,
        azimuth=i * 30.0 % 360,
        channels=[dict(ring=ring, count=20 - 5 * (ring % 2)) for ring in range(3)],
    )


SENSOR = Sensor(
    "shape-channels",
    vendor="Shapes",
    model="Channels",
    frames={
        "data": Frame(
            DATA, data=True, max_length=300, plausible=plausible, points={"channels": points}
        )
    },
    points=None,
    scan=OnWrap("azimuth"),
    links={"data": Serial(230_400)},
    simulation=Simulation(sweep),
    range_limits=(0.1, 40.0),
    status="manual",
    source="invented for the tests: channels of different lengths",
)
