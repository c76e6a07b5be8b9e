"""Point clouds: flat arrays in SI units, REP-103 axes and REP-117 ranges.

How a sensor is mounted: its clouds turned and moved into the axes of what carries it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

#: names of the columns that a cloud can have, in the order in which files list them.
COLUMNS = ("x", "y", "z", "range", "azimuth", "elevation", "intensity", "time", "ring", "return_index")

#: x y z intensity ring time at PCL's offsets.
STRUCTURED = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "time"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<f4"],
        "offsets": [0, 4, 8, 16, 20, 24],
        "itemsize": 32,
    }
)

#: largest float32 below pi: azimuths stay in [-pi, pi) in either precision.
_PI = np.nextafter(np.float32(np.pi), np.float32(0))

#: radians from which on taking off whole turns loses precision.
_FAR = 1e6


@dataclass(frozen=True, eq=False, repr=False)
class PointCloud:
    """N points in stream order.

    Attributes:
        x, y, z: (N,) float32 metres, REP-103 (x forward, y left, z up); nan unless `valid`.
        range: (N,) float32 metres; inf for no return, nan where the sensor marks a point as wrong.
        azimuth: (N,) float32 radians in [-pi, pi), counter-clockwise.
        elevation: (N,) float32 radians above the horizon.
        time: (N,) float64 seconds since `stamp_ns`.
        intensity: (N,) float32, the wire's number; None where the sensor has none.
        ring: (N,) uint16, None where the sensor has none.
        return_index: (N,) uint8, None where the sensor has none.
        valid: (N,) bool, True for real returns.
        stamp_ns: int64 nanoseconds.
        shape: (columns, rows) where the points are organised so, else None.
        nominal: True where a default calibration stood in for the sensor's own.
    """

    x: Floats
    y: Floats
    z: Floats
    range: Floats
    azimuth: Floats
    elevation: Floats
    time: NDArray[np.float64]
    valid: NDArray[np.bool_]
    intensity: Floats | None = None
    ring: NDArray[np.uint16] | None = None
    return_index: NDArray[np.uint8] | None = None
    stamp_ns: int = 0
    shape: tuple[int, int] | None = None
    nominal: np.bool_ = field(default_factory=np.bool_)

    def __len__(self) -> int:
        return len(self.x)

    def __repr__(self) -> str:
        near, far = (f(self.range[self.valid], initial=start) for f, start in ((np.min, np.inf), (np.max, 0)))
        span = f", {near:.2f}..{far:.2f} m" if self.valid.any() else ""
        return f"PointCloud({len(self)} points, {int(self.valid.sum())} valid{span}{', nominal calibration' if self.nominal else ''})"

    @property
    def columns(self) -> Mapping[str, NDArray[Any]]:
        """The columns that this cloud has, by name."""
        return {name: getattr(self, name) for name in COLUMNS if getattr(self, name) is not None}

    @property
    def xyz(self) -> Floats:
        """(N, 3) float32 metres."""
        return np.stack([self.x, self.y, self.z], axis=1)

    def __getitem__(self, which: Any) -> PointCloud:
        """Some of the points, by mask, indices or slice; organised only if the slice holds whole columns."""
        picked = {f.name: _pick(getattr(self, f.name), which) for f in fields(self)}
        shape = None
        if self.shape and isinstance(which, slice) and which.step in (None, 1):
            first, number = which.indices(len(self))[0], len(picked["x"])
            rows = self.shape[1]
            shape = (number // rows, rows) if first % rows == 0 and number % rows == 0 else None
        return PointCloud(**{**picked, "shape": shape})

    def times_at(self, indices: NDArray[np.intp]) -> NDArray[np.float64]:
        """The times of some points, without making the column where it is not made yet."""
        return self.time[indices]

    def stretch(self, start: int, stop: int) -> PointCloud:
        """Consecutive points."""
        return self[start:stop]

    def to_structured(self) -> NDArray[Any]:
        """A structured array (N,) with PCL's layout: x y z intensity ring time, itemsize 32; what is missing is 0."""
        found = np.zeros(len(self), STRUCTURED)
        for name in STRUCTURED.names or ():
            column = getattr(self, name)
            if column is not None:
                found[name] = column
        return found


def _pick(value: Any, which: Any) -> Any:
    return value[which] if isinstance(value, np.ndarray) and value.ndim else value


