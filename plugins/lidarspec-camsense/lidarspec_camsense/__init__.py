"""Camsense X1 and the LDS08RR that sends its packets: 360 degree lidars of vacuum cleaners, which
turn and send by themselves.

There is no public manual. Source: packets of both (thijses/camsense-X1, "a few data packets";
kaiaai/LDS, issue 17), of which every checksum is right, and the drivers kaiaai/LDS
(LDS_CAMSENSE_X1, LDS_LDS08RR_CAMSENSE) and lds2d. Known errors of drivers: what they call an
unknown CRC-16 is a folded sum over all bytes before it. There are two LDS08RR: the other one sends
3iRobotix' packets, which begin with AA.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from functools import partial
from typing import Any, Literal

import numpy as np
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Bytes,
    ByteSwapped,
    Const,
    Construct,
    Int8ul,
    Int16ul,
    Struct,
)

from lidarspec.spec import (
    Checksummed,
    Fields,
    Fold15,
    Frame,
    OnWrap,
    Polar,
    Scaled,
    Sensor,
    Serial,
    Simulation,
    hookimpl,
    spread,
    wrap,
)

HOUSING = 21.0  # degrees from the data's zero to the housing's, for the X1 (the vendor's SDK)
DISTANCE = ByteSwapped(
    BitStruct(
        "invalid" / BitsInteger(1) * "1: no return",
        "reserved" / BitsInteger(1),
        "distance" / Scaled(BitsInteger(14), 0.001, "m"),
    )
)


def angle() -> Construct:
    """1/64 degree, from A000 on."""
    return Scaled(Int16ul, 1 / 64, "deg", -0xA000 / 64)


def data(form: int, count: int, *rest: Construct) -> Frame:
    """The packet with so many samples, of a distance, an intensity and what else its form has."""
    struct = Struct(
        "header" / Const(bytes([0x55, 0xAA, form, count])) * "sync, form and number of the samples",
        "speed" / Scaled(Int16ul, 1 / 64, "rpm"),
        "start_angle" / angle() * "of the first sample",
        "samples" / Array(count, Struct("range" / DISTANCE, "intensity" / Int8ul, *rest)),
        "end_angle" / angle() * "of the last sample",
        "checksum" / Int16ul,
    )
    sealed = Checksummed(struct, field="checksum", algorithm=Fold15())
    if count > 8:
        weak = {"LS310": "the sum loses the highest bits of the first words of a long packet"}
    else:
        weak = {}
    return Frame(sealed, data=True, plausible=plausible, acknowledged=weak)


def plausible(f: Fields) -> Any:
    """Angles within the circle (the drivers turn down what is below A000)."""
    return (f.start_angle >= 0) & (f.start_angle <= 360) & (f.end_angle >= 0) & (f.end_angle <= 360)


def points(f: Fields, count: int, zero: float = 0.0) -> Polar:
    """Even steps from the start angle to the end angle, clockwise; the direction is that of the
    drivers, which draw rooms with it.
    """
    swept = spread(f.start_angle, f.end_angle, count, full=360.0)  # degrees, (n, count)
    return Polar(
        range=np.where(f.samples.range.invalid, 0, f.samples.range.distance),
        azimuth=-np.deg2rad(wrap(swept + zero, 360.0)),
        intensity=f.samples.intensity,
        time=np.where(f.speed > 0, (swept - f.start_angle) / (np.maximum(f.speed, 1) * 6), 0),
    )


def configure(sensor: Sensor, *, zero: Literal["data", "housing"] = "data") -> Sensor:
    """Return the X1 with angles from the zero of the data, as on the wire, or of the housing.

    The vendor's SDK counts from the zero of the housing.
    """
    offset = HOUSING if zero == "housing" else 0.0
    return dataclasses.replace(sensor, points=partial(points, count=8, zero=offset))


def sweep(i: int, count: int, steps: int, speed: float) -> dict[str, float]:
    """Packet i of turns with so many points, at so many turns a minute."""
    first = i * count % steps
    return {
        "speed": speed,
        "start_angle": first * 360 / steps,
        "end_angle": (first + count - 1) * 360 / steps,
    }


X1 = Sensor(
    "camsense-x1",
    vendor="Camsense",
    model="X1",
    frames={"data": data(0x03, 8)},
    points=partial(points, count=8),
    scan=OnWrap("azimuth"),
    links={"data": Serial(115_200)},
    simulation=Simulation(
        partial(sweep, count=8, steps=400, speed=312)
    ),  # 2080 samples and 5.2 turns a second
    configure=configure,
    range_limits=(0.08, 8.0),
    turn=(4.5, 6.0),
    status="vectors",
    source=(
        "three captured packets; kaiaai/LDS, LDS_CAMSENSE_X1; the housing's zero from the vendor's"
        " SDK. Limits of range are assumed"
    ),
)

LDS08RR = dataclasses.replace(
    X1,
    id="camsense-lds08rr",
    model="LDS08RR (Camsense packets)",
    frames={"data": data(0x07, 12, "reserved" / Bytes(1))},
    points=partial(points, count=12),
    simulation=Simulation(partial(sweep, count=12, steps=360, speed=302)),
    configure=None,  # where the zero of its housing is, no public source says
    status="capture",
    source=(
        "two captured packets; kaiaai/LDS, LDS_LDS08RR_CAMSENSE. Limits of range and speed are"
        " assumed"
    ),
)


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """The Camsense sensors."""
    return [X1, LDS08RR]
