"""Functions shared by file formats.

They select the points of scans, spool columns beside the file, and replace a file when the new one
is complete.

A format is a function that writes scans to a path, one by one, so that memory stays small. Many
formats begin with their size, which is only known at the end: they go back and write it, or spool
their columns in unnamed files.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from lidarspec.errors import SourceError, UsageError, suggest, system_errors
from lidarspec.points.cloud import COLUMNS, PointCloud
from lidarspec.remote_files import remove
from lidarspec.scans.scan import Scan
from lidarspec.unfinished_files import path_while_written, remove_abandoned

# Files of a folder format, by suffix: an existing folder with any other file is not replaced.
FOLDER_FILES = {
    ".zarr": re.compile(r"(.+/)?(zarr\.json|\.z(group|attrs|array|metadata)|(c/)?\d+([./]\d+)*)"),
    ".rosbag2": re.compile(r"metadata\.yaml|[^/]+\.(mcap|db3(-wal|-shm)?)"),
}
#: ns since 1970 of the GPS epoch, 1980-01-06, for a clock without leap seconds, minus the 18 leap
#: seconds that apply since 2017.
GPS_EPOCH = (315_964_800 - 18) * 10**9
_Piece = TypeVar("_Piece")


@contextlib.contextmanager
def replace_file(path: Path) -> Iterator[Path]:
    """Yield a path to write to; it replaces a file or folder when the block ends.

    If the block fails, the new file is removed.

    Raises:
        SourceError: if it cannot be written.
        UsageError: if the path is a folder with files of other kinds.
    """
    refuse_foreign_files(path)
    remove_abandoned(path)
    part = path_while_written(path)
    try:
        with contextlib.suppress(SourceError):
            remove(part)
        with system_errors(path):
            path.parent.stat()  # a missing folder is reported before anything is made
            yield part
            if path.is_dir() and part.is_dir():
                refuse_foreign_files(path)
                remove(path)
            os.replace(part, path)
    finally:
        with contextlib.suppress(SourceError):
            remove(part)


def refuse_foreign_files(folder: Path) -> None:
    """Raise if replacing a folder would delete files that its format does not write.

    Raises:
        UsageError: with the first such file.
    """
    if not folder.is_dir():
        return
    pattern = FOLDER_FILES.get(folder.suffix.lower())
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink() or (path.is_file() and not (pattern and pattern.fullmatch(name))):
            error = UsageError(
                f"{folder} holds other files, such as {name}, which would be deleted"
            )
            raise suggest(error, "choose another output, or move these files away")


@contextlib.contextmanager
def write_in_thread(write: Callable[[_Piece], object]) -> Iterator[Callable[[_Piece], None]]:
    """Yield a function that writes pieces in a thread, while the next piece is made.

    At the end everything is written. An error is raised with the next piece, or at the end.
    """
    with ThreadPoolExecutor(1) as thread:
        last: Future[object] = thread.submit(lambda: None)

        def hand_over(piece: _Piece) -> None:
            nonlocal last
            last.result()
            last = thread.submit(write, piece)

        yield hand_over
        last.result()


def select_points(scan: Scan, *, every_point: bool) -> PointCloud:
    """Return the points of a scan to write: those with a valid return, or all."""
    which = find_points(scan.points, every_point=every_point)
    if which is None:
        return scan.points
    return scan.points[which]


def find_points(cloud: PointCloud, *, every_point: bool) -> NDArray[np.intp] | None:
    """Return the indices of the points to write, None for all.

    Indexing columns by numbers is several times as fast as by a mask.
    """
    if every_point or cloud.valid.all():
        return None
    return np.flatnonzero(cloud.valid)


def select_columns(
    scan: Scan, names: Iterable[str], *, every_point: bool
) -> dict[str, NDArray[Any]]:
    """Return the requested columns that a scan has, for the points to write.

    "valid" and additional columns may be requested too.
    """
    cloud = scan.points
    named = tuple(name for name in names if name == "valid" or cloud.has_column(name))
    cloud.load(*named, "valid")
    columns = {
        name: getattr(cloud, name) if name in (*COLUMNS, "valid") else cloud.extra.get(name)
        for name in named
    }
    which = find_points(cloud, every_point=every_point)
    return {
        name: column if which is None else column[which]
        for name, column in columns.items()
        if column is not None
    }


def to_image(values: NDArray[Any], cloud: PointCloud) -> NDArray[Any]:
    """Return values of organized points, (n,), as (rows, columns).

    There is a row for each ring; several returns are side by side.
    """
    columns, rows = cloud.shape or (len(cloud), 1)
    returns = len(cloud) // max(columns * rows, 1) or 1
    height = rows
    if cloud.ring is not None and columns:
        rings = cloud.ring[: rows * returns : returns]
        once = len(np.unique(rings))
        if rows % once == 0 and (rings.reshape(-1, once) == rings[:once]).all():
            height = once  # a packet's column may hold several firings
    return values.reshape(-1, height, returns).swapaxes(0, 1).reshape(height, -1)


class ColumnSpool:
    """The values of one column in an unnamed file in the folder of the target."""

    def __init__(self, folder: Path, dtype: DTypeLike) -> None:
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115  closed by `close`
        self.dtype = np.dtype(dtype)
        self.length = 0

    def add(self, values: NDArray[Any]) -> None:
        """Append the values of a scan."""
        self._file.write(np.ascontiguousarray(values, self.dtype).view(np.uint8).data)
        self.length += len(values)

    def copy_to(self, target: IO[bytes]) -> None:
        """Copy all values to a file."""
        self._file.seek(0)
        shutil.copyfileobj(self._file, target)

    def close(self) -> None:
        """Close and remove the file."""
        self._file.close()
