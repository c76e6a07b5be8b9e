"""Points as rows of bytes, as PCD, PLY, KITTI's .bin and .npy hold them: scan by scan, behind a
header that says how many they are.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.formats.writing import behind, columns_of, picture
from lidarspec.points.cloud import PointCloud
from lidarspec.points.table_types import STRUCTURED
from lidarspec.scans.scan import Scan
from lidarspec.scans.stream import handed_out

#: columns that rows begin with; a sensor's further ones follow.
NAMES = STRUCTURED.names or ()
#: figures that there is room for where a header says how many rows follow.
FIGURES = 20
#: bytes written at once: what a processor's cache holds is copied three times as fast.
PIECE = 1 << 20


class PointRows:
    """The points of scans as structured rows of one type, (n,) a scan.

    Args:
        layout: makes the type of a row from those of the columns that the first scan has: x y z
            intensity ring time, its further ones, and `scan`, the number of the scan, where there
            are several. Columns of other names are left out; of a scan that has not all of them,
            what is missing is 0.
        every_point: also the points without a valid return.
        is_picture: where every point of a single organised scan is written, put them row by row.

    Attributes:
        dtype: of a row.
        length: how many rows there were so far.
        shape: (width, height) of such a picture, else None; several returns of a place stand side
            by side.
        facts: what a header may say of the sensor, the stamp of the first scan and the units, a
            line each.
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
                height, width = picture(np.empty(len(cloud), np.bool_), cloud).shape
                self.shape = width, height
            units = [f"unit {name} {unit}" for name, unit in cloud.units.items() if unit]
            self.facts = [f"sensor {first[0].sensor.id}", f"stamp_ns {cloud.stamp_ns}", *units]
        self.dtype = layout(types)
        self._scans = itertools.chain(handed_out(first), scans)

    def __iter__(self) -> Iterator[NDArray[Any]]:
        return itertools.starmap(self.filled, self.parts())

    def parts(self) -> Iterator[tuple[Mapping[str, NDArray[Any]], PointCloud]]:
        """The columns of each scan, and its points, of which `filled` makes rows."""
        for number, scan in enumerate(self._scans):
            yield self._columns(scan, number, self.dtype.names or ()), scan.points

    def filled(self, columns: Mapping[str, NDArray[Any]], points: PointCloud) -> NDArray[Any]:
        """The rows of a scan, which are counted."""
        rows = np.zeros(len(columns["x"]), self.dtype)
        for name, column in columns.items():
            rows[name] = column
        self.length += len(rows)
        if self.shape:
            return picture(rows, points).reshape(-1)
        return rows

    def _columns(self, scan: Scan, number: int, names: Sequence[str]) -> dict[str, NDArray[Any]]:
        """Return the requested columns that the scan has, of the points to write.

        The column "scan" has the number of the scan.
        """
        columns = columns_of(scan, names, every_point=self._every_point)
        return columns | (
            {"scan": np.full(len(columns["x"]), number, np.int32)} if "scan" in names else {}
        )


def write_rows(path: Path, rows: PointRows, header: Callable[[PointRows], bytes]) -> None:
    """Write rows behind a header, which is made again when they are counted: its length must not
    depend on their number.
    """
    with path.open("wb") as file:
        file.write(header(rows))

        def append(part: tuple[Mapping[str, NDArray[Any]], PointCloud]) -> None:
            data = rows.filled(*part).view(np.uint8).data
            for start in range(0, len(data), PIECE):
                file.write(data[start : start + PIECE])

        with behind(append) as write:
            for part in rows.parts():
                write(part)
        file.seek(0)
        file.write(header(rows))


def room(*numbers: int) -> str:
    """The spaces that make a header as long with these numbers as with any others."""
    return " " * sum(FIGURES - len(str(number)) for number in numbers)
