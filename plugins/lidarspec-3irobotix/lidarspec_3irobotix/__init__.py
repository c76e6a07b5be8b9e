"""3iRobotix Delta-2A, 2B, 2D and 2G, and the LDS08RR that sends their packets: lidars of vacuum
cleaners, which send by themselves.

Source: the drivers kaiaai/LDS (LDS_DELTA_2A and its kin, LDS_LDS08RR) and lds2d; two packets of a
Delta-2A out of another driver's tests. There is no public manual. A packet has the angle of its
first sample alone; its span follows from the packets of a turn, 16, or 15 of a 2G. Known errors of
drivers: one takes the sum modulo FFFF, and it is modulo 10000. The field of the zero's offset is
told and not applied, as the drivers do. The motor is driven by the host, by PWM.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Any

import numpy as np
from construct import Array, Const, Int8ub, Int16sb, Int16ub, Rebuild, Struct, this

from lidarspec.spec import (
    Checksummed,
    Fields,
    Frame,
    OnWrap,
    Polar,
    Relative,
    Scaled,
    Sensor,
    Serial,
    Simulation,
    Sum,
    hookimpl,
    spread,
    steps,
    wrap,
)

TURN = 6.0  # turns a second (kaiaai/LDS, getTargetScanFreqHz)
MOST = 70  # samples of a packet: more than any driver has room for
SPEED = Scaled(Int8ub, 0.05, "Hz")

DATA = Checksummed(
    Struct(
        "header" / Const(b"\xaa"),
        "length" / Rebuild(Int16ub, this.size + 8) * "of all that stands before the sum",
        "version" / Int8ub * "of the protocol: 0 or 1",
        "type" / Const(0x61, Int8ub),
        "command" / Const(0xAD, Int8ub) * "speed and samples",
        "size" / Int16ub * "from the speed to the last sample",
        "speed" / SPEED,
        "zero_offset" / Scaled(Int16sb, 0.01, "deg"),
        "start_angle" / Scaled(Int16ub, 0.01, "deg") * "of the first sample",
        "samples"
        / Array(
            (this.size - 5) // 3,
            Struct("quality" / Int8ub, "distance" / Scaled(Int16ub, 0.00025, "m") * "0: no return"),
        ),
        "sum" / Int16ub,
    ),
    field="sum",
    algorithm=Sum(16),
)
SPEED_ALONE = Checksummed(
    Struct(
        "header" / Const(b"\xaa\x00\x09"),
        "version" / Int8ub * "of the protocol: 0 or 1",
        "type" / Const(0x61, Int8ub),
        "command" / Const(0xAE, Int8ub) * "speed alone",
        "size" / Const(1, Int16ub),
        "speed" / SPEED * "while the motor comes to its speed",
        "sum" / Int16ub,
    ),
    field="sum",
    algorithm=Sum(16),
)


def plausible(f: Fields) -> Any:
    """Both lengths agree, on a sample at least, and the angle is one of the circle."""
    return (
        (f.length == f.size + 8)
        & (f.size > 5)
        & (f.size % 3 == 2)
        & (f.start_angle < 360)
        & (f.version <= 1)
    )


def points(f: Fields, packets: int) -> Polar:
    """Even steps, clockwise, through the span of one of so many packets a turn."""
    count = (f.size - 5) / 3
    span = 360 / packets
    angles = spread(f.start_angle, f.start_angle + span - span / count, count, full=360.0)
    return Polar(
        range=f.samples.distance,
        azimuth=-np.deg2rad(wrap(angles, 360.0)),
        intensity=f.samples.quality,
        time=np.where(
            f.speed > 0, steps(count) * (span / count) / (np.maximum(f.speed, 0.05) * 360), 0
        ),
    )


def starts_as(f: Fields, packets: int) -> Any:
    """Whether a packet starts, not at 0, where one of so many packets a turn does: 22.5 and 24
    degrees have no other multiple in common.
    """
    return (f.start_angle > 0) & (f.start_angle % (360 / packets) == 0)


def sweep(i: int, packets: int, count: int) -> dict[str, float]:
    """Packet i of turns with so many packets of so many samples."""
    return {
        "size": 5 + 3 * count,
        "speed": TURN,
        "version": 1,
        "start_angle": i % packets * 360 / packets,
    }


FRAMES = {
    "data": Frame(DATA, data=True, max_length=15 + 3 * MOST, plausible=plausible),
    "speed": Frame(SPEED_ALONE),
}
#: id -> model, packets a turn, samples of a simulated packet, bauds.
MODELS: dict[str, tuple[str, int, int, tuple[int, ...]]] = {
    "3irobotix-delta2a": (
        "Delta-2A",
        16,
        47,
        (230_400, 115_200),
    ),  # its captured packet has more samples than 115 200 baud carry
    "3irobotix-delta2b": ("Delta-2B", 16, 47, (230_400,)),
    "3irobotix-delta2d": ("Delta-2D", 16, 24, (115_200,)),
    "3irobotix-delta2g": ("Delta-2G", 15, 24, (115_200,)),
    "3irobotix-lds08rr": ("LDS08RR (Delta packets)", 16, 24, (115_200,)),
}


def relative(own: int, other: int) -> str | Relative:
    """What tells a model with so many packets a turn apart."""
    if own == other:
        return "nothing in the packets: the baud rate, or the label on the housing"
    return Relative(
        f"packets start every {360 / other:g} degrees", partial(starts_as, packets=other)
    )


def lidar(name: str) -> Sensor:
    """One row of the table as a sensor."""
    model, packets, count, bauds = MODELS[name]
    return Sensor(
        name,
        vendor="3iRobotix",
        model=model,
        frames=FRAMES,
        points=partial(points, packets=packets),
        scan=OnWrap("azimuth"),
        links={"data": Serial(*bauds)},
        simulation=Simulation(partial(sweep, packets=packets, count=count)),
        range_limits=(0.1, 8.0),
        relatives={
            other: relative(packets, row[1]) for other, row in MODELS.items() if other != name
        },
        status="vectors" if model == "Delta-2A" else "manual",
        source="kaiaai/LDS and lds2d"
        + "; two packets of a unit" * (model == "Delta-2A")
        + ". Limits of range are assumed",
    )


DELTA_2A, DELTA_2B, DELTA_2D, DELTA_2G, LDS08RR = SENSORS = [lidar(name) for name in MODELS]


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """The Delta models."""
    return SENSORS
