"""Restricted values: permitted numbers, named values, checks and error branches."""

from __future__ import annotations

import numpy as np
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Check,
    Const,
    Error,
    Int8ub,
    Int16ub,
    Int32ub,
    Mapping,
    NoneOf,
    OneOf,
    Struct,
    Switch,
    this,
)

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
)

SAMPLE = Struct(
    "distance" / Scaled(Int16ub, 0.001, "m"),
    "flags" / BitStruct("kind" / OneOf(BitsInteger(2), [1, 2]), "quality" / BitsInteger(6)),
    "strong" / Check(this.flags.quality >= this._.least),
)
DATA = Checksummed(
    Struct(
        "magic" / Const(b"\xd1\x5e\x2c"),
        "version" / OneOf(Int32ub, [0x01000002, 0x01000003]),
        "mode" / Mapping(Int8ub, {"slow": 1, "fast": 4}),
        "least" / NoneOf(Int8ub, [0, *range(32, 256)]),
        "setting"
        / Switch(
            this.mode,
            {"slow": Struct("rate" / Int8ub), "fast": Struct("rate" / Int16ub)},
            default=Error,
        ),
        "angle" / Scaled(Int16ub, 0.01, "deg"),
        "turned" / Check(this.angle < 36_000),
        "samples" / Array(2, SAMPLE),
        "sum" / Int8ub,
    ),
    field="sum",
    algorithm=Sum(8),
)


def points(f: Fields) -> Polar:
    return Polar(
        range=f.samples.distance,
        azimuth=np.deg2rad(f.angle + np.arange(2)),
        intensity=f.samples.flags.quality,
    )


def sweep(i: int) -> dict[str, float]:
    """Return the values of packet i, eighteen packets a turn.

    Fields with restricted values are left out; the simulation uses the first allowed value.
    """
    return {"angle": i * 20.0 % 360, "samples.flags.quality": 40}


SENSOR = Sensor(
    "shape-choices",
    vendor="Shapes",
    model="Choices",
    frames={"data": Frame(DATA, data=True, max_length=20)},
    points=points,
    scan=OnWrap("angle"),
    simulation=Simulation(sweep),
    links={"data": Serial(115_200)},
    range_limits=(0.05, 60.0),
    status="manual",
    source="invented for the tests: what values are allowed",
)
