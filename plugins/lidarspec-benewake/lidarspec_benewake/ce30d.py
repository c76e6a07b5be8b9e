"""Benewake CE30-D: solid-state lidar of 320 by 20 pixels over UDP.

Source: the vendor's SDK ce30_driver 1.3 (packet.h, packet.cpp, udp_socket.h, README.md), and a
driver in MATLAB (LidarDriver, ce30Sensor.m and ce30_ExtractAngleDist.m), which agree. A scan is
sent in 27 packets of 12 columns, so the last packet has 4 columns beyond the field of view. The
header has 42 bytes. Its content is not documented, except for one bit that marks a grey image. The
byte order of the time is uncertain, so points have the host's time. Grey images are not read. The y
axis is assumed to point to the left, as in the point cloud of the SDK. The simulated rate is
assumed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Bytes,
    Const,
    Enum,
    Int8ul,
    Int16ul,
    Struct,
)

from lidarspec.spec import (
    Command,
    Fields,
    Frame,
    OnRewind,
    Polar,
    Scaled,
    Sensor,
    Simulation,
    Udp,
    wrap,
)

COLUMNS_PER_SCAN = 320
COLUMNS_PER_PACKET = 12
PACKETS_PER_SCAN = 27
PIXELS = 20
FIELD_OF_VIEW_DEG = 60.0
TOP_ELEVATION_DEG = 1.9
ELEVATION_STEP_DEG = 0.2
PORT = 2368
COMMAND_BYTES = 50
#: Simulated scans a second.
SCAN_RATE_HZ = 30

PIXEL = Struct(
    "distance" / Scaled(Int16ul, 0.002, "m"),
    "state" / Enum(Int8ul, normal=0, signal_high=1, signal_low=2, ambient_high=3, removed=4),
)
PACKET = Struct(
    "header"
    / Struct(
        "first" / Bytes(16),
        "flags"
        / BitStruct(
            "others" / BitsInteger(6), "grey" / Const(0, BitsInteger(1)), "last" / BitsInteger(1)
        ),
        "rest" / Bytes(25),
    ),
    "columns"
    / Array(
        COLUMNS_PER_PACKET,
        Struct(
            "mark" / Const(b"\xff\xee"),
            "azimuth"
            / Scaled(Int16ul, 0.01, "deg")
            * "angle from the right edge of the field of view, 0 to 59.81",
            "pixels" / Array(PIXELS, PIXEL),
        ),
    ),
    "timestamp" / Bytes(4) * "microseconds; the byte order is uncertain",
    "factory" / Int16ul,
)
ORDER = Struct("text" / Bytes(COMMAND_BYTES) * "the bytes after the last value are zero")


def points(f: Fields) -> Polar:
    """Return the pixels of the columns, from top to bottom."""
    column = f.columns
    azimuth = wrap(column.azimuth, 360.0)
    return Polar(
        range=column.pixels.distance,
        azimuth=np.deg2rad(azimuth - FIELD_OF_VIEW_DEG / 2),
        elevation=np.deg2rad(TOP_ELEVATION_DEG - ELEVATION_STEP_DEG * column.pixels.index),
        ring=column.pixels.index,
        invalid=(column.pixels.state != 0) | (azimuth >= FIELD_OF_VIEW_DEG),
    )


def sweep(i: int) -> dict[str, Any]:
    """Return the values of simulated packet i."""
    numbers = i % PACKETS_PER_SCAN * COLUMNS_PER_PACKET + np.arange(COLUMNS_PER_PACKET)
    return {
        "columns.azimuth": numbers * FIELD_OF_VIEW_DEG / COLUMNS_PER_SCAN,
        "columns.pixels.state": np.zeros((COLUMNS_PER_PACKET, PIXELS)),
    }


def make_command(text: str, **more: Any) -> Command:
    """Return the command with this text."""
    return Command("order", {"text": text.encode().ljust(COMMAND_BYTES, b"\0")}, **more)


CE30D = Sensor(
    "benewake-ce30d",
    vendor="Benewake",
    model="CE30-D",
    frames={
        "data": Frame(PACKET, data=True),
        "order": Frame(ORDER, direction="out"),
    },
    points=points,
    scan=OnRewind("columns.azimuth"),
    links={"data": Udp(PORT)},
    commands={
        "start": make_command("getDistanceAndAmplitudeSorted", starts=True),
        "stop": make_command("join", stops=True),
        "grey_off": make_command("enableGrayOutput 0"),
    },
    on_open=("start",),
    simulation=Simulation(sweep, rate=SCAN_RATE_HZ * PACKETS_PER_SCAN),
    range_limits=(0.1, 30.0),
    status="manual",
    source="ce30_driver 1.3, packet.h, packet.cpp and udp_socket.h; the shortest range is assumed",
)
