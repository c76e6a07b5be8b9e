"""State from another packet: elevations from the info frame, otherwise defaults.

Fields next to the samples are broadcast to the shape of the points.
"""

from __future__ import annotations

import numpy as np
from construct import Array, Const, Int8ul, Int16sl, Int16ul, Struct

from lidarspec import Sensor
from lidarspec.spec import Checksummed, Fields, Frame, OnWrap, Polar, Scaled, Serial, Sum

BLOCKS, CHANNELS = 3, 4

DATA = Checksummed(
    Struct(
        "header" / Const(b"\xd1\xda"),
        "twist" / Array(CHANNELS, Scaled(Int8ul, 0.01, "deg")),
        "lag" / Array(BLOCKS, Scaled(Int8ul, 0.000001, "s")),
        "blocks"
        / Array(
            BLOCKS,
            Struct(
                "azimuth" / Scaled(Int16ul, 0.01, "deg"),
                "channels" / Array(CHANNELS, Struct("distance" / Scaled(Int16ul, 0.002, "m"))),
            ),
        ),
        "sum" / Int8ul,
    ),
    field="sum",
    algorithm=Sum(8),
)
INFO = Checksummed(
    Struct(
        "header" / Const(b"\xd1\x1f"),
        "zero" / Scaled(Int16ul, 0.01, "deg"),
        "vertical" / Array(CHANNELS, Scaled(Int16sl, 0.01, "deg")),
        "sum" / Int8ul,
    ),
    field="sum",
    algorithm=Sum(8),
)


def points(f: Fields) -> Polar:
    info = f.state.info
    return Polar(
        range=f.blocks.channels.distance,
        azimuth=np.deg2rad(f.blocks.azimuth + f.twist.on("channels") - info.zero),
        elevation=np.deg2rad(info.vertical.on("channels")),
        time=f.lag.on("blocks"),
        ring=np.arange(CHANNELS),
    )


SENSOR = Sensor(
    "shape-state",
    vendor="Shapes",
    model="State",
    frames={
        "data": Frame(
            DATA,
            data=True,
            max_length=40,
            acknowledged={"LS206": "no line is noisy enough for a shape"},
        ),
        "info": Frame(INFO, max_length=13, plausible=lambda f: f.zero < 360),
    },
    points=points,
    scan=OnWrap("blocks.azimuth"),
    links={"data": Serial(921_600)},
    state={"info": {"zero": 0.0, "vertical": np.array([-3.0, -1.0, 1.0, 3.0])}},
    range_limits=(0.2, 100.0),
    status="manual",
    source="invented for the tests: state from another packet",
)
