"""The receiver of `receiver.py` with lines of text between its frames.

The lines have decimal fractions, empty and missing tokens, and a hexadecimal checksum.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from construct import Bytes, Const, Float32b, Float64b, Int8ub, Struct

from lidarspec import Sensor
from lidarspec.spec import Frame, HexCheck, Scaled, Simulation, Tokens, hookimpl
from tests.shapes import receiver

LINE = Struct(
    "talker" / Bytes(2),
    "kind" / Const(b"FIX"),
    "time" / Scaled(Float64b, 1, "s"),
    "status" / Bytes(1),
    "height" / Scaled(Float32b, 1, "m"),
    "satellites" / Int8ub,
    "station" / Bytes(4),
)
WIRE = Tokens(
    start=b"$",
    sep=b",",
    end=b"\r\n",
    base=10,
    check=HexCheck(),
    formats={"time": "000000.00", "satellites": "00"},
    joined=2,
    padded=True,
    optional=1,
)


def sweep(i: int) -> dict[str, Any]:
    return {
        "talker": b"GP",
        "time": i / 4 % 3600,
        "status": b"A",
        "height": 431.5,
        "satellites": 7 + i % 3,
        "station": b"12",
    }


SENSOR = replace(
    receiver.SENSOR,
    id="shape-mixed",
    model="Mixed",
    frames={
        **receiver.SENSOR.frames,
        "line": Frame(LINE, max_length=60, wire=WIRE, simulation=Simulation(sweep, rate=4)),
    },
    source="invented for the tests: two protocols on one line",
)


@hookimpl
def lidarspec_sensors() -> list[Sensor]:
    """Return the sensor, so that the command line can load it from this file."""
    return [SENSOR]
