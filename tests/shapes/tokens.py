"""Text in tokens.

The lines have a constant after any three characters, all kinds of hexadecimal numbers, arrays with
their own counts, and a name that contains a separator.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import (
    Array,
    Bytes,
    Const,
    Enum,
    Float32b,
    If,
    Int8ub,
    Int16sb,
    Int16ub,
    Int32sb,
    Int32ub,
    Struct,
    this,
)

from lidarspec import Sensor
from lidarspec.spec import (
    Clock,
    Fields,
    Frame,
    OnWrap,
    PacketCounter,
    Polar,
    Scaled,
    Simulation,
    Tcp,
    Tokens,
    steps,
)

BEAMS = 30
KIND = np.frombuffer(b"sSN", np.uint8)

SCAN = Struct(
    "kind" / Bytes(3),
    "name" / Const(b"scandata"),
    "counter" / Int16ub,
    "time" / Scaled(Int32ub, 1, "us"),
    "mode" / Enum(Int8ub, steady=0, slow=1),
    "scale" / Float32b,
    "start" / Scaled(Int32sb, 1e-7, "deg"),
    "step" / Scaled(Int16sb, 1e-4, "deg"),
    "count" / Int8ub,
    "ranges" / Array(this.count, Scaled(Int16ub, 0.001, "m")),
    "strengths" / Int8ub,
    "strength" / Array(this.strengths, Int8ub),
    "is_named" / Int8ub,
    "title" / If(this.is_named == 1, Struct("length" / Int8ub, "text" / Bytes(this.length))),
)


def plausible(f: Fields) -> Any:
    return (f.start >= -180.0) & (f.start < 180.0) & (f.step > 0)


def points(f: Fields) -> Polar:
    return Polar(range=f.ranges, azimuth=np.deg2rad(f.start + f.step * steps(f.count)))


def sweep(i: int) -> dict[str, Any]:
    """Return the values of telegram i, twelve a turn."""
    return dict(
        kind=KIND,
        counter=i % 65_536,
        time=i * 5000 % 2**32,
        scale=1.0,
        start=(i * BEAMS) % 360 - 180.0,
        step=1.0,
        count=BEAMS,
    )


SENSOR = Sensor(
    "shape-tokens",
    vendor="Shapes",
    model="Tokens",
    frames={
        "data": Frame(
            SCAN,
            data=True,
            max_length=3000,
            plausible=plausible,
            wire=Tokens(start=b"\x02", sep=b" ", end=b"\x03"),
        )
    },
    points=points,
    scan=OnWrap("azimuth"),
    links={"data": Tcp(2112)},
    clock=Clock("time", wraps_at=2**32 * 1e-6),
    sequence=PacketCounter("counter"),
    simulation=Simulation(sweep),
    range_limits=(0.05, 30.0),
    status="manual",
    source="invented for the tests: text in tokens",
)
