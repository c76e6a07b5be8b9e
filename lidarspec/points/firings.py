"""Group the returns of each firing, and choose one of them.

Returns with the same column and ring belong to one firing. Without columns, returns with the same
time and ring belong to one firing. A return may be missing, because it was not sent, or because its
packet is lost.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import UsageError
from lidarspec.frames.arrays import mark_changes
from lidarspec.points.cloud import PointCloud

#: A choice among the returns of each firing.
Returns = Literal["first", "last", "strongest", "all"]
RETURNS: tuple[Returns, ...] = ("first", "last", "strongest", "all")
#: The index of a return that is missing.
MISSING = -1
#: The ranks of invalid and of missing returns. The return with the lowest rank is chosen.
_INVALID_RANK = 1e30
_MISSING_RANK = 1e31


def group_firings(cloud: PointCloud) -> NDArray[np.intp]:
    """Return the indices of the returns of each firing, (firings, returns).

    Firings are in the order of their first points. The index of a missing return is `MISSING`.
    """
    count = len(cloud)
    if cloud.return_index is None or not count:
        return np.arange(count)[:, None]
    numbers = cloud.return_index.astype(np.intp)
    size = int(numbers.max()) + 1
    if count % size == 0 and (numbers.reshape(-1, size) == np.arange(size)).all():
        return np.arange(count).reshape(-1, size)  # adjacent returns
    cloud.load("column", "time", "ring")
    columns = cloud.time if cloud.column is None else cloud.column
    rings = np.zeros(count, np.uint16) if cloud.ring is None else cloud.ring
    occurrences = _count_occurrences(columns, rings, numbers)
    order = np.lexsort((occurrences, rings, columns))
    is_first = mark_changes(columns[order], rings[order], occurrences[order])
    firings = np.full((int(is_first.sum()), size), MISSING, np.intp)
    firings[np.cumsum(is_first) - 1, numbers[order]] = order
    first_points = np.where(firings == MISSING, count, firings).min(axis=1)
    return firings[np.argsort(first_points)]


def _count_occurrences(*keys: NDArray[Any]) -> NDArray[np.intp]:
    """Return how many earlier points have the same keys, (n,)."""
    order = np.lexsort(keys)  # stable
    starts = np.flatnonzero(mark_changes(*(key[order] for key in keys)))
    positions = np.arange(len(order))
    positions -= np.repeat(starts, np.diff(starts, append=len(order)))
    occurrences = np.empty(len(order), np.intp)
    occurrences[order] = positions
    return occurrences


def choose_returns(
    cloud: PointCloud, which: Returns, names: Sequence[str] = ()
) -> NDArray[np.intp]:
    """Return the index of the chosen return of each firing, (firings,).

    A firing without a valid return keeps its return with the lowest index.

    Args:
        which: "first", "last" or "strongest". The strongest return has the highest intensity.
        names: the names of the returns, by return index (`Sensor.returns`). If a return has the
            name `which`, this return is chosen.

    Raises:
        UsageError: for "strongest" if there is neither an intensity nor a return of this name.
    """
    # If returns have other names, the first return is the nearest one. Without names, the order is
    # that of the return indices.
    firings = group_firings(cloud)
    is_missing = firings == MISSING
    if which == "strongest" and cloud.intensity is not None:
        ranks = -cloud.intensity[firings]
    elif which in names:
        ranks = np.where(np.arange(firings.shape[1]) == names.index(which), 0.0, 1.0)
        ranks = np.broadcast_to(ranks, firings.shape)
    elif which == "strongest":
        raise UsageError("the strongest return is unknown: the points have no intensity")
    else:
        ranks = np.broadcast_to(np.arange(firings.shape[1]), firings.shape)
        if names:
            ranks = cloud.range[firings]
        if which == "last":
            ranks = -ranks
    ranks = np.where(cloud.valid[firings], ranks, _INVALID_RANK)
    ranks = np.where(is_missing, _MISSING_RANK, ranks)
    chosen = np.argmin(ranks, axis=1)
    indices: NDArray[np.intp] = firings[np.arange(len(firings)), chosen]
    return indices


def take_returns(cloud: PointCloud, indices: NDArray[np.intp]) -> PointCloud:
    """Return the points at `indices`, which select one return of each firing."""
    picked = cloud[indices]
    if cloud.shape is None or picked.ring is None:
        return picked
    rows = cloud.shape[1]
    if len(picked) % rows or (picked.ring.reshape(-1, rows) != picked.ring[:rows]).any():
        return picked
    return replace(picked, shape=(len(picked) // rows, rows))
