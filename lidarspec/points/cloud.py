"""Point clouds: flat arrays in SI units, REP-103 axes and REP-117 ranges.

A mounting turns and moves the points of a sensor.

A `PointCloud` holds its columns. A `LazyCloud` takes each from a `ColumnSource` when it is first
read. There is one interface of such sources, whatever the points are: those of a batch of packets
(`lazy_columns.BatchColumns`), those of a cloud that has its columns (`CloudColumns`), and some of
other sources one after another (`Stretches`), as slices and scans are. Scans are so cut out of
batches without a column being made, and a source that can makes the columns of a scan for that scan
alone.

Columns under names of a sensor's own are in `extra`, each made when it is first read too; a source
has them like all others, by name.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from lidarspec.display import drawn
from lidarspec.errors import UnknownName, UsageError
from lidarspec.libraries import import_library
from lidarspec.points.conventions import (
    TYPES,
    UNITS,
    Floats,
    Grid,
    Grids,
    Kind,
    narrowed,
    whole_columns,
)

#: names of the columns that a cloud can have, in the order in which files list them.
COLUMNS = tuple(TYPES)

#: x y z intensity ring time at PCL's offsets.
STRUCTURED = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "time"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<f4"],
        "offsets": [0, 4, 8, 16, 20, 24],
        "itemsize": 32,
    }
)
#: what the size of a structured point is a multiple of.
_ALIGNED = 16


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
        column: (N,) uint16, which column of its turn a point is in, None where the sensor does not
            say.
        valid: (N,) bool, True for real returns.
        stamp_ns: int64 nanoseconds.
        shape: (columns, rows) where the points are organised so, else None; several returns of a
            place stand side by side: ``cloud.range.reshape(*cloud.shape, -1)`` is (columns, rows,
            returns).
        nominal: True where a default calibration stood in for the sensor's own.
        extra: (N,) columns that the sensor gives besides, by name, such as "velocity"; each in its
            type.
        units: of those in `extra`, by name; "" for a plain number.
        chosen: the columns that `columns` and files have, see `only`; () for all.
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
        return np.size(self.x)  # 1 of `cloud[0]`

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

    _repr_svg_ = drawn("cloud")

    @property
    def columns(self) -> Mapping[str, NDArray[Any]]:
        """The columns of this cloud by name, `extra` last.

        Only the chosen ones, if columns were chosen.
        """
        names = self.chosen or (*COLUMNS, *self.extra)
        source_of(self).prepare(names)
        columns = {
            name: self.extra[name] if name in self.extra else getattr(self, name) for name in names
        }
        return {name: column for name, column in columns.items() if column is not None}

    def shows(self, name: str) -> bool:
        """Whether a column was chosen, or is a place, which every file of points has."""
        return not self.chosen or name in (*self.chosen, "x", "y", "z")

    def only(self, *names: str) -> PointCloud:
        """Return the same points with these columns alone.

        They apply to `columns`, `to_structured` and files. x, y and z remain if a format requires
        them.

        Raises:
            UnknownName: for a column that the cloud has not; it names those that it has.
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

    def read(self, *names: str) -> dict[str, NDArray[Any]]:
        """Return columns by name, including "valid" and those in `extra`.

        They are computed together, which is faster than one after another.

        Raises:
            UnknownName: for a column that the cloud has not.
        """
        source_of(self).prepare(names)
        found = {name: getattr(self, name) for name in names if name in (*COLUMNS, "valid")}
        found |= {name: self.extra[name] for name in names if name in self.extra}
        missing = next((name for name in names if found.get(name) is None), None)
        if missing is not None:
            raise UnknownName(missing, [*self.columns, "valid"], place="columns of points")
        return {name: found[name] for name in names}

    @property
    def calibration(self) -> str:
        """The origin of the calibration.

        "own" is the sensor's own, "nominal" means that defaults were used.
        """
        if self.nominal:
            return "nominal"
        return "own"

    @property
    def xyz(self) -> Floats:
        """(N, 3) float32 metres."""
        return np.stack([self.x, self.y, self.z], axis=-1)

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        """Return `xyz`, as NumPy, SciPy and Open3D expect points.

        `to_structured` has the other columns too.

        Raises:
            ValueError: with ``copy=False``, since x, y and z are columns of their own.
        """
        if copy is False:
            raise ValueError(
                "x, y and z of a PointCloud are columns of their own, of which (N, 3) is a copy"
            )
        if dtype is None:
            return self.xyz
        return self.xyz.astype(dtype, copy=False)

    def __getitem__(self, which: Any) -> PointCloud:
        """Return the points at a mask, indices or a slice.

        The result is organised only if a slice holds whole columns. One index gives scalars.
        """
        picked = {f.name: _pick(getattr(self, f.name), which) for f in fields(self)}
        picked["extra"] = {name: column[which] for name, column in self.extra.items()}
        shape = None
        if self.shape and isinstance(which, slice) and which.step in (None, 1):
            shape = organised(
                len(picked["x"]),
                whole_columns(grid_of(self), which.indices(len(self))[0], len(picked["x"])),
            )
        return PointCloud(**{**picked, "shape": shape})

    def organised(self, columns: int) -> PointCloud:
        """Return the points as a picture of `columns` columns, placed by their number.

        A missing column is a gap of invalid points.

        Args:
            columns: of a whole turn. The points are those of one turn at most.

        Raises:
            UsageError: where they have no `column` or are not organised, or a number comes twice or
                is too large.
        """
        if self.shape is None or self.column is None:
            raise UsageError(
                "a picture is made of organised points whose columns have numbers: Polar(...,"
                " column=...)"
            )
        each = grid_of(self).column
        numbers, counts = np.unique(self.column[::each], return_counts=True)
        wrong = numbers[(numbers >= columns) | (counts > 1)]
        if len(wrong):
            if wrong[0] < columns:
                reason = f"comes {int(counts[numbers == wrong[0]][0])} times"
            else:
                reason = f"is not one of {columns}"
            raise UsageError(
                f"column {wrong[0]} {reason}: give the points of one turn, and how many columns"
                " that has"
            )
        place = np.full(columns, -1)
        place[self.column[::each]] = np.arange(self.shape[0])
        indices = np.where(place[:, None] < 0, -1, place[:, None] * each + np.arange(each))
        numbered = np.repeat(np.arange(columns), each).astype(TYPES["column"])
        return replace(self._rearranged(indices), column=numbered, shape=(columns, self.shape[1]))

    def destaggered(self, shifts: Sequence[int]) -> PointCloud:
        """Return the points of a picture with each row shifted by some columns.

        Rows wrap around. Afterwards one column has one direction.

        Args:
            shifts: columns for each row, (rows,), as the sensor's metadata has them.

        Raises:
            UsageError: where the points are not organised (see `organised`), or there is not one
                shift for each row.
        """
        if self.shape is None or np.shape(shifts) != (self.shape[1],):
            if self.shape:
                what = f"{self.shape[1]} rows"
            else:
                what = "points that are not organised"
            raise UsageError(f"{np.size(shifts)} shifts for {what}")
        grid, (columns, rows) = grid_of(self), self.shape
        source = (np.arange(columns)[:, None] - np.asarray(shifts)) % columns
        places = source * rows + np.arange(rows)
        return replace(
            self._rearranged(places[:, :, None] * grid.returns + np.arange(grid.returns)),
            shape=self.shape,
        )

    def _rearranged(self, indices: NDArray[np.intp]) -> PointCloud:
        """Return the points at some indices, which form whole columns.

        Index -1 is an invalid point in its row.
        """
        indices = indices.reshape(-1)
        each = grid_of(self).column
        gaps = indices < 0
        picked = self[np.where(gaps, np.arange(len(indices)) % each, indices)]
        if gaps.any():
            for column in (*picked.columns.values(), picked.valid):
                if column.dtype.kind in "fb":
                    column[gaps] = np.nan if column.dtype.kind == "f" else False
        return picked

    def to_structured(self) -> NDArray[Any]:
        """Return a structured array (N,) with PCL's layout.

        The fields are x y z intensity ring time, itemsize 32. Missing values are 0.

        The columns in `extra` follow from byte 32 on, each where its type allows, and the itemsize
        is a multiple of 16.
        """
        names = [name for name in STRUCTURED.names or () if self.shows(name)]
        source_of(self).prepare((*names, *self.extra))
        columns = {name: getattr(self, name) for name in names} | dict(self.extra)
        structured = np.zeros(
            len(self), structured_type({name: column.dtype for name, column in self.extra.items()})
        )
        for name, column in columns.items():
            if column is not None:
                structured[name] = column
        return structured

    def to_arrow(self, facts: Mapping[str, str] | None = None) -> Any:
        """Return a `pyarrow.Table` with the columns of `columns`.

        Columns are not copied, except bools. The metadata of each field has its unit.

        Args:
            facts: further metadata of the schema, beside `units` as JSON, `calibration` ("nominal"
                or "own") and `stamp_ns`.

        Raises:
            UsageError: where pyarrow is not installed.
        """
        return import_library("pyarrow", "arrow").table(
            dict(self.columns),
            arrow_schema(self, {"stamp_ns": str(self.stamp_ns), **(facts or {})}),
        )

    def __arrow_c_stream__(self, requested_schema: object = None) -> object:
        """The table of `to_arrow`, as DuckDB, Polars and pandas take it from the object itself."""
        return self.to_arrow().__arrow_c_stream__(requested_schema)

    def to_pandas(self) -> Any:
        """Return a `pandas.DataFrame` with the columns of `columns`, not copied.

        `attrs` has "units" and "stamp_ns".

        Raises:
            UsageError: where pandas is not installed.
        """
        frame = import_library("pandas", "pandas").DataFrame(dict(self.columns), copy=False)
        frame.attrs.update(units=units_of(self), stamp_ns=self.stamp_ns)
        return frame

    def to_polars(self) -> Any:
        """A `polars.DataFrame` with the columns of `columns`, which are not copied.

        Raises:
            UsageError: where Polars is not installed.
        """
        return import_library("polars", "polars").DataFrame(dict(self.columns))


