"""A chain of segments under one checksum.

Each gives the length of the next, and has its own number of channels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import Array, Const, Int8ul, Int16ul, Int32ul, Struct, this

from lidarspec import Sensor
from lidarspec.spec import (
    Checksummed,
    Clock,
    Crc,
    Extra,
    Fields,
    Frame,
    OnChange,
    PacketCounter,
    Parts,
    Polar,
    Scaled,
    Simulation,
    Udp,
    steps,
)

SEGMENT = Struct(
    "turn" / Int16ul,
    "channels" / Int8ul,
    "beams" / Int8ul,
    "time" / Scaled(Int32ul, 1, "us"),
    "start" / Scaled(Int16ul, 0.01, "deg"),
    "elevations" / Array(this.channels, Scaled(Int8ul, 0.5, "deg")),
    "next_size" / Int16ul * "bytes of the next segment, 0 behind the last",
    "data"
    / Array(
        this.beams,
        Array(this.channels, Struct("distance" / Scaled(Int16ul, 0.001, "m"), "strength" / Int8ul)),
    ),
)
DATA = Checksummed(
    Struct(
        "magic" / Const(b"SEGM"),
        "counter" / Int16ul,
        "step" / Scaled(Int8ul, 0.1, "deg"),
        "first_size" / Int16ul,
        "segments" / Parts(SEGMENT, size=this.first_size, following=this.next_size),
        "crc" / Int32ul,
    ),
    field="crc",
    algorithm=Crc(32, 0x04C11DB7, init=0xFFFFFFFF, refin=True, refout=True, xorout=0xFFFFFFFF),
)


CHANNELS, BEAMS = 3, 8


def points(f: Fields) -> Polar:
    return Polar(
        range=f.data.distance,
        azimuth=np.deg2rad(f.start + f.frame.step * steps(f.beams)[:, None]),
        elevation=np.deg2rad(f.elevations.on("data[]")),
        intensity=f.data.strength,
        ring=steps(f.channels),
        extra={
            "signal": f.data.strength,
            "step": Extra(f.frame.step, unit="deg"),
            "share": f.data.strength / 255,
        },
    )


def segment(i: int) -> dict[str, Any]:
    """Return the values of segment i, thirty segments of two lengths a turn."""
    number = CHANNELS - i % 2
    elevations = np.arange(number) * 2.0
    return dict(
        turn=i // 30,
        channels=number,
        beams=BEAMS,
        time=i * 500.0,
        start=i * 12.0 % 360,
        elevations=elevations,
    )


def sweep(i: int) -> dict[str, Any]:
    """Return the values of telegram i; telegrams alternately have two segments or one."""
    first = i // 2 * 3 + i % 2 * 2
    return dict(
        counter=i % 65_536,
        step=1.5,
        segments=[segment(number) for number in range(first, first + 2 - i % 2)],
    )


SENSOR = Sensor(
    "shape-segments",
    vendor="Shapes",
    model="Segments",
    frames={
        "data": Frame(
            DATA,
            data=True,
            max_length=1200,
            points={"segments": points},
            simulation=Simulation(sweep),
        )
    },
    points=None,
    scan=OnChange("segments.turn"),
    links={"data": Udp(7005)},
    clock=Clock("segments.time", wraps_at=2**32 * 1e-6),
    sequence=PacketCounter("counter"),
    range_limits=(0.05, 30.0),
    status="manual",
    source="invented for the tests: a chain of segments",
)
