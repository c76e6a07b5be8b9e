"""Write text files with one row per point: .csv, .csv.gz and .xyz."""

from __future__ import annotations

import contextlib
import functools
import gzip
import io
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.formats.common import find_points, select_points, write_in_thread
from lidarspec.scans.scan import Scan
from lidarspec.transports.protocol import Format

#: The format of the numbers of each NumPy type. Seven digits are half a micrometre at 1 m.
_NUMBER_FORMATS = {"f2": "%.7g", "f4": "%.7g", "f8": "%.15g"}
#: The format of times in seconds, with nine decimals for nanoseconds.
_TIME_FORMAT = "%.9f"
#: The number of rows that are formatted together; this is a third faster than single rows.
BLOCK_ROWS = 1 << 10
#: The level of gzip. Level 1 compresses numbers to 34 % of their size; the default, level 6,
#: compresses them to 27 % in five times the time.
_GZIP_LEVEL = 1


@contextlib.contextmanager
def open_text_file(path: Path, *, is_zipped: bool = False) -> Iterator[Callable[[str], None]]:
    """Open a text file in UTF-8, and yield a function that writes to it in a thread."""
    with contextlib.ExitStack() as files:
        file: Any = files.enter_context(path.open("wb"))
        if is_zipped:
            # Without a name and a time, equal content gives equal files.
            file = files.enter_context(gzip.GzipFile("", "wb", _GZIP_LEVEL, file, mtime=0))
        text = files.enter_context(io.TextIOWrapper(file, encoding="utf-8", newline=""))
        yield files.enter_context(write_in_thread(text.write))


def write(path: Path, scans: Iterable[Scan], *, every_point: bool, is_zipped: bool = False) -> None:
    """Write a .csv file with the columns of the first scan, and a column `scan`."""
    names: tuple[str, ...] = ()
    with open_text_file(path, is_zipped=is_zipped) as put:
        for number, scan in enumerate(scans):
            cloud = select_points(scan, every_point=every_point)
            if not names:
                names = tuple(cloud.columns)
                put(",".join([*names, "scan"]) + "\n")
            own = cloud.columns
            columns = [_fill_column(own.get(name), len(cloud)) for name in names]
            cells = [
                _TIME_FORMAT if name == "time" else _NUMBER_FORMATS.get(column.dtype.str[1:], "%d")
                for name, column in zip(names, columns, strict=True)
            ]
            _put_rows(put, ",".join([*cells, f"{number}\n"]), columns)


def write_xyz(path: Path, scans: Iterable[Scan], *, every_point: bool) -> None:
    """Write x y z of each point in metres; missing points are nan."""
    with open_text_file(path) as put:
        for scan in scans:
            which = find_points(scan.points, every_point=every_point)
            columns = scan.points.read("x", "y", "z").values()
            _put_rows(
                put,
                "%.7g %.7g %.7g\n",
                [column if which is None else column[which] for column in columns],
            )


def write_columns(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write columns of integers or float64, of equal length, with a header row."""
    template = (
        ",".join("%d" if column.dtype.kind == "i" else "%.15g" for column in columns.values())
        + "\n"
    )
    with open_text_file(path) as put:
        put(",".join(columns) + "\n")
        _put_rows(put, template, [*columns.values()])


def _put_rows(put: Callable[[str], None], template: str, columns: Sequence[NDArray[Any]]) -> None:
    """Write the rows of columns.

    Args:
        put: a function that writes a text to the file.
        template: the %-format of a row.
    """
    for start in range(0, len(columns[0]), BLOCK_ROWS):
        rows = zip(
            *(column[start : start + BLOCK_ROWS].tolist() for column in columns), strict=True
        )
        values = tuple(itertools.chain.from_iterable(rows))
        put(template * (len(values) // len(columns)) % values)


def _fill_column(values: NDArray[Any] | None, length: int) -> NDArray[Any]:
    if values is None:
        return np.full(length, np.nan, np.float32)
    return values


CSV = Format(".csv", "comma-separated values, one row per point", write)
CSV_GZ = Format(
    ".csv.gz", "comma-separated values, compressed", functools.partial(write, is_zipped=True)
)
XYZ = Format(".xyz", "x y z as text, one row per point", write_xyz)
