"""Conventions for points: axes, ranges, coordinates, types and grids.

The formulas accept arrays as well as traced columns, so that each formula is written once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarspec.expressions.columns import Column
from lidarspec.expressions.graph import TracedColumn
from lidarspec.spec.results import Extra
from lidarspec.spec.sensor import DIRECTIONS, SensorDescription

Floats = NDArray[np.float32]

#: The types of the columns that a cloud can have, in the order of the columns in files.
TYPES: Mapping[str, Any] = {
    **dict.fromkeys(("x", "y", "z", "range", "azimuth", "elevation", "intensity"), np.float32),
    **{"time": np.float64, "ring": np.uint16, "return_index": np.uint8, "column": np.uint16},
}

#: The units of columns by name; columns that are not listed are plain numbers.
UNITS: Mapping[str, str] = {
    **dict.fromkeys(("x", "y", "z", "range"), "m"),
    **dict.fromkeys(("azimuth", "elevation"), "rad"),
    "time": "s",
}

#: The directions of x, y and z in REP-103.
REP_103 = ("forward", "left", "up")

#: The largest float32 below pi, so that azimuths are in [-pi, pi) in float32 and in float64.
_BELOW_PI = np.nextafter(np.float32(np.pi), np.float32(0))

#: The largest coordinate that float32 can represent, metres.
MAX_COORDINATE_M = float(np.finfo(np.float32).max)

#: The largest angle, radians, from which whole turns can be subtracted without losing precision.
_MAX_SUBTRACTED_RAD = 1e6


def shown_range(measured: Any, invalid: Any) -> Any:
    """Return the range of points in a cloud, metres (REP-117).

    Args:
        measured: the measured range, metres; 0 without a return, for which the result is inf.
        invalid: whether the sensor marks the point as invalid, for which the result is nan.
    """
    return mark_invalid(
        np.where(measured == 0, np.inf, np.where(measured < 0, np.nan, measured)), invalid
    )


def returned_range(measured: Any) -> Any:
    """Return measured ranges, metres, with nan for points without a return."""
    # For a traced column the result is a single node, which the compilers recognize.
    if isinstance(measured, TracedColumn):
        return measured.apply_function(returned_range, measured)
    return np.where((measured > 0) & (measured < np.inf), measured, np.nan)


def mark_invalid(measured: Any, invalid: Any) -> Any:
    """Return ranges, with nan for points that the sensor marks as invalid."""
    if isinstance(invalid, TracedColumn) or np.any(invalid):
        return np.where(invalid, np.nan, measured)
    return measured


def coordinates(
    distance: Any, azimuth: Any, elevation: Any, origin: Sequence[Any]
) -> tuple[Any, Any, Any]:
    """Return x, y and z of points, metres.

    Args:
        distance: the distance along the beam, metres.
        azimuth: the azimuth of the beam, radians.
        elevation: the elevation of the beam, radians.
        origin: x, y and z of the start of the beam, metres.
    """
    level: Any = np.cos(elevation)
    sides = [np.cos(azimuth), np.sin(azimuth)]
    if _is_row_lookup(azimuth) or _is_row_lookup(elevation):
        known = [_multiply(level, side) for side in sides]
        level, sides = (1, known) if all(map(_is_row_lookup, known)) else (level, sides)
    level = _multiply(distance, level)
    places = *(_multiply(level, side) for side in sides), distance * np.sin(elevation)
    x, y, z = (
        place if is_zero(start) else place + start
        for place, start in zip(places, origin, strict=True)
    )
    return x, y, z


def place_points(coordinates: Sequence[Any], invalid: Any) -> list[Any]:
    """Return x, y and z in metres, with nan for points that are not valid.

    Args:
        coordinates: x, y and z of a `Cartesian` that the `points` function returned; 0, 0, 0 means
            that there is no return.
        invalid: whether the sensor marks the point as invalid.
    """
    away = sum(abs(place) for place in coordinates if not is_zero(place))
    lost = np.logical_not((away > 0) & (away <= MAX_COORDINATE_M))
    if isinstance(invalid, TracedColumn) or np.any(invalid):
        lost = lost | invalid
    return [np.where(lost, np.nan, place) for place in coordinates]


def find_direction(x: Any, y: Any, z: Any) -> tuple[Any, Any, Any]:
    """Return range (metres), azimuth and elevation (radians) of coordinates in metres."""
    level = np.hypot(x, y)
    return np.hypot(level, z), np.arctan2(y, x), np.arctan2(z, level)


def _multiply(first: Any, second: Any) -> Any:
    if not isinstance(second, TracedColumn) and np.size(second) == 1 and np.all(second == 1):
        return first
    return first * second


def _is_row_lookup(value: Any) -> bool:
    """Return whether a traced value is a lookup of rows in a table."""
    # Computations with such a value are done once, for the whole table.
    return isinstance(value, TracedColumn) and value.node.kind == "rows"


def is_zero(value: Any) -> bool:
    """Return whether a value is a constant 0, which does not depend on data."""
    return not isinstance(value, TracedColumn) and bool(np.all(np.asarray(value) == 0))


def seconds_since(time_ns: NDArray[np.int64], base: int) -> NDArray[np.float64]:
    """Return the times of packets, (n,) ns, as seconds since `base`."""
    return np.multiply(time_ns - base, 1e-9, dtype=np.float64)


class Grid(NamedTuple):
    """The organisation of points in columns and rows.

    Attributes:
        rows: the number of directions in a column; 0 if the points are not organised.
        returns: the number of adjacent returns of each direction.
    """

    rows: int = 0
    returns: int = 1

    @property
    def column_size(self) -> int:
        """The number of points of a column."""
        return self.rows * self.returns


def make_grid(shape: Sequence[int], axes: Sequence[str | None]) -> Grid:
    """Return the organisation of points of a given shape.

    Args:
        shape: the lengths of the axes of the points.
        axes: the names of the axes. The name of an axis for returns starts with "<".
    """
    is_stacked = bool(axes) and (axes[-1] or "").startswith("<")
    *lengths, returns = shape if is_stacked else (*shape, 1)
    while len(lengths) > 2 and lengths[-1] == 1:
        lengths.pop()
    if len(lengths) > 1 and lengths[-1] > 1:
        return Grid(lengths[-1], returns)
    return Grid()


class Grids(NamedTuple):
    """The organisation of the points of packets with several shapes, in stream order.

    Attributes:
        ends: (n,) the index after the last point of each packet.
        which: (n,) the index in `grids` for each packet; any index for a packet without points.
    """

    ends: NDArray[np.intp]
    which: NDArray[np.intp]
    grids: Sequence[Grid]

    def grid_between(self, start: int, stop: int) -> Grid:
        """Return the organisation of points `start` to `stop - 1`, or an empty `Grid`."""
        first = self.ends.searchsorted(start, side="right")
        last = self.ends.searchsorted(stop)
        begin = int(self.ends[first - 1]) if first else 0
        packets = slice(first, last + 1)
        has_points = np.diff(self.ends[packets], prepend=begin) > 0
        found = {self.grids[which] for which in np.unique(self.which[packets][has_points]).tolist()}
        if len(found) == 1:
            return slice_grid(found.pop(), start - begin, stop - start)
        return Grid()


def slice_grid(grid: Grid, first: int, number: int) -> Grid:
    """Return the organisation of a slice; an empty `Grid` if a column is cut.

    Args:
        grid: the organisation of all points.
        first: the index of the first point of the slice, in the cloud or in its packet.
        number: the number of points of the slice.
    """
    if grid.rows and first % grid.column_size == 0 and number % grid.column_size == 0:
        return grid
    return Grid()


class ExtraType(NamedTuple):
    """The type and the unit of a column in `extra`; the unit is "" for a plain number."""

    dtype: np.dtype[Any]
    unit: str

    @classmethod
    def of(cls, extra: Extra, values: Any) -> ExtraType:
        """Return the declared type and unit of a column; by default, those of its field."""
        is_own = isinstance(values, Column) and not values.frame
        if is_own:
            info = values.batch.table.schema.fields.get(values.source)
        else:
            info = None
        if info is not None and info.kind == "int" and not info.scaled:
            as_sent = info.dtype
        else:
            as_sent = None
        if isinstance(values, Column):
            array = values.array
        else:
            array = np.asarray(values)
        if extra.dtype is None:
            dtype = np.dtype(bool if array.dtype.kind == "b" else as_sent or np.float32)
        else:
            dtype = extra.dtype
        unit = extra.unit
        if unit is None:
            unit = "" if info is None else info.unit
        return cls(dtype, unit)

    def column(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return values converted to this type, with the same shape."""
        if self.dtype.kind == "f":
            return values.astype(self.dtype, copy=False)
        return convert_numbers(values, self.dtype)


