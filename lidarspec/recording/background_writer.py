"""Write records to a file in a thread, so that a slow disk does not delay the capture.

The thread calls fsync every second. An existing file is kept until the new file has its first
record. The file always ends after a complete record.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Protocol, Self

from lidarspec.errors import SourceError, SourceTimeout, UsageError, WriteError, failure_reason
from lidarspec.transports.protocol import Chunk
from lidarspec.unfinished_files import path_while_written, remove_abandoned_files

#: records are written when their total size reaches this limit.
FLUSH_BYTES = 1 << 16
#: maximum time between two writes.
FLUSH_PERIOD_S = 0.2
#: time between two calls of fsync.
SYNC_PERIOD_S = 1.0
#: maximum size of the records that wait for a slow disk. Further records are dropped and counted.
MAX_WAITING_BYTES = 1 << 26
#: maximum time that `sync` and `close` wait for the disk.
DISK_TIMEOUT_S = 60.0

#: Takes bytes and an offset, and returns the length of the record at this offset; 0 or less if the
#: record is not complete.
Size = Callable[[bytes | bytearray, int], int]


class RecordingFile:
    """A new file, to which complete records are appended.

    An existing file with the same path is kept until `settle` replaces it.

    Args:
        size_at: a function that returns the length of a record; None if the file has no records,
            only bytes.
        overwrite: whether an existing file may be replaced.

    Raises:
        UsageError: if the file exists and `overwrite` is false.
        SourceError: if the file cannot be created.
    """

    def __init__(self, path: str, size_at: Size | None, *, overwrite: bool) -> None:
        self._place = Path(os.path.realpath(path))
        can_rename_open_files = os.name != "nt"
        self.replaces = overwrite and self._place.is_file() and can_rename_open_files
        self._opened = self._place
        if self.replaces:
            remove_abandoned_files(self._place)
            self._opened = path_while_written(self._place)
        try:
            self._file = open(self._opened, "wb" if overwrite else "xb", buffering=0)  # noqa: SIM115  closed by `close`
        except FileExistsError:
            raise UsageError(f"{path} already exists and was not overwritten") from None
        except OSError as error:
            raise SourceError(f"{path}: {failure_reason(path, error)}") from None
        self.size = 0
        self._size_at = size_at

    def append(self, records: bytes | bytearray) -> None:
        """Write complete records.

        Raises:
            OSError: if a record could not be written. The file then ends after the last complete
                record.
        """
        written = 0
        try:
            with memoryview(records) as left:
                while written < len(records):
                    more = self._file.write(left[written:])
                    if not more:
                        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                    written += more
        except OSError:
            self.size += self._count_whole_bytes(records, written)
            with contextlib.suppress(OSError):
                self._file.truncate(self.size)
            raise
        self.size += written

    def _count_whole_bytes(self, records: bytes | bytearray, limit: int) -> int:
        """Return the total size of the records that end within the first `limit` bytes."""
        if self._size_at is None:
            return limit
        end = 0
        while 0 < (size := self._size_at(records, end)) <= limit - end:
            end += size
        return end

    @property
    def is_settled(self) -> bool:
        """Whether the file has its final name."""
        return self._opened == self._place

    def settle(self) -> None:
        """Give the file its final name, which replaces an existing file."""
        if not self.is_settled:
            os.replace(self._opened, self._place)
            self._opened = self._place

    def flush_to_disk(self) -> None:
        """Wait until all data is on the disk. For pipes and devices, this does nothing."""
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOTSUP):
                raise

    def close(self) -> None:
        """Close the file.

        If `settle` was not called, the existing file is kept and the new file is removed.
        """
        with contextlib.suppress(OSError):
            self._file.close()
            if not self.is_settled:
                self._opened.unlink()


class TrafficLog(Protocol):
    """Interface of recorders: records the data that is received and sent.

    Attributes:
        error: the error that ended the recording; None if there is no error.
    """

    @property
    def error(self) -> SourceError | None: ...

    def write(self, chunk: Chunk, direction: Literal["in", "out"] = "in") -> None:
        """Add data that was received or sent to the recording, with its time."""

    def event(self, name: str, at: int | None = None, **details: Any) -> None:
        """Record an event of the connection, such as "disconnect" or "reconnect".

        Args:
            at: the time, ns since 1970; by default now.
        """

    def close(self) -> None:
        """End the recording.

        Raises:
            SourceError: if the file could not be written.
        """


class BackgroundWriter:
    """Base class of recorders, a context manager; any thread may add records.

    If the file cannot be written, the capture continues: adding a record raises no error. The error
    is stored in `error`, and raised once, by the next `sync` or by `close`. The file is then valid
    up to its last complete record.

    Args:
        path: the path of the file.
        size_at: returns the length of a record, as in `RecordingFile`.
        overwrite: whether an existing file may be replaced.

    Attributes:
        records: number of records so far.
        bytes: number of data bytes in these records.
        dropped: number of records that were dropped because the disk was too slow or failed.
        error: the error of the file; None if there is no error.
    """

    def __init__(self, path: str | Path, size_at: Size | None, *, overwrite: bool) -> None:
        self.path = str(path)
        self.records = 0
        self.bytes = 0
        self.dropped = 0
        self.error: SourceError | None = None
        self._changed = threading.Condition()
        self._waiting = bytearray()
        self._unreported_drops = 0
        self._has_raised = False
        self._closing = False
        # Numbers of records that were added, that `sync` waits for, and that are on the disk.
        self._records_added = 0
        self._records_requested = 0
        self._records_synced = 0
        self._file = RecordingFile(self.path, size_at, overwrite=overwrite)
        self._thread = threading.Thread(
            target=self._write_records, name=f"recorder of {path}", daemon=True
        )
        self._thread.start()
        atexit.register(self._finish)

    def write(self, chunk: Chunk, direction: Literal["in", "out"] = "in") -> None:
        """Add data that was received or sent to the recording, with its time."""
        raise NotImplementedError

    def event(self, name: str, at: int | None = None, **details: Any) -> None:
        """Record an event of the connection, if the format supports events."""

    def sync(self) -> None:
        """Wait until all records that were added so far are on the disk.

        Raises:
            SourceError: if the file cannot be written, or the disk is too slow.
        """
        with self._changed:
            target = self._records_requested = self._records_added
            self._changed.notify_all()
            if not self._changed.wait_for(
                lambda: self._records_synced >= target or self.error or not self._thread.is_alive(),
                DISK_TIMEOUT_S,
            ):
                raise SourceTimeout(
                    f"{self.path}: the disk did not store the recording within"
                    f" {DISK_TIMEOUT_S:.0f} s; the newest data may be missing in the file:"
                    " record to a faster disk"
                )
        self._raise_failure()

    def wait_for_room(self) -> None:
        """Wait until there is memory for more records.

        Call this regularly while reading from a source that loses no data by waiting, such as a
        file.

        Raises:
            SourceError: if the file cannot be written, or the disk is too slow.
        """
        if len(self._waiting) > MAX_WAITING_BYTES // 4 or self.error:
            self.sync()

    def close(self) -> None:
        """Write the waiting records, and close the file. A second call does nothing.

        Raises:
            SourceError: if the file could not be written, unless `sync` has raised it already.
        """
        self._finish()
        self._raise_failure()

    def discard(self) -> bool:
        """Remove the new file. Call this only if the file was closed without records.

        Returns:
            True if no file is left at the path; False if an older file is there, which was kept.
        """
        if not self._file.replaces:
            with contextlib.suppress(OSError):
                os.unlink(self.path)
        return not self._file.replaces

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._finish()
        if error is None:
            self._raise_failure()

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({self.path}: {self.records} records, {self.bytes}"
            f" bytes{f'; {self.error}' if self.error else ''})"
        )

    def _put(self, record: bytes, size: int | None = None) -> None:
        """Queue a record for the thread.

        Args:
            size: number of data bytes to add to `bytes`; None for a header or event.
        """
        with self._changed:
            if self.error or self._closing or len(self._waiting) + len(record) > MAX_WAITING_BYTES:
                self.dropped += 1
                self._unreported_drops += 1
                return
            is_first = not self._waiting
            if self._unreported_drops:
                self._waiting += self._make_drop_record(self._unreported_drops)
                self._unreported_drops = 0
            self._waiting += record
            self._records_added += 1
            if size is not None:
                self.records += 1
                self.bytes += size
            if is_first or len(self._waiting) >= FLUSH_BYTES:
                self._changed.notify_all()

    def _make_drop_record(self, dropped: int) -> bytes:
        """Return a record that reports dropped records; b"" if the format has none."""
        return b""

    def _raise_failure(self) -> None:
        if self.error and not self._has_raised:
            self._has_raised = True
            raise self.error

    def _finish(self) -> None:
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join(DISK_TIMEOUT_S)
        atexit.unregister(self._finish)

    def _write_records(self) -> None:
        """Write the waiting records until the recorder is closed or an error occurs."""
        try:
            due = time.monotonic() + SYNC_PERIOD_S
            while not (
                self._closing and not self._waiting and self._records_synced == self._records_added
            ):
                with self._changed:
                    self._changed.wait_for(
                        lambda: (
                            self._waiting
                            or self._records_synced < self._records_added
                            or self._closing
                        )
                    )
                    self._changed.wait_for(self._is_urgent, FLUSH_PERIOD_S)
                    waiting = self._waiting
                    self._waiting = bytearray()
                    taken = self._records_added
                    asked = self._records_requested > self._records_synced or self._closing
                    is_begun = self.records > 0
                self._file.append(waiting)
                if is_begun:
                    self._file.settle()
                if asked or time.monotonic() >= due:
                    self._file.flush_to_disk()
                    due = time.monotonic() + SYNC_PERIOD_S
                    with self._changed:
                        self._records_synced = taken
                        self._changed.notify_all()
        except Exception as error:
            with self._changed:
                reason = (error.strerror if isinstance(error, OSError) else None) or error
                if self._file.is_settled:
                    held = f"the recording is complete up to byte {self._file.size}"
                else:
                    held = "the existing content is unchanged"
                self.error = WriteError(self.path, str(reason), held)
                self._changed.notify_all()
        finally:
            self._file.close()

    def _is_urgent(self) -> bool:
        return (
            len(self._waiting) >= FLUSH_BYTES
            or self._records_requested > self._records_synced
            or self._closing
        )