class Columns(Protocol):
    """Where a `LazyCloud` takes its columns from.

    Attributes:
        size: the number of points.
    """

    size: int

    def column(self, name: str) -> NDArray[Any] | None:
        """A column of `PointCloud`; None where the sensor has none."""

    def times_at(self, indices: NDArray[np.intp]) -> NDArray[np.float64]:
        """Some values of the column "time"; the others need not be made for them."""

    def stretch(self, start: int, stop: int) -> Columns | None:
        """Those of consecutive points, which may be made for these alone; None where that is not known."""
        return None

    def followed(self, others: Sequence[Columns]) -> Columns | None:
        """These points and others after them as one, made together; None where that is not known."""
        return None


class _Unread:
    """A column that is made when it is first read."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, cloud: Any, owner: Any) -> Any:
        if cloud is None:
            return self
        cloud.__dict__[self._name] = found = cloud.source.column(self._name)
        return found


class LazyCloud(PointCloud):
    """A cloud whose columns are made when they are first read."""

    source: Columns

    @classmethod
    def of(cls, source: Columns, *, stamp_ns: int, shape: tuple[int, int] | None, nominal: np.bool_) -> LazyCloud:
        """The cloud of these columns."""
        found = object.__new__(cls)
        found.__dict__.update(source=source, stamp_ns=stamp_ns, shape=shape, nominal=nominal)
        return found

    def __len__(self) -> int:
        return self.source.size

    def __getitem__(self, which: Any) -> PointCloud:
        if isinstance(which, slice) and which.step in (None, 1):
            first, end, _ = which.indices(len(self))
            number = max(end - first, 0)
            return self._part(_Sliced(self, slice(first, first + number), number), first)
        return super().__getitem__(which)

    def stretch(self, start: int, stop: int) -> PointCloud:
        """Consecutive points; where they are many their columns are made for them alone."""
        source = self.source.stretch(start, stop) if stop > start else None
        return self[start:stop] if source is None else self._part(source, start)

    def _part(self, source: Columns, first: int) -> LazyCloud:
        """The points of a source, of which the first is one of ours."""
        number, rows = source.size, self.shape[1] if self.shape else 0
        shape = (number // rows, rows) if rows and first % rows == 0 and number % rows == 0 else None
        return LazyCloud.of(source, stamp_ns=self.stamp_ns, shape=shape, nominal=self.nominal)

    def times_at(self, indices: NDArray[np.intp]) -> NDArray[np.float64]:
        return self.time[indices] if "time" in self.__dict__ else self.source.times_at(indices)

    def __reduce__(self) -> Any:
        return _cloud, ({f.name: getattr(self, f.name) for f in fields(self)},)


for _name in (*COLUMNS, "valid"):
    setattr(LazyCloud, _name, _Unread(_name))


def _cloud(values: dict[str, Any]) -> PointCloud:
    return PointCloud(**values)


@dataclass(eq=False)
class _Sliced(Columns):
    """Some points of another cloud, one after another."""

    cloud: PointCloud
    which: slice
    size: int

    def column(self, name: str) -> NDArray[Any] | None:
        found = getattr(self.cloud, name)
        return None if found is None else found[self.which]

    def times_at(self, indices: NDArray[np.intp]) -> NDArray[np.float64]:
        return self.cloud.times_at(indices + self.which.start)


@dataclass(eq=False)
class _Joined(Columns):
    """Several clouds one after another, with times from one stamp."""

    clouds: Sequence[PointCloud]
    stamp_ns: int
    size: int

    def column(self, name: str) -> NDArray[Any] | None:
        if name == "time":
            return np.concatenate([cloud.time + (cloud.stamp_ns - self.stamp_ns) * 1e-9 for cloud in self.clouds])
        parts = [getattr(cloud, name) for cloud in self.clouds]
        return None if any(part is None for part in parts) else np.concatenate(parts)

    def times_at(self, indices: NDArray[np.intp]) -> NDArray[np.float64]:
        found, start = np.empty(len(indices)), 0
        for cloud in self.clouds:
            inside = (indices >= start) & (indices < start + len(cloud))
            found[inside] = cloud.times_at(indices[inside] - start) + (cloud.stamp_ns - self.stamp_ns) * 1e-9
            start += len(cloud)
        return found


@dataclass(eq=False)
class _Restamped(Columns):
    """Other columns with times counted from the first point."""

    source: Columns
    size: int

    def column(self, name: str) -> NDArray[Any] | None:
        found = self.source.column(name)
        return found - found[0] if name == "time" and found is not None else found

    def times_at(self, indices: NDArray[np.intp]) -> NDArray[np.float64]:
        return self.source.times_at(indices) - self.source.times_at(np.zeros(1, np.intp))


def joined(clouds: Sequence[PointCloud]) -> PointCloud:
    """Clouds of one sensor, one after another; times count from the first one's stamp."""
    clouds = [cloud for cloud in clouds if len(cloud)] or list(clouds[:1])
    if len(clouds) == 1:
        return clouds[0]
    rows = {cloud.shape[1] for cloud in clouds if cloud.shape}
    shape = (
        (sum(cloud.shape[0] for cloud in clouds if cloud.shape), rows.pop()) if len(rows) == 1 and all(c.shape for c in clouds) else None
    )
    sources = [cloud.source for cloud in clouds if isinstance(cloud, LazyCloud)]
    source = sources[0].followed(sources[1:]) if len(sources) == len(clouds) else None
    if source is None:
        source = _Joined(clouds, clouds[0].stamp_ns, sum(map(len, clouds)))
    return LazyCloud.of(source, stamp_ns=clouds[0].stamp_ns, shape=shape, nominal=np.bool_(any(cloud.nominal for cloud in clouds)))


