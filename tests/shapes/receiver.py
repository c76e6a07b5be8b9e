"""A receiver without points: frames with a clock and a counter, and one request."""

from __future__ import annotations

from typing import Any

from construct import Const, Enum, Int8ul, Int16sl, Int16ul, Int32sl, Struct

from lidarspec import Sensor
from lidarspec.spec import (
    Checksummed,
    Clock,
    Command,
    Fields,
    Frame,
    PacketCounter,
    Scaled,
    Serial,
    Simulation,
    Sum,
    hookimpl,
)

FIX = Checksummed(
    Struct(
        "head" / Const(b"\xc5\x01"),
        "number" / Int8ul,
        "time" / Scaled(Int16ul, 0.1, "s"),
        "latitude" / Scaled(Int32sl, 1e-7, "deg"),
        "longitude" / Scaled(Int32sl, 1e-7, "deg"),
        "quality" / Enum(Int8ul, none=0, fix=3),
        "sum" / Int8ul,
    ),
    field="sum",
    algorithm=Sum(),
)
WARMTH = Checksummed(
    Struct(
        "head" / Const(b"\xc5\x02"),
        "temperature" / Scaled(Int16sl, 0.01, "degC"),
        "sum" / Int8ul,
    ),
    field="sum",
    algorithm=Sum(),
)
REQUEST = Checksummed(
    Struct("head" / Const(b"\xc5\x81"), "rate" / Scaled(Int8ul, 1, "Hz"), "sum" / Int8ul),
    field="sum",
    algorithm=Sum(),
)
REPLY = Checksummed(
    Struct("head" / Const(b"\xc5\x82"), "rate" / Scaled(Int8ul, 1, "Hz"), "sum" / Int8ul),
    field="sum",
    algorithm=Sum(),
)


def plausible(f: Fields) -> Any:
    return (abs(f.latitude) <= 90) & (abs(f.longitude) <= 180) & (f.time < 3600)


def sweep(i: int) -> dict[str, Any]:
    """Return fix i of ten a second, on the way north."""
    return {
        "number": i % 256,
        "time": i % 36_000 / 10,
        "latitude": 47 + i % 1000 * 1e-5,
        "longitude": 8.5,
        "quality": 3,
    }


SENSOR = Sensor(
    "shape-receiver",
    vendor="Shapes",
    model="Receiver",
    frames={
        "fix": Frame(FIX, plausible=plausible, simulation=Simulation(sweep, rate=10)),
        "warmth": Frame(
            WARMTH, simulation=Simulation(lambda i: {"temperature": 20 + i % 10}, rate=2)
        ),
        "rate_request": Frame(REQUEST, direction="out"),
        "rate_reply": Frame(REPLY),
    },
    links={"data": Serial(9600, 115_200)},
    commands={
        "rate": Command(
            "rate_request", args={"rate": ("rate", 1, 20)}, reply="rate_reply", echoes=("rate",)
        )
    },
    clock=Clock("time", wraps_at=3600.0),
    sequence=PacketCounter("number"),
    info={"temperature": "warmth.temperature"},
    status="manual",
    source="invented for the tests: a device without points",
)


@hookimpl
def lidarspec_sensors() -> list[Sensor]:
    """Return the sensor, so that the command line can load it from this file."""
    return [SENSOR]
