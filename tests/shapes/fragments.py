"""Messages in several datagrams.

Each has the message number, its own index and the number of fragments. A short message is one
datagram.
"""

from __future__ import annotations

import numpy as np
from construct import Array, Const, Int8ub, Int16ub, Struct, this

from lidarspec import Sensor
from lidarspec.spec import (
    Assembled,
    Fields,
    Frame,
    OnWrap,
    PacketCounter,
    Polar,
    Scaled,
    Simulation,
    SizeOf,
    Udp,
    spread,
)

LONGEST = 60

DATA = Struct(
    "magic" / Const(b"\x7a\xa7\x10"),
    "counter" / Int8ub,
    "length" / SizeOf(Int16ub) * "of the whole message",
    "angle" / Scaled(Int16ub, 0.01, "deg"),
    "count" / Int8ub,
    "samples" / Array(this.count, Scaled(Int16ub, 0.001, "m")),
)

FRAGMENT = Struct(
    "magic" / Const(b"\x7a\xa7\x01"), "message" / Int16ub, "index" / Int8ub, "count" / Int8ub
)


def points(f: Fields) -> Polar:
    azimuth = np.deg2rad(spread(f.angle, f.angle + 30 - 30 / f.count, f.count, full=360.0))
    return Polar(range=f.samples, azimuth=azimuth)


def sweep(i: int) -> dict[str, float]:
    """Return the values of message i, twelve a turn."""
    return dict(counter=i % 256, count=LONGEST - i % 3, angle=i * 30.0 % 360)


SENSOR = Sensor(
    "shape-fragments",
    vendor="Shapes",
    model="Fragments",
    frames={
        "data": Frame(
            DATA,
            data=True,
            max_length=9 + 2 * LONGEST,
            plausible=lambda f: (f.angle < 360) & (f.count > 1),
        )
    },
    points=points,
    scan=OnWrap("azimuth"),
    links={
        "data": Udp(
            7780, assembled=Assembled(FRAGMENT, key="message", index="index", count="count")
        )
    },
    sequence=PacketCounter("counter"),
    simulation=Simulation(sweep),
    range_limits=(0.05, 30.0),
    status="manual",
    source="invented for the tests: messages in several datagrams",
)
