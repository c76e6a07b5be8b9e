"""Arrays directly in arrays, and a Cartesian cloud from them."""

from __future__ import annotations

import numpy as np
from construct import Array, Const, Int8sb, Int16ub, Struct

from lidarspec import Sensor
from lidarspec.spec import Cartesian, Checksummed, Crc, Fields, Frame, OnChange, Scaled, Serial

ROWS, COLUMNS = 3, 4

DATA = Checksummed(
    Struct(
        "header" / Const(b"\x6d\x1d"),
        "frame" / Int16ub,
        "depth" / Array(ROWS, Array(COLUMNS, Scaled(Int16ub, 0.001, "m"))),
        "skew" / Array(ROWS, Array(COLUMNS, Scaled(Int8sb, 0.01, "m"))),
        "crc" / Int16ub,
    ),
    field="crc",
    algorithm=Crc(16, 0x8BB7, order="big"),
)


def points(f: Fields) -> Cartesian:
    """Return the points of a depth image: columns to the right, rows down."""
    right, down = np.arange(COLUMNS) - 1.5, np.arange(ROWS)[:, None] - 1.0
    return Cartesian(
        x=f.depth,
        y=-f.depth * right * 0.1,
        z=-f.depth * down * 0.1 + f.skew.on("depth", "depth[]"),
        ring=np.arange(ROWS)[:, None],
    )


SENSOR = Sensor(
    "shape-grid",
    vendor="Shapes",
    model="Grid",
    frames={"data": Frame(DATA, data=True, max_length=42)},
    points=points,
    scan=OnChange("frame"),
    links={"data": Serial(921_600)},
    range_limits=(0.1, 10.0),
    status="manual",
    source="invented for the tests: arrays in arrays",
)
