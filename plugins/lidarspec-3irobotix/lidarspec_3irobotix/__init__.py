"""3iRobotix Delta-2A, 2B, 2D and 2G, and the LDS08RR with the same packets.

These lidars are built into vacuum cleaners, and send without a request. The host drives the motor
with PWM.

Source: the drivers kaiaai/LDS (LDS_DELTA_2A and related classes, LDS_LDS08RR) and lds2d; two
packets of a Delta-2A from another driver's tests. There is no public manual. A packet has only the
angle of its first sample. A packet covers 360 degrees divided by the number of packets per
revolution, which is 16, or 15 for a 2G. Like the drivers, this module does not add the zero offset
in the packets to the angles.
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

SCAN_RATE_HZ = 6.0  # kaiaai/LDS, getTargetScanFreqHz
MAX_SAMPLES_PER_PACKET = 70  # more than the buffer of any driver
SPEED = Scaled(Int8ub, 0.05, "Hz")

DATA = Checksummed(
    Struct(
        "header" / Const(b"\xaa"),
        "length" / Rebuild(Int16ub, this.size + 8) * "number of bytes before the checksum",
        "version" / Int8ub * "protocol version, 0 or 1",
        "type" / Const(0x61, Int8ub),
        "command" / Const(0xAD, Int8ub) * "AD: the packet contains the speed and samples",
        "size" / Int16ub * "number of bytes from the speed to the last sample",
        "speed" / SPEED,
        "zero_offset" / Scaled(Int16sb, 0.01, "deg"),
        "start_angle" / Scaled(Int16ub, 0.01, "deg") * "azimuth of the first sample",
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
SPEED_STRUCT = Checksummed(
    Struct(
        "header" / Const(b"\xaa\x00\x09"),
        "version" / Int8ub * "protocol version, 0 or 1",
        "type" / Const(0x61, Int8ub),
        "command" / Const(0xAE, Int8ub) * "AE: the packet contains only the speed",
        "size" / Const(1, Int16ub),
        "speed" / SPEED * "sent while the motor starts",
        "sum" / Int16ub,
    ),
    field="sum",
    algorithm=Sum(16),
)


def plausible(f: Fields) -> Any:
    """Return whether sizes, start angle and version are valid, and samples exist."""
    return (
        (f.length == f.size + 8)
        & (f.size > 5)
        & (f.size % 3 == 2)
        & (f.start_angle < 360)
        & (f.version <= 1)
    )


def points(f: Fields, packets: int) -> Polar:
    """Return points at even steps, clockwise, over the angle that a packet covers.

    `packets` is the number of packets per revolution.
    """
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


def starts_on_grid(f: Fields, packets: int) -> Any:
    """Return whether the start angle is a multiple of the angle that one packet covers.

    0 is excluded: it is a multiple for every model, and so distinguishes none.

    Args:
        packets: packets per revolution of the model.
    """
    return (f.start_angle > 0) & (f.start_angle % (360 / packets) == 0)


def sweep(i: int, packets: int, count: int) -> dict[str, float]:
    """Return the simulated values of packet i.

    Args:
        packets: packets per revolution.
        count: samples per packet.
    """
    return {
        "size": 5 + 3 * count,
        "speed": SCAN_RATE_HZ,
        "version": 1,
        "start_angle": i % packets * 360 / packets,
    }


FRAMES = {
    "data": Frame(DATA, data=True, max_length=15 + 3 * MAX_SAMPLES_PER_PACKET, plausible=plausible),
    "speed": Frame(SPEED_STRUCT),
}
#: The models by id: name, packets per revolution, samples of a simulated packet, baud rates.
MODELS: dict[str, tuple[str, int, int, tuple[int, ...]]] = {
    # the samples of the captured Delta-2A packet need more than 115 200 baud
    "3irobotix-delta2a": ("Delta-2A", 16, 47, (230_400, 115_200)),
    "3irobotix-delta2b": ("Delta-2B", 16, 47, (230_400,)),
    "3irobotix-delta2d": ("Delta-2D", 16, 24, (115_200,)),
    "3irobotix-delta2g": ("Delta-2G", 15, 24, (115_200,)),
    "3irobotix-lds08rr": ("LDS08RR (Delta packets)", 16, 24, (115_200,)),
}


def describe_difference(own: int, other: int) -> str | Relative:
    """Return how to distinguish two models by their packets per revolution."""
    if own == other:
        return "both models send the same packets; the label and possibly the baud rate differ"
    return Relative(
        f"packets start every {360 / other:g} degrees", partial(starts_on_grid, packets=other)
    )


def make_lidar(name: str) -> Sensor:
    """Return the sensor of one row of `MODELS`."""
    model, packets, count, bauds = MODELS[name]
    has_vectors = model == "Delta-2A"
    source = "kaiaai/LDS and lds2d"
    if has_vectors:
        source += "; two packets captured from a unit"
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
            other: describe_difference(packets, row[1])
            for other, row in MODELS.items()
            if other != name
        },
        status="vectors" if has_vectors else "manual",
        source=f"{source}. Range limits are assumed",
    )


DELTA_2A, DELTA_2B, DELTA_2D, DELTA_2G, LDS08RR = SENSORS = [make_lidar(name) for name in MODELS]


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """Return the Delta models."""
    return SENSORS
