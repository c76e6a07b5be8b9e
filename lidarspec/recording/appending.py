"""A file that grows by whole records, written by a thread of its own, so that a slow disk holds up
no capture.

A file that is overwritten stays until the new one has its first record.

What is put in waits in memory. The thread writes it out every 0.2 s or 64 KiB, and has it put on
the disk every second. Short writes are gone on with; what a full disk takes of a record that it
does not take whole is cut off again.
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
from lidarspec.unfinished import path_while_written, remove_abandoned

#: when what was put in is written out, and when the disk is asked to keep it.
FLUSH_BYTES = 1 << 16
FLUSH_SECONDS = 0.2
DISK_SECONDS = 1.0
#: bytes that may wait for a disk that does not keep up; what comes then is dropped and counted.
BACKLOG = 1 << 26
#: seconds that `sync` and `close` give a disk.
PATIENCE = 60.0

#: (bytes, place) -> the length of the record that begins there; 0 or less where none does.
Size = Callable[[bytes | bytearray, int], int]


class RecordFile:
    """A new file, opened at once; one that it is to replace stays in its place until `settle`.

    Args:
        size_at: how long records are, since a piece of the file may be cut behind each; None where
            it may be anywhere.

    Raises:
        UsageError: where it exists, and is not to be overwritten.
        SourceError: where it cannot be made.
    """

    def __init__(self, path: str, size_at: Size | None, *, overwrite: bool) -> None:
        self._place = Path(os.path.realpath(path))
        self.replaces = (
            overwrite and self._place.is_file() and os.name != "nt"
        )  # where open files keep their names
        self._opened = self._place
        if self.replaces:
            remove_abandoned(self._place)
            self._opened = path_while_written(self._place)
        try:
            self._file = open(self._opened, "wb" if overwrite else "xb", buffering=0)  # noqa: SIM115  closed by `close`
        except FileExistsError:
            raise UsageError(
                f"{path} exists already; it is not overwritten unless asked for"
            ) from None
        except OSError as error:
            raise SourceError(f"{path}: {failure_reason(path, error)}") from None
        self.size = 0
        self._size_at = size_at

    def append(self, records: bytes | bytearray) -> None:
        """Write whole records.

        Raises:
            OSError: where not all of them are taken; the file then ends behind the last that is.
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
            self.size += self._whole(records, written)
            with contextlib.suppress(OSError):
                self._file.truncate(self.size)
            raise
        self.size += written

    def _whole(self, records: bytes | bytearray, limit: int) -> int:
        """The bytes of those records that end within the limit."""
        end = limit if self._size_at is None else 0
        while (
            self._size_at is not None and 0 < (size := self._size_at(records, end)) <= limit - end
        ):
            end += size
        return end

    @property
    def is_settled(self) -> bool:
        """Whether it stands in its place."""
        return self._opened == self._place

    def settle(self) -> None:
        """Take the place of the file that it replaces, if there is one and it stands there still.

        Raises:
            OSError: where that cannot be done.
        """
        if not self.is_settled:
            os.replace(self._opened, self._place)
            self._opened = self._place

    def keep(self) -> None:
        """Returns when all of it is on the disk; pipes and devices have none."""
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOTSUP):
                raise

    def close(self) -> None:
        """Close the file; without `settle`, the one that it was to replace stays, and this one is
        gone.
        """
        with contextlib.suppress(OSError):
            self._file.close()
            if not self.is_settled:
                self._opened.unlink()


class Log(Protocol):
    """Where everything that arrives and is sent is taken down: a file, or what stands in its place.

    Attributes:
        error: what went wrong with it, None where nothing did.
    """

    @property
    def error(self) -> SourceError | None: ...

    def write(self, chunk: Chunk, direction: Literal["in", "out"] = "in") -> None:
        """Take what was received, or sent, with its arrival time."""

    def event(self, name: str, at: int | None = None, **details: Any) -> None:
        """Take down what happened to the line, such as "disconnect" or "reconnect"; now, unless
        `at` says when.
        """

    def close(self) -> None:
        """End it.

        Raises:
            SourceError: where it could not be written.
        """


