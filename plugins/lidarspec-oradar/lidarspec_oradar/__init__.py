"""ORADAR MS200: 360 degree time-of-flight lidar, which streams over a UART at 230 400 baud.

The data frame is the same as that of LDROBOT's LD06. The commands and the start messages differ
from those of an LD06.

Source: the vendor's SDK as published with oradar_lidar (ordlidar_protocol.h, ord_lidar_driver.cpp,
utils.h) and its ROS node (oradar_scan_node.cpp, ms200_scan.launch.py). The SDK does not state when
the time in a frame restarts, so points have the host's time. The replies to commands are not
documented. The messages with serial number and firmware after power-on (AA 55) are not read. The
simulated number of points per second is assumed.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from construct import Array, Const, Enum, Int8ul, Int16ul, Struct

from lidarspec.spec import (
    Checksummed,
    Command,
    Crc,
    Fields,
    Frame,
    OnWrap,
    Polar,
    Scaled,
    Sensor,
    Serial,
    Simulation,
    SizeOf,
    Xor,
    hookimpl,
    spread,
    wrap,
)

POINTS = 12
#: Simulated sensor: points a second, revolutions a second.
POINT_RATE_HZ = 4500
TURN_RATE_HZ = 10
# Codes of commands (ordlidar_protocol.h).
SET_SPEED = 0xA1
SET_MODE = 0xA2
MODES = Enum(Int8ul, standby=0x80, measure=0x81)

DATA = Checksummed(
    Struct(
        "header" / Const(b"\x54\x2c"),
        "speed" / Scaled(Int16ul, 1, "deg/s"),
        "start_angle" / Scaled(Int16ul, 0.01, "deg"),
        "points"
        / Array(
            POINTS,
            Struct(
                "distance" / Scaled(Int16ul, 0.001, "m") * "0: no return",
                "confidence" / Int8ul,
            ),
        ),
        "end_angle" / Scaled(Int16ul, 0.01, "deg"),
        "timestamp" / Scaled(Int16ul, 0.001, "s"),
        "crc" / Int8ul,
    ),
    field="crc",
    algorithm=Crc(width=8, poly=0x4D),
)


def make_command_frame(code: int, *content: Any) -> Frame:
    """Return the frame of a command: header, code, type, size, content, XOR, tail."""
    struct = Struct(
        "body"
        / Checksummed(
            Struct(
                "header" / Const(b"\xa5\xf5"),
                "code" / Const(code, Int8ul),
                "type" / Const(0xC1, Int8ul) * "C1: the command sets a parameter",
                "size" / SizeOf(Int8ul, "content"),
                "content" / Struct(*content),
                "check" / Int8ul,
            ),
            field="check",
            algorithm=Xor(),
        ),
        "tail" / Const(b"\x31\xf2"),
    )
    return Frame(struct, direction="out")


def plausible(f: Fields) -> Any:
    """Return whether the angles are below 360 degrees."""
    return (f.start_angle < 360) & (f.end_angle < 360)


def points(f: Fields) -> Polar:
    """Return points at even steps from the start angle to the end angle."""
    clockwise = spread(f.start_angle, f.end_angle, POINTS, full=360.0)  # degrees, (n, 12)
    step = wrap(f.end_angle - f.start_angle, 360.0) / (POINTS - 1)
    return Polar(
        range=f.points.distance,
        azimuth=-np.deg2rad(clockwise),
        intensity=f.points.confidence,
        time=np.arange(POINTS) * step / np.maximum(f.speed, 1),
    )


def sweep(i: int) -> dict[str, float]:
    """Return the values of simulated frame i."""
    step = 360.0 * TURN_RATE_HZ / POINT_RATE_HZ
    start = i * POINTS * step % 360
    return {
        "speed": 360 * TURN_RATE_HZ,
        "start_angle": start,
        "end_angle": (start + (POINTS - 1) * step) % 360,
        "timestamp": i * POINTS / POINT_RATE_HZ % 60,
    }


IDENTICAL = "the frames are those of an MS200, but the commands begin with 0x54"
MS200 = Sensor(
    "oradar-ms200",
    vendor="ORADAR",
    model="MS200",
    frames={
        "data": Frame(DATA, data=True, plausible=plausible),
        "speed": make_command_frame(SET_SPEED, "rate" / Scaled(Int16ul, 1, "Hz")),
        "mode": make_command_frame(SET_MODE, "mode" / MODES),
    },
    points=points,
    scan=OnWrap("azimuth"),
    links={"data": Serial(230_400)},
    commands={
        "start": Command("mode", {"body.content.mode": "measure"}, starts=True),
        "stop": Command("mode", {"body.content.mode": "standby"}, settle=0.1, stops=True),
        "set_speed": Command("speed", args={"rate": ("body.content.rate", 5, 15)}, settle=0.1),
    },
    on_open=("start",),
    simulation=Simulation(sweep, rate=POINT_RATE_HZ / POINTS),
    vendor_axes=("forward", "right", "up"),
    range_limits=(0.05, 20.0),
    turn=(5, 15),
    relatives={
        "ldrobot-stl27l": IDENTICAL,
        "ldrobot-ld06": "sends the same frames, but accepts no commands",
        "ldrobot-ld20": IDENTICAL,
        "ldrobot-stl06p": IDENTICAL,
        "ldrobot-ld14": IDENTICAL,
        "ldrobot-ld14p": IDENTICAL,
    },
    status="manual",
    source="the vendor's SDK and its ROS node, as published with oradar_lidar",
)


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """Return the ORADAR sensors."""
    return [MS200]
