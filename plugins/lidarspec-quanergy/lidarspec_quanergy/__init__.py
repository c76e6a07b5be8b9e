"""Quanergy M8 and MQ8: rotating lidars with eight lasers, which stream over TCP.

Numbers are big-endian. Source: the vendor's quanergy_client (packet_header.h,
m_series_data_packet.h, data_packet_parser_00.cpp, data_packet_parser_04.cpp,
data_packet_parser_m_series.h). In the client, the time of a packet is the time of its last firing.
Three things are assumed: evenly spaced firings with 420,000 points a second in total, the range
limits, and the number of revolutions per second. The positions of the firings increase or decrease,
depending on the direction of rotation. In packets before version 4, the field `nanoseconds` counts
steps of 10 ns. This module always reads steps of 1 ns, so the times of these packets are wrong.
Packets of kind 0 (three returns) and kind 4 (one return) are supported; kinds 1 and 6 and settings
over HTTP are not supported. No captured packet was available.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

import numpy as np
from construct import Array, Bytes, Const, Construct, Enum, Int8ub, Int16ub, Int32ub, Struct
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
POSITIONS_PER_TURN = 10_400
#: The first packet version with distance steps of 10 um; earlier versions have steps of 10 mm.
FINE_STEP_VERSION = 5
FIRING_PERIOD_S = LASERS / 420_000
#: The seconds from the time of the packet to each firing.
FIRING_TIMES_S = (np.arange(FIRINGS) - (FIRINGS - 1)) * FIRING_PERIOD_S

#: Elevation in radians, from the lowest laser to the highest.
M8_ELEVATION = np.array(
    [-0.318505, -0.2692, -0.218009, -0.165195, -0.111003, -0.0557982, 0.0, 0.0557982]
)
MQ8_ELEVATION = np.array(
    [-0.24435, -0.18326, -0.14137, -0.10297, -0.07854, -0.055327, -0.041364, -0.027402]
)

POSITION: Construct = Scaled(Int16ub, 360 / POSITIONS_PER_TURN, "deg") * "counter-clockwise"
DISTANCES: Construct = Array(
    LASERS, Scaled(Int32ub, 1e-5, "m") * "0: no return; before version 5, one step is 10 mm"
)
INTENSITIES: Construct = Array(LASERS, Int8ub * "255: saturated")
#: The meaning of status bits. version_mismatch: the versions of software and firmware do not match.
STATUS = Enum(Int16ub, good=0, version_mismatch=1, watchdog=2)


def make_header(kind: int, size: int) -> tuple[Construct, ...]:
    """Return the header fields of a packet with this kind and total size in bytes."""
    return (
        "signature" / Const(b"\x75\xbd\x7e\x97"),
        "size" / Const(size, Int32ub) * "number of bytes of the packet",
        "seconds" / Scaled(Int32ub, 1, "s") * "time since 1970",
        "nanoseconds" / Scaled(Int32ub, 1e-9, "s"),
        "version" / Bytes(3),
        "kind" / Const(kind, Int8ub),
    )


THREE_RETURNS = Struct(
    *make_header(0, 6632),
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
    "body_seconds" / Int32ub * "the same time as in the header",
    "body_nanoseconds" / Int32ub * "the same time as in the header",
    "api" / Int16ub * "packet version",
    "status" / STATUS,
)
ONE_RETURN = Struct(
    *make_header(4, 2224),
    "status" / STATUS,
    "return_id" / Int8ub * "number of the return that this packet contains",
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
    """Return whether the positions are at most 360 degrees and nanoseconds below 1 s."""
    return (f.firings.position <= 360) & (f.nanoseconds < 1)


def three_return_points(f: Fields, elevation: NDArray[np.float64]) -> Polar:
    """Return the points of packets with three returns of each laser.

    `elevation` is in radians, one per laser.
    """
    firings = f.firings
    first, second, third = (
        each.on("firings", "firings.third")
        for each in (firings.first, firings.second, firings.third)
    )
    intensities = (firings.first_intensity, firings.second_intensity, firings.third_intensity)
    return Polar(
        range=stack(np.where(first == third, 0, first), np.where(second == third, 0, second), third)
        * np.where(f.api < FINE_STEP_VERSION, 1000, 1),
        azimuth=np.deg2rad(firings.position),
        elevation=elevation[:, None],
        intensity=stack(*(each.on("firings", "firings.third") for each in intensities)),
        time=FIRING_TIMES_S[:, None, None],
        ring=np.arange(LASERS)[:, None],
        return_index=np.arange(3),
    )


def one_return_points(f: Fields, elevation: NDArray[np.float64]) -> Polar:
    """Return the points of packets with one return of each laser.

    `elevation` is in radians, one per laser.
    """
    return Polar(
        range=f.firings.distance,
        azimuth=np.deg2rad(f.firings.position),
        elevation=elevation,
        intensity=f.firings.intensity.on("firings", "firings.distance"),
        time=FIRING_TIMES_S[:, None],
        ring=np.arange(LASERS),
        return_index=f.return_id,
    )


def sweep(i: int, more: Mapping[str, Any]) -> dict[str, Any]:
    """Return the field values of simulated packet i, at 10 revolutions a second.

    `more` has the values of fields that only one packet kind has.
    """
    seconds, nanoseconds = divmod(round(i * FIRINGS * FIRING_PERIOD_S * 1e9), 1_000_000_000)
    position = (i * FIRINGS + np.arange(FIRINGS)) * FIRING_PERIOD_S * 3600 % 360
    return {
        "firings.position": position,
        "seconds": seconds,
        "nanoseconds": nanoseconds * 1e-9,
        **more,
    }


def make_lidar(model: str, elevation: NDArray[np.float64], other: str, **facts: Any) -> Sensor:
    """Return the sensor of one model; the models differ only in their laser angles.

    Args:
        elevation: elevation in radians, one per laser.
        other: the last part of the other model's id.
    """
    kinds = {
        "data": (THREE_RETURNS, three_return_points, {"api": FINE_STEP_VERSION}),
        "data_single": (ONE_RETURN, one_return_points, {}),
    }
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
                    "LS507": "in the simulated scene each laser has one return, which the packet"
                    " contains three times"
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
            f"quanergy-{other}": (
                "both models send the same packets; the label and the web page of the sensor name"
                " the model"
            )
        },
        status="manual",
        source="quanergy_client; rate, speed and range are assumed",
        **facts,
    )


M8 = make_lidar("M8", M8_ELEVATION, "mq8", range_limits=(1.0, 150.0))
MQ8 = make_lidar("MQ8", MQ8_ELEVATION, "m8", range_limits=(1.0, 150.0))


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """Return the Quanergy sensors."""
    return [M8, MQ8]
