"""Write NumPy arrays (.npz, .npy) and Zarr folders."""

from __future__ import annotations

import contextlib
import io
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from lidarspec.formats.common import ColumnSpool, select_points, to_image
from lidarspec.formats.point_rows import COLUMN_NAMES, PointRows, write_rows
from lidarspec.optional_libraries import import_library
from lidarspec.points.cloud import units_of
from lidarspec.points.table_types import structured_type
from lidarspec.scans.scan import Scan
from lidarspec.transports.protocol import Format

#: The number of values in a Zarr chunk of a column with one value per point.
POINT_CHUNK = 1 << 18
#: The number of values in a Zarr chunk of a column with one value per scan.
SCAN_CHUNK = 1 << 12
#: The type and unit of each column with one value per scan. Units are in the form that xarray
#: reads.
SCAN_COLUMNS: dict[str, tuple[DTypeLike, str]] = {
    "stamp_ns": (np.int64, "nanoseconds since 1970-01-01"),
    "rate_hz": (np.float64, "Hz"),
    "complete": (np.bool_, ""),
}


def write_array(
    archive: zipfile.ZipFile, name: str, column: ColumnSpool, height: int | None = None
) -> None:
    """Add a column to an archive as a NumPy array.

    Args:
        height: number of rows of an organized column; None for a flat column.
    """
    with archive.open(f"{name}.npy", "w", force_zip64=True) as target:
        lengths = (column.length,) if height is None else (height, column.length // height)
        shape = {"descr": column.dtype.str, "fortran_order": False, "shape": lengths}
        np.lib.format.write_array_header_1_0(target, shape)
        column.copy_to(target)


def write(path: Path, scans: Iterable[Scan], *, every_point: bool, organized: bool = False) -> None:
    """Write an .npz file with an array for each column of the points.

    A column is written if all scans have it. With `organized`, arrays have the shape (rows,
    columns). The arrays stamp_ns, rate_hz and complete have one element for each scan.
    """
    height: int | None = None
    with contextlib.ExitStack() as files:

        def column(dtype: DTypeLike) -> ColumnSpool:
            return files.enter_context(contextlib.closing(ColumnSpool(path.parent, dtype)))

        scan_columns = {
            "stamp_ns": column(np.int64),
            "rate_hz": column(np.float64),
            "complete": column(np.bool_),
        }
        numbers = column(np.int32)
        columns = dict[str, ColumnSpool]()
        units = dict[str, str]()
        for number, scan in enumerate(scans):
            cloud = select_points(scan, every_point=every_point)
            own = cloud.columns
            if organized:
                height = len(to_image(cloud.valid, cloud))
                own = {name: to_image(column, cloud).ravel() for name, column in own.items()}
            if not number:
                columns = {name: column(values.dtype) for name, values in own.items()}
            if not number:
                units = {name: unit for name, unit in cloud.units.items() if unit}
            columns = {name: kept for name, kept in columns.items() if name in own}
            for name, kept in columns.items():
                kept.add(own[name])
            numbers.add(np.full(len(cloud), number))
            for name, kept in scan_columns.items():
                kept.add(np.array([getattr(scan, name)]))
        unit_columns = {f"{name}.unit": column(f"<U{len(unit)}") for name, unit in units.items()}
        for unit, kept in zip(units.values(), unit_columns.values(), strict=True):
            kept.add(np.array([unit]))
        with zipfile.ZipFile(path, "w") as archive:
            for name, kept in {**columns, "scan": numbers}.items():
                write_array(archive, name, kept, height)
            for name, kept in {**scan_columns, **unit_columns}.items():
                write_array(archive, name, kept)


def write_npy(
    path: Path, scans: Iterable[Scan], *, every_point: bool, organized: bool = False
) -> None:
    """Write one structured array with PCL's layout, like `PointCloud.to_structured`.

    Missing columns are 0. With `organized`, the array has the shape (rows, columns).
    """
    write_rows(
        path,
        PointRows(scans, _make_structured_dtype, every_point=every_point, is_image=organized),
        _make_npy_header,
    )


def _make_structured_dtype(types: Mapping[str, Any]) -> np.dtype[Any]:
    return structured_type(
        {name: np.dtype(dtype) for name, dtype in types.items() if name not in COLUMN_NAMES}
    )


def _make_npy_header(rows: PointRows) -> bytes:
    """Return the header of a .npy file, with a length that is the same for all shapes."""
    header = io.BytesIO()
    shape = {
        "descr": np.lib.format.dtype_to_descr(rows.dtype),
        "fortran_order": False,
        "shape": rows.shape[::-1] if rows.shape else (rows.length,),
    }
    np.lib.format.write_array_header_1_0(header, shape)
    return header.getvalue()


class _ZarrColumn:
    """A Zarr array that grows by whole chunks.

    Added values wait in memory until they fill a chunk.
    """

    def __init__(
        self, group: Any, name: str, dtype: DTypeLike, *, unit: str = "", along: str = "points"
    ) -> None:
        self._chunk = {"points": POINT_CHUNK, "scans": SCAN_CHUNK}[along]
        self._array = group.create_array(
            name,
            shape=(0,),
            chunks=(self._chunk,),
            dtype=np.dtype(dtype),
            dimension_names=(along,),
            attributes={"units": unit} if unit else {},
        )
        self._waiting = list[NDArray[Any]]()
        self._length = 0

    def add(self, values: NDArray[Any] | None, length: int) -> None:
        """Append values; if `values` is None, append `length` missing values."""
        dtype = self._array.dtype
        self._waiting.append(
            np.full(length, np.nan if dtype.kind == "f" else 0, dtype) if values is None else values
        )
        self._length += length
        if self._length >= self._chunk:
            self.write(self._length - self._length % self._chunk)

    def write(self, count: int) -> None:
        """Write the first `count` of the values that wait in memory."""
        waiting = np.concatenate([np.empty(0, self._array.dtype), *self._waiting])
        self._array.append(waiting[:count])
        self._waiting = [waiting[count:].copy()]
        self._length = len(waiting) - count

    def finish(self) -> None:
        """Write all waiting values."""
        self.write(self._length)


def write_zarr(path: Path, scans: Iterable[Scan], *, every_point: bool) -> None:
    """Write a Zarr folder with an array for each column of the points.

    The columns are those of the first scan. If a later scan lacks a column, its values are nan, or
    0 for integers. The arrays in `SCAN_COLUMNS` have one element for each scan.
    """
    group = import_library("zarr", "zarr").open_group(str(path), mode="w")
    scan_columns = {
        name: _ZarrColumn(group, name, dtype, unit=unit, along="scans")
        for name, (dtype, unit) in SCAN_COLUMNS.items()
    }
    columns = {"scan": _ZarrColumn(group, "scan", np.int32)}
    for number, scan in enumerate(scans):
        cloud = select_points(scan, every_point=every_point)
        own = {**cloud.columns, "scan": np.full(len(cloud), number, np.int32)}
        if not number:
            units = units_of(cloud)
            group.attrs.update(scan.facts)
            columns |= {
                name: _ZarrColumn(group, name, own[name].dtype, unit=units.get(name, ""))
                for name in cloud.columns
            }
        for name, column in columns.items():
            column.add(own.get(name), len(cloud))
        for name, column in scan_columns.items():
            column.add(np.array([getattr(scan, name)]), 1)
    for column in (*columns.values(), *scan_columns.values()):
        column.finish()


NPZ = Format(".npz", "NumPy arrays, one per column", write, ("organized",))
NPY = Format(".npy", "a structured NumPy array with PCL's layout", write_npy, ("organized",))
ZARR = Format(".zarr", "Zarr, a folder with one array per column (zarr)", write_zarr)
