"""Escaped bytes between flags, with a checksum over the bytes without escapes.

The content is divided into segments of variable length.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import Array, Int8ub, Int16ub, Int16ul, Struct, this

from lidarspec import Sensor
from lidarspec.spec import (
    Checksummed,
    Crc,
    Escaped,
    Fields,
    Frame,
    OnWrap,
    PacketCounter,
    Parts,
    Polar,
    Scaled,
    Serial,
    Simulation,
    steps,
)

SEGMENT = Struct(
    "count" / Int8ub,
    "start" / Scaled(Int16ub, 0.01, "deg"),
    "distances" / Array(this.count, Scaled(Int16ub, 0.001, "m")),
)
DATA = Checksummed(
    Struct(
        "number" / Int8ub,
        "channels" / Int8ub,
        "segments" / Parts(SEGMENT, count=this.channels),
        "fcs" / Int16ul,
    ),
    field="fcs",
    algorithm=Crc(16, 0x1021, init=0xFFFF, refin=True, refout=True, xorout=0xFFFF),
)

BEAMS = 12


def points(f: Fields) -> Polar:
    return Polar(range=f.distances, azimuth=np.deg2rad(f.start + 2.0 * steps(f.count)))


def sweep(i: int) -> dict[str, Any]:
    """Return the values of frame i, fifteen frames a turn.

    A frame has two segments of different lengths.
    """
    segments = [
        dict(count=BEAMS - number % 2, start=number * 24.0 % 360) for number in (2 * i, 2 * i + 1)
    ]
    return dict(number=i % 256, segments=segments)


SENSOR = Sensor(
    "shape-escaped",
    vendor="Shapes",
    model="Escaped",
    frames={
        "data": Frame(
            DATA,
            data=True,
            max_length=1200,
            points={"segments": points},
            simulation=Simulation(sweep),
            wire=Escaped(),
        )
    },
    points=None,
    scan=OnWrap("segments.start"),
    links={"data": Serial(115_200)},
    sequence=PacketCounter("number"),
    range_limits=(0.05, 30.0),
    status="manual",
    source="invented for the tests: escaped bytes between flags",
)
