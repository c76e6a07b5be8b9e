"""What a sensor's `points` function returns: columns of a batch of packets, not yet flattened.

The engine turns them into a `PointCloud`: coordinates, masks, REP-103 and REP-117 are its work. Conventions of the
columns: metres, radians, seconds; azimuth counter-clockwise from the manual's zero direction, elevation from the
horizon; a range of 0 is no return.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

#: anything that broadcasts against the packets: a column, a NumPy array or a number.
Array = Any


@dataclass(frozen=True, eq=False)
class Polar:
    """Points given by range and direction.

    Args:
        range: metres; 0 is no return, `inf` stays, nan is wrong.
        azimuth: radians, counter-clockwise seen from above; a nan makes the point invalid.
        elevation: radians above the horizon.
        intensity: the wire's number; None where the sensor has none.
        time: seconds after the packet's clock.
        ring: number of the laser or channel, None where there is none.
        return_index: 0 for the first or only return, 1 for the second ...; None where there is one.
        invalid: True where the sensor marks a point as wrong (becomes nan).
        origin: (x, y, z) in metres of where the beam starts, columns allowed, in REP-103 axes.
        nominal: True where a default calibration stands in for the sensor's own, which the cloud then says.
        column: number of the column in its turn, from 0, where points are columns of rows; `PointCloud.organised` places it by that.
    """

    range: Array
    azimuth: Array
    elevation: Array = 0
    intensity: Array | None = None
    time: Array = 0
    ring: Array | None = None
    return_index: Array | None = None
    invalid: Array = False
    origin: tuple[Array, Array, Array] = (0, 0, 0)
    nominal: bool = False
    column: Array | None = None


@dataclass(frozen=True, eq=False)
class Cartesian:
    """Points given by coordinates.

    Args:
        x, y, z: metres, x forward, y left, z up; all three 0 is no return, one that is nan or infinite makes the point invalid.
        intensity: the wire's number; None where the sensor has none.
        time: seconds after the packet's clock.
        ring: number of the laser or channel, None where there is none.
        return_index: 0 for the first or only return, 1 for the second ...; None where there is one.
        invalid: True where the sensor marks a point as wrong (becomes nan).
        nominal: True where a default calibration stands in for the sensor's own, which the cloud then says.
        column: number of the column in its turn, from 0, where points are columns of rows; `PointCloud.organised` places it by that.
    """

    x: Array
    y: Array
    z: Array
    intensity: Array | None = None
    time: Array = 0
    ring: Array | None = None
    return_index: Array | None = None
    invalid: Array = False
    nominal: bool = False
    column: Array | None = None


Points = Polar | Cartesian
