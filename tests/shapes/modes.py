"""Frame types selected by a descriptor.

The same bytes have one of two types, depending on the last descriptor.
"""

from __future__ import annotations

import numpy as np
from construct import Array, BitsInteger, BitStruct, Const, Int8ul, Int16ul, Struct

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

SAMPLES = 4

PLAIN = Checksummed(
    Struct(
        "sync" / Const(b"\xa5"),
        "angle" / Scaled(Int16ul, 0.01, "deg"),
        "distance" / Scaled(Int16ul, 0.001, "m"),
        "sum" / Int8ul,
    ),
    field="sum",
    algorithm=Sum(8),
)
EXPRESS = Checksummed(
    Struct(
        "sync" / Const(b"\xa5"),
        "head" / BitStruct("start" / BitsInteger(1), "turn" / BitsInteger(7)),
        "angle" / Scaled(Int16ul, 0.01, "deg"),
        "distances" / Array(SAMPLES, Scaled(Int16ul, 0.001, "m")),
        "sum" / Int8ul,
    ),
    field="sum",
    algorithm=Sum(8),
)


def plain(f: Fields) -> Polar:
    return Polar(range=f.distance, azimuth=np.deg2rad(f.angle))


def express(f: Fields) -> Polar:
    return Polar(range=f.distances, azimuth=np.deg2rad(f.angle + np.arange(SAMPLES)))


def sweep_plain(i: int) -> dict[str, float]:
    return {"angle": i * 2 % 360}


def sweep_express(i: int) -> dict[str, float]:
    return {"angle": i * SAMPLES % 360, "head.turn": i * SAMPLES // 360 % 128}


SENSOR = Sensor(
    "shape-modes",
    vendor="Shapes",
    model="Modes",
    frames={
        "begin_plain": Frame(Struct("descriptor" / Const(b"\xa5\x5a\x05\x81")), max_length=4),
        "begin_express": Frame(Struct("descriptor" / Const(b"\xa5\x5a\x54\x82")), max_length=4),
        "plain": Frame(
            PLAIN,
            data=True,
            points=plain,
            max_length=6,
            plausible=lambda f: f.angle < 360,
            after="begin_plain",
            simulation=Simulation(sweep_plain),
        ),
        "express": Frame(
            EXPRESS,
            data=True,
            points=express,
            max_length=13,
            plausible=lambda f: f.angle < 360,
            after="begin_express",
            simulation=Simulation(sweep_express),
        ),
    },
    points=None,
    scan=OnWrap("azimuth"),
    links={"data": Serial(115_200)},
    range_limits=(0.05, 30.0),
    status="manual",
    source="invented for the tests: frame types that a descriptor switches",
)
