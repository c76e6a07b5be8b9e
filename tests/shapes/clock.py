"""A clock that wraps after a minute, as the sum of two fields; its time cuts scans."""

from __future__ import annotations

import numpy as np
from construct import Array, Const, Int8ul, Int16ul, Struct

from lidarspec import Sensor
from lidarspec.spec import Checksummed, Clock, Every, Fields, Frame, Polar, Scaled, Serial, Sum

SAMPLES = 4

DATA = Checksummed(
    Struct(
        "header" / Const(b"\xc1\x0c"),
        "seconds" / Scaled(Int8ul, 1, "s"),
        "ticks" / Scaled(Int16ul, 0.0001, "s"),
        "distances" / Array(SAMPLES, Scaled(Int16ul, 1, "mm")),
        "sum" / Int16ul,
    ),
    field="sum",
    algorithm=Sum(16),
)


def points(f: Fields) -> Polar:
    return Polar(
        range=f.distances * 0.001, azimuth=np.arange(SAMPLES) * 0.1, time=np.arange(SAMPLES) * 0.001
    )


SENSOR = Sensor(
    "shape-clock",
    vendor="Shapes",
    model="Clock",
    frames={
        "data": Frame(
            DATA, data=True, max_length=15, plausible=lambda f: (f.seconds < 60) & (f.ticks < 1)
        )
    },
    points=points,
    scan=Every(0.1),
    links={"data": Serial(115_200)},
    clock=Clock(("seconds", "ticks"), wraps_at=60.0),
    range_limits=(0.05, 30.0),
    status="manual",
    source="invented for the tests: a clock that wraps",
)
