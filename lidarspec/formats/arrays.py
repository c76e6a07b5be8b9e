"""NumPy's .npz: one array a column, and one entry a scan for the stamps; and .npy: one structured array. Memory stays small.

How long an array is stands before it, and is known at the end alone: until then each column of an .npz grows in a file of its own,
without a name, in the same folder.
"""

from __future__ import annotations

import contextlib
import io
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from lidarspec.formats.rows import NAMES, Rows, write_rows
from lidarspec.formats.writing import Spool, written
from lidarspec.points.cloud import structured_type
from lidarspec.scans.scans import Scan
from lidarspec.transports.protocol import Format


def put(archive: zipfile.ZipFile, name: str, column: Spool) -> None:
    """Put a column into an archive, as NumPy reads it."""
    with archive.open(f"{name}.npy", "w", force_zip64=True) as target:
        shape = {"descr": column.dtype.str, "fortran_order": False, "shape": (column.length,)}
        np.lib.format.write_array_header_1_0(target, shape)
        column.copy_to(target)


def write(path: Path, scans: Iterable[Scan], *, every_point: bool) -> None:
    """Write the columns that all scans have, `scan` for each point, and for each scan `stamp_ns`, `rate_hz` and `complete`.

    The unit of a sensor's further column stands in NAME.unit.
    """
    with contextlib.ExitStack() as files:

        def column(dtype: DTypeLike) -> Spool:
            return files.enter_context(contextlib.closing(Spool(path.parent, dtype)))

        facts = {"stamp_ns": column(np.int64), "rate_hz": column(np.float64), "complete": column(np.bool_)}
        numbers, columns, units = column(np.int32), dict[str, Spool](), dict[str, str]()
        for number, scan in enumerate(scans):
            cloud = written(scan, every_point=every_point)
            own = cloud.columns
            columns = columns if number else {name: column(values.dtype) for name, values in own.items()}
            units = units if number else {name: unit for name, unit in cloud.units.items() if unit}
            columns = {name: kept for name, kept in columns.items() if name in own}
            for name, kept in columns.items():
                kept.add(own[name])
            numbers.add(np.full(len(cloud), number))
            for name, kept in facts.items():
                kept.add(np.array([getattr(scan, name)]))
        told = {f"{name}.unit": column(f"<U{len(unit)}") for name, unit in units.items()}
        for unit, kept in zip(units.values(), told.values(), strict=True):
            kept.add(np.array([unit]))
        with zipfile.ZipFile(path, "w") as archive:
            for name, kept in {**columns, "scan": numbers, **facts, **told}.items():
                put(archive, name, kept)


def write_npy(path: Path, scans: Iterable[Scan], *, every_point: bool) -> None:
    """Write one structured array with PCL's layout, as `PointCloud.to_structured` makes it: what the sensor lacks is 0.

    Where there are several scans, their number is a further column, `scan`. Such a file can be mapped: ``np.load(path, mmap_mode="r")``.
    """
    write_rows(path, Rows(scans, _structured, every_point=every_point), _npy_header)


def _structured(types: Mapping[str, Any]) -> np.dtype[Any]:
    return structured_type({name: np.dtype(dtype) for name, dtype in types.items() if name not in NAMES})


def _npy_header(rows: Rows) -> bytes:
    """As long for any number of rows, since NumPy leaves room for it."""
    header = io.BytesIO()
    shape = {"descr": np.lib.format.dtype_to_descr(rows.dtype), "fortran_order": False, "shape": (rows.length,)}
    np.lib.format.write_array_header_1_0(header, shape)
    return header.getvalue()


NPZ = Format(".npz", "NumPy arrays, one a column", write)
NPY = Format(".npy", "a structured NumPy array with PCL's layout", write_npy)
