"""Points as coordinates: counted whole millimetres, whole centimetres, and floats.

A float may be NaN.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import Array, Const, Float32b, Int8ul, Int16sl, Int16ul, Int32sl, Struct, this

from lidarspec import Sensor
from lidarspec.spec import (
    Cartesian,
    Checksummed,
    Clock,
    Crc,
    Every,
    Fields,
    Frame,
    PacketCounter,
    Scaled,
    Simulation,
    Udp,
)

POINTS, RATE = 12, 100


def _sensor(name: str, coordinate: Any, count: Any, longest: int) -> Sensor:
    """Return a sensor whose points have coordinates of one kind."""
    point = Struct(*(axis / coordinate for axis in "xyz"), "reflectivity" / Int8ul, "tag" / Int8ul)
    data = Checksummed(
        Struct(
            "head" / Const(b"\x4c" + name[0].encode()),
            "number" / Int16ul,
            "time" / Scaled(Int16ul, 0.01, "s"),
            "count" / Int8ul,
            "points" / Array(count, point),
            "crc" / Int16ul,
        ),
        field="crc",
        algorithm=Crc(16, 0x1021, init=0xFFFF),
    )
    return Sensor(
        f"shape-{name}",
        vendor="Shapes",
        model=name.capitalize(),
        frames={"data": Frame(data, data=True, max_length=longest)},
        points=points,
        scan=Every(0.1),
        links={"data": Udp(56_300)},
        clock=Clock("time", wraps_at=655.36),
        sequence=PacketCounter("number"),
        simulation=Simulation(
            lambda i: dict(number=i % 65_536, time=i / RATE % 655.36, count=POINTS),
            directions=directions,
        ),
        range_limits=(0.1, 100.0),
        status="manual",
        source="invented for the tests: points by coordinates",
    )


def points(f: Fields) -> Cartesian:
    """Return points; a point with a tag of 200 or more is noise."""
    return Cartesian(
        f.points.x,
        f.points.y,
        f.points.z,
        intensity=f.points.reflectivity,
        invalid=f.points.tag >= 200,
    )


def directions(i: int) -> tuple[Any, Any]:
    """Return directions in the form of a flower, another part of it in each packet."""
    turns = (np.arange(POINTS) + i * POINTS) * 0.0377
    return 0.6 * np.sin(turns * 2.6) * np.cos(turns), 0.4 * np.sin(turns * 2.6) * np.sin(turns)


SENSORS = (
    _sensor("millimetres", Scaled(Int32sl, 0.001, "m"), this.count, 9 + 14 * 255),
    _sensor("centimetres", Scaled(Int16sl, 0.01, "m"), POINTS, 9 + 8 * POINTS),
    _sensor("floats", Scaled(Float32b, 1, "m"), POINTS, 9 + 14 * POINTS),
)
