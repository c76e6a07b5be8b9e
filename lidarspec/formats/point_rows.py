"""Convert points to rows of bytes, for PCD, PLY, KITTI's .bin and .npy.

The rows of all scans follow one another, after a header with their number.
"""

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
from lidarspec.scans.stream import iter_released

#: the first columns of a row; additional columns follow.
NAMES = STRUCTURED.names or ()
#: digits reserved for the number of rows in a header.
FIGURES = 20
#: bytes per write; pieces that fit into the processor's cache are copied three times as fast.
PIECE = 1 << 20


class PointRows:
    """The points of scans as structured rows of one type, (n,) per scan.

    Args:
        layout: returns the type of a row for the types of the columns of the first scan: x y z
            intensity ring time, additional ones, and `scan`, the number of the scan, if there are
            several. Other columns are left out. If a later scan lacks a column, its values are 0.
        every_point: also points without a valid return.
        is_picture: order the points row by row if every point of a single organized scan is
            written.

    Attributes:
        dtype: of a row.
        length: the number of rows so far.
        shape: (width, height) of an organized scan, else None; several returns are side by side.
        facts: lines for a header: the sensor, the stamp of the first scan, and the units.
    """

    def __init__(
        self,
        scans: Iterable[Scan],
        layout: Callable[[Mapping[str, Any]], np.dtype[Any]],
        *,
        every_point: bool,
        is_picture: bool = False,
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
            columns = self._columns(
                first[0], 0, (*NAMES, *cloud.extra, *(["scan"] if len(first) > 1 else []))
            )
            types |= {
                name: STRUCTURED[name] if name in NAMES else column.dtype
                for name, column in columns.items()
            }
            if is_picture and every_point and len(first) == 1 and cloud.shape:
                height, width = to_image(np.empty(len(cloud), np.bool_), cloud).shape
                self.shape = width, height
            units = [f"unit {name} {unit}" for name, unit in cloud.units.items() if unit]
            self.facts = [f"sensor {first[0].sensor.id}", f"stamp_ns {cloud.stamp_ns}", *units]
        self.dtype = layout(types)
        self._scans = itertools.chain(iter_released(first), scans)

    def __iter__(self) -> Iterator[NDArray[Any]]:
        return itertools.starmap(self.fill, self.parts())

    def parts(self) -> Iterator[tuple[Mapping[str, NDArray[Any]], PointCloud]]:
        """Yield the columns and points of each scan, for `fill`."""
        for number, scan in enumerate(self._scans):
            yield self._columns(scan, number, self.dtype.names or ()), scan.points

    def fill(self, columns: Mapping[str, NDArray[Any]], points: PointCloud) -> NDArray[Any]:
        """Return the rows of a scan, and count them."""
        rows = np.zeros(len(columns["x"]), self.dtype)
        for name, column in columns.items():
            rows[name] = column
        self.length += len(rows)
        if self.shape:
            return to_image(rows, points).reshape(-1)
        return rows

    def _columns(self, scan: Scan, number: int, names: Sequence[str]) -> dict[str, NDArray[Any]]:
        """Return the requested columns that the scan has, of the points to write.

        The column "scan" has the number of the scan.
        """
        columns = select_columns(scan, names, every_point=self._every_point)
        return columns | (
            {"scan": np.full(len(columns["x"]), number, np.int32)} if "scan" in names else {}
        )


def write_rows(path: Path, rows: PointRows, header: Callable[[PointRows], bytes]) -> None:
    """Write rows after a header.

    The header is written again at the end with the number of rows, so its length must not depend on
    it.
    """
    with path.open("wb") as file:
        file.write(header(rows))

        def append(part: tuple[Mapping[str, NDArray[Any]], PointCloud]) -> None:
            data = rows.fill(*part).view(np.uint8).data
            for start in range(0, len(data), PIECE):
                file.write(data[start : start + PIECE])

        with write_in_thread(append) as write:
            for part in rows.parts():
                write(part)
        file.seek(0)
        file.write(header(rows))


def pad_header(*numbers: int) -> str:
    """Return spaces that make the length of a header independent of these numbers."""
    return " " * sum(FIGURES - len(str(number)) for number in numbers)
