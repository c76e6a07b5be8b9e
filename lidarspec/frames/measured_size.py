"""Sizes that are found by reading the content of a frame, not its header.

An example is the size of a text that ends at a mark, such as a zero byte, which is called the end
mark here.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.frames.layout import Bytes2D, view_span
from lidarspec.spec import tree
from lidarspec.spec.wire_forms import find_next_offsets

Offsets = NDArray[np.intp]

#: The status of a frame if its content was found.
FOUND = 0
#: The status of a frame if its bytes end before the end of the content.
CUT_OFF = 1
#: The status of a frame if the content has an invalid length.
LENGTH = 2

#: The number of bytes that are searched in each frame by itself, in units of the size of the end
#: mark.
#: Most texts are shorter.
FIRST_WINDOW_MARKS = 32
#: The maximum number of bytes that are searched in one step, of all frames together.
MAX_WINDOW_BYTES = 1 << 16


@dataclass(frozen=True, eq=False)
class MeasuredSize(ABC):
    """A size that is found by reading the content of a frame.

    Like a header field, it can be a selector of layouts, so it has the same methods as a `Leaf`.

    Attributes:
        info: describes the size like a field that contains the size.
    """

    info: tree.FieldInfo

    @property
    def known(self) -> int | None:
        """The size if the layout already determines it; else None."""
        return None

    @abstractmethod
    def read(
        self, buffer: NDArray[np.uint8], offsets: Offsets, stops: Offsets | None = None
    ) -> tuple[Offsets | None, NDArray[Any]]:
        """Find the size in the candidates at these offsets.

        Args:
            stops: the end offset of each candidate; by default the end of the buffer.

        Returns:
            The indices of the candidates in which the size was found (None for all candidates), and
            the sizes. For invalid content, the size is a negated status, such as `-LENGTH`.
        """

    @abstractmethod
    def load(self, rows: Bytes2D) -> NDArray[Any]:
        """Return the size in each frame, given as a row of bytes, (n,).

        For invalid content, the size is a negated status, such as `-LENGTH`.
        """

    def read_first(self, frame: bytes | memoryview) -> int | None:
        """Return the size, given the first bytes of a frame; None if they are too few."""
        values = self.read(np.frombuffer(frame, np.uint8), np.zeros(1, np.intp))[1]
        if len(values):
            return int(values[0])
        return None


@dataclass(frozen=True, eq=False)
class TextSize(MeasuredSize):
    """The size of a text that extends to an end mark, or to the end of the datagram.

    Attributes:
        ending: the end mark, or the end of the datagram.
        start: the offset of the text in a frame.
        limit: the maximum size of a frame, in bytes.
    """

    ending: tree.Ending
    start: int
    limit: int

    def read(
        self, buffer: NDArray[np.uint8], offsets: Offsets, stops: Offsets | None = None
    ) -> tuple[Offsets | None, NDArray[Any]]:
        if stops is None and not self.ending.mark:
            return None, np.full(len(offsets), -LENGTH)  # a stream has no end of a datagram
        if stops is None:
            stops = np.full(len(offsets), len(buffer))
        ends = np.minimum(stops, offsets + self.limit)
        values = self._find_sizes(buffer, offsets + self.start, ends)
        is_missing = values < 0
        if not np.count_nonzero(is_missing):
            return None, values
        is_full = is_missing & (stops - offsets >= self.limit)
        values[is_full] = -LENGTH
        there = np.flatnonzero(~is_missing | is_full)
        return there, values[there]

    def read_first(self, frame: bytes | memoryview) -> int | None:
        if len(frame) < self.start:
            return None
        size = self.ending.find(bytes(frame[self.start : self.limit]))
        if size >= 0:
            return size
        return -LENGTH if len(frame) >= self.limit else None

    def load(self, rows: Bytes2D) -> NDArray[Any]:
        offsets = np.arange(len(rows)) * rows.strides[0]
        values = self._find_sizes(view_span(rows), offsets + self.start, offsets + rows.shape[1])
        values[values < 0] = -CUT_OFF
        return values

    def _find_sizes(
        self, buffer: NDArray[np.uint8], starts: Offsets, ends: Offsets
    ) -> NDArray[np.int64]:
        """Return the size of the text of each frame, (n,); -1 if it has no end mark.

        Args:
            starts: the offset of each text in the buffer.
            ends: the offset at which the search for the end mark of each text stops.
        """
        step = len(self.ending.mark)
        if not step:
            return np.asarray(np.maximum(ends - starts, -1), np.int64)
        most = max(MAX_WINDOW_BYTES // (step * FIRST_WINDOW_MARKS), 1)
        blocks = [slice(first, first + most) for first in range(0, len(starts), most)]
        found = [self._find_sizes_of_few(buffer, starts[block], ends[block]) for block in blocks]
        return np.concatenate([np.empty(0, np.int64), *found])

    def _find_sizes_of_few(
        self, buffer: NDArray[np.uint8], starts: Offsets, ends: Offsets
    ) -> NDArray[np.int64]:
        """Return the result of `_find_sizes` for a few frames."""
        step = len(self.ending.mark)
        reach = np.arange(FIRST_WINDOW_MARKS * step)
        offsets = starts[:, None] + reach
        units = buffer[np.minimum(offsets, len(buffer) - 1)].reshape(len(starts), -1, step)
        last = offsets.reshape(units.shape)[:, :, -1]
        is_mark = self._match(units) & (last < ends[:, None])
        has_mark = is_mark.any(axis=1)
        content = is_mark.argmax(axis=1) + self.ending.is_content
        sizes = np.where(has_mark, step * content, -1)
        # The bytes that longer texts share are searched once.
        open_ended = np.flatnonzero(~has_mark & (starts + len(reach) + step <= ends))
        for phase in np.unique(starts[open_ended] % step).tolist():
            own = open_ended[starts[open_ended] % step == phase]
            sizes[own] = self._find_sizes_together(buffer, starts[own], ends[own])
        return sizes

    def _find_sizes_together(
        self, buffer: NDArray[np.uint8], starts: Offsets, ends: Offsets
    ) -> NDArray[np.int64]:
        """Return the sizes of several texts, found by one search.

        The offsets of the texts must differ by multiples of the size of the end mark.
        """
        step = len(self.ending.mark)
        begin = int(starts.min())
        count = (int(ends.max()) - begin) // step
        units = buffer[begin : begin + count * step].reshape(count, step)
        marks = begin + step * np.flatnonzero(self._match(units))
        found = find_next_offsets(marks, starts, len(buffer))
        sizes = found - starts + step * self.ending.is_content
        return np.where(found + step <= ends, sizes, -1)

    def _match(self, units: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Return whether each group of bytes is equal to the end mark, (...).

        Args:
            units: the groups, which have the size of the end mark, (..., size).
        """
        mark = np.frombuffer(self.ending.mark, np.uint8)
        mask = np.frombuffer(self.ending.mask, np.uint8)
        matches: NDArray[np.bool_] = ((units & mask) == mark).all(axis=-1)
        return matches
