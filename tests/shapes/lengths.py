"""Two data frames that differ only in length: with and without a counter.

The sensor sends either of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import Array, Const, Int16ul, Struct

from lidarspec import Sensor
from lidarspec.spec import Fields, Frame, OnWrap, PacketCounter, Polar, Scaled, Simulation, Udp

PLAIN = Struct(
    "magic" / Const(b"LN"),
    "azimuth" / Scaled(Int16ul, 0.01, "deg"),
    "distances" / Array(3, Scaled(Int16ul, 0.001, "m")),
)
COUNTED = Struct(*PLAIN.subcons, "counter" / Int16ul)


def points(f: Fields) -> Polar:
    return Polar(range=f.distances, azimuth=np.deg2rad(f.azimuth + np.arange(3)))


def sweep(i: int) -> dict[str, Any]:
    """Return the values of packet i, twelve packets a turn.

    Frames without a counter ignore the counter.
    """
    return {"azimuth": i * 30.0 % 360, "counter": i % 65_536}


SENSOR = Sensor(
    "shape-lengths",
    vendor="Shapes",
    model="Lengths",
    frames={
        "plain": Frame(PLAIN, data=True, max_length=10, plausible=lambda f: f.azimuth < 360),
        "counted": Frame(COUNTED, data=True, max_length=12, plausible=lambda f: f.azimuth < 360),
    },
    points=points,
    scan=OnWrap("azimuth"),
    links={"data": Udp(7003)},
    sequence=PacketCounter("counter"),
    simulation=Simulation(sweep),
    range_limits=(0.1, 60.0),
    status="manual",
    source="invented for the tests: data frames that differ in length alone",
)
