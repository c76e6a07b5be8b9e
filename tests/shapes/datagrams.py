"""Datagrams with a sequence number that wraps to 1, and times by the host's clock."""

from __future__ import annotations

import numpy as np
from construct import Array, Bytes, Const, Int8ub, Int16ub, Struct

from lidarspec import Sensor
from lidarspec.spec import Fields, Frame, OnWrap, PacketCounter, Polar, Scaled, Udp

BLOCKS, CHANNELS = 4, 3

DATA = Struct(
    "magic" / Const(b"DGRM"),
    "number" / Int8ub,
    "reserved" / Bytes(3),
    "blocks"
    / Array(
        BLOCKS,
        Struct(
            "azimuth" / Scaled(Int16ub, 0.01, "deg"),
            "channels"
            / Array(
                CHANNELS, Struct("distance" / Scaled(Int16ub, 0.005, "m"), "intensity" / Int8ub)
            ),
        ),
    ),
)
INFO = Struct("magic" / Const(b"INFO"), "elevation" / Array(CHANNELS, Scaled(Int8ub, 0.1, "deg")))


def points(f: Fields) -> Polar:
    return Polar(
        range=f.blocks.channels.distance,
        azimuth=np.deg2rad(f.blocks.azimuth),
        elevation=np.deg2rad(f.state.info.elevation.on("channels")),
        intensity=f.blocks.channels.intensity,
        time=np.arange(BLOCKS)[:, None] * 1e-5,
        ring=np.arange(CHANNELS),
    )


SENSOR = Sensor(
    "shape-datagrams",
    vendor="Shapes",
    model="Datagrams",
    frames={
        "data": Frame(
            DATA, data=True, max_length=52, plausible=lambda f: (f.number >= 1) & (f.number <= 200)
        ),
        "info": Frame(INFO, max_length=7),
    },
    points=points,
    scan=OnWrap("blocks.azimuth"),
    links={"data": Udp(7001, 7002)},
    sequence=PacketCounter("number", first=1, last=200),
    state={"info": {"elevation": np.array([0.0, 1.0, 2.0])}},
    range_limits=(0.2, 100.0),
    status="manual",
    source="invented for the tests: datagrams with a sequence",
)
