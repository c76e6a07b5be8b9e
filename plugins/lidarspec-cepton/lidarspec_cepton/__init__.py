"""Cepton Vista: forward-looking lidars, which send Cartesian points over UDP.

Source: the first part of Cepton's Sensor Communication Specifications
(developer.cepton.com/doc/data_format), and a public reader of the packets in Rust. Neither source
states whether the letters STDV are sent in this order, or in reverse order as a little-endian
number, so both orders are accepted. The maximum range and the simulated pattern are assumed. It is
also assumed that the time of a point counts from the previous point, because 144 points take longer
than a byte can represent. Information and fault packets are not public and are skipped. No captured
packet was available.
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
    PacketCounter,
    Scaled,
    Sensor,
    Simulation,
    Udp,
    hookimpl,
    running,
)

MAX_POINTS_PER_PACKET = 144
HEADER_BYTES = 24
POINT_BYTES = 10
SIMULATED_STEP_S = 2e-6  # from point to point
SIMULATED_PACKETS = 64  # of a scan
SIGNATURES = (0x56445453, 0x53544456)  # the letters STDV, and STDV as a number, low byte first

DATA = Struct(
    "signature" / Int32ul * "the characters STDV",
    "header_version" / Int8ul,
    "header_size" / Const(HEADER_BYTES, Int8ul),
    "flags" / Int16ul,
    "time" / Scaled(Int64ul, 1e-6, "s") * "time since 1970",
    "point_version" / Int8ul,
    "point_size" / Const(POINT_BYTES, Int8ul),
    "count" / Int16ul,
    "sequence" / Int32ul,
    "points"
    / Array(
        this.count,
        Struct(
            "x" / Scaled(Int16sl, 0.005, "m") * "positive to the right",
            "y" / Scaled(Int16ul, 0.005, "m") * "positive forwards",
            "z" / Scaled(Int16sl, 0.005, "m") * "positive upwards",
            "reflectivity" / Int8ul,
            "after" / Scaled(Int8ul, 1e-6, "s") * "time since the previous point",
            "channel" / Int8ul,
            "flags"
            / BitStruct(
                "reserved" / BitsInteger(1),
                "noise" / BitsInteger(1),
                "no_return" / BitsInteger(1),
                "second" / BitsInteger(1) * "1: second return",
                "boundary" / BitsInteger(1) * "1: first point of an image",
                "parity" / BitsInteger(1) * "changes with each image",
                "weak" / BitsInteger(1),
                "saturated" / BitsInteger(1),
            ),
        ),
    ),
)


def plausible(f: Fields) -> Any:
    """Return whether signature and point count are valid."""
    return (
        ((f.signature == SIGNATURES[0]) | (f.signature == SIGNATURES[1]))
        & (f.count >= 1)
        & (f.count <= MAX_POINTS_PER_PACKET)
    )


def points(f: Fields) -> Cartesian:
    """Return the points, converted from axes (right, ahead, up) to (ahead, left, up)."""
    members = f.points
    return Cartesian(
        members.y,
        -members.x,
        members.z,
        intensity=members.reflectivity,
        time=running(members.after),
        ring=members.channel,
        return_index=members.flags.second,
        invalid=(members.flags.no_return == 1) | (members.flags.noise == 1),
    )


def sweep(i: int) -> dict[str, Any]:
    """Return the simulated values of packet i; a scan has 64 packets."""
    return {
        "signature": SIGNATURES[0],
        "time": i * MAX_POINTS_PER_PACKET * SIMULATED_STEP_S,
        "count": MAX_POINTS_PER_PACKET,
        "sequence": i,
        "points.after": SIMULATED_STEP_S,
        "points.flags.parity": i // SIMULATED_PACKETS % 2,
    }


def directions(i: int) -> tuple[Any, Any]:
    """Return the simulated beams of packet i, as azimuth and elevation in radians."""
    return np.linspace(-np.pi / 6, np.pi / 6, MAX_POINTS_PER_PACKET), np.deg2rad(
        i % SIMULATED_PACKETS * 22 / SIMULATED_PACKETS - 11
    )


VISTA = Sensor(
    "cepton-vista",
    vendor="Cepton",
    model="Vista",
    frames={
        "data": Frame(
            DATA,
            data=True,
            max_length=HEADER_BYTES + MAX_POINTS_PER_PACKET * POINT_BYTES,
            plausible=plausible,
        )
    },
    points=points,
    scan=OnChange("points.flags.parity"),
    links={"data": Udp(8808)},
    clock=Clock("time"),
    sequence=PacketCounter("sequence"),
    simulation=Simulation(sweep, directions=directions),
    range_limits=(0.5, 200.0),
    vendor_axes=("right", "forward", "up"),
    status="manual",
    source=(
        "first pages of the Sensor Communication Specifications, and a public reader; the"
        " maximum range is assumed"
    ),
)


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """Return the Cepton sensor."""
    return [VISTA]
