"""Counts and options in the header.

They select optional parts, alternatives, a count from two fields, and the unit of the distances.
"""

from __future__ import annotations

import numpy as np
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Const,
    If,
    Int8ub,
    Int16ub,
    Int16ul,
    Int32ub,
    Struct,
    Switch,
    this,
)

from lidarspec import Sensor
from lidarspec.spec import Checksummed, Crc, Fields, Frame, OnRewind, Polar, Scaled, Serial

LONGEST = 48

DATA = Checksummed(
    Struct(
        "magic" / Const(b"\x0f\xf0"),
        "options"
        / BitStruct(
            "extended" / BitsInteger(1), "coarse" / BitsInteger(1), "kind" / BitsInteger(6)
        ),
        "rows" / Int8ub,
        "columns" / Int8ub,
        "extension"
        / If(
            this.options.extended == 1,
            Struct("serial" / Int32ub, "trim" / Scaled(Int8ub, 0.1, "deg")),
        ),
        "extra"
        / Switch(
            this.options.kind,
            {1: Struct("rpm" / Int16ub), 2: Struct("rpm" / Int16ub, "volts" / Int8ub)},
        ),
        "angle" / Scaled(Int16ub, 0.01, "deg"),
        "distances"
        / Array(this.rows * this.columns, Scaled(Int16ul, 1, "") * "in steps that the options say"),
        "crc" / Int16ub,
    ),
    field="crc",
    algorithm=Crc(16, 0x1021, order="big"),
)


def points(f: Fields) -> Polar:
    """Return points; the header selects distances in steps of 1 mm or of 4 mm."""
    trim = np.nan_to_num(f.extension.trim)
    azimuth = np.deg2rad(f.angle + trim + 0.0 * f.distances)
    return Polar(range=f.distances * np.where(f.options.coarse == 1, 0.004, 0.001), azimuth=azimuth)


SENSOR = Sensor(
    "shape-options",
    vendor="Shapes",
    model="Options",
    frames={
        "data": Frame(
            DATA,
            data=True,
            max_length=17 + 2 * LONGEST,
            plausible=lambda f: (f.options.kind <= 2) & (f.angle < 360),
        )
    },
    points=points,
    scan=OnRewind("angle"),
    links={"data": Serial(921_600)},
    range_limits=(0.2, 100.0),
    status="manual",
    source="invented for the tests: counts and options in the header",
)
