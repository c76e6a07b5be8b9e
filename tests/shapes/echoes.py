"""Two echoes of each beam in separate fields, both in the cloud."""

from __future__ import annotations

import numpy as np
from construct import Array, Const, Int8ul, Int16ul, Struct

from lidarspec import Sensor
from lidarspec.spec import Checksummed, Fields, Frame, OnChange, Polar, Scaled, Serial, Xor, stack

BEAMS = 5

DATA = Checksummed(
    Struct(
        "header" / Const(b"\xec\x02"),
        "turn" / Int8ul,
        "angle" / Scaled(Int16ul, 0.0001, "rad"),
        "beams"
        / Array(
            BEAMS,
            Struct(
                "near" / Scaled(Int16ul, 0.004, "m"),
                "far" / Scaled(Int16ul, 0.004, "m"),
                "weak" / Int8ul,
                "strong" / Int8ul,
            ),
        ),
        "check" / Int8ul,
    ),
    field="check",
    algorithm=Xor(),
)


def points(f: Fields) -> Polar:
    return Polar(
        range=stack(f.beams.near, f.beams.far),
        azimuth=f.angle + np.arange(BEAMS) * 0.01,
        intensity=stack(f.beams.weak, f.beams.strong),
        return_index=np.arange(2),
    )


SENSOR = Sensor(
    "shape-echoes",
    vendor="Shapes",
    model="Echoes",
    frames={
        "data": Frame(
            DATA,
            data=True,
            max_length=36,
            acknowledged={"LS206": "no line is noisy enough for a shape"},
        )
    },
    points=points,
    scan=OnChange("turn"),
    links={"data": Serial(115_200)},
    range_limits=(0.05, 200.0),
    status="manual",
    source="invented for the tests: two echoes",
)
