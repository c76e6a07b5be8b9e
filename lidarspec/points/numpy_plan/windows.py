"""Fields as long flat arrays: blocks compacted first, then each field loaded through a window of one or two bytes.

A window's raw value indexes a table, so byte order, bits and scale cost nothing while decoding.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.columns.graph import Node, only_field
from lidarspec.wire.layout import Bytes2D, Leaf, elements


@dataclass(frozen=True)
class Window:
    """The bytes of a field in its element: from `offset` of the frame, `size` (1 or 2) bytes, little-endian."""

    offset: int
    size: int

    @property
    def dtype(self) -> np.dtype[Any]:
        """The type it is loaded as."""
        return np.dtype("u1") if self.size == 1 else np.dtype("<u2")


def window(leaf: Leaf) -> Window | None:
    """The window of a field; None where it takes more than two bytes, or stands inside a bit block as an array."""
    if leaf.wire is not None:
        return Window(leaf.offset, leaf.wire.itemsize) if leaf.wire.itemsize <= 2 and leaf.wire.kind in "iu" else None
    if len(leaf.shape) > len(leaf.strides):
        return None
    held = [segment.byte for segment in leaf.elements[0].segments]
    low, high = min(held), max(held)
    return Window(leaf.offset + low, high - low + 1) if high - low < 2 else None


def raw_values(leaf: Leaf, seen: Window) -> NDArray[Any]:
    """The raw values of a field for every value of its window: (256,) or (65536,)."""
    codes = np.arange(1 << (8 * seen.size)).astype(seen.dtype)
    frames = np.zeros((len(codes), leaf.size), np.uint8)
    start = seen.offset - leaf.offset
    frames[:, start : start + seen.size] = codes.view(np.uint8).reshape(len(codes), seen.size)
    single = Leaf(leaf.info, 0, (), (), leaf.size, leaf.wire, leaf.elements)
    return single.load(frames)


def shift_of(leaf: Leaf, seen: Window) -> tuple[int, int] | None:
    """By how much a window is shifted right, and what is masked then, to give the raw value of a field; None where that is not all."""
    raw = raw_values(leaf, seen).astype(np.int64)
    ones = np.flatnonzero(raw[1 << np.arange(8 * seen.size)] == 1)
    if not len(ones):
        return None
    shift, mask = int(ones[0]), int(raw[-1])
    return (shift, mask) if np.array_equal(np.arange(len(raw)) >> shift & mask, raw) else None


def every_value(node: Node, leaf: Leaf) -> NDArray[Any] | None:
    """An expression of one field for every value of the field's window, in its order; None where it has no window."""
    seen = window(leaf)
    if seen is None:
        return None
    raw = raw_values(leaf, seen).astype(np.float64)
    with np.errstate(all="ignore"):
        return np.broadcast_to(_evaluated(node, leaf.info.physical(raw)), raw.shape)


def possible(node: Node, leaves: Mapping[str, Leaf]) -> NDArray[Any] | None:
    """All values that an expression can have, whatever the bytes are; None where it is not of one field, or nobody knows."""
    source = only_field(node)
    leaf = leaves.get(source.path) if source is not None else None
    return every_value(node, leaf) if leaf is not None else None


def _evaluated(node: Node, values: NDArray[np.float64]) -> Any:
    """An expression of one field for given values of it."""
    if node.kind == "field":
        return values
    args = [_evaluated(arg, values) if isinstance(arg, Node) else np.asarray(arg).reshape(()) for arg in node.args]
    return node.function(*args)


class Blocks:
    """The innermost arrays of frames, without what stands between them, a chunk of packets at a time.

    Args:
        leaves: the fields wanted; all of the same arrays.
        size: of a frame in bytes.

    Attributes:
        is_flat: whether nothing stands between them, if the frames stand back to back, as they then have to.
        room: bytes that they take for each packet when they are compacted.
    """

    def __init__(self, leaves: list[Leaf], size: int) -> None:
        first = leaves[0]
        self.shape, strides = first.shape[: len(first.strides)], first.strides
        self.stride = strides[-1] if strides else size
        count = self.shape[-1] if self.shape else 1
        self.is_flat = self._regular(size, strides)
        self._length = count * self.stride
        self._base = 0 if self.is_flat else max(min(*(leaf.offset for leaf in leaves), size - self._length), 0)
        self._strides, self._size = strides[:-1], size
        self.room = 0 if self.is_flat else math.prod(self.shape[:-1]) * self._length

    def _regular(self, size: int, strides: tuple[int, ...]) -> bool:
        """Whether elements follow each other at one distance from frame to frame too."""
        expected = size
        for length, stride in zip(self.shape, strides, strict=True):
            if stride * length != expected:
                return False
            expected = stride
        return True

    def loading(self, rows: Bytes2D, room: NDArray[np.uint8]) -> Loading:
        """Their fields, compacted in this room."""
        if self.is_flat:
            return Loading(rows, None, 0, self._size, self.stride)
        block = np.dtype(f"V{self._length}")
        source = elements(rows, block, self._base, self.shape[:-1], self._strides)
        return Loading(source, room.view(block).reshape(-1, *self.shape[:-1]), self._base, 0, self.stride)

    def holds(self, seen: Window) -> bool:
        """Whether a window lies in the elements that are kept."""
        return self.is_flat or 0 <= seen.offset - self._base <= self.stride - seen.size


class Loading:
    """The fields of some frames, a chunk of packets at a time.

    Args:
        source: the frames, or their blocks.
        compact: what the blocks of a chunk are copied to; None where the frames are looked at themselves.
        base: where a block begins in its frame.
        size: bytes from packet to packet in the source, where that is looked at.
        stride: bytes from element to element.
    """

    def __init__(self, source: NDArray[Any], compact: NDArray[Any] | None, base: int, size: int, stride: int) -> None:
        self._source, self._compact, self._base, self._size, self._stride = source, compact, base, size, stride
        self._start = -1

    def column(self, seen: Window, start: int, stop: int, width: int) -> NDArray[Any]:
        """A window of each of `width` elements of the packets from `start` to `stop`."""
        if self._compact is None:
            return np.ndarray(((stop - start) * width,), seen.dtype, self._source.data, start * self._size + seen.offset, (self._stride,))
        if self._start != start:
            np.copyto(self._compact[: stop - start], self._source[start:stop])
            self._start = start
        return np.ndarray(((stop - start) * width,), seen.dtype, self._compact.data, seen.offset - self._base, (self._stride,))