class Appender:
    """Takes records for a file, from any thread, and is a context manager; kinds of recordings are
    made of it.

    Nothing that goes wrong with the file is raised while records are taken: the capture goes on. It
    is kept in `error`, and raised once, by the next `sync` or by `close`; the file is then valid to
    its last whole record.

    Args:
        path, size_at, overwrite: as in `RecordFile`.

    Attributes:
        records, bytes: taken so far, and the bytes of the wire in them.
        dropped: those that came while the disk did not keep up, or after it failed.
        error: what went wrong with the file, None where nothing did.
    """

    def __init__(self, path: str | Path, size_at: Size | None, *, overwrite: bool) -> None:
        self.path = str(path)
        self.records = 0
        self.bytes = 0
        self.dropped = 0
        self.error: SourceError | None = None
        self._changed = threading.Condition()
        self._waiting = bytearray()
        self._untold = 0
        self._raised = False
        self._closing = False
        self._taken = 0
        self._asked = 0
        self._kept = 0  # pieces: in memory or further, asked to be on the disk, and there
        self._file = RecordFile(self.path, size_at, overwrite=overwrite)
        self._thread = threading.Thread(target=self._work, name=f"recorder of {path}", daemon=True)
        self._thread.start()
        atexit.register(self._finish)

    def write(self, chunk: Chunk, direction: Literal["in", "out"] = "in") -> None:
        """Take what was received, or sent, with its arrival time."""
        raise NotImplementedError

    def event(self, name: str, at: int | None = None, **details: Any) -> None:
        """Take down what happened to the line, where the format has a place for that."""

    def sync(self) -> None:
        """Returns when everything taken so far is on the disk.

        Raises:
            SourceError: where it cannot be.
        """
        with self._changed:
            target = self._asked = self._taken
            self._changed.notify_all()
            if not self._changed.wait_for(
                lambda: self._kept >= target or self.error or not self._thread.is_alive(), PATIENCE
            ):
                raise SourceTimeout(
                    f"{self.path}: the disk has not taken the recording within {PATIENCE:.0f} s"
                )
        self._complain()

    def keep_up(self) -> None:
        """Returns when there is room for more: for sources that can wait for the disk.

        Raises:
            SourceError: as `sync`.
        """
        if len(self._waiting) > BACKLOG // 4 or self.error:
            self.sync()

    def close(self) -> None:
        """Write what is left, and close the file; a second call does nothing.

        Raises:
            SourceError: where the file could not be written, unless `sync` has said so already.
        """
        self._finish()
        self._complain()

    def discard(self) -> bool:
        """Take away a closed file that got no record; False where one that it was to replace stays
        in its place.
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
            self._complain()

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({self.path}: {self.records} records, {self.bytes}"
            f" bytes{f'; {self.error}' if self.error else ''})"
        )

    def _put(self, record: bytes, size: int | None = None) -> None:
        """Let a record wait for the thread, with so many bytes of the wire in it; what has none is
        not counted.
        """
        with self._changed:
            if self.error or self._closing or len(self._waiting) + len(record) > BACKLOG:
                self.dropped += 1
                self._untold += 1
                return
            is_first = not self._waiting
            if self._untold:
                self._waiting += self._make_drop_record(self._untold)
                self._untold = 0
            self._waiting += record
            self._taken += 1
            if size is not None:
                self.records += 1
                self.bytes += size
            if is_first or len(self._waiting) >= FLUSH_BYTES:
                self._changed.notify_all()

    def _make_drop_record(self, dropped: int) -> bytes:
        """The record that tells that so many were dropped, where the format has one."""
        return b""

    def _complain(self) -> None:
        if self.error and not self._raised:
            self._raised = True
            raise self.error

    def _finish(self) -> None:
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join(PATIENCE)
        atexit.unregister(self._finish)

    def _work(self) -> None:
        """The thread: what waits is written, and put on the disk when that is due, until the end or
        a failure.
        """
        try:
            due = time.monotonic() + DISK_SECONDS
            while not (self._closing and not self._waiting and self._kept == self._taken):
                with self._changed:
                    self._changed.wait_for(
                        lambda: self._waiting or self._kept < self._taken or self._closing
                    )
                    self._changed.wait_for(self._is_urgent, FLUSH_SECONDS)
                    waiting = self._waiting
                    self._waiting = bytearray()
                    taken = self._taken
                    asked = self._asked > self._kept or self._closing
                    is_begun = self.records > 0
                self._file.append(waiting)
                if is_begun:
                    self._file.settle()
                if asked or time.monotonic() >= due:
                    self._file.keep()
                    due = time.monotonic() + DISK_SECONDS
                    with self._changed:
                        self._kept = taken
                        self._changed.notify_all()
        except Exception as error:
            with self._changed:
                reason = (error.strerror if isinstance(error, OSError) else None) or error
                if self._file.is_settled:
                    held = f"the recording is whole up to byte {self._file.size}"
                else:
                    held = "what was there before is kept"
                self.error = WriteError(self.path, str(reason), held)
                self._changed.notify_all()
        finally:
            self._file.close()

    def _is_urgent(self) -> bool:
        return len(self._waiting) >= FLUSH_BYTES or self._asked > self._kept or self._closing
