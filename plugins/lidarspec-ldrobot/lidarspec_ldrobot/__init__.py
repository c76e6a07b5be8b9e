"""LDROBOT STL-27L and relatives: 360 degree time-of-flight lidars over a UART, which send by themselves.

Source: STL-27L development manual, section 3. Known errors of the manual: the CRC table lacks entries 175 to 186 (it
is generated here); the decode table of the example prints point 2 as 200 mm (0x00dc is 220) and point 12 as B0 00 EA
(the dump, whose CRC is right, has C0 00 E5); no rule for frames that cross 360 degrees.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from functools import partial
from typing import Any

import numpy as np
from construct import Array, Const, Int8ul, Int16ul, Struct

from lidarspec.spec import Checksummed, Clock, Crc, Fields, Frame, OnWrap, Polar, Scaled, Sensor, Serial, Simulation, hookimpl, spread

POINTS = 12
RATE_STL27L = 21_600  # points per second (STL-27L manual, section 1)
RATE_LD06 = 4_500  # points per second (LD06 data sheet; 450 points a turn at 10 Hz)

DATA = Checksummed(
    Struct(
        "header" / Const(b"\x54\x2c") * "start byte 0x54; type 1 and 12 points",
        "speed" / Scaled(Int16ul, 1, "deg/s"),
        "start_angle" / Scaled(Int16ul, 0.01, "deg"),
        "points"
        / Array(
            POINTS,
            Struct(
                "distance" / Scaled(Int16ul, 0.001, "m") * "0: no return",
                "intensity" / Int8ul,
            ),
        ),
        "end_angle" / Scaled(Int16ul, 0.01, "deg"),
        "timestamp" / Scaled(Int16ul, 0.001, "s") * "restarts at 30 s",
        "crc" / Int8ul,
    ),
    field="crc",
    algorithm=Crc(width=8, poly=0x4D),
)


def plausible(f: Fields) -> Any:
    """Angles below 360 degrees and a time of at most 30 s (manual 3.1)."""
    return (f.start_angle < 360) & (f.end_angle < 360) & (f.timestamp <= 30)


def points(f: Fields, rate: int) -> Polar:
    """Even steps from the start angle to the end angle (manual 3.2), at `rate` points per second."""
    clockwise = spread(f.start_angle, f.end_angle, POINTS, full=360.0)  # degrees, (n, 12)
    return Polar(
        range=f.points.distance,
        azimuth=-np.deg2rad(clockwise),  # left-handed, clockwise (manual, section 4)
        intensity=f.points.intensity,
        time=np.arange(POINTS) / rate,
    )


def sweep(i: int, rate: int) -> dict[str, float]:
    """Frame i at 10 turns and `rate` points per second."""
    step = 360.0 * 10 / rate
    start = i * POINTS * step % 360
    return dict(speed=3600, start_angle=start, end_angle=(start + (POINTS - 1) * step) % 360, timestamp=i * POINTS / rate % 30)


STL27L = Sensor(
    "ldrobot-stl27l",
    vendor="LDROBOT",
    model="STL-27L",
    frames={"data": Frame(DATA, data=True, plausible=plausible)},
    points=partial(points, rate=RATE_STL27L),
    scan=OnWrap("azimuth"),
    links={"data": Serial(921_600)},
    clock=Clock("timestamp", wraps_at=30.0),
    simulation=Simulation(partial(sweep, rate=RATE_STL27L)),
    range_limits=(0.03, 25.0),
    vendor_axes=("forward", "right", "up"),
    turn=(9.9, 10.1),  # by its own control (manual, section 1); no limits are given for control by PWM
    relatives={"ldrobot-ld06": "frames come 1800 to the second, an LD06's 375"},
    aliases=("stl27l",),
    status="vectors",
    source="STL-27L development manual, sections 1 to 4",
)

LD06 = dataclasses.replace(
    STL27L,
    id="ldrobot-ld06",
    model="LD06",
    aliases=("ld06", "ld19"),  # one manual, one frame, one baud rate
    points=partial(points, rate=RATE_LD06),
    simulation=Simulation(partial(sweep, rate=RATE_LD06)),
    links={"data": Serial(230_400)},
    range_limits=(0.02, 12.0),
    turn=(5.0, 13.0),  # inno-maker's page of the LD06; by PWM, as for the LD19
    relatives={"ldrobot-stl27l": "frames come 375 to the second, an STL-27L's 1800"},
    status="capture",
    source="LD06 and LD19 development manual v2.5 (the STL-27L's frame); three consecutive captured frames",
)


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """The LDROBOT sensors."""
    return [STL27L, LD06]
