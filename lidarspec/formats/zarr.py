"""Zarr, a folder of arrays in compressed chunks, by zarr: a column each, as xarray and Dask open them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from lidarspec.errors import library
from lidarspec.formats.writing import facts, units_of, written
from lidarspec.scans.scans import Scan
from lidarspec.transports.protocol import Format

#: numbers of a chunk, and of one of those that have a number a scan.
ROWS, SCANS = 1 << 18, 1 << 12
#: what there is of each scan: type and unit, as xarray reads it.
OF_SCANS: dict[str, tuple[DTypeLike, str]] = {
    "stamp_ns": (np.int64, "nanoseconds since 1970-01-01"),
    "rate_hz": (np.float64, "Hz"),
    "complete": (np.bool_, ""),
}


class _Column:
    """An array that grows by whole chunks, so that none is compressed twice."""

    def __init__(self, group: Any, name: str, dtype: DTypeLike, *, unit: str = "", along: str = "points") -> None:
        self._chunk = {"points": ROWS, "scans": SCANS}[along]
        self._array = group.create_array(
            name,
            shape=(0,),
            chunks=(self._chunk,),
            dtype=np.dtype(dtype),
            dimension_names=(along,),
            attributes={"units": unit} if unit else {},
        )
        self._waiting, self._length = list[NDArray[Any]](), 0

    def add(self, values: NDArray[Any] | None, length: int) -> None:
        """Append values; without any, nan or 0 as often as `length` says."""
        dtype = self._array.dtype
        self._waiting.append(np.full(length, np.nan if dtype.kind == "f" else 0, dtype) if values is None else values)
        self._length += length
        if self._length >= self._chunk:
            self.write(self._length - self._length % self._chunk)

    def write(self, number: int) -> None:
        """Write so many of the values that wait."""
        waiting = np.concatenate([np.empty(0, self._array.dtype), *self._waiting])
        self._array.append(waiting[:number])
        self._waiting, self._length = [waiting[number:].copy()], len(waiting) - number

    def finish(self) -> None:
        """Write all that wait."""
        self.write(self._length)


def _write(path: Path, scans: Iterable[Scan], *, every_point: bool) -> None:
    """Write the columns that the first scan has, and `scan`, along "points", `stamp_ns`, `rate_hz` and `complete` along "scans".

    Arrays have their `units`; the group has `sensor`, `source`, `frame` (where x, y and z point) and `calibration`. A column that a later
    scan lacks is nan there, or 0 where it holds whole numbers.
    """
    group = library("zarr", "zarr").open_group(str(path), mode="w")
    of_scans = {name: _Column(group, name, dtype, unit=unit, along="scans") for name, (dtype, unit) in OF_SCANS.items()}
    columns = {"scan": _Column(group, "scan", np.int32)}
    for number, scan in enumerate(scans):
        cloud = written(scan, every_point=every_point)
        own = {**cloud.columns, "scan": np.full(len(cloud), number, np.int32)}
        if not number:
            units = units_of(cloud)
            group.attrs.update(facts(scan))
            columns |= {name: _Column(group, name, own[name].dtype, unit=units.get(name, "")) for name in cloud.columns}
        for name, column in columns.items():
            column.add(own.get(name), len(cloud))
        for name, column in of_scans.items():
            column.add(np.array([getattr(scan, name)]), 1)
    for column in (*columns.values(), *of_scans.values()):
        column.finish()


ZARR = Format(".zarr", "Zarr, a folder with an array a column (zarr)", _write)
