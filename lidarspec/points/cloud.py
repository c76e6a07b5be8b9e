"""Point clouds: flat arrays in SI units, with REP-103 axes and REP-117 ranges.

A `PointCloud` contains its columns. A `LazyCloud` computes each column when it is first read.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from lidarspec.errors import UnknownName, UsageError
from lidarspec.notebook_display import make_display_method
from lidarspec.optional_libraries import import_library
from lidarspec.points.column_sources import ColumnSource, JoinedColumns, LazyColumns, SourcePart
from lidarspec.points.conventions import TYPES, UNITS, ExtraType, Floats, Grid, Grids, slice_grid
from lidarspec.points.table_types import STRUCTURED, arrow_schema, structured_type

#: The names of the columns that a cloud can have, in the order of the columns in files.
COLUMNS = tuple(TYPES)


@dataclass(frozen=True, eq=False, repr=False)
class PointCloud:
    """N points in stream order.

    Attributes:
        x, y, z: (N,) float32 metres, forward, left and up (REP-103); nan unless `valid`.
        range: (N,) float32 metres; inf without a return, nan if the sensor marks the point as
            invalid.
        azimuth: (N,) float32 radians in [-pi, pi), counter-clockwise.
        elevation: (N,) float32 radians above the horizon.
        time: (N,) float64 seconds since `stamp_ns`.
        intensity: (N,) float32, the raw value; None if the sensor sends no intensity.
        ring: (N,) uint16; None if the sensor has no rings.
        return_index: (N,) uint8; None if the sensor does not send several returns.
        column: (N,) uint16, the index of the point's column in its revolution; None if the sensor
            does not send it.
        valid: (N,) bool, True for real returns.
        stamp_ns: the time that `time` counts from, int64 ns.
        shape: (columns, rows) if the points are organised, else None. Several returns of one
            direction are adjacent: ``cloud.range.reshape(*cloud.shape, -1)`` is (columns, rows,
            returns).
        nominal: True if the points use a default calibration instead of the sensor's own.
        extra: (N,) further columns of the sensor by name, for example "velocity".
        units: the units of the columns in `extra`, by name; "" for a plain number.
        chosen: the names of the columns selected by `select_columns`; () for all columns.
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
    column: NDArray[np.uint16] | None = None
    stamp_ns: int = 0
    shape: tuple[int, int] | None = None
    nominal: np.bool_ = field(default_factory=np.bool_)
    extra: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    chosen: tuple[str, ...] = ()

    def __len__(self) -> int:
        return np.size(self.x)  # 1 for a single point, `cloud[0]`

    def __repr__(self) -> str:
        if not np.ndim(self.x):
            units = units_of(self)
            values = [
                f"{name}={value:.6g} {units.get(name, '')}".rstrip()
                for name, value in self.columns.items()
            ]
            return f"Point({', '.join(values)}{'' if self.valid else ', not valid'})"
        near, far = (
            f(self.range[self.valid], initial=start) for f, start in ((np.min, np.inf), (np.max, 0))
        )
        if self.valid.any():
            span = f", {near:.2f}..{far:.2f} m"
        else:
            span = ""
        return (
            f"PointCloud({len(self)} points, {int(self.valid.sum())}"
            f" valid{span}{', nominal calibration' if self.nominal else ''})"
        )

    _repr_svg_ = make_display_method("cloud")

    @property
    def columns(self) -> Mapping[str, NDArray[Any]]:
        """The selected columns of this cloud by name; by default all columns."""
        names = self.chosen or (*COLUMNS, *self.extra)
        self.load(*names)
        columns = {
            name: self.extra[name] if name in self.extra else getattr(self, name) for name in names
        }
        return {name: column for name, column in columns.items() if column is not None}

    def is_selected(self, name: str) -> bool:
        """Return whether a column was selected by `select_columns`.

        If no columns were selected, the result is True for every name. The result is always True
        for x, y and z, which some files require.
        """
        return not self.chosen or name in (*self.chosen, "x", "y", "z")

    def select_columns(self, *names: str) -> PointCloud:
        """Return the same points with some of their columns.

        A file that requires x, y and z contains them even if they are not selected.

        Raises:
            UnknownName: if the cloud does not have a column.
        """
        lacking = [
            name
            for name in names
            if name not in self.extra and (name not in COLUMNS or getattr(self, name) is None)
        ]
        if lacking:
            raise UnknownName(lacking[0], self.columns, place="columns of points")
        source = CloudColumns(self)
        source.extra = {name: kind for name, kind in source.extra.items() if name in names}
        cloud = LazyCloud.of(source, self.stamp_ns)
        cloud.__dict__["chosen"] = names
        return cloud

    def load(self, *names: str) -> None:
        """Compute columns together, which is faster than one after another."""
        # Columns that are already computed or unknown are ignored.

    def read(self, *names: str) -> dict[str, NDArray[Any]]:
        """Return columns by name, including "valid" and columns in `extra`.

        Raises:
            UnknownName: if the cloud does not have a column.
        """
        self.load(*names)
        columns = {name: getattr(self, name) for name in names if name in (*COLUMNS, "valid")}
        columns |= {name: self.extra[name] for name in names if name in self.extra}
        missing = next((name for name in names if columns.get(name) is None), None)
        if missing is not None:
            raise UnknownName(missing, [*self.columns, "valid"], place="columns of points")
        return {name: columns[name] for name in names}

    @property
    def calibration(self) -> str:
        """The calibration of the points: "own" (of this sensor) or "nominal" (a default)."""
        if self.nominal:
            return "nominal"
        return "own"

    @property
    def xyz(self) -> Floats:
        """The coordinates, (N, 3) float32 metres."""
        return np.stack([self.x, self.y, self.z], axis=-1)

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        """Return `xyz`, as NumPy, SciPy and Open3D expect points.

        Raises:
            ValueError: with ``copy=False``, since x, y and z are separate columns.
        """
        if copy is False:
            raise ValueError("xyz must be copied, because x, y and z are separate columns")
        if dtype is None:
            return self.xyz
        return self.xyz.astype(dtype, copy=False)

    def __getitem__(self, which: Any) -> PointCloud:
        """Return the points selected by a mask, indices or a slice.

        The result is organised only if a slice selects whole columns. An integer selects one point;
        its columns are scalars.
        """
        picked = {f.name: _select(getattr(self, f.name), which) for f in fields(self)}
        picked["extra"] = {name: column[which] for name, column in self.extra.items()}
        shape = None
        if self.shape and isinstance(which, slice) and which.step in (None, 1):
            shape = find_organised_shape(
                len(picked["x"]),
                slice_grid(find_grid(self), which.indices(len(self))[0], len(picked["x"])),
            )
        return PointCloud(**{**picked, "shape": shape})

    def organise(self, columns: int) -> PointCloud:
        """Return the points of a revolution as an image.

        The columns of the image are in the order of the `column` numbers of the points. An image
        column without points is filled with invalid points.

        Args:
            columns: the number of columns of a revolution. All points must be from one revolution.

        Raises:
            UsageError: if the points have no `column` or no `shape`, or if a column number occurs
                twice or is too large.
        """
        if self.shape is None or self.column is None:
            raise UsageError("an image requires organised points with column numbers")
        column_size = find_grid(self).column_size
        numbers, counts = np.unique(self.column[::column_size], return_counts=True)
        wrong = numbers[(numbers >= columns) | (counts > 1)]
        if len(wrong):
            if wrong[0] < columns:
                reason = f"occurs {int(counts[numbers == wrong[0]][0])} times"
            else:
                reason = f"is not below {columns}"
            raise UsageError(
                f"the column number {wrong[0]} {reason}: pass the points of a single revolution,"
                " and the number of columns of a revolution"
            )
        place = np.full(columns, -1)
        place[self.column[::column_size]] = np.arange(self.shape[0])
        indices = np.where(
            place[:, None] < 0, -1, place[:, None] * column_size + np.arange(column_size)
        )
        numbered = np.repeat(np.arange(columns), column_size).astype(TYPES["column"])
        return replace(self._rearrange(indices), column=numbered, shape=(columns, self.shape[1]))

    def destagger(self, shifts: Sequence[int]) -> PointCloud:
        """Return the points of an image with each row shifted by a number of columns.

        Rows wrap around. After the shift, the points of a column have the same azimuth.

        Args:
            shifts: the shift of each row in columns, (rows,), as in the sensor's metadata.

        Raises:
            UsageError: if the points are not organised, or if there is not one shift for each row.
        """
        if self.shape is None or np.shape(shifts) != (self.shape[1],):
            if self.shape:
                reason = (
                    f"expected one shift for each of {self.shape[1]} rows, got {np.size(shifts)}"
                )
            else:
                reason = "the points are not organised in rows and columns"
            raise UsageError(reason)
        grid = find_grid(self)
        columns, rows = self.shape
        source = (np.arange(columns)[:, None] - np.asarray(shifts)) % columns
        places = source * rows + np.arange(rows)
        return replace(
            self._rearrange(places[:, :, None] * grid.returns + np.arange(grid.returns)),
            shape=self.shape,
        )

    def _rearrange(self, indices: NDArray[np.intp]) -> PointCloud:
        """Return the points at `indices`, which select whole columns."""
        # An index of -1 gives an invalid point.
        indices = indices.reshape(-1)
        column_size = find_grid(self).column_size
        gaps = indices < 0
        picked = self[np.where(gaps, np.arange(len(indices)) % column_size, indices)]
        if gaps.any():
            for column in (*picked.columns.values(), picked.valid):
                if column.dtype.kind in "fb":
                    column[gaps] = np.nan if column.dtype.kind == "f" else False
        return picked

    def to_structured(self) -> NDArray[Any]:
        """Return a structured array (N,) with PCL's layout, 32 bytes for each point.

        The fields are x y z intensity ring time. Missing columns are 0. Columns in `extra` begin at
        byte 32, each aligned to its size; the size of a point is then a multiple of 16.
        """
        names = [name for name in STRUCTURED.names or () if self.is_selected(name)]
        self.load(*names, *self.extra)
        columns = {name: getattr(self, name) for name in names} | dict(self.extra)
        structured = np.zeros(
            len(self), structured_type({name: column.dtype for name, column in self.extra.items()})
        )
        for name, column in columns.items():
            if column is not None:
                structured[name] = column
        return structured

    def to_arrow(self, facts: Mapping[str, str] | None = None) -> Any:
        """Return a `pyarrow.Table` of `columns`, without copying them, except bools.

        The metadata of each field has its unit.

        Args:
            facts: further metadata of the schema. The schema always contains `units` (as JSON),
                `calibration` ("nominal" or "own") and `stamp_ns`.

        Raises:
            UsageError: if pyarrow is not installed.
        """
        schema_facts = {
            "stamp_ns": str(self.stamp_ns),
            **(facts or {}),
            "calibration": self.calibration,
        }
        columns = dict(self.columns)
        schema = arrow_schema(columns, units_of(self), schema_facts)
        return import_library("pyarrow", "arrow").table(columns, schema)

    def __arrow_c_stream__(self, requested_schema: object = None) -> object:
        """Return the Arrow stream through which DuckDB, Polars and pandas read the points."""
        return self.to_arrow().__arrow_c_stream__(requested_schema)

    def to_pandas(self) -> Any:
        """Return a `pandas.DataFrame` of `columns`, without copying them.

        The attribute `attrs` of the result contains "units" and "stamp_ns".

        Raises:
            UsageError: if pandas is not installed.
        """
        frame = import_library("pandas", "pandas").DataFrame(dict(self.columns), copy=False)
        frame.attrs.update(units=units_of(self), stamp_ns=self.stamp_ns)
        return frame

    def to_polars(self) -> Any:
        """Return a `polars.DataFrame` of `columns`, without copying them.

        Raises:
            UsageError: if Polars is not installed.
        """
        return import_library("polars", "polars").DataFrame(dict(self.columns))


