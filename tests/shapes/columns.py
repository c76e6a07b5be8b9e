"""Columns of pixels, each with its own header.

Their angles come from tables by column number. All columns share some fields of the frame.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import Array, Const, Int8ub, Int16sl, Int16ul, Int32ul, Struct

from lidarspec import Sensor
from lidarspec.spec import (
    Clock,
    Fields,
    Frame,
    OnChange,
    Polar,
    Scaled,
    Simulation,
    Udp,
    along,
    take,
)

COLUMNS, PIXELS, TURN = 16, 32, 64

PIXEL = Struct("range" / Scaled(Int16ul, 0.01, "m"), "signal" / Int8ub)
COLUMN = Struct(
    "timestamp" / Scaled(Int32ul, 1e-6, "s"),
    "measurement" / Int16ul * "number of the column in its turn",
    "status" / Int16ul * "1 where it is valid",
    "pixels" / Array(PIXELS, PIXEL),
)
DATA = Struct(
    "header" / Const(b"\xc0\x15"),
    "frame" / Int16ul * "number of the turn",
    "shifts" / Array(PIXELS, Scaled(Int16sl, 0.001, "deg")) * "of the azimuth of each pixel",
    "gains" / Array(COLUMNS, Int8ub),
    "columns" / Array(COLUMNS, COLUMN),
)

_NUMBERS, _ROWS = np.arange(TURN)[:, None], np.arange(PIXELS)
#: radians, (columns of a turn, pixels), and above the horizon, (pixels,).
AZIMUTHS = -2 * np.pi * _NUMBERS / TURN + 0.002 * (_ROWS % 4)
ELEVATIONS = np.deg2rad(_ROWS - 15.5)


def points(f: Fields) -> Polar:
    columns = f.columns
    return Polar(
        range=columns.pixels.range,
        azimuth=take(AZIMUTHS, columns.measurement) + np.deg2rad(f.shifts.on("pixels")),
        elevation=along("pixels", ELEVATIONS),
        intensity=columns.pixels.signal * f.gains.on("columns"),
        time=columns.timestamp - columns[0].timestamp,
        ring=columns.pixels.index,
        column=columns.measurement,
        invalid=columns.status != 1,
    )


def sweep(i: int) -> dict[str, Any]:
    """Return the values of packet i, four packets a turn of a tenth of a second."""
    numbers = COLUMNS * i + np.arange(COLUMNS)
    times, places = numbers * (0.1 / TURN) % 4000, numbers % TURN
    return {
        "frame": i * COLUMNS // TURN % 65536,
        "gains": np.ones(COLUMNS),
        "columns.timestamp": times,
        "columns.measurement": places,
        "columns.status": np.ones(COLUMNS),
    }


SENSOR = Sensor(
    "shape-columns",
    vendor="Shapes",
    model="Columns",
    frames={"data": Frame(DATA, data=True, plausible=lambda f: f.columns.measurement < TURN)},
    points=points,
    scan=OnChange("frame"),
    clock=Clock("columns[0].timestamp", wraps_at=4294.967296),
    links={"data": Udp(7502)},
    simulation=Simulation(sweep, rate=10),
    range_limits=(0.1, 200.0),
    status="manual",
    source="invented for the tests: columns of pixels",
)
