"""A command with arguments, and its reply."""

from __future__ import annotations

import numpy as np
from construct import Array, Const, Int8ul, Int16ul, Struct

from lidarspec import Sensor
from lidarspec.spec import (
    Checksummed,
    Choice,
    Command,
    Fields,
    Frame,
    OnWrap,
    Polar,
    Scaled,
    Serial,
    Sum,
    Xor,
)

SAMPLES = 3

ORDER = Checksummed(
    Struct(
        "header" / Const(b"\x16"),
        "code" / Int8ul,
        "motor"
        / Struct(
            "speed" / Scaled(Int16ul, 0.01, "Hz"), "trim" / Scaled(Int8ul, 0.5, "deg", offset=-64)
        ),
        "check" / Int8ul,
    ),
    field="check",
    algorithm=Xor(),
)
ACK = Checksummed(
    Struct("header" / Const(b"\x17\x71"), "code" / Int8ul, "result" / Int8ul, "check" / Int8ul),
    field="check",
    algorithm=Xor(),
)
DATA = Checksummed(
    Struct(
        "header" / Const(b"\x18\x81"),
        "angle" / Scaled(Int16ul, 0.01, "deg"),
        "distances" / Array(SAMPLES, Scaled(Int16ul, 0.001, "m")),
        "sum" / Int8ul,
    ),
    field="sum",
    algorithm=Sum(8),
)


def points(f: Fields) -> Polar:
    return Polar(range=f.distances, azimuth=np.deg2rad(f.angle + np.arange(SAMPLES)))


SENSOR = Sensor(
    "shape-commands",
    vendor="Shapes",
    model="Commands",
    frames={
        "data": Frame(DATA, data=True, max_length=11, plausible=lambda f: f.angle < 360),
        "ack": Frame(ACK, max_length=5),
        "order": Frame(ORDER, direction="out", max_length=6),
    },
    points=points,
    scan=OnWrap("azimuth"),
    links={"data": Serial(115_200, dtr=True)},
    commands={
        "start": Command(
            "order",
            values={"code": 1, "motor.speed": 0, "motor.trim": 0},
            reply="ack",
            matches={"code": 1},
            starts=True,
        ),
        "stop": Command(
            "order", values={"code": 2, "motor.speed": 0, "motor.trim": 0}, settle=0.1, stops=True
        ),
        "speed": Command(
            "order",
            values={"code": 3},
            args={"rate": ("motor.speed", 5.0, 20.0), "trim": ("motor.trim", -10.0, 10.0)},
            reply="ack",
            matches={"code": 3, "result": 0},
        ),
        "mode": Command(
            "order",
            values={"motor.speed": 0, "motor.trim": 0},
            args={"mode": ("code", Choice(eco=4, boost=9))},
        ),
        "spin": Command(lines={"dtr": True}),
    },
    on_open=("start",),
    on_close=("stop",),
    range_limits=(0.05, 30.0),
    status="manual",
    source="invented for the tests: an outgoing command with arguments and a reply",
)
