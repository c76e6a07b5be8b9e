"""Compact frames before computing.

The innermost arrays of a chunk of packets are copied without the bytes between them.

Each field is then one long array with one distance from element to element, which NumPy reads
several times as fast as a view with a distance for each level. Where elements follow each other at
one distance from frame to frame as they stand, nothing is copied; nor where so many of them do that
their arrays are read as quickly where they are.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.frames.layout import Bytes2D, Leaf, elements
from lidarspec.points.windows import Window

#: elements of an array from which on it is not compacted.
LONG = 64


class Blocks:
    """The innermost arrays of frames, without the bytes between them.

    A chunk of packets is loaded at a time.

    Args:
        leaves: the fields wanted; all of the same arrays.
        size: of a frame in bytes.

    Attributes:
        is_flat: whether nothing stands between them, if the frames stand back to back, as they then
            have to.
        room: bytes that they take for each packet when they are compacted.
    """

    def __init__(self, leaves: list[Leaf], size: int) -> None:
        first = leaves[0]
        self.shape = first.shape[: len(first.strides)]
        strides = first.strides
        self.stride = strides[-1] if strides else size
        count = self.shape[-1] if self.shape else 1
        self.is_flat = self._regular(size, strides)
        self.is_long = count >= LONG and not self.is_flat
        self._length = count * self.stride
        last = sum(
            (number - 1) * step for number, step in zip(self.shape, strides[:-1], strict=False)
        )  # from the first block on
        if self.is_flat:
            self._base = 0
        else:
            self._base = min(*(leaf.offset for leaf in leaves), size - last - self._length)
        self._strides = strides[:-1]
        self._size = size
        if self.is_flat or self.is_long:
            self.room = 0
        else:
            self.room = math.prod(self.shape[:-1]) * self._length

    def _regular(self, size: int, strides: tuple[int, ...]) -> bool:
        """Whether elements follow each other at one distance from frame to frame too."""
        steps = zip(self.shape, strides, (size, *strides), strict=False)
        return all(stride * length == outer for length, stride, outer in steps)

    def loading(self, rows: Bytes2D, room: NDArray[np.uint8]) -> Loading:
        """Their fields, compacted in this room."""
        if self.is_flat or self.is_long:
            return Loading(
                rows,
                None,
                0,
                self._size,
                self.stride,
                (self.shape, (*self._strides, self.stride)) if self.is_long else None,
            )
        block = np.dtype(f"V{self._length}")
        source = elements(rows, block, self._base, self.shape[:-1], self._strides)
        return Loading(
            source, room.view(block).reshape(-1, *self.shape[:-1]), self._base, 0, self.stride
        )

    def holds(self, seen: Window) -> bool:
        """Whether a window lies in the elements that are kept."""
        return self.is_flat or 0 <= seen.offset - self._base <= self.stride - seen.size


class Loading:
    """The fields of some frames, a chunk of packets at a time.

    Args:
        source: the frames, or their blocks.
        compact: what the blocks of a chunk are copied to; None where the frames are looked at
            themselves.
        base: where a block begins in its frame.
        size: bytes from packet to packet in the source, where that is looked at.
        stride: bytes from element to element.
        arrays: lengths and distances of arrays that are looked at themselves; None where all
            elements have one distance.
    """

    def __init__(
        self,
        source: NDArray[Any],
        compact: NDArray[Any] | None,
        base: int,
        size: int,
        stride: int,
        arrays: tuple[tuple[int, ...], tuple[int, ...]] | None = None,
    ) -> None:
        self._source = source
        self._compact = compact
        self._base = base
        self._size = size
        self._stride = stride
        self._arrays = arrays
        self._start = -1

    def column(self, seen: Window, start: int, stop: int, width: int) -> NDArray[Any]:
        """Return a window of each of `width` elements of some packets.

        The packets are those from `start` to `stop`. If the arrays are long, the result has their
        shape.
        """
        if self._arrays is not None:
            return elements(self._source[start:stop], seen.dtype, seen.offset, *self._arrays)
        if self._compact is None:
            return np.ndarray(
                ((stop - start) * width,),
                seen.dtype,
                self._source.data,
                start * self._size + seen.offset,
                (self._stride,),
            )
        if self._start != start:
            np.copyto(self._compact[: stop - start], self._source[start:stop])
            self._start = start
        return np.ndarray(
            ((stop - start) * width,),
            seen.dtype,
            self._compact.data,
            seen.offset - self._base,
            (self._stride,),
        )
