"""Tags with a type and a length, also of unknown types, then padding.

One type of tag has the points.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import Array, Bytes, Const, Int8ul, Int16sl, Int16ul, Struct, this

from lidarspec import Sensor
from lidarspec.spec import (
    Checksummed,
    Fields,
    Frame,
    OnChange,
    Parts,
    Polar,
    Scaled,
    Serial,
    Simulation,
    Sum,
    hookimpl,
    previous,
)

POINTS = Struct(
    "type" / Const(1, Int8ul),
    "length" / Int8ul * "bytes of the points",
    "points"
    / Array(
        this.length // 4,
        Struct("distance" / Scaled(Int16ul, 0.01, "m"), "angle" / Scaled(Int16sl, 0.01, "deg")),
    ),
)
TEMPERATURE = Struct(
    "type" / Const(2, Int8ul),
    "length" / Const(2, Int8ul),
    "temperature" / Scaled(Int16sl, 0.1, "degC"),
)
UNKNOWN = Struct("type" / Int8ul, "length" / Int8ul, "content" / Bytes(this.length))
DATA = Checksummed(
    Struct(
        "magic" / Const(bytes([2, 1, 4, 3])),
        "number" / Int8ul,
        "count" / Int8ul * "tags",
        "tags"
        / Parts({"points": POINTS, "temperature": TEMPERATURE, "other": UNKNOWN}, count=this.count),
        "padding" / Bytes(-(7 + this.tags.size) % 8),
        "sum" / Int8ul,
    ),
    field="sum",
    algorithm=Sum(),
)
TURN = 4


def points(f: Fields) -> Polar:
    return Polar(
        range=f.points.distance,
        azimuth=np.deg2rad(f.points.angle),
        invalid=f.points.distance == previous(f.points.distance),
    )


def tag(i: int, number: int) -> dict[str, Any]:
    return dict(
        type=1,
        length=4 * number,
        **{"points.angle": (i % TURN) * 90 - 180 + np.arange(number) * 5.0},
    )


def sweep(i: int) -> dict[str, Any]:
    """Return four frames a turn; one has two lists of points with another tag between."""
    tags = (
        [tag(i, 6)]
        if i % TURN
        else [tag(i, 4), dict(type=99, length=3), dict(type=2, temperature=31.5), tag(i, 5)]
    )
    return dict(number=i // TURN % 256, tags=tags)


SENSOR = Sensor(
    "shape-tags",
    vendor="Shapes",
    model="Tags",
    frames={"data": Frame(DATA, data=True, max_length=120, points={"tags.points": points})},
    points=None,
    scan=OnChange("number"),
    links={"data": Serial(115_200)},
    simulation=Simulation(sweep, rate=40),
    range_limits=(0.1, 60.0),
    status="manual",
    source="invented for the tests: tags with a type and a length",
)


@hookimpl
def lidarspec_sensors() -> list[Sensor]:
    """Return the sensor, so that the command line can load it from this file."""
    return [SENSOR]
