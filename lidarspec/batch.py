"""Convert many files, large files in pieces, in several processes or on a cluster.

`convert` writes files of points and a manifest. `read` returns a Dask dataframe with a partition
for each piece of a file.

The manifest is the file `manifest.jsonl` in the folder of the results. For each piece, it has a
line of JSON with the input, the sensor, the versions, and the output or the error. A file is not
converted again if all its lines and results exist.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import json
import multiprocessing
import os
import platform
import queue
import re
import signal
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from lidarspec._version import __version__
from lidarspec.detect.identification import detect
from lidarspec.device.file_scans import FileScans
from lidarspec.errors import (
    LidarSpecError,
    SourceError,
    UsageError,
    WireError,
    suggest,
    system_errors,
)
from lidarspec.formats import format_of, write
from lidarspec.formats.arrow_tables import iter_tables
from lidarspec.optional_libraries import import_library
from lidarspec.plugins import sensor as named_sensor
from lidarspec.remote_files import (
    files_in,
    find_files,
    hash_ends,
    is_remote,
    normalise_path,
    open_stored,
    read_stamp,
    remove,
    upload,
)
from lidarspec.scans.scan import Scan
from lidarspec.scans.selection import EVERYTHING, ScanSelector, Selection
from lidarspec.sensor_operations import Sensor

#: The size of a piece of a capture in bytes, if its points are written to a file.
PIECE_BYTES = 256_000_000
#: The size of a piece of a capture in bytes, if its points are a partition in memory.
PARTITION_BYTES = 32_000_000
MANIFEST = "manifest.jsonl"
#: The maximum number of tasks that an executor has at a time.
MAX_RUNNING_TASKS = 1000
#: The time between two uploads of a manifest to an object store, in which a file cannot be
#: extended.
MANIFEST_PERIOD_S = 2.0
VERSIONS = {"lidarspec": __version__, "numpy": np.__version__, "python": platform.python_version()}

Record = dict[str, Any]


@dataclass(frozen=True)
class FilePiece:
    """A piece of a file: some of its scans, and the output to which they are written.

    Attributes:
        source: the path or URL of the file.
        sensor: the sensor's id; "" to detect the sensor.
        target: the path of the output, to which `output` adds the number of the piece; "" if the
            points are not written to a file.
        every_point: whether to include points without a valid return.
        number: the number of the piece in the file, from 0.
        first: the number of the piece's first scan in the file, from 0.
        count: the number of scans in the piece; None for all scans up to the end of the file.
        bookmark: the start of the piece; None for the start of the file.
    """

    source: str
    sensor: str
    options: Mapping[str, Any]
    target: str
    every_point: bool
    size: int
    select: Selection = EVERYTHING
    number: int = 0
    first: int = 0
    count: int | None = None
    bookmark: bytes | None = field(default=None, repr=False)
    is_last: bool = True

    @property
    def output(self) -> str:
        """The file that the piece is written to."""
        if not self.number and self.is_last:
            return self.target
        suffix = format_of(self.target).suffix
        return f"{self.target.removesuffix(suffix)}-{self.number:05d}{suffix}"

    @property
    def settings(self) -> Record:
        """The settings that affect the result, without the file and the piece number."""
        options = {name: str(value) for name, value in self.options.items()}
        select = {
            name: str(value)
            for name, value in vars(self.select).items()
            if value != getattr(Selection, name)
        }
        how = {
            "options": options,
            "select": select,
            "every_point": self.every_point,
            "piece_size": self.size,
        }
        return {"asked": self.sensor, **how, "target": self.target}

    def open_scans(self) -> FileScans:
        """Open the file, and return a reader of its scans from the start of the piece."""
        if self.sensor:
            named = _configure_sensor(self.sensor, tuple(self.options.items()))
        else:
            named = detect(self.source)
        return FileScans(self.source, named, self.bookmark)

    def make_record(self, **more: Any) -> Record:
        """Return the record of the piece for the manifest."""
        return {
            "source": self.source,
            "piece": self.number,
            "last": self.is_last,
            **self.settings,
            "versions": VERSIONS,
            **more,
        }

    def describe_failure(self, error: Exception) -> Record:
        """Return the record of the piece after an error."""
        reason = str(error)
        if not isinstance(error, LidarSpecError):
            reason = f"{type(error).__name__}: {error}"
        return self.make_record(error=reason)

    def iter_numbered(self, scans: FileScans) -> Iterator[Scan]:
        """Yield the selected scans of the piece.

        `Scan.number` of each scan is its number in the whole file, from 0.

        Args:
            scans: the reader that `open_scans` has returned.
        """
        sieve = ScanSelector(self.select, self.source)
        for number, scan in enumerate(itertools.islice(scans, self.count), self.first):
            if (wanted := sieve.select(scan)) is not None:
                yield replace(wanted, number=number)
            if sieve.ended:
                break
        scans.add_warnings(sieve.warnings)
        if sieve.is_empty:
            raise sieve.make_no_scan_error()


@functools.lru_cache(maxsize=64)
def _configure_sensor(name: str, options: tuple[tuple[str, Any], ...]) -> Sensor:
    """Return a configured sensor; the same object each time, so that it is compiled only once."""
    named = named_sensor(name)
    configured: Sensor = named.configure(**dict(options)) if options else named
    return configured


def find_piece_end(piece: FilePiece) -> list[FilePiece]:
    """Read a file from the start of a piece, to find where the piece ends.

    Returns:
        The piece with the number of its scans; and the next piece, if the file continues.
    """
    with piece.open_scans() as scans:
        count, bookmark = scans.survey(piece.size)
    if bookmark is None:
        return [replace(piece, count=count, is_last=True)]
    following = replace(
        piece, number=piece.number + 1, first=piece.first + count, bookmark=bookmark
    )
    return [replace(piece, count=count, is_last=False), following]


def convert_piece(piece: FilePiece) -> Record:
    """Write the points of a piece, and return its record for the manifest."""
    counts: Record = {"first_scan": piece.first, "scans": 0, "points": 0}
    try:
        about = {**read_stamp(piece.source), "digest": hash_ends(piece.source)}
        with piece.open_scans() as scans:
            counted = _count_scans(piece, piece.iter_numbered(scans), counts)
            first = next(counted, None)
            if first is None and piece.is_last and not piece.first:
                raise WireError(f"no scan found: {scans.stats}")
            if first is not None:
                _write(piece, itertools.chain([first], counted))
            return piece.make_record(
                **about,
                **counts,
                output=piece.output if first is not None else None,
                warnings=scans.warnings,
                unread=scans.stats.unread,
            )
    except Exception as error:  # any error, because the other pieces must be converted
        return piece.describe_failure(error)


def _count_scans(piece: FilePiece, scans: Iterator[Scan], counts: Record) -> Iterator[Scan]:
    for scan in scans:
        counts["scans"] += 1
        counts["points"] += len(scan) if piece.every_point else int(scan.points.valid.sum())
        yield scan


def _write(piece: FilePiece, scans: Iterable[Scan]) -> None:
    """Write scans to the output of the piece."""
    if not is_remote(piece.output):
        with system_errors(piece.output):
            Path(piece.output).parent.mkdir(parents=True, exist_ok=True)
        write(piece.output, scans, every_point=piece.every_point)
        return
    with tempfile.TemporaryDirectory() as folder:
        local = Path(folder) / piece.output.rpartition("/")[2]
        write(local, scans, every_point=piece.every_point)
        upload(local, piece.output)


def make_pieces(
    sources: Sequence[str],
    sensor: str | Sensor | None,
    *,
    folder: str = "",
    to: str = "",
    every_point: bool,
    size: int,
    select: Selection,
) -> list[FilePiece]:
    """Return a piece for each file that matches the paths, patterns and URLs.

    Raises:
        SourceError: if no file matches.
        UsageError: if two output files would have the same name.
    """
    if isinstance(sensor, Sensor):
        name = sensor.id
        options = dict(sensor.options)
    else:
        name = sensor or ""
        options = {}
    by_output: dict[str, FilePiece] = {}
    for source, below in (pair for pattern in sources for pair in find_files(str(pattern))):
        if to:
            target = f"{folder.rstrip('/')}/{below.rpartition('.')[0] or below}.{to}"
        else:
            target = source
        if target in by_output and by_output[target].source != source:
            raise UsageError(
                f"{by_output[target].source} and {source} would both be written to {target}:"
                " convert them into two folders"
            )
        by_output[target] = FilePiece(
            source, name, options, target if to else "", every_point, size, select
        )
    return list(by_output.values())


#: The keys of each record of a manifest, with their types.
_RECORD_KEYS: Mapping[str, Any] = {"source": str, "target": str, "piece": int}
#: Further keys of the record of a piece without an error.
_WRITTEN_KEYS: Mapping[str, Any] = {
    "last": bool,
    "size": int,
    "modified": str,
    "digest": str,
    "output": str | None,
}


def _is_record(value: Any) -> bool:
    """Return whether a value from a manifest has the keys and types of a record."""
    if not isinstance(value, dict):
        return False
    keys = dict(_RECORD_KEYS)
    if "error" not in value:
        keys |= _WRITTEN_KEYS
    return all(name in value and isinstance(value[name], kind) for name, kind in keys.items())


class Manifest:
    """The records of the pieces in a folder, from this run and earlier runs.

    Raises:
        SourceError: if the folder cannot be written to.

    Attributes:
        is_new: whether the folder had no manifest before this run.
    """

    def __init__(self, folder: str) -> None:
        self.path = f"{folder.rstrip('/')}/{MANIFEST}"
        self._records: dict[tuple[str, str], dict[int, Record]] = {}
        self._due = 0.0
        self._is_stored = is_remote(folder)
        self._lines = [
            line
            for number, line in enumerate(self._read_lines(), 1)
            if self._store_line(line, number)
        ]
        self._outputs = files_in(folder)
        self.is_new = not self.existed_before(self.path)
        if not self._is_stored:
            with system_errors(self.path):
                Path(folder).mkdir(parents=True, exist_ok=True)
                self._file = open(self.path, "a", encoding="utf-8")  # noqa: SIM115  closed by `close`
                if self._file.tell():  # keep a truncated line separate from the next one
                    self._file.write("\n")

    def _read_lines(self) -> list[str]:
        """Return the lines of an existing manifest; an empty list without a manifest."""
        try:
            with contextlib.closing(open_stored(self.path)) as file:
                return file.read().decode(errors="replace").splitlines()
        except SourceError:
            return []

    def _store_line(self, line: str, number: int) -> bool:
        """Store the record of a line; return False if the line is damaged."""
        try:
            record = json.loads(line)
        except ValueError:
            return False
        except RecursionError:
            error = SourceError(
                f"{self.path}: line {number} is no record: its brackets are nested too deeply"
            )
            raise suggest(error, "delete the line; the piece is then converted again") from None
        if not _is_record(record):
            return False
        self._records.setdefault((record["source"], record["target"]), {})[record["piece"]] = record
        return True

    def existed_before(self, path: str) -> bool:
        """Return whether a file was in the folder before this run."""
        return normalise_path(path) in self._outputs

    def find_finished(self, piece: FilePiece) -> Record | None:
        """Return the record of a piece that need not be converted again; otherwise None."""
        record = self._records.get((piece.source, piece.target), {}).get(piece.number)
        if (
            record is None
            or "error" in record
            or any(record.get(name) != value for name, value in piece.settings.items())
        ):
            return None
        is_there = record["output"] is None or self.existed_before(record["output"])
        if is_there and self._is_unchanged(piece.source, record):
            return record
        return None

    def _is_unchanged(self, source: str, record: Record) -> bool:
        """Return whether a file has not changed since a record was written."""
        now = read_stamp(source)
        return bool(
            now["size"] == record["size"]
            and (now["modified"] == record["modified"] or hash_ends(source) == record["digest"])
        )

    def find_records(self, piece: FilePiece) -> list[Record]:
        """Return the records of all pieces of a file; an empty list if one is missing."""
        records = list[Record]()
        for number in itertools.count():
            if (record := self.find_finished(replace(piece, number=number))) is None:
                return []
            records.append(record)
            if record["last"]:
                return records
        return []

    def remove_outdated_outputs(self, piece: FilePiece) -> None:
        """Remove the outputs of an input file if the input or the settings have changed."""
        for number, record in self._records.get((piece.source, piece.target), {}).items():
            output = record.get("output")
            if (
                output
                and self.existed_before(output)
                and self.find_finished(replace(piece, number=number)) is None
            ):
                remove(output)

    def add(self, record: Record) -> None:
        """Write the record of a piece."""
        line = json.dumps(record)
        if self._is_stored:
            self._lines.append(line)
            if (now := time.monotonic()) >= self._due:
                self._due = now + MANIFEST_PERIOD_S
                self._upload_lines()
            return
        self._file.write(f"{line}\n")
        self._file.flush()

    def close(self) -> None:
        """Write the remaining records, and close the file."""
        if self._is_stored:
            self._upload_lines()
        else:
            self._file.close()

    def _upload_lines(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            local = Path(folder) / MANIFEST
            local.write_text("".join(f"{line}\n" for line in self._lines), encoding="utf-8")
            upload(local, self.path)


class _InProcessExecutor(Executor):
    """Runs each task in this process when it is submitted."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run the task, and return its finished future."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def _exit_with_parent() -> None:
    """Make this worker process end without a traceback when its parent ends."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


@contextlib.contextmanager
def _open_executor(jobs: int, scheduler: str) -> Iterator[Executor]:
    """Yield an executor: this process, other processes, or a Dask cluster."""
    if scheduler:
        distributed = import_library("distributed", "dask")
        try:
            client = distributed.Client(scheduler)
        except (OSError, ValueError) as error:
            raise suggest(
                SourceError(f"{scheduler}: no reply from the Dask scheduler: {error}"),
                "dask scheduler",
            ) from error
        with client, client.get_executor(pure=False) as executor:
            yield executor
    elif jobs == 1:
        yield _InProcessExecutor()
    else:
        context = multiprocessing.get_context(
            "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
        )
        context.set_forkserver_preload([__name__])
        with ProcessPoolExecutor(jobs, context, initializer=_exit_with_parent) as executor:
            try:
                yield executor
            except BaseException:
                executor.shutdown(cancel_futures=True)
                raise


def convert(
    sources: Sequence[str],
    folder: str,
    to: str,
    sensor: str | Sensor | None = None,
    *,
    jobs: int = 1,
    scheduler: str = "",
    every_point: bool = False,
    select: Selection = EVERYTHING,
    size: int = PIECE_BYTES,
    force: bool = False,
) -> Iterator[tuple[Record, bool]]:
    """Write the points of many files into a folder.

    Yields the record of each finished piece, and whether an earlier run finished the piece. If a
    piece fails, its record has the key "error", and the function continues with the next piece.

    Args:
        sources: paths, patterns such as "drives/**/*.pcap", and URLs of fsspec.
        folder: the path or URL of the folder. With the pattern above, the points of drives/a/b.pcap
            are written to a/b.parquet in this folder.
        to: the suffix of a format, such as "parquet".
        sensor: an id, a path or a Sensor; by default, the sensor of each file is detected.
        jobs: number of processes on this computer.
        scheduler: the address of a Dask scheduler. Its workers need access to the sources and the
            folder.
        every_point: whether to include points without a valid return.
        select: the scans to convert, and the parts of each scan. A file is not cut into pieces if
            `select` needs all earlier scans of the file: with `times`, `scans`, `every`, or the
            time "utc".
        size: the size of a piece in bytes. A file that is larger than a piece is cut, and has
            several outputs.
        force: whether to convert finished pieces again.

    Raises:
        SourceError: if a source does not exist, the folder cannot be written to, the scheduler
            cannot be reached, or a worker was killed.
        UsageError: for an unknown format, or if a library is missing.
    """
    format_of(f"{folder}/*.{to}")
    todo = make_pieces(
        sources, sensor, folder=folder, to=to, every_point=every_point, size=size, select=select
    )
    with contextlib.closing(Manifest(folder)) as manifest:
        _check_format(to)
        if taken := [
            piece.target
            for piece in todo
            if manifest.is_new and not force and manifest.existed_before(piece.target)
        ]:
            error = UsageError(
                f"{taken[0]} exists already and was not overwritten: the folder has no {MANIFEST},"
                " so the source of the file is unknown"
            )
            raise suggest(error, "repeat with --force, or with another folder")
        if not force:
            finished = {piece.source: manifest.find_records(piece) for piece in todo}
            yield from ((record, True) for records in finished.values() for record in records)
            todo = [piece for piece in todo if not finished[piece.source]]
        for piece in todo:
            manifest.remove_outdated_outputs(piece)
        with _remove_partial_files(folder, to), _open_executor(jobs, scheduler) as executor:
            for record, is_old in _iter_results(
                executor, todo, (lambda _: None) if force else manifest.find_finished
            ):
                if not is_old:
                    manifest.add(record)
                yield record, is_old


def _iter_results(
    executor: Executor, todo: Iterable[FilePiece], done: Callable[[FilePiece], Record | None]
) -> Iterator[tuple[Record, bool]]:
    """Yield the record of each finished piece, and whether it is from an earlier run."""
    # While one task searches for the start of the next piece, others convert earlier pieces.
    ended = queue.SimpleQueue[tuple[FilePiece, Future[Any]]]()
    tasks = deque((find_piece_end if _is_large(piece) else convert_piece, piece) for piece in todo)
    running = 0
    most_running = 1 if isinstance(executor, _InProcessExecutor) else MAX_RUNNING_TASKS

    def hand_over(function: Callable[[FilePiece], Any], piece: FilePiece) -> None:
        executor.submit(function, piece).add_done_callback(
            lambda future: ended.put((piece, future))
        )

    while tasks or running:
        while tasks and running < most_running:
            hand_over(*tasks.popleft())
            running += 1
        piece, future = ended.get()
        running -= 1
        try:
            result = future.result()
        except BrokenProcessPool:
            error = SourceError(
                "a worker process was killed, possibly because memory ran out, so the piece that it"
                " was converting was not written"
            )
            raise suggest(
                error, "repeat the command: it converts only the missing pieces"
            ) from None
        except (
            Exception
        ) as failure:  # in `find_piece_end`, or because a Dask worker died repeatedly
            result = piece.describe_failure(failure)
        if isinstance(result, dict):
            yield result, False
            continue
        tasks.extendleft((find_piece_end, following) for following in result[1:])
        if (record := done(result[0])) is None:
            tasks.appendleft((convert_piece, result[0]))
        else:
            yield record, True


def _is_large(piece: FilePiece) -> bool:
    """Return whether a file has to be cut, because it is larger than a piece."""
    if piece.select.needs_all_scans:
        return False
    with contextlib.suppress(LidarSpecError):
        return bool(read_stamp(piece.source)["size"] > piece.size)
    return False


def _check_format(to: str) -> None:
    """Check that the library of a format is installed, before any input is read."""
    with tempfile.TemporaryDirectory() as folder, contextlib.suppress(ValueError, IndexError):
        write(Path(folder) / f"none.{to}", [])


@contextlib.contextmanager
def _remove_partial_files(folder: str, to: str) -> Iterator[None]:
    """Remove partial files from a folder when the context begins and when it ends.

    Processes that were killed have left these files.
    """

    def sweep() -> None:
        for path in () if is_remote(folder) else Path(folder).rglob(f".*.{to}"):
            if re.match(r"\.\d+\.", path.name):
                remove(path)

    sweep()
    try:
        yield
    finally:
        sweep()


def read(
    urls: str | Sequence[str],
    sensor: str | Sensor | None = None,
    *,
    every_point: bool = False,
    select: Selection = EVERYTHING,
    size: int = PARTITION_BYTES,
) -> Any:
    """Return the points of many files as a Dask dataframe, one partition per piece.

    The columns are those that `convert` writes to a Parquet file. This function reads through large
    files to cut them into pieces. Dask computes the points when it needs them.

    Args:
        urls: paths, patterns such as "s3://bucket/drives/**/*.pcap", and URLs of fsspec.
        sensor: an id, a path or a Sensor; by default, the sensor of each file is detected.
        every_point: whether to include points without a valid return.
        select: the scans to read, and the parts of each scan. A file is not cut into pieces if
            `select` needs all earlier scans of the file: with `times`, `scans`, `every`, or the
            time "utc".
        size: the size of a piece in bytes. The points of a piece take about ten times as much
            memory.

    Raises:
        SourceError: if a file does not exist.
        UsageError: if a library is missing.
    """
    dask = import_library("dask", "dask")
    frames = import_library("dask.dataframe", "dask")
    import_library("pyarrow", "arrow")
    todo = make_pieces(
        [urls] if isinstance(urls, str) else urls,
        sensor,
        every_point=every_point,
        size=size,
        select=select,
    )
    results = dask.compute(*(dask.delayed(_cut_into_pieces)(piece) for piece in todo))
    cut = [piece for pieces in results for piece in pieces if piece.count != 0 or not piece.number]
    return frames.from_map(
        _read_partition, cut, meta=_read_partition(replace(cut[0], count=1)).iloc[:0]
    )


def _cut_into_pieces(piece: FilePiece) -> list[FilePiece]:
    """Return all pieces of a file."""
    if not _is_large(piece):
        return [piece]
    pieces = list[FilePiece]()
    following = [piece]
    while following:
        first, *following = find_piece_end(following[0])
        pieces.append(first)
    return pieces


def _read_partition(piece: FilePiece) -> Any:
    """Return the points of a piece as a pandas dataframe."""
    with piece.open_scans() as scans:
        tables = iter_tables(piece.iter_numbered(scans), every_point=piece.every_point)
        table = import_library("pyarrow", "arrow").concat_tables(tables)
        if not table.num_rows and piece.is_last and not piece.first:
            raise WireError(f"no scan found in {piece.source}: {scans.stats}")
    return table.to_pandas()
