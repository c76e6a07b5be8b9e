"""NumPy's .npz: one array a column, and one entry a scan for the stamps; written scan by scan, so memory stays small.

How long an array is stands before it, and is known at the end alone: until then each column grows in a file of its own, without a
name, in the same folder.
"""

from __future__ import annotations

import contextlib
import shutil
import tempfile
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from lidarspec.scans.scans import Scan
from lidarspec.transports.protocol import Format


class Column:
    """One column, as long as scans come."""

    def __init__(self, folder: Path, dtype: DTypeLike) -> None:
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115  closed by `close`
        self._dtype, self._length = np.dtype(dtype), 0

    def add(self, values: NDArray[Any]) -> None:
        """Append the values of a scan."""
        self._file.write(np.ascontiguousarray(values, self._dtype).view(np.uint8).data)
        self._length += len(values)

    def put(self, archive: zipfile.ZipFile, name: str) -> None:
        """Put all of it into an archive, as NumPy reads it."""
        self._file.seek(0)
        with archive.open(f"{name}.npy", "w", force_zip64=True) as target:
            shape = {"descr": self._dtype.str, "fortran_order": False, "shape": (self._length,)}
            np.lib.format.write_array_header_1_0(target, shape)
            shutil.copyfileobj(self._file, target)

    def close(self) -> None:
        """Give its file back."""
        self._file.close()


def write(path: Path, scans: Iterable[Scan], *, every_point: bool) -> None:
    """Write the columns that all scans have, `scan` for each point, and for each scan `stamp_ns`, `rate_hz` and `complete`.

    The unit of a sensor's further column stands in NAME.unit.
    """
    with contextlib.ExitStack() as files:

        def column(dtype: DTypeLike) -> Column:
            return files.enter_context(contextlib.closing(Column(path.parent, dtype)))

        facts = {"stamp_ns": column(np.int64), "rate_hz": column(np.float64), "complete": column(np.bool_)}
        numbers, columns, units = column(np.int32), dict[str, Column](), dict[str, str]()
        for number, scan in enumerate(scans):
            cloud = scan.points if every_point else scan.points[scan.points.valid]
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
                kept.put(archive, name)


NPZ = Format(".npz", "NumPy arrays, one a column", write)
