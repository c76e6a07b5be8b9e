"""Arrays that cost next to nothing, and the memory of arrays.

They hold one repeated value, consecutive numbers, or some rows of another array.
"""

from __future__ import annotations

import sys
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: numbers that `count_up` keeps.
COUNTED = 1 << 17
#: bytes; what is freed at the end of the heap is kept up to twice as much.
KEPT = 1 << 24


def repeat(value: int, *shape: int) -> NDArray[np.int64]:
    """Return an array of this shape that holds one value everywhere, read-only.

    It equals the result of `np.broadcast_to`, at a tenth of its cost.
    """
    memory = value.to_bytes(8, sys.byteorder, signed=True)
    return np.ndarray(shape, np.int64, memory, 0, (0,) * len(shape))


def select_values(
    values: NDArray[np.int64], which: NDArray[np.bool_] | NDArray[np.intp] | slice
) -> NDArray[np.int64]:
    """Return the values, (k,), that a mask, indices or a slice pick; equal ones stay `repeat`."""
    value = broadcast_value(values)
    if value is None or isinstance(which, slice):
        return values[which]
    return repeat(value, int(np.count_nonzero(which)) if which.dtype == np.bool_ else len(which))


def count_up(count: int) -> NDArray[np.int64]:
    """Return the numbers from 0 to `count` - 1, (count,), read-only.

    Small counts share the same memory.
    """
    if count <= COUNTED:
        return _numbers()[:count]
    return np.arange(count)


def is_counted(numbers: NDArray[np.int64]) -> bool:
    """Return whether numbers are known to ascend, because they are from `count_up`."""
    return numbers.base is _numbers() and numbers.strides[0] > 0


@lru_cache(maxsize=1)
def _numbers() -> NDArray[np.int64]:
    numbers = np.arange(COUNTED)
    numbers.setflags(write=False)
    return numbers


def broadcast_value(values: NDArray[np.int64]) -> int | None:
    """Return the value of a zero-stride array, as from `repeat`, else None."""
    if values.strides == (0,) and len(values):
        return values.item(0)
    return None


def group_by_value(values: NDArray[Any], few: int) -> list[tuple[int, NDArray[np.intp]]]:
    """Return each different value, ascending, with the indices of its occurrences.

    The indices are ascending, (k,).

    Args:
        few: so many different ones are found one by one sooner than sorted.
    """
    values_found = list[int]()
    left = values
    while len(left) and len(values_found) < few:
        values_found.append(left.item(0))
        left = left[left != left[0]]
    if not len(left):
        return [(value, np.flatnonzero(values == value)) for value in sorted(values_found)]
    order = np.argsort(values, kind="stable")
    ordered = values[order]
    edges = [0, *(np.flatnonzero(ordered[1:] != ordered[:-1]) + 1).tolist(), len(values)]
    return [(ordered.item(start), order[start:stop]) for start, stop in pairwise(edges)]


def take_rows(
    rows: NDArray[np.uint8], which: NDArray[np.intp] | NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """Return the rows of bytes that indices or a mask pick, (k, size), each copied as one piece."""
    whole = rows.view(f"V{rows.shape[1]}")[:, 0]
    if which.dtype != np.bool_ and rows.flags.c_contiguous:
        some = whole.take(which)
    else:
        some = whole[which]
    return some.view(np.uint8).reshape(-1, rows.shape[1])


@lru_cache(maxsize=1)
def keep_freed_memory() -> None:
    """Let the allocator keep freed blocks, up to 32 MiB.

    This applies from the first work on large batches on.

    The columns of a batch are blocks of some hundred kilobytes that live for milliseconds. glibc
    takes such blocks from the system and gives them back, page by page, and fetching the pages anew
    costs several times what computing the columns costs. It stops doing so for blocks smaller than
    the largest one that was ever freed, so one is: it is never touched, and takes no memory.

    Source: mallopt(3), M_MMAP_THRESHOLD: the threshold is adjusted dynamically, and
    M_TRIM_THRESHOLD to twice its value.
    """
    np.empty(KEPT, np.uint8)


def add_axes(array: NDArray[Any], depth: int) -> NDArray[Any]:
    """Return values of packets, (n, ...), with `depth` axes behind the first.

    Additional axes have length 1.
    """
    return array.reshape(*array.shape, *(1,) * (depth + 1 - array.ndim))
