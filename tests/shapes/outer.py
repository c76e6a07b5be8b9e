"""An array with its count in the header, outside the array's struct."""

from __future__ import annotations

import numpy as np
from construct import Array, BitsInteger, BitStruct, Const, Int8ul, Int16ul, Struct, this

from lidarspec import Sensor
from lidarspec.spec import Checksummed, Fields, Frame, OnWrap, Polar, Scaled, Serial, Sum

MOST = 15

DATA = Checksummed(
    Struct(
        "sync" / Const(b"\x3c\xc3"),
        "header"
        / BitStruct(
            "version" / BitsInteger(4),
            "size" / BitsInteger(4) * "of the body: an angle and two bytes a distance",
        ),
        "body"
        / Struct(
            "angle" / Scaled(Int8ul, 1, "deg"),
            "distances" / Array(this._.header.size - 1, Scaled(Int16ul, 0.001, "m")),
        ),
        "sum" / Int8ul,
    ),
    field="sum",
    algorithm=Sum(8),
)


def points(f: Fields) -> Polar:
    return Polar(
        range=f.body.distances,
        azimuth=np.deg2rad(f.body.angle + np.arange(f.body.distances.shape[1])),
    )


SENSOR = Sensor(
    "shape-outer",
    vendor="Shapes",
    model="Outer",
    frames={
        "data": Frame(
            DATA,
            data=True,
            max_length=5 + 2 * MOST,
            plausible=lambda f: f.header.size > 0,
            acknowledged={"LS208 points": "the number of points is asked of a column"},
        )
    },
    points=points,
    scan=OnWrap("azimuth"),
    links={"data": Serial(115_200)},
    range_limits=(0.05, 60.0),
    status="manual",
    source="invented for the tests: a count further out",
)
