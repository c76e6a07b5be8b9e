"""A header with the number of blocks, their unit, and a flag for a counter.

The angles are nominal until a file is given.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from construct import Array, Const, If, Int8ul, Int16ul, Struct, this

from lidarspec import Sensor
from lidarspec.spec import Fields, Frame, OnWrap, PacketCounter, Polar, Scaled, Simulation, Udp

CHANNELS = 3
EXAMPLE = Path(__file__).with_name("calibration.json")

DATA = Struct(
    "magic" / Const(b"HD"),
    "unit" / Scaled(Int8ul, 1, "mm") * "one step of a distance",
    "rows" / Int8ul,
    "counted" / Int8ul,
    "blocks"
    / Array(
        this.rows,
        Struct(
            "azimuth" / Scaled(Int16ul, 0.01, "deg"),
            "channels" / Array(CHANNELS, Struct("distance" / Int16ul, "strength" / Int8ul)),
        ),
    ),
    "counter" / If(this.counted == 1, Int16ul),
)


def points_with(elevation: Any, *, nominal: bool) -> Callable[[Fields], Polar]:
    def points(f: Fields) -> Polar:
        return Polar(
            range=f.blocks.channels.distance * (f.unit * 0.001),
            azimuth=-np.deg2rad(f.blocks.azimuth),
            elevation=np.deg2rad(elevation),
            intensity=f.blocks.channels.strength,
            ring=np.arange(CHANNELS),
            nominal=nominal,
        )

    return points


def configure(sensor: Sensor, *, calibration: str | Path) -> Sensor:
    """Return the sensor with the elevations of a file."""
    elevations = json.loads(Path(calibration).read_text(encoding="utf-8"))["elevations"][:CHANNELS]
    return dataclasses.replace(sensor, points=points_with(elevations, nominal=False))


def sweep(i: int) -> dict[str, Any]:
    """Return the values of packet i, twelve packets of two blocks a turn."""
    return {
        "unit": 4,
        "rows": 2,
        "counted": 1,
        "counter": i % 65_536,
        "blocks.azimuth": [i * 30 % 360, (i * 30 + 15) % 360],
    }


SENSOR = Sensor(
    "shape-headed",
    vendor="Shapes",
    model="Headed",
    frames={
        "data": Frame(
            DATA,
            data=True,
            max_length=7 + 8 * 11,
            plausible=lambda f: (f.unit >= 1) & (f.blocks.azimuth < 360),
        )
    },
    points=points_with([-1.0, 0.0, 1.0], nominal=True),
    scan=OnWrap("blocks.azimuth"),
    links={"data": Udp(7004)},
    sequence=PacketCounter("counter"),
    simulation=Simulation(sweep),
    configure=configure,
    range_limits=(0.1, 60.0),
    status="manual",
    source="invented for the tests: counts, unit and counter by the header",
)
