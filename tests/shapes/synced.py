"""A clock that is free-running at first, and counts TAI once it is locked.

Each packet has the state of the clock, and so has a report.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import Array, Const, Int8ul, Int16ul, Int64ul, Struct

from lidarspec import Sensor
from lidarspec.spec import (
    Clock,
    ClockState,
    ClockStatus,
    Fields,
    Frame,
    OnWrap,
    PacketCounter,
    Polar,
    Scaled,
    Simulation,
    Udp,
)

SAMPLES = 4
PACKETS_PER_SCAN = 50
PERIOD_NS = 2_000_000
FREE, LOCKED, HOLDOVER = range(3)

DATA = Struct(
    "magic" / Const(b"\x5c\x01"),
    "number" / Int16ul,
    "sync" / Int8ul * "0 free-running, 1 locked, 2 holdover",
    "time" / Scaled(Int64ul, 1, "ns"),
    "azimuth" / Scaled(Int16ul, 0.01, "deg"),
    "distances" / Array(SAMPLES, Scaled(Int16ul, 0.002, "m")),
)
REPORT = Struct("magic" / Const(b"\x5c\x02"), "sync" / Int8ul * "as in data", "load" / Int8ul)
STATES = {
    FREE: ClockState("free-running", False, epoch="boot"),
    LOCKED: ClockState("locked to PTP", True),
    HOLDOVER: ClockState("holdover", False),
}


def points(f: Fields) -> Polar:
    degrees = f.azimuth + np.arange(SAMPLES) * 1.8
    return Polar(range=f.distances, azimuth=np.deg2rad(degrees), time=np.arange(SAMPLES) * 5e-4)


def sweep(i: int) -> dict[str, Any]:
    return {
        "number": i % 65_536,
        "sync": LOCKED,
        "time": i * PERIOD_NS,
        "azimuth": i % PACKETS_PER_SCAN * 360 / PACKETS_PER_SCAN,
    }


SENSOR = Sensor(
    "shape-synced",
    vendor="Shapes",
    model="Synced",
    frames={
        "data": Frame(DATA, data=True, plausible=lambda f: f.azimuth < 360),
        "report": Frame(REPORT),
    },
    points=points,
    scan=OnWrap("azimuth"),
    links={"data": Udp(7011)},
    clock=Clock("time", epoch="tai", status=ClockStatus("sync", STATES)),
    sequence=PacketCounter("number"),
    simulation=Simulation(sweep),
    range_limits=(0.1, 100.0),
    turn=(10.0, 10.0),
    status="manual",
    source="invented for the tests: a clock with a status",
)
