"""A mirror with two faces, each with its own sector, one of them across 0.

A scan ends when the angle jumps from one sector to the other.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import Array, Const, Int8ul, Int16ul, Struct

from lidarspec import Sensor
from lidarspec.spec import Fields, Frame, OnJump, PacketCounter, Polar, Scaled, Simulation, Udp

ROWS, PER_FACE, STEP = 3, 20, 1.5  # rows of a packet and of a face, degrees between two of them
FACES = (150.0, 345.0)  # where they begin; a sector has 28.5 degrees, and the second goes on past 0
FRAME = Struct(
    "magic" / Const(b"MR"),
    "counter" / Int8ul,
    "rows"
    / Array(
        ROWS,
        Struct(
            "angle" / Scaled(Int16ul, 0.01, "deg"),
            "distances" / Array(2, Scaled(Int16ul, 0.01, "m")),
        ),
    ),
)


def points(f: Fields) -> Polar:
    """Return two pixels side by side.

    The mirror deflects the beam by twice its own angle.
    """
    behind = np.minimum(*(np.mod(f.rows.angle - face, 360) for face in FACES))
    return Polar(range=f.rows.distances, azimuth=np.deg2rad(2 * behind + np.array([-0.2, 0.2])))


def sweep(i: int) -> dict[str, Any]:
    """Return the values of packet i; the faces follow one another.

    A packet may contain rows of both faces.
    """
    row = i * ROWS + np.arange(ROWS)
    begins = np.array(FACES)[row // PER_FACE % len(FACES)]
    return {"counter": i % 256, "rows.angle": np.round((begins + row % PER_FACE * STEP) % 360, 2)}


SENSOR = Sensor(
    "shape-mirror",
    vendor="Shapes",
    model="Mirror",
    frames={
        "data": Frame(
            FRAME,
            data=True,
            max_length=3 + 6 * ROWS,
            plausible=lambda f: f.rows.angle < 360,
        )
    },
    points=points,
    scan=OnJump("rows.angle", 10.0),
    links={"data": Udp(7043)},
    sequence=PacketCounter("counter"),
    simulation=Simulation(sweep),
    range_limits=(0.01, 60.0),
    status="manual",
    source="invented for the tests: sectors of a mirror",
)