def restamped(cloud: PointCloud, stamp_ns: int) -> PointCloud:
    """The same points with times counted from the first one, which is at `stamp_ns`."""
    if not isinstance(cloud, LazyCloud):
        return replace(cloud, time=cloud.time - cloud.time[0], stamp_ns=stamp_ns)
    return LazyCloud.of(_Restamped(cloud.source, len(cloud)), stamp_ns=stamp_ns, shape=cloud.shape, nominal=cloud.nominal)


#: directions in REP-103: (axis index, sign).
_DIRECTIONS = {"forward": (0, 1), "back": (0, -1), "left": (1, 1), "right": (1, -1), "up": (2, 1), "down": (2, -1)}


def axis_matrix(axes: Sequence[str]) -> NDArray[np.float64]:
    """The matrix that turns REP-103 coordinates into those of axes named by where x, y and z point."""
    matrix = np.zeros((3, 3))
    for row, name in enumerate(axes):
        column, sign = _DIRECTIONS[name]
        matrix[row, column] = sign
    return matrix


def narrowed(angle: NDArray[np.float64]) -> Floats:
    """Radians as float32 in [-pi, pi)."""
    turned = angle - 2 * np.pi * np.floor((angle + np.pi) / (2 * np.pi))
    far = np.abs(angle) > _FAR
    if far.any():
        turned[far] = np.mod(angle[far] + np.pi, 2 * np.pi) - np.pi  # exact however many turns it is, and slow
    return np.clip(turned.astype(np.float32), -_PI, _PI)


@dataclass(frozen=True)
class Mount:
    """Where a sensor sits on its carrier, and how it is turned there; both have REP-103 axes.

    The sensor is turned over first where it is `inverted`, then by roll, pitch and yaw about the carrier's fixed axes.

    Attributes:
        x, y, z: the sensor's origin, metres forward, left and up.
        roll_deg, pitch_deg, yaw_deg: about x, y and z, right-handed: a yaw of 90 makes the sensor look to the left.
        inverted: whether it hangs upside down, turned by half a turn about its forward axis.
    """

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0
    inverted: bool = False

    @property
    def rotation(self) -> NDArray[np.float64]:
        """The (3, 3) matrix from the sensor's axes to the carrier's."""
        roll, pitch, yaw = np.deg2rad([self.roll_deg + 180.0 * self.inverted, self.pitch_deg, self.yaw_deg])
        about_x = np.array([[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]])
        about_y = np.array([[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]])
        about_z = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        return np.asarray(about_z @ about_y @ about_x)

    def applied(self, cloud: PointCloud) -> PointCloud:
        """The same points in the carrier's axes.

        Returns:
            x y z from the carrier's origin; azimuth and elevation of the beams in its axes. `range` stays what the sensor
            measured, from the sensor.
        """
        turn = self.rotation
        azimuth, elevation = cloud.azimuth.astype(np.float64), cloud.elevation.astype(np.float64)
        level = np.cos(elevation)
        beam = turn @ np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
        xyz = turn @ np.stack([cloud.x, cloud.y, cloud.z]).astype(np.float64) + np.array([[self.x], [self.y], [self.z]])
        x, y, z = xyz.astype(np.float32)
        # arcsin is coarse where beams point straight up; the other two sides of the triangle are not
        raised = np.arctan2(beam[2], np.hypot(beam[0], beam[1])).astype(np.float32)
        same = {f.name: getattr(cloud, f.name) for f in fields(cloud)}
        turned = {"x": x, "y": y, "z": z, "azimuth": narrowed(np.arctan2(beam[1], beam[0])), "elevation": raised}
        return PointCloud(**{**same, **turned})

    def __str__(self) -> str:
        given = [f"{f.name}={getattr(self, f.name):g}" for f in fields(self)[:-1] if getattr(self, f.name)]
        return ", ".join([*given, *(["inverted"] if self.inverted else [])]) or "as the sensor stands"
