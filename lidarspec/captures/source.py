"""Read the bytes of a capture from a file or a pipe.

Each read has a limited size, so a corrupt length in the file cannot cause a large allocation.
`BufferedInput.view` returns the buffer as an array without copying it.
"""

from __future__ import annotations

import functools
import io
import os
import stat
import weakref
from collections.abc import Callable
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import SourceError

#: The initial size of a buffer, and the maximum number of bytes that `skip` reads at once.
MIN_BUFFER_BYTES = 1 << 16
#: The number of bytes after the filled part of a buffer that callers may read, so that they can
#: compare words of several bytes at its end. The values of these bytes are undefined.
SLACK_BYTES = 256
#: The maximum number of buffers with a view that are kept for reuse.
MAX_VIEWED_BUFFERS = 2


class TruncatedError(Exception):
    """The input ended within a record."""


class BufferedInput:
    """A buffered reader of a file or pipe.

    Args:
        max_buffer_bytes: maximum size of the buffer. The buffer exceeds this size only if a single
            record does not fit into it.

    Attributes:
        storage: the current buffer. Its last `SLACK_BYTES` are never filled.
        at: offset of the next byte in `storage`.
        record: file offset of the current record.
        offset: file offset of the next byte.
    """

    def __init__(self, file: BinaryIO, *, max_buffer_bytes: int = MIN_BUFFER_BYTES) -> None:
        self._file = file
        self._read_into = _get_read_function(file)
        self._max_buffer_bytes = max_buffer_bytes
        self._viewed_buffers: list[tuple[NDArray[np.uint8], weakref.ref[Any]]] = []
        self._last_view: weakref.ref[Any] | None = None
        self._data = memoryview(b"")
        self._bytes_dropped = 0  # bytes of the file before `storage`
        self.record = self.at = 0
        self._use_buffer(
            np.empty(_choose_buffer_size(file, max_buffer_bytes) + SLACK_BYTES, np.uint8), 0
        )

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the arguments for pickling; the unpickled reader has the same offset."""
        return _open_source_at, (self._file, self._max_buffer_bytes, self.offset)

    @property
    def stop(self) -> int:
        """The end of the filled part of `storage`, as an offset."""
        return len(self._data)

    @property
    def offset(self) -> int:
        return self._bytes_dropped + self.at

    def open_at(self, offset: int) -> BufferedInput:
        """Return a second `BufferedInput` that reads the same file from an offset.

        Before using the first one again, call its `seek`: both share the position of the file.
        """
        return _open_source_at(self._file, MIN_BUFFER_BYTES, offset)

    def seek(self, offset: int) -> None:
        """Continue at an offset of a seekable file."""
        self._file.seek(offset)
        self._last_view = None  # the new buffer has no view
        self._use_buffer(np.empty_like(self.storage), 0)
        self.record = self._bytes_dropped = offset

    @property
    def size(self) -> int | None:
        """The size of the file in bytes; None if it is not seekable."""
        if not self._file.seekable():
            return None
        here = self._file.tell()
        size = self._file.seek(0, os.SEEK_END)
        self._file.seek(here)
        return size

    def peek(self, size: int) -> memoryview:
        """Return the next `size` bytes without consuming them; fewer at the end."""
        self._fill_buffer(size)
        return self._data[self.at : self.at + size]

    def begin_record(self) -> bool:
        """Mark the start of a record; return False at the end of the input."""
        self.record = self.offset
        return self._fill_buffer(1)

    def take(self, size: int) -> bytes:
        """Return the next `size` bytes, and advance.

        The caller must limit `size`, because the buffer grows to `size` bytes.

        Raises:
            TruncatedError: if fewer bytes are left.
        """
        if not self._fill_buffer(size):
            raise TruncatedError
        self.at += size
        return bytes(self._data[self.at - size : self.at])

    def skip(self, size: int) -> None:
        """Skip any number of bytes.

        Raises:
            TruncatedError: if fewer bytes are left.
        """
        while size:
            step = min(size, MIN_BUFFER_BYTES)
            if not self._fill_buffer(step):
                raise TruncatedError
            self.at += step
            size -= step

    def read_more(self) -> bool:
        """Read at least one more byte; return False at the end of the input.

        This may replace `storage` and change `at`.
        """
        return self._fill_buffer(len(self._data) - self.at + 1)

    def view(self) -> NDArray[np.uint8]:
        """Return the bytes in the buffer, (n,), uint8, read-only.

        The buffer is not overwritten while the array is in use.
        """
        array = np.frombuffer(self._view[: len(self._data)], np.uint8)
        array.flags.writeable = False
        self._last_view = weakref.ref(array)
        return array

    def _fill_buffer(self, size: int) -> bool:
        have = len(self._data) - self.at
        if have >= size:
            return True
        self._move_unread(have)
        while have < size:
            if have == len(self.storage) - SLACK_BYTES:
                self._move_unread(have)
            try:
                count = self._read_into(self._view[have : len(self.storage) - SLACK_BYTES])
            except OSError as error:
                raise SourceError(f"cannot read the capture: {error}") from error
            if not count:
                break
            have += count
            self._data = self._view[:have]
        return have >= size

    def _move_unread(self, have: int) -> None:
        """Move the unread bytes to the start of the buffer, or to another buffer."""
        size = len(self.storage) - SLACK_BYTES
        tail = self.storage[self.at : self.at + have]
        at = self.at
        if len(self._data) == size:
            if have == size:
                size = 2 * size
            else:
                size = max(size, min(2 * size, self._max_buffer_bytes))
        if self._last_view is not None:
            self._viewed_buffers = [
                *self._viewed_buffers[1 - MAX_VIEWED_BUFFERS :],
                (self.storage, self._last_view),
            ]
        spare = self._find_spare_buffer(size)
        spare[:have] = tail
        self._bytes_dropped += at
        self._use_buffer(spare, have)

    def _find_spare_buffer(self, size: int) -> NDArray[np.uint8]:
        if self._last_view is None and len(self.storage) - SLACK_BYTES == size:
            return self.storage
        self._last_view = None
        for index, (storage, lent) in enumerate(self._viewed_buffers):
            if lent() is None and len(storage) - SLACK_BYTES == size:
                del self._viewed_buffers[index]
                return storage
        return np.empty(size + SLACK_BYTES, np.uint8)

    def _use_buffer(self, storage: NDArray[np.uint8], have: int) -> None:
        self.storage = storage
        self._view = storage.data
        self._data = self._view[:have]
        self.at = 0


def _open_source_at(file: BinaryIO, max_buffer_bytes: int, offset: int) -> BufferedInput:
    """Return a `BufferedInput` that reads a seekable file from an offset."""
    file.seek(offset)
    source = BufferedInput(file, max_buffer_bytes=max_buffer_bytes)
    source.record = source._bytes_dropped = offset
    return source


def _get_read_function(file: BinaryIO) -> Callable[[memoryview], int | None]:
    """Return a function that reads the available bytes into a buffer."""
    if isinstance(file, io.BufferedIOBase):
        # readinto blocks until the buffer is full
        return file.readinto1
    if isinstance(file, io.RawIOBase):
        return file.readinto
    return functools.partial(_copy_bytes, file)


def _copy_bytes(file: BinaryIO, buffer: memoryview) -> int:
    data = file.read(len(buffer))
    buffer[: len(data)] = data
    return len(data)


def _choose_buffer_size(file: BinaryIO, max_buffer_bytes: int) -> int:
    try:
        status = os.fstat(file.fileno())
    except (AttributeError, OSError):
        return MIN_BUFFER_BYTES
    if stat.S_ISREG(status.st_mode):
        return min(max(status.st_size, MIN_BUFFER_BYTES), max_buffer_bytes)
    return MIN_BUFFER_BYTES
