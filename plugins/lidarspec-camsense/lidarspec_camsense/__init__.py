"""Camsense X1, and the LDS08RR with the same packets: 360 degree lidars of vacuum cleaners.

The lidars rotate and send without a request.

There is no public manual. Source: packets of both lidars (thijses/camsense-X1, "a few data
packets"; kaiaai/LDS, issue 17), all with valid checksums, and the drivers kaiaai/LDS
(LDS_CAMSENSE_X1, LDS_LDS08RR_CAMSENSE) and lds2d. The drivers call the checksum an unknown CRC-16,
but it is a folded sum over all bytes before it. Another sensor with the name LDS08RR sends packets
of 3iRobotix, which begin with AA.
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

HOUSING_ZERO_DEG = 21.0  # from the data's zero to the housing's, for the X1 (the vendor's SDK)
DISTANCE = ByteSwapped(
    BitStruct(
        "invalid" / BitsInteger(1) * "1: no return",
        "reserved" / BitsInteger(1),
        "distance" / Scaled(BitsInteger(14), 0.001, "m"),
    )
)


def make_angle() -> Construct:
    """Return the type of an angle: steps of 1/64 degree, with 0 at A000."""
    return Scaled(Int16ul, 1 / 64, "deg", -0xA000 / 64)


def make_data_frame(form: int, count: int, *rest: Construct) -> Frame:
    """Return the frame of a data packet.

    Args:
        form: the third byte of the packet.
        count: samples per packet.
        rest: the fields of a sample after distance and intensity.
    """
    struct = Struct(
        "header"
        / Const(bytes([0x55, 0xAA, form, count]))
        * "sync, packet format and number of samples",
        "speed" / Scaled(Int16ul, 1 / 64, "rpm"),
        "start_angle" / make_angle() * "azimuth of the first sample",
        "samples" / Array(count, Struct("range" / DISTANCE, "intensity" / Int8ul, *rest)),
        "end_angle" / make_angle() * "azimuth of the last sample",
        "checksum" / Int16ul,
    )
    struct_with_sum = Checksummed(struct, field="checksum", algorithm=Fold15())
    if count > 8:
        acknowledged = {
            "LS310": "errors in the highest bits of the first words of a long packet are not"
            " detected, because these bits overflow in the sum"
        }
    else:
        acknowledged = {}
    return Frame(struct_with_sum, data=True, plausible=plausible, acknowledged=acknowledged)


def plausible(f: Fields) -> Any:
    """Return whether the angles are between 0 and 360 degrees."""
    return (f.start_angle >= 0) & (f.start_angle <= 360) & (f.end_angle >= 0) & (f.end_angle <= 360)


def points(f: Fields, count: int, zero: float = 0.0) -> Polar:
    """Return points at even steps from the start angle to the end angle, clockwise.

    Args:
        zero: the angle in degrees added to all samples.
    """
    clockwise = spread(f.start_angle, f.end_angle, count, full=360.0)  # degrees, (n, count)
    return Polar(
        range=np.where(f.samples.range.invalid, 0, f.samples.range.distance),
        azimuth=-np.deg2rad(wrap(clockwise + zero, 360.0)),
        intensity=f.samples.intensity,
        time=np.where(f.speed > 0, (clockwise - f.start_angle) / (np.maximum(f.speed, 1) * 6), 0),
    )


def configure(sensor: Sensor, *, zero: Literal["data", "housing"] = "data") -> Sensor:
    """Return the X1 with angles from the zero direction of the data or the housing."""
    offset = HOUSING_ZERO_DEG if zero == "housing" else 0.0
    return dataclasses.replace(sensor, points=partial(points, count=8, zero=offset))


def sweep(i: int, count: int, steps: int, speed: float) -> dict[str, float]:
    """Return the simulated values of packet i.

    Args:
        count: samples per packet.
        steps: samples per revolution.
        speed: revolutions per minute.
    """
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
    frames={"data": make_data_frame(0x03, 8)},
    points=partial(points, count=8),
    scan=OnWrap("azimuth"),
    links={"data": Serial(115_200)},
    # 2080 samples and 5.2 revolutions a second
    simulation=Simulation(partial(sweep, count=8, steps=400, speed=312)),
    configure=configure,
    range_limits=(0.08, 8.0),
    turn=(4.5, 6.0),
    status="vectors",
    source=(
        "three captured packets; kaiaai/LDS, LDS_CAMSENSE_X1; zero direction of the housing"
        " from the vendor's SDK. Range limits are assumed"
    ),
)

LDS08RR = dataclasses.replace(
    X1,
    id="camsense-lds08rr",
    model="LDS08RR (Camsense packets)",
    frames={"data": make_data_frame(0x07, 12, "reserved" / Bytes(1))},
    points=partial(points, count=12),
    simulation=Simulation(partial(sweep, count=12, steps=360, speed=302)),
    configure=None,  # the zero of its housing is not public
    status="capture",
    source=(
        "two captured packets; kaiaai/LDS, LDS_LDS08RR_CAMSENSE. Range and speed limits are assumed"
    ),
)


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """Return the Camsense sensors."""
    return [X1, LDS08RR]
