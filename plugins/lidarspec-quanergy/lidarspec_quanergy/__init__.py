"""Quanergy M8 and MQ8: rotating lidars of eight lasers over TCP, which send by themselves, high
byte first.

Source: the vendor's quanergy_client (packet_header.h, m_series_data_packet.h,
data_packet_parser_00.cpp, data_packet_parser_04.cpp, data_packet_parser_m_series.h). The client
takes the time of a packet for that of its last firing. Assumed are what it does not say: that
firings are evenly apart, at 420 000 points a second, the limits of range, and turns a second. Which
way a unit turns its positions tell: they may fall as well as grow. The nanoseconds of packets
before version 4 count tens of them, which is not corrected here. Packets of other kinds (1 and 6)
and settings over HTTP are left out. No packet of a sensor was seen.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

import numpy as np
from construct import Array, Bytes, Const, Construct, Int8ub, Int16ub, Int32ub, Struct
from numpy.typing import NDArray

from lidarspec.spec import (
    Clock,
    Fields,
    Frame,
    OnWrap,
    Polar,
    Scaled,
    Sensor,
    Simulation,
    Tcp,
    hookimpl,
    stack,
)

FIRINGS = 50
LASERS = 8
TICKS = 10_400  # positions of a turn
FINE = 5  # the first version of packets with steps of 10 um; before it they are of 10 mm
PERIOD = LASERS / 420_000  # seconds from firing to firing
TIME = (
    np.arange(FIRINGS) - (FIRINGS - 1)
) * PERIOD  # of the firings of a packet, after the packet's own

#: radians above the level, from the lowest laser to the highest.
M8_ELEVATION = np.array(
    [-0.318505, -0.2692, -0.218009, -0.165195, -0.111003, -0.0557982, 0.0, 0.0557982]
)
MQ8_ELEVATION = np.array(
    [-0.24435, -0.18326, -0.14137, -0.10297, -0.07854, -0.055327, -0.041364, -0.027402]
)

POSITION: Construct = Scaled(Int16ub, 360 / TICKS, "deg") * "counter-clockwise"
DISTANCES: Construct = Array(
    LASERS, Scaled(Int32ub, 1e-5, "m") * "0: no return; before version 5 a step is 10 mm"
)
INTENSITIES: Construct = Array(LASERS, Int8ub * "255: saturated")


def header(kind: int, size: int) -> tuple[Construct, ...]:
    """Return the header of a packet of this kind and so many bytes in all."""
    return (
        "signature" / Const(b"\x75\xbd\x7e\x97"),
        "size" / Const(size, Int32ub) * "of the whole packet",
        "seconds" / Scaled(Int32ub, 1, "s") * "since 1970",
        "nanoseconds" / Scaled(Int32ub, 1e-9, "s"),
        "version" / Bytes(3),
        "kind" / Const(kind, Int8ub),
    )


THREE = Struct(
    *header(0, 6632),
    "firings"
    / Array(
        FIRINGS,
        Struct(
            "position" / POSITION,
            "padding" / Bytes(2),
            "first" / DISTANCES,
            "second" / DISTANCES,
            "third" / DISTANCES,
            "first_intensity" / INTENSITIES,
            "second_intensity" / INTENSITIES,
            "third_intensity" / INTENSITIES,
            "reserved" / Bytes(LASERS),
        ),
    ),
    "body_seconds" / Int32ub * "as in the header",
    "body_nanoseconds" / Int32ub * "as in the header",
    "api" / Int16ub * "version of the packet",
    "status" / Int16ub * "0 good, 1 software and firmware do not match, 2 watchdog",
)
ONE = Struct(
    *header(4, 2224),
    "status" / Int16ub * "0 good, 1 software and firmware do not match, 2 watchdog",
    "return_id" / Int8ub * "which of the three returns",
    "reserved" / Bytes(1),
    "firings"
    / Array(
        FIRINGS,
        Struct(
            "position" / POSITION,
            "padding" / Bytes(2),
            "distance" / DISTANCES,
            "intensity" / INTENSITIES,
        ),
    ),
)


def plausible(f: Fields) -> Any:
    """Positions of the circle, and a time of day."""
    return (f.firings.position <= 360) & (f.nanoseconds < 1)


def three_points(f: Fields, elevation: NDArray[np.float64]) -> Polar:
    """Three returns of each laser; where there are fewer, the third repeats the first or the
    second, which then are no points.
    """
    fields = f.firings
    first, second, third = (
        each.on("firings", "firings.third") for each in (fields.first, fields.second, fields.third)
    )
    intensities = (fields.first_intensity, fields.second_intensity, fields.third_intensity)
    return Polar(
        range=stack(np.where(first == third, 0, first), np.where(second == third, 0, second), third)
        * np.where(f.api < FINE, 1000, 1),
        azimuth=np.deg2rad(fields.position),
        elevation=elevation[:, None],
        intensity=stack(*(each.on("firings", "firings.third") for each in intensities)),
        time=TIME[:, None, None],
        ring=np.arange(LASERS)[:, None],
        return_index=np.arange(3),
    )


def one_points(f: Fields, elevation: NDArray[np.float64]) -> Polar:
    """One return of each laser."""
    return Polar(
        range=f.firings.distance,
        azimuth=np.deg2rad(f.firings.position),
        elevation=elevation,
        intensity=f.firings.intensity.on("firings", "firings.distance"),
        time=TIME[:, None],
        ring=np.arange(LASERS),
        return_index=f.return_id,
    )


def sweep(i: int, more: Mapping[str, Any]) -> dict[str, Any]:
    """Packet i of 10 turns a second."""
    seconds, nanoseconds = divmod(round(i * FIRINGS * PERIOD * 1e9), 1_000_000_000)
    position = (i * FIRINGS + np.arange(FIRINGS)) * PERIOD * 3600 % 360
    return {
        "firings.position": position,
        "seconds": seconds,
        "nanoseconds": nanoseconds * 1e-9,
        **more,
    }


def lidar(model: str, elevation: NDArray[np.float64], other: str, **facts: Any) -> Sensor:
    """One model, which differs from the other one by the angles of its lasers alone."""
    kinds = {"data": (THREE, three_points, {"api": FINE}), "data_single": (ONE, one_points, {})}
    return Sensor(
        f"quanergy-{model.lower()}",
        vendor="Quanergy",
        model=model,
        frames={
            name: Frame(
                struct,
                data=True,
                plausible=plausible,
                points=partial(points, elevation=elevation),
                simulation=Simulation(partial(sweep, more=more)),
                acknowledged={
                    "LS507": "of a wall each laser has one return, which the other two repeat"
                }
                if more
                else {},
            )
            for name, (struct, points, more) in kinds.items()
        },
        points=None,
        scan=OnWrap("firings.position"),
        links={"data": Tcp(4141)},
        clock=Clock(("seconds", "nanoseconds")),
        vendor_axes=("forward", "left", "up"),
        turn=(5.0, 20.0),
        relatives={
            f"quanergy-{other}": "nothing in the packets: the label, or the sensor's web page"
        },
        status="manual",
        source="quanergy_client; rate, turns and range are assumed",
        **facts,
    )


M8 = lidar("M8", M8_ELEVATION, "mq8", range_limits=(1.0, 150.0))
MQ8 = lidar("MQ8", MQ8_ELEVATION, "m8", range_limits=(1.0, 150.0))


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """The Quanergy sensors."""
    return [M8, MQ8]