def units_of(cloud: PointCloud) -> dict[str, str]:
    """The units of the columns that a cloud has, by name, those that are plain numbers left out."""
    return {
        name: unit for name in cloud.columns if (unit := UNITS.get(name) or cloud.units.get(name))
    }


def arrow_schema(cloud: PointCloud, facts: Mapping[str, str]) -> Any:
    """Return the `pyarrow.Schema` of a cloud.

    Float columns are not nullable, which is faster to write: nan marks a missing value.

    Args:
        facts: metadata of the schema, beside `units` as JSON and `calibration`: "nominal" or "own".
    """
    arrow = import_library("pyarrow", "arrow")
    units = units_of(cloud)
    fields = [
        arrow.field(
            name,
            arrow.from_numpy_dtype(column.dtype),
            column.dtype.kind != "f",
            {"unit": units.get(name, "")},
        )
        for name, column in cloud.columns.items()
    ]
    return arrow.schema(
        fields, {**facts, "calibration": cloud.calibration, "units": json.dumps(units)}
    )


def structured_type(extra: Mapping[str, np.dtype[Any]]) -> np.dtype[Any]:
    """PCL's layout with further columns behind it, each where its type allows."""
    places = {name: place[:2] for name, place in (STRUCTURED.fields or {}).items()}
    end = STRUCTURED.itemsize
    for name, dtype in extra.items():
        start = end + -end % dtype.itemsize
        places[name], end = (dtype.newbyteorder("<"), start), start + dtype.itemsize
    formats, offsets = zip(*places.values(), strict=True)
    return np.dtype(
        {
            "names": list(places),
            "formats": formats,
            "offsets": offsets,
            "itemsize": end + -end % _ALIGNED,
        }
    )


