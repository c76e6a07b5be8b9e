"""No counter, but a clock of two fields with a declared pace.

Another frame gives the minute. The axes are the vendor's.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from construct import Array, Const, Default, Int8ub, Int16ub, Int24ub, Struct

from lidarspec import Sensor
from lidarspec.spec import Clock, Fields, Frame, OnFlag, Polar, Scaled, Simulation, Udp

SAMPLES = 6
PACKETS_PER_SCAN = 20
#: Seconds from a packet to the next in the fast and the slow mode.
FAST_S = 0.005
SLOW_S = 0.02
FAST_MODE = 1
SLOW_MODE = 2
SCAN_START = 7
TURN_S = 60.0

TIME: dict[str, Any] = {"seconds": Scaled(Int8ub, 1, "s"), "micros": Scaled(Int24ub, 1e-6, "s")}
DATA = Struct(
    "magic" / Const(b"\xbe\xa7\x01"),
    "mode" / Int8ub * "1 fast, 2 slow",
    "start" / Int8ub * "7 in the first packet of a scan",
    *(name / field for name, field in TIME.items()),
    "azimuth" / Scaled(Int16ub, 0.01, "deg"),
    "distances" / Array(SAMPLES, Scaled(Int16ub, 0.002, "m")),
    "spare" / Default(Int16ub, 0),
)
POSITION = Struct(
    "magic" / Const(b"\xbe\xa7\x02"),
    *(name / field for name, field in TIME.items()),
    "minutes" / Int24ub * "since 1970",
)


def pace(f: Fields) -> Any:
    return np.where(f.mode == SLOW_MODE, SLOW_S, FAST_S)


def unix_time(f: Fields) -> Any:
    return f.minutes * 60.0 + f.seconds + f.micros


def plausible(f: Fields, turn_s: float) -> Any:
    return (f.seconds < turn_s) & (f.micros < 1) & (f.azimuth < 360)


def points(f: Fields, step_deg: float) -> Polar:
    degrees = f.azimuth + np.arange(SAMPLES) * step_deg
    return Polar(range=f.distances, azimuth=-np.deg2rad(degrees), time=np.arange(SAMPLES) * 1e-4)


def sweep(i: int, step_deg: float) -> dict[str, Any]:
    micros = round(i * FAST_S * 1e6)
    return {
        "mode": FAST_MODE,
        "start": SCAN_START if i % PACKETS_PER_SCAN == 0 else 0,
        "seconds": micros // 1_000_000 % 60,
        "micros": micros % 1_000_000 * 1e-6,
        "azimuth": i % PACKETS_PER_SCAN * SAMPLES * step_deg,
    }


SENSOR = Sensor(
    "shape-paced",
    vendor="Shapes",
    model="Paced",
    frames={
        "data": Frame(DATA, data=True, plausible=partial(plausible, turn_s=TURN_S)),
        "position": Frame(POSITION),
    },
    points=partial(points, step_deg=3.0),
    scan=OnFlag("start", value=SCAN_START),
    links={"data": Udp(7010)},
    clock=Clock(
        ("seconds", "micros"), wraps_at=TURN_S, pace=pace, reference=("position", unix_time)
    ),
    simulation=Simulation(partial(sweep, step_deg=3.0)),
    range_limits=(0.1, 100.0),
    vendor_axes=("right", "forward", "up"),
    turn=(10.0, 10.0),
    status="manual",
    source="invented for the tests: a clock with a pace",
)
