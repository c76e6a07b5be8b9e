"""Constants of frames: compared in words of up to eight bytes, for many frames at a time."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.frames.layout import Bytes2D, elements

#: constants: offset, mask, value.
Marks = tuple[tuple[int, int, int], ...]

#: some of them side by side: offset, type, mask (None: all bits), value.
Word = tuple[int, np.dtype[Any], Any, Any]


def marks(constants: Mapping[int, tuple[int, int]]) -> Marks:
    """Constants by offset, as mask and value: whole bytes first, which tell the most."""
    found = [(spot, mask, value) for spot, (mask, value) in constants.items()]
    return tuple(sorted(found, key=lambda mark: (mark[1] != 0xFF, mark[0])))


@lru_cache(maxsize=2048)
def words(constants: Marks) -> tuple[Word, ...]:
    """Constants as few words of 1, 2, 4 or 8 bytes, each from a byte with a constant to another."""
    left, found = {spot: (mask, value) for spot, mask, value in constants}, list[Word]()
    while left:
        first = min(left)
        size = next(size for size in (8, 4, 2, 1) if first + size - 1 in left)
        parts = [left.pop(spot, (0, 0)) for spot in range(first, first + size)]
        dtype = np.dtype(f"<u{size}")
        mask, value = (np.frombuffer(bytes(part), dtype)[0] for part in zip(*parts, strict=True))
        found.append((first, dtype, None if all(part[0] == 0xFF for part in parts) else mask, value))
    return tuple(found)


def exclude(some: Marks, others: Marks) -> bool:
    """Whether no frame has some constants and the others as well."""
    known = {spot: (mask, value) for spot, mask, value in others}
    both = [(mask & known[spot][0], value ^ known[spot][1]) for spot, mask, value in some if spot in known]
    return any(mask & differing for mask, differing in both)


def equal(found: NDArray[Any], word: Word) -> NDArray[np.bool_]:
    """Where the right constants stand, of what stands at their place."""
    _, _, mask, value = word
    return np.asarray((found if mask is None else found & mask) == value)


def right(constants: tuple[Word, ...], rows: Bytes2D) -> NDArray[np.bool_] | None:
    """Which rows have all constants; None where all have."""
    held: NDArray[np.bool_] | None = None
    for word in constants:
        spot, dtype, _, _ = word
        if spot + dtype.itemsize > rows.shape[1]:
            return np.zeros(len(rows), np.bool_)
        each = equal(elements(rows, dtype, spot, (), ()), word)
        number = np.count_nonzero(each)
        if number < len(rows):
            held = each if held is None else np.bitwise_and(held, each, out=held)
        if not number:
            break
    return held
