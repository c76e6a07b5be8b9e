"""Neato XV-11 and its kin: lidars of vacuum cleaners and of the TurtleBot3, with a point to the
degree.

Source: the drivers xv_11_laser_driver, kaiaai/LDS (LDS_NEATO_XV11, LDS_LDS02RR, LDS_HLS_LFCD2) and
hls_lfcd_lds_driver of ROBOTIS; there are no public manuals. The XV-11 and Xiaomi's LDS01RR count
counter-clockwise, the LDS02RR clockwise; nothing in their packets says which it is. The host drives
their motors by PWM, at 5 turns a second; without it they send nothing.

Known contradictions on the HLS-LFCD2: its speed is in tenths of a turn a minute (ROBOTIS,
thijses/HLS_LFCD) or in whole ones (kaiaai); its last two bytes are both FF less the sum of the
others (thijses), the folded sum of an XV-11 (kaiaai), and ROBOTIS passes over them, as it is done
here: two packets in a row are asked for instead.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from functools import partial
from typing import Any

import numpy as np
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Bytes,
    ByteSwapped,
    Const,
    Int8ul,
    Int16ul,
    Struct,
)

from lidarspec.spec import (
    Checksummed,
    Command,
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
)

FIRST = 0xA0  # index of the first packet of a turn

DATA = Checksummed(
    Struct(
        "header" / Const(b"\xfa"),
        "start_angle"
        / Scaled(Int8ul, 4, "deg", -4 * FIRST)
        * "index A0 to F9: angle of the first sample",
        "speed" / Scaled(Int16ul, 1 / 64, "rpm"),
        "samples"
        / Array(
            4,
            Struct(
                "range"
                / ByteSwapped(
                    BitStruct(
                        "invalid" / BitsInteger(1) * "1: the distance is the number of an error",
                        "weak" / BitsInteger(1) * "1: less signal than expected",
                        "distance" / Scaled(BitsInteger(14), 0.001, "m"),
                    )
                ),
                "signal" / Int16ul,
            ),
        ),
        "checksum" / Int16ul,
    ),
    field="checksum",
    algorithm=Fold15(),
)
LFCD = Struct(
    "header" / Const(b"\xfa"),
    "start_angle"
    / Scaled(Int8ul, 6, "deg", -6 * FIRST)
    * "index A0 to DB: angle of the first sample",
    "speed" / Scaled(Int16ul, 0.1, "rpm"),
    "samples"
    / Array(
        6,
        Struct(
            "intensity" / Int16ul,
            "distance" / Scaled(Int16ul, 0.001, "m") * "0: no return",
            "reserved" / Bytes(2),
        ),
    ),
    "trailer" / Bytes(2) * "said to be FF less the sum of all other bytes, twice",
)


def plausible(f: Fields) -> Any:
    """Return an angle of the circle."""
    return (f.start_angle >= 0) & (f.start_angle < 360)


def lfcd_plausible(f: Fields) -> Any:
    """Return an angle of the circle, and no more than twice the speed that it has."""
    return (f.start_angle >= 0) & (f.start_angle < 360) & (f.speed <= 600)


def after_first(f: Fields, count: int) -> Any:
    """Return the seconds from the first sample of a packet to each sample.

    Samples are one degree apart. The result is 0 if the motor stands still.
    """
    return np.where(f.speed > 0, np.arange(count) / (np.maximum(f.speed, 1 / 64) * 6), 0)


def points(f: Fields, turns: int) -> Polar:
    """A degree from sample to sample, counter-clockwise (1) or clockwise (-1); a weak one is a
    point all the same.
    """
    return Polar(
        range=np.where(f.samples.range.invalid, 0, f.samples.range.distance),
        azimuth=np.deg2rad(turns * (f.start_angle + np.arange(4))),
        intensity=f.samples.signal,
        time=after_first(f, 4),
    )


def lfcd_points(f: Fields) -> Polar:
    """A degree from sample to sample, clockwise; the first one is at 359 degrees (ROBOTIS)."""
    azimuth = np.deg2rad(359 - f.start_angle - np.arange(6))
    return Polar(
        range=f.samples.distance,
        azimuth=azimuth,
        intensity=f.samples.intensity,
        time=after_first(f, 6),
    )


def sweep(i: int, count: int) -> dict[str, float]:
    """Packet i of turns at 5 Hz, with so many samples."""
    return {"start_angle": i * count % 360, "speed": 300}


TOLD_BY = "nothing in their packets: it counts the other way, or has another label"
KIN = ("neato-xv11", "xiaomi-lds01rr", "xiaomi-lds02rr")

XV11 = Sensor(
    "neato-xv11",
    vendor="Neato",
    model="XV-11",
    frames={"data": Frame(DATA, data=True, plausible=plausible)},
    points=partial(points, turns=1),
    scan=OnWrap("azimuth"),
    links={"data": Serial(115_200)},
    simulation=Simulation(partial(sweep, count=4)),
    range_limits=(0.15, 6.0),
    beams=360,
    relatives={name: TOLD_BY for name in KIN if name != "neato-xv11"},
    status="vectors",
    source="xv_11_laser_driver; kaiaai/LDS, LDS_NEATO_XV11. Limits of range are assumed",
)
LDS01RR = dataclasses.replace(
    XV11,
    id="xiaomi-lds01rr",
    vendor="Xiaomi",
    model="LDS01RR",
    relatives={name: TOLD_BY for name in KIN if name != "xiaomi-lds01rr"},
    source="kaiaai/LDS, LDS_LDS01RR. Limits of range are assumed",
)
LDS02RR = dataclasses.replace(
    XV11,
    id="xiaomi-lds02rr",
    vendor="Xiaomi",
    model="LDS02RR",
    points=partial(points, turns=-1),
    relatives={name: TOLD_BY for name in KIN if name != "xiaomi-lds02rr"},
    source="kaiaai/LDS, LDS_LDS02RR. Limits of range are assumed",
)
HLS_LFCD2 = Sensor(
    "hitachi-hls-lfcd2",
    vendor="Hitachi-LG",
    model="HLS-LFCD2 (LDS-01)",
    frames={
        "data": Frame(
            LFCD,
            data=True,
            plausible=lfcd_plausible,
            confirm=2,
            acknowledged={"LS212": "its sources contradict each other on the trailer"},
        ),
        "command": Frame(Struct("letter" / Int8ul * "ASCII: b begin, e end"), direction="out"),
    },
    points=lfcd_points,
    scan=OnWrap("azimuth", at=np.deg2rad(359.5)),
    links={"data": Serial(230_400)},
    commands={
        "start": Command("command", {"letter": ord("b")}, starts=True),
        "stop": Command("command", {"letter": ord("e")}, stops=True),
    },
    simulation=Simulation(partial(sweep, count=6)),
    on_open=("start",),
    on_close=("stop",),
    range_limits=(0.12, 3.5),
    beams=360,
    turn=(4.83, 5.17),  # 300 turns a minute, give or take 10 (ROBOTIS, LDS-01)
    status="vectors",
    source=(
        "hls_lfcd_lds_driver and the LDS-01's page of ROBOTIS; thijses/HLS_LFCD. What its trailer"
        " is, is not proven"
    ),
)


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """The XV-11 and its kin."""
    return [XV11, LDS01RR, LDS02RR, HLS_LFCD2]
