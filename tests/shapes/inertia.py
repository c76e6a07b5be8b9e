"""IMU samples in frames with their own clock, and three samples in each data packet.

The two kinds have different units and axes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import Array, Const, Float32l, Int8ul, Int16sl, Int16ul, Int64ul, Struct

from lidarspec import Sensor
from lidarspec.spec import (
    Checksummed,
    Clock,
    Fields,
    Frame,
    Imu,
    OnRewind,
    PacketCounter,
    Polar,
    Scaled,
    Simulation,
    Udp,
    Xor,
    hookimpl,
)

POINTS, SAMPLES, TURN, PERIOD = 8, 3, 20, 0.005
RATE = 100  # IMU frames a second

SAMPLE = Struct(
    *(f"gyro_{axis}" / Scaled(Int16sl, 0.01, "deg/s") for axis in "xyz"),
    *(f"force_{axis}" / Scaled(Int16sl, 9.80665 / 2048, "m/s2") for axis in "xyz"),
)
DATA = Checksummed(
    Struct(
        "head" / Const(b"\x1d\xa7"),
        "number" / Int16ul,
        "time" / Scaled(Int64ul, 1, "ns"),
        "block" / Scaled(Int8ul, 18, "deg"),
        "distances" / Array(POINTS, Scaled(Int16ul, 0.002, "m")),
        "samples" / Array(SAMPLES, SAMPLE),
        "xor" / Int8ul,
    ),
    field="xor",
    algorithm=Xor(),
)
IMU = Checksummed(
    Struct(
        "head" / Const(b"\x1d\xa8"),
        "status" / Int8ul,
        "felt_at" / Scaled(Int64ul, 1, "ns"),
        *(f"gyro_{axis}" / Scaled(Float32l, 1, "rad/s") for axis in "xyz"),
        *(f"force_{axis}" / Scaled(Float32l, 9.80665, "m/s2") for axis in "xyz"),
        "xor" / Int8ul,
    ),
    field="xor",
    algorithm=Xor(),
)


def points(f: Fields) -> Polar:
    return Polar(
        f.distances,
        np.deg2rad(f.block + np.arange(POINTS) * 2.25),
        time=np.arange(POINTS) * (PERIOD / POINTS),
    )


def beside(f: Fields) -> Imu:
    """Return samples of a board that is upside down: x forward, y right, z down."""
    s, radians = f.samples, np.pi / 180
    return Imu(
        (s.gyro_x * radians, s.gyro_y * -radians, s.gyro_z * -radians),
        (s.force_x, -s.force_y, -s.force_z),
        np.arange(SAMPLES) * (PERIOD / SAMPLES),
    )


def alone(f: Fields) -> Imu:
    return Imu((f.gyro_x, f.gyro_y, f.gyro_z), (f.force_x, f.force_y, f.force_z))


def sweep(i: int) -> dict[str, Any]:
    return dict(number=i % 65_536, time=i * 5_000_000, block=i % TURN * 18)


SENSOR = Sensor(
    "shape-inertia",
    vendor="Shapes",
    model="Inertia",
    frames={
        "data": Frame(DATA, data=True, imu=beside),
        "imu": Frame(
            IMU,
            imu=alone,
            clock=Clock("felt_at"),
            simulation=Simulation(lambda i: {"felt_at": i * 10_000_000}, rate=RATE),
        ),
    },
    points=points,
    scan=OnRewind("block"),
    links={"data": Udp(56_320)},
    clock=Clock("time"),
    sequence=PacketCounter("number"),
    simulation=Simulation(sweep),
    range_limits=(0.1, 100.0),
    status="manual",
    source="invented for the tests: an IMU beside the points",
)


@hookimpl
def lidarspec_sensors() -> list[Sensor]:
    return [SENSOR]
