"""Functions shared by file formats.

The functions select the points of scans, store columns in temporary files, and replace a file when
the new file is complete.
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
from lidarspec.unfinished_files import path_while_written, remove_abandoned_files

#: For the suffix of each format that writes a folder, a pattern of the files in the folder. A
#: folder that contains any other file is not replaced.
FOLDER_FILES = {
    ".zarr": re.compile(r"(.+/)?(zarr\.json|\.z(group|attrs|array|metadata)|(c/)?\d+([./]\d+)*)"),
    ".rosbag2": re.compile(r"metadata\.yaml|[^/]+\.(mcap|db3(-wal|-shm)?)"),
}
#: The GPS epoch, 1980-01-06, in ns since 1970, minus the 18 leap seconds that apply since 2017.
#: Unix time minus this value is GPS time.
GPS_EPOCH_NS = (315_964_800 - 18) * 10**9
_Piece = TypeVar("_Piece")


@contextlib.contextmanager
def replace_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path to write to, and rename it to `path` when the block ends.

    If the block raises, the new file is removed.

    Raises:
        SourceError: if the file cannot be written.
        UsageError: if the path is a folder with files that do not belong to its format.
    """
    refuse_foreign_files(path)
    remove_abandoned_files(path)
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
    """Raise UsageError if a folder contains files that do not belong to its format."""
    if not folder.is_dir():
        return
    pattern = FOLDER_FILES.get(folder.suffix.lower())
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink() or (path.is_file() and not (pattern and pattern.fullmatch(name))):
            error = UsageError(
                f"{folder} contains other files, such as {name}, which would be deleted"
            )
            raise suggest(error, "choose another output, or move these files away")


@contextlib.contextmanager
def write_in_thread(write: Callable[[_Piece], object]) -> Iterator[Callable[[_Piece], None]]:
    """Yield a function that writes a piece in a thread.

    When the block ends, all pieces have been written. An error in the thread is raised by the next
    call, or at the end of the block.
    """
    with ThreadPoolExecutor(1) as thread:
        last: Future[object] = thread.submit(lambda: None)

        def write_next(piece: _Piece) -> None:
            nonlocal last
            last.result()
            last = thread.submit(write, piece)

        yield write_next
        last.result()


def select_points(scan: Scan, *, every_point: bool) -> PointCloud:
    """Return all points of a scan, or only the valid points."""
    which = find_points(scan.points, every_point=every_point)
    if which is None:
        return scan.points
    return scan.points[which]


def find_points(cloud: PointCloud, *, every_point: bool) -> NDArray[np.intp] | None:
    """Return the indices of the points to write; None for all points."""
    if every_point or cloud.valid.all():
        return None
    # Indexing a column by integers is several times as fast as indexing it by a mask.
    return np.flatnonzero(cloud.valid)


def select_columns(
    scan: Scan, names: Iterable[str], *, every_point: bool
) -> dict[str, NDArray[Any]]:
    """Return the columns of the points to write, by name.

    Requested columns that the scan does not have are omitted.
    """
    cloud = scan.points
    existing = tuple(name for name in names if name == "valid" or cloud.is_selected(name))
    cloud.load(*existing, "valid")
    columns = {
        name: getattr(cloud, name) if name in (*COLUMNS, "valid") else cloud.extra.get(name)
        for name in existing
    }
    which = find_points(cloud, every_point=every_point)
    return {
        name: column if which is None else column[which]
        for name, column in columns.items()
        if column is not None
    }


def to_image(values: NDArray[Any], cloud: PointCloud) -> NDArray[Any]:
    """Return values of organized points, (n,), as an image with a row for each ring."""
    columns, rows = cloud.shape or (len(cloud), 1)
    returns = len(cloud) // max(columns * rows, 1) or 1
    height = rows
    if cloud.ring is not None and columns:
        rings = cloud.ring[: rows * returns : returns]
        ring_count = len(np.unique(rings))
        is_periodic = rows % ring_count == 0
        if is_periodic and (rings.reshape(-1, ring_count) == rings[:ring_count]).all():
            height = ring_count  # a column of a packet may contain several firings
    return values.reshape(-1, height, returns).swapaxes(0, 1).reshape(height, -1)


class ColumnSpool:
    """Stores the values of one column in an unnamed temporary file in a folder."""

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
