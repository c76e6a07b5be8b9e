"""Sources of the columns of consecutive points.

A cloud or a scan reads its columns from a `ColumnSource` when they are first used. `JoinedColumns`
joins slices of sources without computing any column.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarspec.points.conventions import ExtraType, Grid, Grids, slice_grid


class ColumnSource:
    """A source of the columns of consecutive points.

    Attributes:
        base: the time that the column "time" counts from, int64 ns.
        grid: the organisation of all points together.
        grids: the organisation of the points of each packet, if packets have different shapes.
        nominal: whether a default calibration is used instead of the sensor's own.
        extra: the types and units of the columns in `PointCloud.extra`, by name.
        is_level: whether all points are in the horizontal plane through the sensor.
    """

    size: int
    base: int
    grid: Grid = Grid()
    grids: Grids | None = None
    nominal: bool = False
    extra: Mapping[str, ExtraType] = {}
    is_level: bool = False

    def columns(self, names: Sequence[str], start: int, stop: int) -> dict[str, NDArray[Any]]:
        """Return columns of the points from `start` to `stop`, (stop - start,) each.

        The result may have further columns. It has no entry for columns that the sensor does not
        have. It may lack "valid", which is True for each point whose x is not nan. If `is_level`,
        it may lack "z" (`level_z`).

        Args:
            names: the names of columns of `PointCloud`, or of columns in `extra`.
        """
        raise NotImplementedError

    def grid_between(self, start: int, stop: int) -> Grid:
        """Return how the points from `start` to `stop` are organised."""
        if self.grids:
            return self.grids.grid_between(start, stop)
        return slice_grid(self.grid, start, stop - start)

    def times_at(self, indices: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return the times of the points at some indices, in seconds since `base`."""
        picked: NDArray[np.float64] = self.columns(("time",), 0, self.size)["time"][indices]
        return picked

    def seconds_after(self, time_ns: int) -> float:
        """Return the seconds from `time_ns` to the base of this source."""
        return (self.base - time_ns) * 1e-9


class LazyColumns:
    """The columns of a source, each computed when it is first read.

    Attributes:
        computed: the columns computed so far, by name; None if the sensor does not have a column.
    """

    def __init__(self, source: ColumnSource) -> None:
        self.source = source
        self.computed: dict[str, NDArray[Any] | None] = {}

    def load(self, *names: str) -> None:
        """Compute the columns that are not computed yet, together."""
        missing = [name for name in names if name not in self.computed]
        if not missing:
            return
        columns = self.source.columns(missing, 0, self.source.size)
        self.computed = dict.fromkeys(missing) | columns | self.computed
        if "z" in missing and self.source.is_level:
            self.computed["z"] = level_z(self._read_x())
        if "valid" in missing and "valid" not in columns:
            self.computed["valid"] = ~np.isnan(self._read_x())  # x is nan unless a point is valid

    def read(self, name: str) -> NDArray[Any] | None:
        """Return a column; None if the sensor does not have it."""
        if name not in self.computed:
            self.load(name)
        return self.computed[name]

    def _read_x(self) -> NDArray[Any]:
        x = self.read("x")
        assert x is not None  # since every cloud has it
        return x


def level_z(x: NDArray[Any]) -> NDArray[Any]:
    """Return the z of points in the horizontal plane: 0, or nan if x is nan."""
    z: NDArray[Any] = x - x
    return z


class SourcePart(NamedTuple):
    """Consecutive points of a source."""

    source: ColumnSource
    start: int
    stop: int

    @property
    def size(self) -> int:
        """The number of points."""
        return self.stop - self.start


class JoinedColumns(ColumnSource):
    """Slices of sources, concatenated.

    Args:
        parts: the slices, at least one.
        from_first: True if times count from the first point, False if they count from the base of
            the first source.
    """

    def __init__(self, parts: Sequence[SourcePart], *, from_first: bool = False) -> None:
        self._parts = parts
        self._from_first = from_first
        self.size = sum(part.size for part in parts)
        self.base = parts[0].source.base
        grids = {part.source.grid_between(part.start, part.stop) for part in parts}
        if len(grids) == 1:
            self.grid = grids.pop()
        self.nominal = any(part.source.nominal for part in parts)
        self.is_level = all(part.source.is_level for part in parts)
        self.extra = {
            name: kind
            for name, kind in parts[0].source.extra.items()
            if all(name in part.source.extra for part in parts)
        }

    def columns(self, names: Sequence[str], start: int, stop: int) -> dict[str, NDArray[Any]]:
        pieces = [self._read_part(part, names) for part in self._parts]
        columns = {
            name: _join([piece[name] for piece in pieces])
            for name in pieces[0]
            if all(name in piece for piece in pieces)
        }
        if self._from_first and "time" in columns:
            columns["time"] = columns["time"] - columns["time"][0]
        return {name: column[start:stop] for name, column in columns.items()}

    def _read_part(self, part: SourcePart, names: Sequence[str]) -> dict[str, NDArray[Any]]:
        """Return columns of one slice, with times since the base of the first source."""
        piece = part.source.columns(names, part.start, part.stop)
        if "time" in piece:
            piece["time"] = piece["time"] + part.source.seconds_after(self.base)
        if "z" in names and part.source.is_level and not self.is_level:
            piece["z"] = level_z(part.source.columns(("x",), part.start, part.stop)["x"])
        return piece

    def times_at(self, indices: NDArray[np.intp]) -> NDArray[np.float64]:
        times = self._times_since_base(indices)
        if self._from_first:
            times -= self._times_since_base(np.zeros(1, np.intp))
        return times

    def _times_since_base(self, indices: NDArray[np.intp]) -> NDArray[np.float64]:
        times = np.empty(len(indices))
        first = 0
        for part in self._parts:
            is_inside = (indices >= first) & (indices < first + part.size)
            if is_inside.any():
                found = part.source.times_at(indices[is_inside] - first + part.start)
                times[is_inside] = found + part.source.seconds_after(self.base)
            first += part.size
        return times


def _join(pieces: Sequence[NDArray[Any]]) -> NDArray[Any]:
    if len(pieces) == 1:
        return pieces[0]
    return np.concatenate(pieces)