def _pick(value: Any, which: Any) -> Any:
    if isinstance(value, np.ndarray) and value.ndim:
        return value[which]
    return value


def grid_of(cloud: PointCloud) -> Grid:
    """How the points of a cloud are organised."""
    if cloud.shape:
        return Grid(cloud.shape[1], len(cloud) // max(cloud.shape[0] * cloud.shape[1], 1) or 1)
    return Grid()


def organised(number: int, grid: Grid) -> tuple[int, int] | None:
    """The shape of a cloud of so many points."""
    if grid.rows:
        return (number // grid.column, grid.rows)
    return None


class ColumnSource:
    """Where the columns of consecutive points come from.

    Attributes:
        size: the number of points.
        base: the time that their times count from, int64 ns.
        grid: how the points are organised, all together.
        grids: how those of each packet are, where they are of several shapes.
        nominal: whether a default calibration stood in for the sensor's own.
        extra: what the columns under names of the sensor's own hold, by name.
    """

    size: int
    base: int
    grid: Grid = Grid()
    grids: Grids | None = None
    nominal: bool = False
    extra: Mapping[str, Kind] = {}

    def column(self, name: str) -> NDArray[Any] | None:
        """Return a column of `PointCloud`, (size,), "valid", or one of `extra`.

        Returns None if the sensor does not have it.
        """
        raise NotImplementedError

    def holds(self, name: str) -> bool:
        """Whether a column is made already."""
        raise NotImplementedError

    def prepare(self, names: Sequence[str]) -> None:
        """Make columns that will be asked for together, where that is quicker."""

    def part(self, name: str, start: int, stop: int) -> NDArray[Any] | None:
        """Return a column of the points from `start` to `stop`, (stop - start,).

        Returns None if the sensor does not have it.
        """
        column = self.column(name)
        if column is None:
            return None
        return column[start:stop]

    def grid_between(self, start: int, stop: int) -> Grid:
        """How the points from `start` to `stop` are organised, whatever is around them."""
        if self.grids:
            return self.grids.between(start, stop)
        return whole_columns(self.grid, start, stop - start)

    def times_at(self, indices: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return the column "time" at some indices, in their shape.

        Times are in seconds since `base`. Other times need not be computed.
        """
        times = self.column("time")
        assert times is not None  # since every cloud has it
        picked: NDArray[np.float64] = times[indices]
        return picked

    def together(self, parts: Sequence[Stretch]) -> ColumnSource | None:
        """Return a source of the columns of several stretches for these points alone.

        The stretches are of this and further sources. Returns None if there is no such source.
        """
        return None


class CloudColumns(ColumnSource):
    """The columns of a cloud."""

    def __init__(self, cloud: PointCloud, grids: Grids | None = None) -> None:
        self._cloud = cloud
        self.size = len(cloud)
        self.base = cloud.stamp_ns
        self.grids = grids
        self.nominal = bool(cloud.nominal)
        if grids:
            self.grid = grids.between(0, self.size)
        else:
            self.grid = grid_of(cloud)
        if isinstance(cloud, LazyCloud):
            own = cloud.source.extra
        else:
            own = None
        if own is None:
            self.extra = {
                name: Kind(column.dtype, cloud.units.get(name, ""))
                for name, column in cloud.extra.items()
            }
        else:
            self.extra = own

    def column(self, name: str) -> NDArray[Any] | None:
        column: NDArray[Any] | None = (
            self._cloud.extra[name] if name in self.extra else getattr(self._cloud, name)
        )
        return column

    def holds(self, name: str) -> bool:
        return name in vars(self._cloud)

    def prepare(self, names: Sequence[str]) -> None:
        if isinstance(self._cloud, LazyCloud):
            self._cloud.source.prepare([name for name in names if not self.holds(name)])

    def times_at(self, indices: NDArray[np.intp]) -> NDArray[np.float64]:
        if isinstance(self._cloud, LazyCloud) and not self.holds("time"):
            return self._cloud.source.times_at(indices)
        return super().times_at(indices)


class Stretch(NamedTuple):
    """Consecutive points of a source."""

    source: ColumnSource
    start: int
    stop: int

    @property
    def size(self) -> int:
        """The number of points."""
        return self.stop - self.start


class Stretches(ColumnSource):
    """Stretches of sources, one after another, at least one.

    Args:
        from_first: times count from the first point; else from where those of the first source do.
    """

    def __init__(self, parts: Sequence[Stretch], *, from_first: bool = False) -> None:
        self._parts = parts
        self._from_first = from_first
        self.size = sum(part.size for part in parts)
        self.base = parts[0].source.base
        grids = {part.source.grid_between(part.start, part.stop) for part in parts}
        if len(grids) == 1:
            self.grid = grids.pop()
        else:
            self.grid = Grid()
        self.nominal = any(part.source.nominal for part in parts)
        first = parts[0].source.extra
        if first:
            self.extra = {
                name: first[name]
                for name in first
                if all(name in part.source.extra for part in parts)
            }
        else:
            self.extra = first
        self._together = parts[0].source.together(parts)

    def column(self, name: str) -> NDArray[Any] | None:
        together = self._together
        if together is not None and (
            together.holds(name) or not all(part.source.holds(name) for part in self._parts)
        ):
            column = together.column(name)
        else:
            column = self._joined(name)
        return (
            column - column[0]
            if name == "time" and self._from_first and column is not None
            else column
        )

    def holds(self, name: str) -> bool:
        return False

    def prepare(self, names: Sequence[str]) -> None:
        if self._together is not None and not any(
            part.source.holds(name) for name in names for part in self._parts
        ):
            self._together.prepare(names)

    def times_at(self, indices: NDArray[np.intp]) -> NDArray[np.float64]:
        if self._from_first:
            times = self._times_at(np.concatenate([np.zeros(1, np.intp), indices]))
            return np.asarray(times[1:] - times[0])
        return self._times_at(indices)

    def _times_at(self, indices: NDArray[np.intp]) -> NDArray[np.float64]:
        """Times of some points, which count from where those of the first source do."""
        times = np.empty(len(indices))
        start = 0
        for part in self._parts:
            inside = (indices >= start) & (indices < start + part.size)
            if inside.any():
                times[inside] = part.source.times_at(indices[inside] - start + part.start) + later(
                    part.source, self.base
                )
            start += part.size
        return times

    def _joined(self, name: str) -> NDArray[Any] | None:
        """What the sources have, one after another."""
        columns: list[NDArray[Any]] = []
        for part in self._parts:
            column = part.source.part(name, part.start, part.stop)
            if column is None:
                return None
            columns.append(column + later(part.source, self.base) if name == "time" else column)
        if len(columns) == 1:
            return columns[0]
        return np.concatenate(columns)


def later(source: ColumnSource, base: int) -> float:
    """What the times of a source count from, after another time, seconds."""
    return (source.base - base) * 1e-9


class Extras(Mapping[str, NDArray[Any]]):
    """The columns of a source under names of the sensor's own, each made when it is first read."""

    def __init__(self, source: ColumnSource) -> None:
        self._source = source
        self._made = dict[str, Any]()

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name not in self._made:
            self._made[name] = self._source.column(name) if name in self._source.extra else None
        if self._made[name] is None:
            raise KeyError(f"{name}: there are {', '.join(self) or 'none'}")
        column: NDArray[Any] = self._made[name]
        return column

    def __contains__(self, name: object) -> bool:
        return name in self._source.extra  # without making it

    def __iter__(self) -> Iterator[str]:
        return iter(self._source.extra)

    def __len__(self) -> int:
        return len(self._source.extra)

    def __repr__(self) -> str:
        names = [
            f"{name} [{kind.unit}]" if kind.unit else name
            for name, kind in self._source.extra.items()
        ]
        return f"Extras({', '.join(names)})"


class _Unread:
    """A column that is made when it is first read."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, cloud: Any, owner: Any) -> Any:
        if cloud is None:
            return self
        cloud.__dict__[self._name] = column = cloud.source.column(self._name)
        return column


class LazyCloud(PointCloud):
    """A cloud whose columns are made when they are first read."""

    source: ColumnSource

    @classmethod
    def of(cls, source: ColumnSource, stamp_ns: int) -> LazyCloud:
        """The cloud of these columns; `stamp_ns`: the time that theirs count from."""
        cloud = object.__new__(cls)
        shape = organised(source.size, source.grid)
        cloud.__dict__.update(
            source=source, stamp_ns=stamp_ns, shape=shape, nominal=np.bool_(source.nominal)
        )
        cloud.__dict__.update(
            extra=Extras(source), units={name: kind.unit for name, kind in source.extra.items()}
        )
        return cloud

    def __len__(self) -> int:
        return self.source.size

    def __getitem__(self, which: Any) -> PointCloud:
        if isinstance(which, slice) and which.step in (None, 1):
            first, end, _ = which.indices(len(self))
            cloud = LazyCloud.of(
                Stretches([Stretch(CloudColumns(self), first, max(first, end))]), self.stamp_ns
            )
            cloud.__dict__["chosen"] = self.chosen
            return cloud
        return super().__getitem__(which)

    def __reduce__(self) -> Any:
        return (
            functools.partial(
                PointCloud,
                **{f.name: getattr(self, f.name) for f in fields(self)}
                | {"extra": dict(self.extra)},
            ),
            (),
        )


for _name in (*COLUMNS, "valid"):
    setattr(LazyCloud, _name, _Unread(_name))


def source_of(cloud: PointCloud) -> ColumnSource:
    """Where the columns of a cloud come from."""
    if isinstance(cloud, LazyCloud):
        return cloud.source
    return CloudColumns(cloud)


@dataclass(frozen=True)
class Mount:
    """Where a sensor sits on its carrier, and how it is turned there; both have REP-103 axes.

    The sensor is turned over first where it is `inverted`, then by roll, pitch and yaw about the
    carrier's fixed axes.

    Attributes:
        x, y, z: the sensor's origin, metres forward, left and up.
        roll_deg, pitch_deg, yaw_deg: about x, y and z, right-handed: a yaw of 90 makes the sensor
            look to the left.
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
        roll, pitch, yaw = np.deg2rad(
            [self.roll_deg + 180.0 * self.inverted, self.pitch_deg, self.yaw_deg]
        )
        about_x = np.array(
            [[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]]
        )
        about_y = np.array(
            [[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]]
        )
        about_z = np.array(
            [[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]]
        )
        return np.asarray(about_z @ about_y @ about_x)

    def applied(self, cloud: PointCloud) -> PointCloud:
        """A cloud, given in the sensor's axes, in those of the carrier.

        Returns:
            x y z from the carrier's origin; azimuth and elevation of the beams in its axes. `range`
            stays what the sensor measured, from the sensor.
        """
        turn = self.rotation
        azimuth = cloud.azimuth.astype(np.float64)
        elevation = cloud.elevation.astype(np.float64)
        level = np.cos(elevation)
        beam = turn @ np.stack(
            [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)]
        )
        xyz = turn @ np.stack([cloud.x, cloud.y, cloud.z]).astype(np.float64) + np.array(
            [[self.x], [self.y], [self.z]]
        )
        x, y, z = xyz.astype(np.float32)
        # arcsin is coarse where beams point straight up; the other two sides of the triangle are
        # not
        raised = np.arctan2(beam[2], np.hypot(beam[0], beam[1])).astype(np.float32)
        same = {f.name: getattr(cloud, f.name) for f in fields(cloud)}
        turned = {
            "x": x,
            "y": y,
            "z": z,
            "azimuth": narrowed(np.arctan2(beam[1], beam[0])),
            "elevation": raised,
        }
        return PointCloud(**{**same, **turned})

    def __str__(self) -> str:
        given = [
            f"{f.name}={getattr(self, f.name):g}"
            for f in fields(self)[:-1]
            if getattr(self, f.name)
        ]
        return (
            ", ".join([*given, *(["inverted"] if self.inverted else [])]) or "as the sensor stands"
        )
