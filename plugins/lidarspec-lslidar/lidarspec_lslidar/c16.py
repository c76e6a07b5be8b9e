"""LSLIDAR C16, the edition with packets of 1212 bytes: a rotating lidar of 16 lasers over UDP, low
byte first.

Source: the vendor's ROS driver (Lslidar_ROS2_driver, branch C16_V4.0, lslidar_driver.cpp); where
the fields of the device information stand, the user manual of the C32. The times of the lasers are
3.125 us apart, as for the edition before it, which comes to the steps of 0.36 degrees of a captured
packet at 20 turns a second. Firings end at the time of their packet, as the driver has it.

The clock is read as with GPS: date and nanoseconds. With PTP the same bytes are seconds, with NTP
the last part has microseconds; only the device information says which. A C16 of the edition before
sends packets of 1206 bytes, which are a Velodyne's but for their angles: they are not read here.
Configuration, which is the whole device information sent back, is left out, and so are angles that
a unit measured itself.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import numpy as np
from construct import Array, Bytes, Const, Int8ub, Int8ul, Int16ub, Int16ul, Int32ul, Struct

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
LASER = 3.125e-6  # seconds from laser to laser
BLOCK = GROUPS * LASERS * LASER
CENTRE = 0.0361  # metres from the axis to the optical centre
ASIDE = 20.25  # degrees by which the optical centre lies to the left of the azimuth
TURN = (5.0, 20.0)  # turns per second, the slowest and the fastest
FASTEST = TURN[1] * 360  # degrees per second
UNITS = (0.4, 0.25)  # centimetres of a step of distance, by the unit
ELEVATION = np.array([-16.0, 0, -14, 2, -12, 4, -10, 6, -8, 8, -6, 10, -4, 12, -2, 14])

#: as the packets of this vendor have it.
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
            "azimuth" / Scaled(Int16ul, 0.01, "deg") * "clockwise, at the first laser of the block",
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
                "two firings; with dual return the next block contains the other returns of the"
                " same firings"
            ),
        ),
    ),
    *DATE,
    "nanosecond" / Scaled(Int32ul, 1e-9, "s"),
    "return_mode" / Int8ub * "0x37 single, 0x39 dual",
    "model" / Int8ub * "0x10 C16, 0x12 C16 domestic",
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
    "time_service" / Int8ub * "0 GPS, 1 PTP, 2 NTP",
    "reserved_46" / Bytes(1158),
    "tail" / Const(b"\x0f\xf0"),
)


def plausible(f: Fields) -> Any:
    """Azimuths of the circle, a known way of return, and a C16."""
    known = (f.return_mode == STRONGEST) | (f.return_mode == DUAL)
    return (
        (f.blocks.azimuth < 360)
        & known
        & ((f.model == 0x10) | (f.model == 0x12))
        & (f.month <= 12)
        & (f.nanosecond < 1)
    )


def points(f: Fields, unit: float = UNITS[0]) -> Polar:
    """Clockwise from ahead, on the way from block to block; from an optical centre that turns with
    the lasers, beside the axis.
    """
    dual = f.return_mode == DUAL
    block = np.arange(BLOCKS)[:, None, None]
    slot = np.arange(GROUPS)[:, None] * LASERS + np.arange(LASERS)
    rotor = np.deg2rad(f.blocks.azimuth + rotor_step(f, dual) * (slot / (GROUPS * LASERS)))
    firing = np.where(dual, block // 2 - (BLOCKS // 2 - 1), block - (BLOCKS - 1))
    channels = f.blocks.groups.channels
    aside = np.deg2rad(ASIDE)
    return Polar(
        range=channels.distance * (unit / UNITS[0]),
        azimuth=-rotor,
        elevation=np.deg2rad(ELEVATION),
        intensity=channels.intensity,
        time=firing * BLOCK + (slot - (GROUPS * LASERS - 1)) * LASER,
        ring=np.searchsorted(np.sort(ELEVATION), ELEVATION),
        return_index=np.where(dual, block % 2, 0),
        origin=(CENTRE * np.cos(aside - rotor), CENTRE * np.sin(aside - rotor), 0),
    )


def pace(f: Fields) -> Any:
    """Return the seconds that the blocks of a packet take; with dual return, two are one firing."""
    return np.where(f.return_mode == DUAL, BLOCKS // 2, BLOCKS) * BLOCK


def rotor_step(f: Fields, dual: Any) -> Any:
    """Return the degrees from each firing's azimuth to the next one's."""
    azimuth = f.blocks.azimuth
    ahead = np.where(dual, following(azimuth, 2), following(azimuth))
    return between_blocks(azimuth, ahead, fastest=FASTEST * BLOCK)


def configure(sensor: Sensor, /, *, distance_unit: float) -> Sensor:
    """The sensor with steps of distance of so many centimetres, as the driver's parameter of that
    name: 0.4, or 0.25 for some units.

    Raises:
        UsageError: for another unit.
    """
    if distance_unit not in UNITS:
        raise UsageError(f"{sensor.id}: distance_unit must be 0.4 or 0.25, not {distance_unit!r}")
    return dataclasses.replace(sensor, points=partial(points, unit=distance_unit))


def sweep(i: int) -> dict[str, Any]:
    """Packet i of 10 turns a second."""
    seconds = i * BLOCKS * BLOCK
    return {
        "blocks.azimuth": np.round((i * BLOCKS + np.arange(BLOCKS)) * BLOCK * 3600, 2) % 360,
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
    vendor_axes=("right", "forward", "up"),
    turn=TURN,
    info={"model": "data.model"},
    status="vectors",
    source=(
        "Lslidar_ROS2_driver, C16_V4.0; C32 user manual (device information); one captured"
        " packet of an unknown maker"
    ),
)