def convert_numbers(values: NDArray[Any], dtype: Any) -> NDArray[Any]:
    """Return numbers converted to a type, with the same shape; nan becomes 0."""
    return np.asarray(np.nan_to_num(values) if values.dtype.kind == "f" else values, dtype)


def axis_matrix(axes: Sequence[str]) -> NDArray[np.float64]:
    """Return the (3, 3) matrix from REP-103 coordinates to named axes.

    Args:
        axes: the directions of x, y and z, for example ("forward", "left", "up").
    """
    matrix = np.zeros((3, 3))
    for row, name in enumerate(axes):
        axis, is_opposite = divmod(DIRECTIONS.index(name), 2)
        matrix[row, axis] = -1 if is_opposite else 1
    return matrix


def find_axes(sensor: SensorDescription) -> tuple[str, str, str]:
    """Return the directions of the x, y and z axes of a sensor's points."""
    if sensor.options.get("frame") == "vendor":
        wanted = sensor.vendor_axes
    else:
        wanted = None
    return wanted or REP_103


@lru_cache(maxsize=256)
def vendor_turn(sensor: SensorDescription) -> NDArray[np.float64] | None:
    """Return the (3, 3) matrix from REP-103 to the axes of a sensor's points.

    Returns None if the axes are those of REP-103.
    """
    axes = find_axes(sensor)
    if axes == REP_103:
        return None
    return axis_matrix(axes)


def turn_azimuth(angles: NDArray[Any], turn: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert azimuths to rotated axes, radians in [-pi, pi].

    Args:
        angles: the azimuths, radians.
        turn: the (3, 3) rotation matrix.
    """
    direction = turn[:2, :2] @ np.stack([np.cos(angles), np.sin(angles)])
    return np.asarray(np.arctan2(direction[1], direction[0]))


def narrow_angle(angle: NDArray[np.float64]) -> Floats:
    """Return angles in radians as float32 in [-pi, pi), of the same shape."""
    turned = angle - 2 * np.pi * np.floor((angle + np.pi) / (2 * np.pi))
    far = np.abs(angle) > _MAX_SUBTRACTED_RAD
    if far.any():
        # exact for any number of turns, but slow
        turned[far] = np.mod(angle[far] + np.pi, 2 * np.pi) - np.pi
    return np.clip(turned.astype(np.float32), -_BELOW_PI, _BELOW_PI)
