"""Convert points to rows of bytes, for PCD, PLY, KITTI's .bin and .npy."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.formats.common import select_columns, to_image, write_in_thread
from lidarspec.points.cloud import PointCloud
from lidarspec.points.table_types import STRUCTURED
from lidarspec.scans.scan import Scan
from lidarspec.scans.stream import pop_scans

#: The first columns of a row; additional columns follow.
COLUMN_NAMES = STRUCTURED.names or ()
#: The number of characters that are reserved for a number in a header.
RESERVED_DIGITS = 20
#: The number of bytes per write. This fits into the processor's cache, so copying is three times as
#: fast.
WRITE_BYTES = 1 << 20


class PointRows:
    """Yields the points of each scan as rows of a structured array, (n,).

    Args:
        layout: a function that returns the type of a row, given the types of the first scan's
            columns by name.
        every_point: whether to include points without a valid return.
        is_image: whether to order the points of a single organized scan row by row; requires
            `every_point`.

    Attributes:
        dtype: the type of a row.
        length: number of rows so far.
        shape: (width, height) of the image if the points are ordered row by row, else None.
        facts: lines for a header: the sensor, the stamp of the first scan, and the units.
    """

    def __init__(
        self,
        scans: Iterable[Scan],
        layout: Callable[[Mapping[str, Any]], np.dtype[Any]],
        *,
        every_point: bool,
        is_image: bool = False,
    ) -> None:
        scans = iter(scans)
        first = list(itertools.islice(scans, 2))
        self._every_point = every_point
        self.length = 0
        self.facts = list[str]()
        self.shape: tuple[int, int] | None = None
        types: dict[str, Any] = dict.fromkeys("xyz", np.float32)
        if first:
            cloud = first[0].points
            columns = self._select_columns(
                first[0], 0, (*COLUMN_NAMES, *cloud.extra, *(["scan"] if len(first) > 1 else []))
            )
            types |= {
                name: STRUCTURED[name] if name in COLUMN_NAMES else column.dtype
                for name, column in columns.items()
            }
            if is_image and every_point and len(first) == 1 and cloud.shape:
                height, width = to_image(np.empty(len(cloud), np.bool_), cloud).shape
                self.shape = width, height
            units = [f"unit {name} {unit}" for name, unit in cloud.units.items() if unit]
            self.facts = [f"sensor {first[0].sensor.id}", f"stamp_ns {cloud.stamp_ns}", *units]
        self.dtype = layout(types)
        self._scans = itertools.chain(pop_scans(first), scans)

    def __iter__(self) -> Iterator[NDArray[Any]]:
        return itertools.starmap(self.fill, self.iter_parts())

    def iter_parts(self) -> Iterator[tuple[Mapping[str, NDArray[Any]], PointCloud]]:
        """Yield the selected columns and the whole point cloud of each scan, for `fill`."""
        for number, scan in enumerate(self._scans):
            yield self._select_columns(scan, number, self.dtype.names or ()), scan.points

    def fill(self, columns: Mapping[str, NDArray[Any]], points: PointCloud) -> NDArray[Any]:
        """Return the rows of a scan, and add their number to `length`."""
        rows = np.zeros(len(columns["x"]), self.dtype)
        for name, column in columns.items():
            rows[name] = column
        self.length += len(rows)
        if self.shape:
            return to_image(rows, points).reshape(-1)
        return rows

    def _select_columns(
        self, scan: Scan, number: int, names: Sequence[str]
    ) -> dict[str, NDArray[Any]]:
        """Return the requested columns of the points to write, if the scan has them."""
        columns = select_columns(scan, names, every_point=self._every_point)
        if "scan" in names:
            columns["scan"] = np.full(len(columns["x"]), number, np.int32)
        return columns


def write_rows(path: Path, rows: PointRows, header: Callable[[PointRows], bytes]) -> None:
    """Write a header and rows.

    Args:
        header: a function that returns the header. It is called before and after the rows are
            written. The second header overwrites the first, so both must have the same length.
    """
    with path.open("wb") as file:
        file.write(header(rows))

        def append(part: tuple[Mapping[str, NDArray[Any]], PointCloud]) -> None:
            data = rows.fill(*part).view(np.uint8).data
            for start in range(0, len(data), WRITE_BYTES):
                file.write(data[start : start + WRITE_BYTES])

        with write_in_thread(append) as write:
            for part in rows.iter_parts():
                write(part)
        file.seek(0)
        file.write(header(rows))


def make_padding(*numbers: int) -> str:
    """Return the spaces that a header needs so that its length is always the same.

    Args:
        numbers: the numbers in the header whose digits vary.
    """
    return " " * sum(RESERVED_DIGITS - len(str(number)) for number in numbers)
