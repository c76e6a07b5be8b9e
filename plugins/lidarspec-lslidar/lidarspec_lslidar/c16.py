"""LSLIDAR C16 with packets of 1212 bytes: a rotating lidar with 16 lasers over UDP.

Numbers are little-endian. A previous edition of the C16 sends packets of 1206 bytes, which are the
same as those of a Velodyne except for their angles. These packets are not supported.

Source: the vendor's ROS driver (Lslidar_ROS2_driver, branch C16_V4.0, lslidar_driver.cpp); the user
manual of the C32 for the offsets of the device information. The firing interval of 3.125 us is that
of the previous edition, and agrees with the azimuths of a captured packet. The last firing of a
packet is at the time of the packet, as in the driver.

The clock is read as a date and nanoseconds, which the sensor sends if it is synchronized by GPS.
The times of PTP and NTP are sent in other units and are not supported. The configuration of the
sensor and the measured angles of a sensor are not supported either.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import numpy as np
from construct import Array, Bytes, Const, Enum, Int8ub, Int8ul, Int16ub, Int16ul, Int32ul, Struct

from lidarspec import UsageError
from lidarspec.spec import (
    Clock,
    Fields,
    Frame,
    OnWrap,
    Polar,
    Scaled,
    Sensor,
    Simulation,
    Udp,
    between_blocks,
    following,
)

BLOCKS = 12
GROUPS = 2
LASERS = 16
STRONGEST = 0x37
DUAL = 0x39
LASER_PERIOD_S = 3.125e-6  # from laser to laser
BLOCK_PERIOD_S = GROUPS * LASERS * LASER_PERIOD_S
OPTICAL_RADIUS_M = 0.0361  # from the axis to the optical centre
OPTICAL_ANGLE_DEG = 20.25  # of the optical centre to the left of the azimuth
SPEED_LIMITS_HZ = (5.0, 20.0)  # lowest and highest revolutions per second
MAX_SPEED_DEG_S = SPEED_LIMITS_HZ[1] * 360
DISTANCE_STEPS_CM = (0.4, 0.25)  # depends on the unit
ELEVATION = np.array([-16.0, 0, -14, 2, -12, 4, -10, 6, -8, 8, -6, 10, -4, 12, -2, 14])

#: The date in the packets of this vendor.
DATE = (
    "year" / Int8ub * "years since 2000",
    "month" / Int8ub,
    "day" / Int8ub,
    "hour" / Scaled(Int8ub, 3600, "s"),
    "minute" / Scaled(Int8ub, 60, "s"),
    "second" / Scaled(Int8ub, 1, "s"),
)
DATA = Struct(
    "blocks"
    / Array(
        BLOCKS,
        Struct(
            "flag" / Const(b"\xff\xee"),
            "azimuth"
            / Scaled(Int16ul, 0.01, "deg")
            * "clockwise, when the first laser of the block fires",
            "groups"
            / Array(
                GROUPS,
                Struct(
                    "channels"
                    / Array(
                        LASERS,
                        Struct(
                            "distance" / Scaled(Int16ul, 0.004, "m") * "0: no return",
                            "intensity" / Int8ul,
                        ),
                    )
                ),
            )
            * (
                "two firings; with dual return, the next block contains the other returns of"
                " these firings"
            ),
        ),
    ),
    *DATE,
    "nanosecond" / Scaled(Int32ul, 1e-9, "s"),
    "return_mode" / Enum(Int8ub, single=STRONGEST, dual=DUAL),
    "model" / Enum(Int8ub, **{"C16": 0x10, "C16 domestic": 0x12}),
)
DIFOP = Struct(
    "header" / Const(b"\xa5\xff\x00\x5a\x11\x11\x55\x55"),
    "rpm" / Scaled(Int16ub, 1, "rpm") * "configured speed",
    "lidar_ip" / Bytes(4),
    "host_ip" / Bytes(4),
    "mac" / Bytes(6),
    "data_port" / Int16ub,
    "device_port" / Int16ub,
    "reserved_28" / Bytes(17),
    "time_service" / Enum(Int8ub, gps=0, ptp=1, ntp=2),
    "reserved_46" / Bytes(1158),
    "tail" / Const(b"\x0f\xf0"),
)


def plausible(f: Fields) -> Any:
    """Return whether azimuths, return mode, model, month and nanoseconds are valid."""
    has_known_mode = (f.return_mode == STRONGEST) | (f.return_mode == DUAL)
    return (
        (f.blocks.azimuth < 360)
        & has_known_mode
        & ((f.model == 0x10) | (f.model == 0x12))
        & (f.month <= 12)
        & (f.nanosecond < 1)
    )


def points(f: Fields, unit: float = DISTANCE_STEPS_CM[0]) -> Polar:
    """Return the points; azimuths are interpolated between blocks."""
    dual = f.return_mode == DUAL
    block = np.arange(BLOCKS)[:, None, None]
    slot = np.arange(GROUPS)[:, None] * LASERS + np.arange(LASERS)
    clockwise = np.deg2rad(f.blocks.azimuth + block_step(f, dual) * (slot / (GROUPS * LASERS)))
    firing = np.where(dual, block // 2 - (BLOCKS // 2 - 1), block - (BLOCKS - 1))
    channels = f.blocks.groups.channels
    optical_angle = np.deg2rad(OPTICAL_ANGLE_DEG)
    return Polar(
        range=channels.distance * (unit / DISTANCE_STEPS_CM[0]),
        azimuth=-clockwise,
        elevation=np.deg2rad(ELEVATION),
        intensity=channels.intensity,
        time=firing * BLOCK_PERIOD_S + (slot - (GROUPS * LASERS - 1)) * LASER_PERIOD_S,
        ring=np.searchsorted(np.sort(ELEVATION), ELEVATION),
        return_index=np.where(dual, block % 2, 0),
        origin=(
            OPTICAL_RADIUS_M * np.cos(optical_angle - clockwise),
            OPTICAL_RADIUS_M * np.sin(optical_angle - clockwise),
            0,
        ),
    )


def pace(f: Fields) -> Any:
    """Return the seconds from a packet to the next: the duration of the blocks of a packet."""
    return np.where(f.return_mode == DUAL, BLOCKS // 2, BLOCKS) * BLOCK_PERIOD_S


def block_step(f: Fields, dual: Any) -> Any:
    """Return the angle from each block to the block of the next firing, in degrees."""
    azimuth = f.blocks.azimuth
    ahead = np.where(dual, following(azimuth, 2), following(azimuth))
    return between_blocks(azimuth, ahead, fastest=MAX_SPEED_DEG_S * BLOCK_PERIOD_S)


def configure(sensor: Sensor, /, *, distance_unit: float) -> Sensor:
    """Return the sensor with distance steps of 0.4 or, for some units, 0.25 cm.

    Raises:
        UsageError: for another step.
    """
    if distance_unit not in DISTANCE_STEPS_CM:
        raise UsageError(f"{sensor.id}: distance_unit must be 0.4 or 0.25, not {distance_unit!r}")
    return dataclasses.replace(sensor, points=partial(points, unit=distance_unit))


def sweep(i: int) -> dict[str, Any]:
    """Return the values of simulated packet i, at 10 revolutions a second."""
    seconds = i * BLOCKS * BLOCK_PERIOD_S
    return {
        "blocks.azimuth": np.round((i * BLOCKS + np.arange(BLOCKS)) * BLOCK_PERIOD_S * 3600, 2)
        % 360,
        **{
            "year": 26,
            "month": 1,
            "day": 1,
            "hour": seconds // 3600 % 24 * 3600,
            "minute": seconds // 60 % 60 * 60,
        },
        **{
            "second": seconds // 1 % 60,
            "nanosecond": seconds % 1,
            "return_mode": STRONGEST,
            "model": 0x10,
        },
    }


C16 = Sensor(
    "lslidar-c16",
    vendor="LSLIDAR",
    model="C16",
    frames={
        "data": Frame(DATA, data=True, plausible=plausible),
        "difop": Frame(
            DIFOP, simulation=Simulation(lambda i: {"rpm": 600, "time_service": 0}, rate=1.0)
        ),
    },
    points=points,
    scan=OnWrap("blocks.azimuth"),
    links={"data": Udp(2368, 2369)},
    clock=Clock(("hour", "minute", "second", "nanosecond"), wraps_at=86_400.0, pace=pace),
    simulation=Simulation(sweep),
    configure=configure,
    range_limits=(0.3, 200.0),  # the defaults of the driver
    returns=("varying", "varying"),  # the order is not documented
    vendor_axes=("right", "forward", "up"),
    turn=SPEED_LIMITS_HZ,
    info={"model": "data.model"},
    status="vectors",
    source=(
        "Lslidar_ROS2_driver, C16_V4.0; C32 user manual (device information); one captured"
        " packet of an unknown maker"
    ),
)
