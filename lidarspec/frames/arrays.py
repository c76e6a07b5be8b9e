"""Functions that make simple arrays quickly, find equal values, and set the memory allocator."""

from __future__ import annotations

import sys
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: The length of an array of which `count_up` returns slices.
MAX_SHARED_COUNT = 1 << 17
#: The size in bytes of the block that `keep_freed_memory` allocates. glibc then keeps up to twice
#: this size of free memory at the end of the heap.
LARGE_BLOCK_BYTES = 1 << 24


def repeat(value: int, *shape: int) -> NDArray[np.int64]:
    """Return a read-only array of the shape `shape` with one value everywhere."""
    memory = value.to_bytes(8, sys.byteorder, signed=True)
    return np.ndarray(shape, np.int64, memory, 0, (0,) * len(shape))


def select_values(
    values: NDArray[np.int64], which: NDArray[np.bool_] | NDArray[np.intp] | slice
) -> NDArray[np.int64]:
    """Return the values that a mask, indices or a slice select, (k,)."""
    value = broadcast_value(values)
    if value is None or isinstance(which, slice):
        return values[which]
    return repeat(value, int(np.count_nonzero(which)) if which.dtype == np.bool_ else len(which))


def count_up(count: int) -> NDArray[np.int64]:
    """Return the numbers from 0 to `count` - 1, (count,), read-only."""
    if count <= MAX_SHARED_COUNT:
        return _shared_numbers()[:count]
    return np.arange(count)


def is_count_up(numbers: NDArray[np.int64]) -> bool:
    """Return whether an array was made by `count_up`, so that its values ascend.

    An array of more than `MAX_SHARED_COUNT` numbers is not recognized.
    """
    return numbers.base is _shared_numbers() and numbers.strides[0] > 0


@lru_cache(maxsize=1)
def _shared_numbers() -> NDArray[np.int64]:
    numbers = np.arange(MAX_SHARED_COUNT)
    numbers.setflags(write=False)
    return numbers


def broadcast_value(values: NDArray[np.int64]) -> int | None:
    """Return the value that a zero-stride array repeats; None for all other arrays."""
    if values.strides == (0,) and len(values):
        return values.item(0)
    return None


def group_by_value(values: NDArray[Any], few: int) -> list[tuple[int, NDArray[np.intp]]]:
    """Return the distinct values, ascending, each with the indices at which it occurs.

    Args:
        few: the number of distinct values up to which searching is faster than sorting.
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
    return [(ordered.item(run.start), order[run]) for run in split_runs(ordered)]


def mark_changes(*columns: NDArray[Any]) -> NDArray[np.bool_]:
    """Return a mask of the rows in which a column differs from the row before, (n,).

    The first row counts as different.

    Args:
        columns: arrays of the same length, (n,).
    """
    is_changed = np.zeros(len(columns[0]), np.bool_)
    is_changed[:1] = True
    for column in columns:
        is_changed[1:] |= column[1:] != column[:-1]
    return is_changed


def split_runs(*columns: NDArray[Any]) -> list[slice]:
    """Return the slices of consecutive rows in which no column changes.

    Args:
        columns: arrays of the same length, (n,).
    """
    bounds = [*np.flatnonzero(mark_changes(*columns)).tolist(), len(columns[0])]
    return [slice(start, stop) for start, stop in pairwise(bounds)]


def take_rows(
    rows: NDArray[np.uint8], which: NDArray[np.intp] | NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """Return copies of the rows of bytes that indices or a mask select, (k, size)."""
    whole = rows.view(f"V{rows.shape[1]}")[:, 0]
    if which.dtype != np.bool_ and rows.flags.c_contiguous:
        some = whole.take(which)
    else:
        some = whole[which]
    return some.view(np.uint8).reshape(-1, rows.shape[1])


@lru_cache(maxsize=1)
def keep_freed_memory() -> None:
    """Make the allocator keep up to 32 MiB of freed memory for the next arrays.

    Source: mallopt(3), M_MMAP_THRESHOLD.
    """
    # By default, glibc requests each column of a batch from the system, and the page faults take
    # several times as long as computing the column. glibc keeps blocks that are smaller than the
    # largest block that was ever freed. This block is never written, so it takes no memory.
    np.empty(LARGE_BLOCK_BYTES, np.uint8)


def add_axes(array: NDArray[Any], depth: int) -> NDArray[Any]:
    """Append axes of length 1 until the array has `depth` axes after the first."""
    return array.reshape(*array.shape, *(1,) * (depth + 1 - array.ndim))
