"""A scanner that sends its name and a note, each up to a terminator, before the samples."""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import (
    Array,
    Const,
    CString,
    GreedyBytes,
    Int8ul,
    Int16ul,
    NullTerminated,
    Struct,
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
    hookimpl,
    spread,
)

SAMPLES = 12  # in a frame
FRAMES = 30  # in a revolution

SAMPLE = Struct("distance" / Scaled(Int16ul, 0.001, "m"), "strength" / Int8ul)
STRUCT = Struct(
    "head" / Const(b"\x7b\xc1\x19"),
    "name" / CString("ascii"),
    "note" / NullTerminated(GreedyBytes, term=b"\n"),
    "first" / Scaled(Int16ul, 0.01, "deg"),
    "last" / Scaled(Int16ul, 0.01, "deg"),
    "count" / Int8ul,
    "samples" / Array(this.count, SAMPLE),
    "sum" / Int8ul,
)


def points(f: Fields) -> Polar:
    azimuth = np.deg2rad(spread(f.first, f.last, f.count, full=360.0))
    return Polar(f.samples.distance, azimuth, intensity=f.samples.strength)


def sweep(i: int) -> dict[str, Any]:
    step = 360 / FRAMES
    first = i * step % 360
    return {
        "name": f"unit {i % 3}",
        "note": b"x" * (i % 4),
        "first": first,
        "last": (first + step * (SAMPLES - 1) / SAMPLES) % 360,
        "count": SAMPLES,
    }


SENSOR = Sensor(
    "shape-names",
    vendor="Shapes",
    model="Names",
    frames={
        "data": Frame(
            Checksummed(STRUCT, field="sum", algorithm=Sum()),
            data=True,
            max_length=120,
            plausible=lambda f: (f.first < 360) & (f.last < 360),
        )
    },
    points=points,
    scan=OnWrap("first"),
    links={"data": Serial(115_200)},
    simulation=Simulation(sweep, rate=300),
    range_limits=(0.1, 60.0),
    status="manual",
    source="invented for the tests: texts with a terminator",
)


@hookimpl
def lidarspec_sensors() -> list[Sensor]:
    """Return the sensor, so that the command line can load it from this file."""
    return [SENSOR]
