"""Cepton Vista: lidars that look ahead, over UDP, with points by their coordinates.

Source: the opening of Cepton's Sensor Communication Specifications
(developer.cepton.com/doc/data_format), and a public reader of the packets in Rust. Neither says
whether STDV stands in this order on the wire, or as a number with the low byte first: both are
taken. That the time of a point counts from the one before it is assumed, since 144 points take
longer than its byte can say; so are the reach, and the pattern of a simulated one. Information and
fault packets are not public, and are skipped. No packet of a sensor was seen.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Const,
    Int8ul,
    Int16sl,
    Int16ul,
    Int32ul,
    Int64ul,
    Struct,
    this,
)

from lidarspec.spec import (
    Cartesian,
    Clock,
    Fields,
    Frame,
    OnChange,
    Scaled,
    Sensor,
    Sequence,
    Simulation,
    Udp,
    hookimpl,
    running,
)

MOST = 144  # points of a packet
HEADER = 24
POINT = 10  # bytes
STEP = 2e-6  # seconds from point to point of a simulated one
PACKETS = 64  # of a simulated picture
SIGNATURES = (0x56445453, 0x53544456)  # STDV in the order of the bytes, and as a number

DATA = Struct(
    "signature" / Int32ul * "STDV",
    "header_version" / Int8ul,
    "header_size" / Const(HEADER, Int8ul),
    "flags" / Int16ul,
    "time" / Scaled(Int64ul, 1e-6, "s") * "since 1970",
    "point_version" / Int8ul,
    "point_size" / Const(POINT, Int8ul),
    "count" / Int16ul,
    "sequence" / Int32ul,
    "points"
    / Array(
        this.count,
        Struct(
            "x" / Scaled(Int16sl, 0.005, "m") * "to the right",
            "y" / Scaled(Int16ul, 0.005, "m") * "ahead",
            "z" / Scaled(Int16sl, 0.005, "m") * "up",
            "reflectivity" / Int8ul,
            "after" / Scaled(Int8ul, 1e-6, "s") * "the point before",
            "channel" / Int8ul,
            "flags"
            / BitStruct(
                "reserved" / BitsInteger(1),
                "noise" / BitsInteger(1),
                "no_return" / BitsInteger(1),
                "second" / BitsInteger(1) * "1: second return",
                "boundary" / BitsInteger(1) * "1: first of a picture",
                "parity" / BitsInteger(1) * "changes with each picture",
                "weak" / BitsInteger(1),
                "saturated" / BitsInteger(1),
            ),
        ),
    ),
)


def plausible(f: Fields) -> Any:
    """Return a known signature, and no more points than a packet takes."""
    return (
        ((f.signature == SIGNATURES[0]) | (f.signature == SIGNATURES[1]))
        & (f.count >= 1)
        & (f.count <= MOST)
    )


def points(f: Fields) -> Cartesian:
    """Return the sensor's right, ahead and up, turned to ahead, left and up."""
    each = f.points
    return Cartesian(
        each.y,
        -each.x,
        each.z,
        intensity=each.reflectivity,
        time=running(each.after),
        ring=each.channel,
        return_index=each.flags.second,
        invalid=(each.flags.no_return == 1) | (each.flags.noise == 1),
    )


def sweep(i: int) -> dict[str, Any]:
    """Packet i, 64 to a picture."""
    return {
        "signature": SIGNATURES[0],
        "time": i * MOST * STEP,
        "count": MOST,
        "sequence": i,
        "points.after": STEP,
        "points.flags.parity": i // PACKETS % 2,
    }


def directions(i: int) -> tuple[Any, Any]:
    """Lines from the right to the left, 60 degrees wide and 22 high."""
    return np.linspace(-np.pi / 6, np.pi / 6, MOST), np.deg2rad(i % PACKETS * 22 / PACKETS - 11)


VISTA = Sensor(
    "cepton-vista",
    vendor="Cepton",
    model="Vista",
    frames={"data": Frame(DATA, data=True, max_length=HEADER + MOST * POINT, plausible=plausible)},
    points=points,
    scan=OnChange("points.flags.parity"),
    links={"data": Udp(8808)},
    clock=Clock("time"),
    sequence=Sequence("sequence"),
    simulation=Simulation(sweep, directions=directions),
    range_limits=(0.5, 200.0),
    vendor_axes=("right", "forward", "up"),
    status="manual",
    source=(
        "Sensor Communication Specifications (opening), and a public reader; the reach is assumed"
    ),
)


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """The Cepton sensor."""
    return [VISTA]
