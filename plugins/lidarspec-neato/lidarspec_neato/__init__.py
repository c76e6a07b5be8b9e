"""Neato XV-11, and related lidars of vacuum cleaners and of the TurtleBot3.

The lidars measure one point per degree. Source: the drivers xv_11_laser_driver, kaiaai/LDS
(LDS_NEATO_XV11, LDS_LDS02RR, LDS_HLS_LFCD2) and hls_lfcd_lds_driver of ROBOTIS; there are no public
manuals. The XV-11 and Xiaomi's LDS01RR count angles counter-clockwise, and the LDS02RR counts them
clockwise; the packets do not contain the direction. The host drives the motors with PWM, at 5
revolutions a second. The lidars send nothing while the motor is off.

The sources disagree about the HLS-LFCD2. Its speed is in tenths of a revolution per minute
(ROBOTIS, thijses/HLS_LFCD) or in whole revolutions per minute (kaiaai). Its last two bytes are both
FF minus the sum of the other bytes (thijses), or the folded sum of an XV-11 (kaiaai). This module
ignores these bytes, as ROBOTIS does, and requires two consecutive packets instead.
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
    Enum,
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

FIRST_INDEX = 0xA0  # of the packets of a revolution

DATA = Checksummed(
    Struct(
        "header" / Const(b"\xfa"),
        "start_angle"
        / Scaled(Int8ul, 4, "deg", -4 * FIRST_INDEX)
        * "angle of the first sample, sent as an index from A0 to F9",
        "speed" / Scaled(Int16ul, 1 / 64, "rpm"),
        "samples"
        / Array(
            4,
            Struct(
                "range"
                / ByteSwapped(
                    BitStruct(
                        "invalid" / BitsInteger(1) * "1: `distance` contains an error code",
                        "weak" / BitsInteger(1) * "1: the signal is weaker than expected",
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
    / Scaled(Int8ul, 6, "deg", -6 * FIRST_INDEX)
    * "angle of the first sample, sent as an index from A0 to DB",
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
    "trailer"
    / Bytes(2)
    * "not checked; according to the documents, both bytes are FF minus the sum of all other"
    " bytes",
)


def plausible(f: Fields) -> Any:
    """Return whether the start angle is between 0 and 360 degrees."""
    return (f.start_angle >= 0) & (f.start_angle < 360)


def is_lfcd_plausible(f: Fields) -> Any:
    """Return whether the start angle and the speed are possible."""
    return (f.start_angle >= 0) & (f.start_angle < 360) & (f.speed <= 600)


def sample_times(f: Fields, count: int) -> Any:
    """Return the seconds from the first sample of a packet to each sample."""
    return np.where(f.speed > 0, np.arange(count) / (np.maximum(f.speed, 1 / 64) * 6), 0)


def points(f: Fields, direction: int) -> Polar:
    """Return points one degree apart, including weak points.

    `direction` is 1 for counter-clockwise, -1 for clockwise.
    """
    return Polar(
        range=np.where(f.samples.range.invalid, 0, f.samples.range.distance),
        azimuth=np.deg2rad(direction * (f.start_angle + np.arange(4))),
        intensity=f.samples.signal,
        time=sample_times(f, 4),
    )


def lfcd_points(f: Fields) -> Polar:
    """Return points one degree apart, clockwise from 359 degrees (ROBOTIS)."""
    azimuth = np.deg2rad(359 - f.start_angle - np.arange(6))
    return Polar(
        range=f.samples.distance,
        azimuth=azimuth,
        intensity=f.samples.intensity,
        time=sample_times(f, 6),
    )


def sweep(i: int, count: int) -> dict[str, float]:
    """Return the simulated values of packet i with `count` samples, at 5 Hz."""
    return {"start_angle": i * count % 360, "speed": 300}


#: The direction of rotation of each model with these packets: 1 is counter-clockwise.
XV11_DIRECTIONS = {"neato-xv11": 1, "xiaomi-lds01rr": 1, "xiaomi-lds02rr": -1}


def describe_differences(own: str) -> dict[str, str]:
    """Return, by id, how each other model with packets of an XV-11 differs.

    Args:
        own: the id of this model.
    """
    texts = {}
    for other, direction in XV11_DIRECTIONS.items():
        if other == own:
            continue
        if direction == XV11_DIRECTIONS[own]:
            texts[other] = "both models send the same packets; the label names the model"
        elif direction == 1:
            texts[other] = "sends the same packets, but rotates counter-clockwise"
        else:
            texts[other] = "sends the same packets, but rotates clockwise"
    return texts


XV11 = Sensor(
    "neato-xv11",
    vendor="Neato",
    model="XV-11",
    frames={"data": Frame(DATA, data=True, plausible=plausible)},
    points=partial(points, direction=XV11_DIRECTIONS["neato-xv11"]),
    scan=OnWrap("azimuth"),
    links={"data": Serial(115_200)},
    simulation=Simulation(partial(sweep, count=4)),
    range_limits=(0.15, 6.0),
    beams=360,
    relatives=describe_differences("neato-xv11"),
    status="vectors",
    source="xv_11_laser_driver; kaiaai/LDS, LDS_NEATO_XV11. Range limits are assumed",
)
LDS01RR = dataclasses.replace(
    XV11,
    id="xiaomi-lds01rr",
    vendor="Xiaomi",
    model="LDS01RR",
    relatives=describe_differences("xiaomi-lds01rr"),
    source="kaiaai/LDS, LDS_LDS01RR. Range limits are assumed",
)
LDS02RR = dataclasses.replace(
    XV11,
    id="xiaomi-lds02rr",
    vendor="Xiaomi",
    model="LDS02RR",
    points=partial(points, direction=XV11_DIRECTIONS["xiaomi-lds02rr"]),
    relatives=describe_differences("xiaomi-lds02rr"),
    source="kaiaai/LDS, LDS_LDS02RR. Range limits are assumed",
)
HLS_LFCD2 = Sensor(
    "hitachi-hls-lfcd2",
    vendor="Hitachi-LG",
    model="HLS-LFCD2 (LDS-01)",
    frames={
        "data": Frame(
            LFCD,
            data=True,
            plausible=is_lfcd_plausible,
            confirm=2,
            acknowledged={
                "LS212": "the documents of this sensor contradict each other about the trailer"
            },
        ),
        "command": Frame(
            Struct("letter" / Enum(Int8ul, begin=ord("b"), end=ord("e"))), direction="out"
        ),
    },
    points=lfcd_points,
    scan=OnWrap("azimuth", at=np.deg2rad(359.5)),
    links={"data": Serial(230_400)},
    commands={
        "start": Command("command", {"letter": "begin"}, starts=True),
        "stop": Command("command", {"letter": "end"}, stops=True),
    },
    simulation=Simulation(partial(sweep, count=6)),
    on_open=("start",),
    on_close=("stop",),
    range_limits=(0.12, 3.5),
    beams=360,
    turn=(4.83, 5.17),  # 300 +- 10 revolutions per minute (ROBOTIS, LDS-01)
    status="vectors",
    source=(
        "hls_lfcd_lds_driver and the LDS-01's page of ROBOTIS; thijses/HLS_LFCD. The meaning"
        " of the trailer is unverified"
    ),
)


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """Return the XV-11 and the related models."""
    return [XV11, LDS01RR, LDS02RR, HLS_LFCD2]