def units_of(cloud: PointCloud) -> dict[str, str]:
    """Return the units of a cloud's columns by name, without columns of plain numbers."""
    return {
        name: unit for name in cloud.columns if (unit := UNITS.get(name) or cloud.units.get(name))
    }


def _select(value: Any, which: Any) -> Any:
    if isinstance(value, np.ndarray) and value.ndim:
        return value[which]
    return value


def find_grid(cloud: PointCloud) -> Grid:
    """Return how the points of a cloud are organised; an empty Grid if they are not."""
    if cloud.shape:
        return Grid(cloud.shape[1], len(cloud) // max(cloud.shape[0] * cloud.shape[1], 1) or 1)
    return Grid()


def find_organised_shape(number: int, grid: Grid) -> tuple[int, int] | None:
    """Return (columns, rows) for a number of points; None if they are not organised."""
    if grid.rows:
        return (number // grid.column_size, grid.rows)
    return None


class CloudColumns(ColumnSource):
    """A `ColumnSource` with the columns of a cloud."""

    def __init__(self, cloud: PointCloud, grids: Grids | None = None) -> None:
        self._cloud = cloud
        self.size = len(cloud)
        self.base = cloud.stamp_ns
        self.grids = grids
        self.nominal = bool(cloud.nominal)
        if grids:
            self.grid = grids.grid_between(0, self.size)
        else:
            self.grid = find_grid(cloud)
        if isinstance(cloud, LazyCloud):
            self.extra = cloud.lazy.source.extra
        else:
            self.extra = {
                name: ExtraType(column.dtype, cloud.units.get(name, ""))
                for name, column in cloud.extra.items()
            }

    def columns(self, names: Sequence[str], start: int, stop: int) -> dict[str, NDArray[Any]]:
        self._cloud.load(*names)
        columns = dict[str, NDArray[Any] | None]()
        for name in names:
            if name in self.extra:
                columns[name] = self._cloud.extra[name]
            else:
                columns[name] = getattr(self._cloud, name, None)
        return {name: column[start:stop] for name, column in columns.items() if column is not None}

    def times_at(self, indices: NDArray[np.intp]) -> NDArray[np.float64]:
        if isinstance(self._cloud, LazyCloud) and "time" not in self._cloud.lazy.computed:
            return self._cloud.lazy.source.times_at(indices)
        return super().times_at(indices)


class LazyCloud(PointCloud):
    """A cloud with columns that are computed when they are first read.

    Attributes:
        lazy: the columns of the cloud, and those in `extra`.
    """

    lazy: LazyColumns

    def __new__(cls, *args: Any, **columns: Any) -> PointCloud:  # type: ignore[misc]
        """Return a `PointCloud` with these columns, as `dataclasses.replace` requires."""
        return PointCloud(*args, **columns)

    @classmethod
    def of(cls, source: ColumnSource, stamp_ns: int) -> LazyCloud:
        """Return a cloud that reads its columns from a source.

        Args:
            stamp_ns: the time from which the times of the source count, ns.
        """
        lazy = LazyColumns(source)
        cloud = object.__new__(cls)
        cloud.__dict__.update(
            lazy=lazy,
            stamp_ns=stamp_ns,
            shape=find_organised_shape(source.size, source.grid),
            nominal=np.bool_(source.nominal),
            extra=ExtraColumns(lazy),
            units={name: kind.unit for name, kind in source.extra.items()},
        )
        return cloud

    def load(self, *names: str) -> None:
        self.lazy.load(*names)

    def __len__(self) -> int:
        return self.lazy.source.size

    def __getitem__(self, which: Any) -> PointCloud:
        if not isinstance(which, slice) or which.step not in (None, 1):
            return super().__getitem__(which)
        start, stop, _ = which.indices(len(self))
        part = SourcePart(CloudColumns(self), start, max(start, stop))
        cloud = LazyCloud.of(JoinedColumns([part]), self.stamp_ns)
        cloud.__dict__["chosen"] = self.chosen
        return cloud

    def __reduce__(self) -> Any:
        columns = {f.name: getattr(self, f.name) for f in fields(self)}
        columns["extra"] = dict(self.extra)
        return (functools.partial(PointCloud, **columns), ())


class ExtraColumns(Mapping[str, NDArray[Any]]):
    """The columns in `extra` of a cloud, computed when they are first read."""

    def __init__(self, lazy: LazyColumns) -> None:
        self._lazy = lazy

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name in self:
            column = self._lazy.read(name)
            if column is not None:
                return column
        raise KeyError(f"{name}: expected one of {', '.join(self) or 'none'}")

    def __contains__(self, name: object) -> bool:
        return name in self._lazy.source.extra  # without computing the column

    def __iter__(self) -> Iterator[str]:
        return iter(self._lazy.source.extra)

    def __len__(self) -> int:
        return len(self._lazy.source.extra)

    def __repr__(self) -> str:
        names = [
            f"{name} [{kind.unit}]" if kind.unit else name
            for name, kind in self._lazy.source.extra.items()
        ]
        return f"{type(self).__name__}({', '.join(names)})"


class _LazyColumn:
    """A column that is computed when it is first read."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, cloud: Any, owner: Any) -> Any:
        if cloud is None:
            return self
        return cloud.lazy.read(self._name)


for _name in (*COLUMNS, "valid"):
    setattr(LazyCloud, _name, _LazyColumn(_name))
