"""A second frame type that random values never match, with its own `sweep`."""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import Array, Bytes, Const, Int8ul, Int16ul, Struct

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
    Xor,
)

SAMPLES, LETTERS = 4, 24

DATA = Checksummed(
    Struct(
        "header" / Const(b"\x4e\xe4"),
        "angle" / Scaled(Int16ul, 0.01, "deg"),
        "distances" / Array(SAMPLES, Scaled(Int16ul, 0.001, "m")),
        "check" / Int8ul,
    ),
    field="check",
    algorithm=Xor(),
)
REMARK = Struct("header" / Const(b"\x4e\xe5"), "number" / Int8ul, "text" / Bytes(LETTERS))


def points(f: Fields) -> Polar:
    return Polar(range=f.distances, azimuth=np.deg2rad(f.angle + np.arange(SAMPLES)))


def plausible_remark(f: Fields) -> Any:
    """Return whether a remark consists of letters, then zeros."""
    return (f.text == 0) | ((f.text >= 0x41) & (f.text <= 0x5A))


def sweep_remark(i: int) -> dict[str, Any]:
    return {"text": np.where(np.arange(LETTERS) < i % LETTERS, 0x41 + i % 26, 0)}


SENSOR = Sensor(
    "shape-remarks",
    vendor="Shapes",
    model="Remarks",
    frames={
        "data": Frame(
            DATA,
            data=True,
            max_length=13,
            acknowledged={"LS206": "no line is noisy enough for a shape"},
        ),
        "remark": Frame(
            REMARK, max_length=27, plausible=plausible_remark, simulation=Simulation(sweep_remark)
        ),
    },
    points=points,
    scan=OnWrap("angle"),
    links={"data": Serial(115_200)},
    range_limits=(0.05, 30.0),
    status="manual",
    source="invented for the tests: text that random bytes never are",
)
