"""Arrays that cost next to nothing: of one value repeated, of consecutive numbers, and some of the rows of another."""

from __future__ import annotations

import sys
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

#: numbers that `counted` keeps.
COUNTED = 1 << 17


def repeated(value: int, count: int) -> NDArray[np.int64]:
    """The same value so many times, (count,), read-only; as `np.broadcast_to`, at a tenth of its cost."""
    return np.ndarray((count,), np.int64, value.to_bytes(8, sys.byteorder, signed=True), 0, (0,))


def some(values: NDArray[np.int64], which: NDArray[np.bool_] | NDArray[np.intp] | slice) -> NDArray[np.int64]:
    """Some of the values, by mask, indices or slice; of equal ones as `repeated` has them."""
    value = alike(values)
    if value is None or isinstance(which, slice):
        return values[which]
    return repeated(value, int(np.count_nonzero(which)) if which.dtype == np.bool_ else len(which))


def counted(count: int) -> NDArray[np.int64]:
    """0, 1, 2 ... as many numbers as asked for, (count,), read-only; in the same memory each time, unless they are very many."""
    return _numbers()[:count] if count <= COUNTED else np.arange(count)


def is_counted(numbers: NDArray[np.int64]) -> bool:
    """Whether numbers are known to ascend, because they are from `counted`."""
    return numbers.base is _numbers() and numbers.strides[0] > 0


@lru_cache(maxsize=1)
def _numbers() -> NDArray[np.int64]:
    found = np.arange(COUNTED)
    found.setflags(write=False)
    return found


def alike(values: NDArray[np.int64]) -> int | None:
    """The value that all are, where the array itself says so, as one from `repeated` does; else None."""
    return values.item(0) if values.strides == (0,) and len(values) else None


def taken(rows: NDArray[np.uint8], which: NDArray[np.intp] | NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Some of the rows of bytes, by index or mask, (k, size), each copied as one piece."""
    whole = rows.view(f"V{rows.shape[1]}")[:, 0]
    some = whole.take(which) if which.dtype != np.bool_ and rows.flags.c_contiguous else whole[which]
    return some.view(np.uint8).reshape(-1, rows.shape[1])
