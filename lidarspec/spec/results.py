"""Return values of a sensor's `points` function: columns of a batch of packets.

Columns are in metres, radians and seconds. Azimuth is counter-clockwise from the manual's zero
direction, and elevation is measured from the horizon. A range of 0 means no return.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from lidarspec.errors import SpecError

#: A column, or a NumPy array or number that broadcasts with columns.
Array = Any

#: The valid names of additional columns, except for the names in `STANDARD_NAMES`.
_NAME = re.compile(r"[a-z][a-z0-9_]*")
STANDARD_NAMES = frozenset(
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
STANDARD_NAMES |= {
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
STANDARD_NAMES |= {"complete"}


@dataclass(frozen=True, eq=False)
class Extra:
    """An additional column of points, with its unit and type.

    Args:
        values: a column, an array or a number; nan if a point has no value.
        unit: the unit, for example "m/s"; "" for a plain number. The default is the unit of the
            field, if the values are an unchanged field.
        dtype: a numeric NumPy type. The default is the type of the field if the values are an
            unchanged integer field, bool if they are conditions, and float32 otherwise. If the type
            is an integer type, nan becomes 0.
    """

    values: Array
    unit: str | None = None
    dtype: Any = None

    def __post_init__(self) -> None:
        if self.dtype is not None:
            if (kind := np.dtype(self.dtype)).kind not in "biuf":
                raise SpecError(
                    f"a column of points must contain numbers, not {kind}", path="extra"
                )
            object.__setattr__(self, "dtype", kind)


def _name_extras(extra: Mapping[str, Any]) -> Mapping[str, Extra]:
    """Return the additional columns by name, each as an `Extra`.

    Raises:
        SpecError: for an invalid name, or the name of a standard column.
    """
    for name in extra:
        if not _NAME.fullmatch(name) or name in STANDARD_NAMES:
            if name in STANDARD_NAMES:
                reason = "is the name of a standard column"
            else:
                reason = "is not a valid name: use lower-case letters, digits and _"
            raise SpecError(f"{name!r} {reason}", path="extra")
    return MappingProxyType(
        {name: value if isinstance(value, Extra) else Extra(value) for name, value in extra.items()}
    )


@dataclass(frozen=True, eq=False)
class Polar:
    """Points given by range and direction.

    Args:
        range: metres; 0 or inf for a point without a return, nan for an invalid point.
        azimuth: radians, counter-clockwise as seen from above; nan for an invalid point.
        elevation: radians above the horizon.
        intensity: the number on the wire; None if the sensor has none.
        time: seconds after the time of the packet.
        ring: number of the laser or channel; None if there is none.
        return_index: 0 for the first or only return, 1 for the second ...; None if there is only
            one.
        invalid: True for a point that the sensor marks as invalid; its coordinates become nan.
        origin: (x, y, z) of the start of the beam, metres, in REP-103 axes; numbers or columns.
        nominal: True if a default calibration replaces the sensor's own; `PointCloud.nominal`
            reports it.
        column: number of the column in its revolution, from 0, if points form columns of rings;
            used by `PointCloud.organise`.
        extra: additional columns by name: values, or an `Extra` with their unit and type.

    Raises:
        SpecError: for a name in `extra` that already has a meaning.
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
        x, y, z: metres, x forward, y left, z up. A point without a return has three zeros. A point
            with a nan or infinite coordinate is invalid.
        intensity: the number on the wire; None if the sensor has none.
        time: seconds after the time of the packet.
        ring: number of the laser or channel; None if there is none.
        return_index: 0 for the first or only return, 1 for the second ...; None if there is only
            one.
        invalid: True for a point that the sensor marks as invalid; its coordinates become nan.
        nominal: True if a default calibration replaces the sensor's own; `PointCloud.nominal`
            reports it.
        column: number of the column in its revolution, from 0, if points form columns of rings;
            used by `PointCloud.organise`.
        extra: additional columns by name: values, or an `Extra` with their unit and type.

    Raises:
        SpecError: for a name in `extra` that already has a meaning.
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
    """Measurements of an IMU in the sensor, in SI units and the axes of the points.

    The axes are x forward, y left and z up (REP-145).

    Args:
        angular_velocity: three columns, about x, y and z, rad/s, right-handed: a turn to the left
            is positive about z.
        linear_acceleration: three columns, along x, y and z, m/s2, including gravity. A level
            sensor at rest has +9.80665 along z.
        time: seconds after the time of the packet.

    Raises:
        SpecError: if a quantity does not have three columns.
    """

    angular_velocity: tuple[Array, Array, Array]
    linear_acceleration: tuple[Array, Array, Array]
    time: Array = 0

    def __post_init__(self) -> None:
        for name in ("angular_velocity", "linear_acceleration"):
            value = getattr(self, name)
            if not isinstance(value, tuple | list) or len(value) != 3:
                raise SpecError("expected three columns (x, y, z)", path=f"Imu.{name}")
