"""What a sensor's `points` function returns: columns of a batch of packets, not yet flattened.

The engine turns them into a `PointCloud`: coordinates, masks, REP-103 and REP-117 are its work.
Conventions of the columns: metres, radians, seconds; azimuth counter-clockwise from the manual's
zero direction, elevation from the horizon; a range of 0 is no return.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from lidarspec.errors import SpecError

#: anything that broadcasts against the packets: a column, a NumPy array or a number.
Array = Any

#: what a further column of points may be called, and what it may not, since something beside it is.
_NAME = re.compile(r"[a-z][a-z0-9_]*")
TAKEN = frozenset(
    (
        "x",
        "y",
        "z",
        "xyz",
        "range",
        "azimuth",
        "elevation",
        "origin",
        "ox",
        "oy",
        "oz",
        "time",
        "intensity",
        "ring",
    )
)
TAKEN |= {
    "return_index",
    "column",
    "invalid",
    "valid",
    "nominal",
    "extra",
    "units",
    "shape",
    "columns",
    "scan",
    "stamp_ns",
    "rate_hz",
}
TAKEN |= {"complete"}


@dataclass(frozen=True, eq=False)
class Extra:
    """A further column of points, with what it is in.

    Args:
        values: as those of any other column; nan where a point has none.
        unit: "m/s"; "" for a plain number. By default that of the field, where the values are a
            field as it stands.
        dtype: of the column: a NumPy type of numbers. By default that of the wire, where the values
            are a field as it stands that is a whole number; bool for conditions, else float32. In a
            type of integers nan is 0.
    """

    values: Array
    unit: str | None = None
    dtype: Any = None

    def __post_init__(self) -> None:
        if self.dtype is not None:
            if (kind := np.dtype(self.dtype)).kind not in "biuf":
                raise SpecError(f"a column of points has numbers, not {kind}", path="extra")
            object.__setattr__(self, "dtype", kind)


def _name_extras(extra: Mapping[str, Any]) -> Mapping[str, Extra]:
    """The further columns of points by name, each with what it is in.

    Raises:
        SpecError: for a name that means something else, or is none.
    """
    for name in extra:
        if not _NAME.fullmatch(name) or name in TAKEN:
            if name in TAKEN:
                reason = "is the name of something else"
            else:
                reason = "is no name: small letters, digits and _"
            raise SpecError(f"{name!r} {reason}", path="extra")
    return MappingProxyType(
        {name: value if isinstance(value, Extra) else Extra(value) for name, value in extra.items()}
    )


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
        nominal: True where a default calibration stands in for the sensor's own, which the cloud
            then says.
        column: number of the column in its turn, from 0, where points are columns of rows;
            `PointCloud.organised` places it by that.
        extra: further columns by name: values, or an `Extra` with their unit and type.

    Raises:
        SpecError: for a name in `extra` that means something else.
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
    extra: Mapping[str, Extra | Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "extra", _name_extras(self.extra))


@dataclass(frozen=True, eq=False)
class Cartesian:
    """Points given by coordinates.

    Args:
        x, y, z: metres, x forward, y left, z up; all three 0 is no return, one that is nan or
            infinite makes the point invalid.
        intensity: the wire's number; None where the sensor has none.
        time: seconds after the packet's clock.
        ring: number of the laser or channel, None where there is none.
        return_index: 0 for the first or only return, 1 for the second ...; None where there is one.
        invalid: True where the sensor marks a point as wrong (becomes nan).
        nominal: True where a default calibration stands in for the sensor's own, which the cloud
            then says.
        column: number of the column in its turn, from 0, where points are columns of rows;
            `PointCloud.organised` places it by that.
        extra: further columns by name: values, or an `Extra` with their unit and type.

    Raises:
        SpecError: for a name in `extra` that means something else.
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
    extra: Mapping[str, Extra | Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "extra", _name_extras(self.extra))


Points = Polar | Cartesian


@dataclass(frozen=True, eq=False)
class Imu:
    """What an inertial measurement unit in the sensor feels, in SI and in the axes of the points
    (REP-145): x forward, y left, z up.

    Args:
        angular_velocity: about x, y and z, rad/s, right-handed: positive about z turns to the left.
        linear_acceleration: along x, y and z, m/s2, gravity in it: a level sensor at rest has
            +9.80665 along z.
        time: seconds after the packet's clock.

    Raises:
        SpecError: where it is not three of each.
    """

    angular_velocity: tuple[Array, Array, Array]
    linear_acceleration: tuple[Array, Array, Array]
    time: Array = 0

    def __post_init__(self) -> None:
        for name in ("angular_velocity", "linear_acceleration"):
            value = getattr(self, name)
            if not isinstance(value, tuple | list) or len(value) != 3:
                raise SpecError("(x, y, z), three columns", path=f"Imu.{name}")
