"""Two returns of the same firings in two consecutive packets, in the dual-return mode."""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import Array, Const, Int8ub, Int16ub, Struct

from lidarspec import Sensor
from lidarspec.spec import Fields, Frame, OnRewind, PacketCounter, Polar, Scaled, Simulation, Udp

FIRINGS = 3
CHANNELS = 2
LAST_NUMBER = 40
DUAL_MODE = 2

DATA = Struct(
    "magic" / Const(b"\xbe\xa8"),
    "number" / Int8ub * "1 to 40",
    "mode" / Int8ub * "1 single, 2 dual",
    "second" / Int8ub * "1: second returns",
    "firings"
    / Array(
        FIRINGS,
        Struct(
            "azimuth" / Scaled(Int16ub, 0.01, "deg"),
            "channels"
            / Array(
                CHANNELS, Struct("distance" / Scaled(Int16ub, 0.01, "m"), "intensity" / Int8ub)
            ),
        ),
    ),
)


def plausible(f: Fields) -> Any:
    return (f.number >= 1) & (f.number <= LAST_NUMBER) & (f.mode >= 1) & (f.mode <= DUAL_MODE)


def count_returns(f: Fields) -> Any:
    return np.where(f.mode == DUAL_MODE, 2, 1)


def points(f: Fields) -> Polar:
    group = np.where(f.mode == DUAL_MODE, np.floor((f.number - 1) / 2), f.number - 1)
    return Polar(
        range=f.firings.channels.distance,
        azimuth=np.deg2rad(f.firings.azimuth),
        elevation=np.array([0.0, 0.1]),
        intensity=f.firings.channels.intensity,
        ring=np.arange(CHANNELS),
        return_index=f.second,
        column=group * FIRINGS + f.firings.index,
    )


def sweep(i: int) -> dict[str, Any]:
    number = i % LAST_NUMBER
    azimuths = (number * FIRINGS + np.arange(FIRINGS)) * 0.5
    return {"number": number + 1, "mode": 1, "second": 0, "firings.azimuth": azimuths}


SENSOR = Sensor(
    "shape-pairs",
    vendor="Shapes",
    model="Pairs",
    frames={"data": Frame(DATA, data=True, plausible=plausible)},
    points=points,
    scan=OnRewind("number"),
    links={"data": Udp(7011)},
    sequence=PacketCounter("number", first=1, last=LAST_NUMBER, returns=count_returns),
    returns=("first", "last"),
    simulation=Simulation(sweep),
    range_limits=(0.1, 100.0),
    status="manual",
    source="invented for the tests: pairs of packets",
)
