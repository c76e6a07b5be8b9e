"""A capture read into buffers that are lent out and used again.

`Window` is a `Source` that holds as much of the file as fits into one buffer. `lent` gives that buffer away as an array;
it is not written to again while that array, or anything made from it without a copy, is alive. So whoever needs the
bytes for longer just keeps them: another buffer is used then, and the kept one is theirs.
"""

from __future__ import annotations

import os
import stat
import weakref
from collections.abc import Callable
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lidarspec.allocation import keep_freed_memory
from lidarspec.captures.records import LARGEST_BLOCK, Source
from lidarspec.errors import SourceError

#: bytes of a buffer: of the first as many as the file has; each that is filled makes the next one longer.
SMALLEST, LARGEST = 1 << 16, 8 * LARGEST_BLOCK

#: bytes behind what was read that may be looked at, whatever they are, so that records can be compared in words.
SLACK = 256

#: buffers kept for use again.
MOST_KEPT = 2


class Window(Source):
    """Bytes of a file or pipe, in buffers that can be lent out.

    Attributes:
        storage: the buffer in use, `SLACK` bytes longer than it is ever filled.
    """

    def __init__(self, file: BinaryIO) -> None:
        super().__init__(file)
        into: Callable[[Any], int | None] | None = getattr(file, "readinto1", getattr(file, "readinto", None))
        self._into = into
        self._kept: list[tuple[NDArray[np.uint8], weakref.ref[Any]]] = []
        self._lent: weakref.ref[Any] | None = None
        self._adopt(np.empty(_first_size(file) + SLACK, np.uint8), 0)

    @property
    def at(self) -> int:
        """Where in `storage` the next byte stands."""
        return self._at

    @property
    def stop(self) -> int:
        """How much of `storage` is filled."""
        return len(self._data)

    def go(self, at: int) -> None:
        """Makes the byte at this place of `storage` the next one."""
        self._at = at

    def more(self) -> bool:
        """Whether bytes came after those that are there; they may all move."""
        return self._has(len(self._data) - self._at + 1)

    def lent(self) -> NDArray[np.uint8]:
        """What is in the buffer, read-only: not written to again while this array or a view of it is alive."""
        array = np.frombuffer(self._view[: len(self._data)], np.uint8)
        array.flags.writeable = False
        self._lent = weakref.ref(array)
        return array

    def _has(self, size: int) -> bool:
        have = len(self._data) - self._at
        if have >= size:
            return True
        self._turn(have)
        while have < size:
            if have == len(self.storage) - SLACK:
                self._turn(have)
            count = self._read_at(have)
            if not count:
                break
            have += count
            self._data = self._view[:have]
        return have >= size

    def _read_at(self, start: int) -> int:
        """How many bytes came; they stand in the buffer from `start` on."""
        free = self._view[start : len(self.storage) - SLACK]
        try:
            if self._into is not None:
                return self._into(free) or 0
            piece = self._read(len(free))
        except OSError as error:
            raise SourceError(f"cannot read the capture: {error}") from error
        free[: len(piece)] = piece
        return len(piece)

    def _turn(self, have: int) -> None:
        """Puts what is not read yet to the front of a buffer that nobody holds."""
        size = len(self.storage) - SLACK
        tail, at = self.storage[self._at : self._at + have], self._at
        if len(self._data) == size:
            size = min(2 * size, LARGEST)
        if self._lent is not None:
            self._kept = [*self._kept[1 - MOST_KEPT :], (self.storage, self._lent)]
        spare = self._spare(size)
        spare[:have] = tail
        self._passed += at
        self._adopt(spare, have)

    def _spare(self, size: int) -> NDArray[np.uint8]:
        if self._lent is None and len(self.storage) - SLACK == size:
            return self.storage
        self._lent = None
        for index, (storage, lent) in enumerate(self._kept):
            if lent() is None and len(storage) - SLACK == size:
                del self._kept[index]
                return storage
        return np.empty(size + SLACK, np.uint8)

    def _adopt(self, storage: NDArray[np.uint8], have: int) -> None:
        self.storage = storage
        self._view = storage.data
        self._data, self._at = self._view[:have], 0


def _first_size(file: BinaryIO) -> int:
    try:
        status = os.fstat(file.fileno())
    except (AttributeError, OSError):
        return SMALLEST
    return min(max(status.st_size, SMALLEST), LARGEST) if stat.S_ISREG(status.st_mode) else SMALLEST


keep_freed_memory()
