"""Computed lengths, counts and paddings that construct does not return.

Building sets all of them, and parsing verifies all of them.
"""

from __future__ import annotations

import numpy as np
from construct import (
    Aligned,
    BitsInteger,
    BitStruct,
    Bytes,
    Const,
    FixedSized,
    GreedyBytes,
    Int8ub,
    Int16ub,
    Prefixed,
    PrefixedArray,
    Struct,
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
    SizeOf,
    Sum,
    spread,
)

LONGEST = 30

DATA = Checksummed(
    Struct(
        "header"
        / Struct(
            "magic" / Const(b"\x4d\x5a"),
            "length" / SizeOf(Int16ub, "_.body", plus=2) * "bytes of the body and the sum",
        ),
        "body"
        / Struct(
            "kind"
            / BitStruct("version" / BitsInteger(4), "size" / SizeOf(BitsInteger(12), "_.extra")),
            "angle" / Scaled(Int16ub, 0.01, "deg"),
            "samples"
            / PrefixedArray(
                Int8ub, Struct("quality" / Int8ub, "distance" / Scaled(Int16ub, 0.001, "m"))
            ),
            "extra" / Struct("note" / Aligned(4, Prefixed(Int8ub, GreedyBytes))),
            "more"
            / Prefixed(
                Int16ub, Struct("serial" / Bytes(2), "firmware" / Bytes(4)), includelength=True
            ),
            "spare" / FixedSized(6, Struct("temperature" / Scaled(Int16ub, 0.1, "degC"))),
        ),
        "sum" / Int16ub,
    ),
    field="sum",
    algorithm=Sum(16),
)


def points(f: Fields) -> Polar:
    body = f.body
    azimuth = np.deg2rad(
        spread(
            body.angle, body.angle + 20 - 20 / body.samples_count, body.samples_count, full=360.0
        )
    )
    return Polar(range=body.samples.distance, azimuth=azimuth, intensity=body.samples.quality)


def sweep(i: int) -> dict[str, object]:
    """Return the values of packet i, eighteen packets a turn, of different lengths."""
    return {
        "body.samples_count": LONGEST - i % 4,
        "body.angle": i * 20.0 % 360,
        "body.extra.note_size": 4,
    }


SENSOR = Sensor(
    "shape-measured",
    vendor="Shapes",
    model="Measured",
    frames={
        "data": Frame(
            DATA,
            data=True,
            max_length=400,
            plausible=lambda f: (f.body.angle < 360) & (f.body.samples_count > 1),
        )
    },
    points=points,
    scan=OnWrap("azimuth"),
    links={"data": Serial(115_200)},
    simulation=Simulation(sweep),
    range_limits=(0.05, 30.0),
    status="manual",
    source="invented for the tests: lengths of parts",
)
