"""Points with further attributes.

One has a unit and a sign, one belongs to an outer array and has no unit, one is a set of bits, and
one is computed.
"""

from __future__ import annotations

import numpy as np
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Const,
    Int8ul,
    Int16sb,
    Int16ub,
    Int32ub,
    Struct,
)

from lidarspec import Sensor
from lidarspec.spec import (
    Checksummed,
    Clock,
    Every,
    Extra,
    Fields,
    Frame,
    PacketCounter,
    Polar,
    Scaled,
    Simulation,
    Udp,
    Xor,
    hookimpl,
)

BLOCKS, CHANNELS = 4, 3
#: seconds from a packet to the next.
PACE_S = 0.01

DATA = Checksummed(
    Struct(
        "head" / Const(b"\xe5\x7a"),
        "number" / Int16ub,
        "time" / Scaled(Int32ub, 1e-6, "s"),
        "blocks"
        / Array(
            BLOCKS,
            Struct(
                "azimuth" / Scaled(Int16ub, 0.01, "deg"),
                "signal" / Int32ub,
                "channels"
                / Array(
                    CHANNELS,
                    Struct(
                        "distance" / Scaled(Int16ub, 0.004, "m"),
                        "velocity" / Scaled(Int16sb, 0.01, "m/s"),
                        "near_ir" / Int16ub,
                        "mark" / BitStruct("noise" / BitsInteger(3), "tag" / BitsInteger(5)),
                    ),
                ),
            ),
        ),
        "xor" / Int8ul,
    ),
    field="xor",
    algorithm=Xor(),
)


def points(f: Fields) -> Polar:
    """Return points with further columns.

    The signal is that of the block. The confidence falls with the noise, and is missing from noise
    7 on.
    """
    channels = f.blocks.channels
    return Polar(
        channels.distance,
        np.deg2rad(f.blocks.azimuth),
        np.deg2rad([-5.0, 0.0, 5.0]),
        extra={
            "velocity": channels.velocity,
            "near_ir": channels.near_ir,
            "signal": Extra(f.blocks.signal, unit="photons"),
            "tag": channels.mark.tag,
            "confidence": Extra(
                np.where(channels.mark.noise < 7, 1 - channels.mark.noise / 7, np.nan), unit="1"
            ),
            "strong": channels.near_ir > 1000 + 8 * channels.mark.tag,
        },
    )


SENSOR = Sensor(
    "shape-extras",
    vendor="Shapes",
    model="Extras",
    frames={"data": Frame(DATA, data=True)},
    points=points,
    scan=Every(0.1),
    links={"data": Udp(56_310)},
    clock=Clock("time", wraps_at=4294.967296, pace=lambda f: PACE_S),
    sequence=PacketCounter("number"),
    simulation=Simulation(
        lambda i: {
            "number": i % 65_536,
            "time": i * PACE_S % 4294.967296,
            "blocks.azimuth": (np.arange(BLOCKS) + i * BLOCKS) * 9 % 360,
            "blocks.signal": np.arange(BLOCKS) + 2**24 + 1,
        }
    ),
    range_limits=(0.1, 200.0),
    status="manual",
    source="invented for the tests: further attributes of points",
)


@hookimpl
def lidarspec_sensors() -> list[Sensor]:
    return [SENSOR]
