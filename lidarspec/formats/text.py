"""Comma-separated values: a header row, then one row a point; written scan by scan, so memory stays small."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.formats.writing import written
from lidarspec.scans.scans import Scan
from lidarspec.transports.protocol import Format

#: how a number of each type is written: seven figures are half a micrometre at a metre; times keep their nanoseconds.
_WRITTEN = {"f2": "%.7g", "f4": "%.7g", "f8": "%.15g"}
_TIME = "%.9f"
#: rows turned into text at once.
ROWS = 1 << 14


def write(path: Path, scans: Iterable[Scan], *, every_point: bool) -> None:
    """Write the columns that the first scan has, and the number of the scan."""
    names: tuple[str, ...] = ()
    with path.open("w", encoding="ascii", newline="") as file:
        for number, scan in enumerate(scans):
            cloud = written(scan, every_point=every_point)
            if not names:
                names = tuple(cloud.columns)
                file.write(",".join([*names, "scan"]) + "\n")
            own = cloud.columns
            columns = [_column(own.get(name), len(cloud)) for name in names]
            cells = [
                _TIME if name == "time" else _WRITTEN.get(column.dtype.str[1:], "%d") for name, column in zip(names, columns, strict=True)
            ]
            template = ",".join([*cells, f"{number}\n"])
            for start in range(0, len(cloud), ROWS):
                file.write("".join(map(template.__mod__, zip(*(c[start : start + ROWS].tolist() for c in columns), strict=True))))


def write_columns(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write columns of one length, whole numbers and float64, with their names above."""
    template = ",".join("%d" if column.dtype.kind == "i" else "%.15g" for column in columns.values()) + "\n"
    with path.open("w", encoding="ascii", newline="") as file:
        file.write(",".join(columns) + "\n")
        file.writelines(template % row for row in zip(*(column.tolist() for column in columns.values()), strict=True))


def _column(values: NDArray[Any] | None, length: int) -> NDArray[Any]:
    return np.full(length, np.nan, np.float32) if values is None else values


CSV = Format(".csv", "comma-separated values, one row a point", write)
