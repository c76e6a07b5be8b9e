"""Find the returns of each firing, in consecutive packets or in one packet.

Some sensors send each return of their firings in a packet of its own (`PacketCounter.returns`).
These packets form a group with consecutive counters. A group is incomplete if one of its packets is
lost.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.expressions.columns import Batch
from lidarspec.expressions.graph import header_function
from lidarspec.framing.results import Counters
from lidarspec.points.cloud import PointCloud
from lidarspec.points.evaluate import evaluate
from lidarspec.points.firings import MISSING, group_firings
from lidarspec.points.reference_evaluator import PacketBatch
from lidarspec.spec.timing import PacketCounter

#: The number of packets after which a group no longer waits for a late packet.
MAX_PLACES_LATE = 64


def read_groups(
    rule: PacketCounter, batch: Batch, index: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return each packet's group, its position in the group, and the group's size.

    Each result has the shape (n,). The number of a group is the index of its first packet.

    Args:
        index: the index of each packet, (n,).
    """
    sizes = np.ones(len(batch), np.int64)
    if callable(rule.returns):
        (values,) = header_function(rule.returns, batch.table.schema, _to_sizes)(batch)
        sizes = np.broadcast_to(np.maximum(values, 1), (len(batch),))
    else:
        sizes *= rule.returns
    numbers = batch.table.raw(rule.field).astype(np.int64)
    places = (numbers - rule.first) % sizes
    return index - places, places, sizes


def _to_sizes(values: Any, count: int) -> NDArray[np.int64]:
    sizes = np.asarray(values, np.float64).reshape(-1).astype(np.int64)
    if len(sizes) == 1:
        return sizes
    return np.broadcast_to(sizes, (count,))


def describe_incomplete_groups(count: int) -> str:
    """Return a sentence that states the number of incomplete groups."""
    if count == 1:
        return "1 group of packets lacks a return, because packets were lost"
    return f"{count} groups of packets lack a return, because packets were lost"


class GroupCounter:
    """Counts the incomplete groups of packets.

    Args:
        rule: the declaration of the counter that numbers the packets.
        stats: the statistics; the incomplete groups are added to `incomplete_returns`.
    """

    def __init__(self, rule: PacketCounter, stats: Counters) -> None:
        self._rule = rule
        self._stats = stats
        self._first: int | None = None  # the lowest index of the stream
        self._newest = 0
        self._seen = dict[int, set[int]]()  # places seen of each incomplete group
        self._ends = dict[int, int]()  # the last index of each of these groups
        self._counted = set[int]()  # those of them that are counted

    def push(self, batch: Batch, index: NDArray[np.int64]) -> None:
        """Add packets, and count the groups that turn out to be incomplete."""
        if not len(batch):
            return
        groups, places, sizes = read_groups(self._rule, batch, index)
        if self._first is None:
            self._first = int(index.min())
        self._newest = max(self._newest, int(index.max()))
        if int(sizes.max()) > 1:
            for row in _find_incomplete(groups, places, sizes).tolist():
                self._add(int(groups[row]), int(places[row]), int(sizes[row]))
        self._count_ended()

    def _add(self, group: int, place: int, size: int) -> None:
        """Add a packet to its group, and forget the group if it is complete now."""
        assert self._first is not None
        if group < self._first:
            return  # the stream began within the group
        places = self._seen.setdefault(group, set())
        places.add(place)
        self._ends[group] = group + size - 1
        if len(places) == size:
            if group in self._counted:
                self._stats.incomplete_returns -= 1
            self._forget(group)

    def _count_ended(self) -> None:
        """Count the groups that have ended, and are incomplete."""
        for group, end in list(self._ends.items()):
            if end <= self._newest and group not in self._counted:
                self._stats.incomplete_returns += 1
                self._counted.add(group)
            if end < self._newest - MAX_PLACES_LATE:
                self._forget(group)

    def _forget(self, group: int) -> None:
        del self._seen[group]
        del self._ends[group]
        self._counted.discard(group)


def _find_incomplete(
    groups: NDArray[np.int64], places: NDArray[np.int64], sizes: NDArray[np.int64]
) -> NDArray[np.intp]:
    """Return the rows of packets whose groups are incomplete in a batch, (k,)."""
    _, first_rows = np.unique(groups * int(sizes.max()) + places, return_index=True)
    _, numbers, counts = np.unique(groups[first_rows], return_inverse=True, return_counts=True)
    is_incomplete = counts[numbers.reshape(-1)] < sizes[first_rows]
    rows: NDArray[np.intp] = first_rows[is_incomplete]
    return rows


def arrange_returns(packets: PacketBatch, index: NDArray[np.int64]) -> NDArray[Any]:
    """Return the points of packets, with the returns of a firing along the last axis."""
    points = evaluate(packets)
    cloud = points.cloud
    shape = points.counts.shape[1:]
    is_regular = bool(points.counts.all())
    rule = packets.sensor.sequence
    indices: NDArray[np.intp] | None = None
    if is_regular and rule is not None and rule.returns != 1:
        members = read_groups(rule, packets.batch(), index)
        if cloud.return_index is not None:
            numbers = cloud.return_index.reshape(len(packets), -1)
            members = _place_by_return_index(members, numbers)
        indices = _index_points_by_group(members, shape)
    elif is_regular and cloud.return_index is not None:
        indices = _split_axis(cloud.return_index.reshape(len(packets), *shape))
    if indices is None:
        indices = group_firings(cloud)
    return _gather(cloud, indices)


def _place_by_return_index(
    members: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]],
    numbers: NDArray[np.uint8],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return `members`, with each position replaced by the packet's return index.

    Args:
        members: for each packet, its group, its position in the group, and the size of the group,
            (n,).
        numbers: the return index of the points of each packet, (n, points).
    """
    # If return indices occur twice in a group, its positions are kept.
    groups, places, sizes = members
    if not numbers.size:
        return members
    own = numbers[:, 0].astype(np.int64)
    is_place = (numbers == own[:, None]).all(axis=1) & (own < sizes)
    rows = np.flatnonzero(is_place)
    keys = groups[rows] * int(sizes.max()) + own[rows]
    _, numbers_of_keys, counts = np.unique(keys, return_inverse=True, return_counts=True)
    is_place[rows] = counts[numbers_of_keys.reshape(-1)] == 1
    is_kept = np.isin(groups, groups[~is_place])
    return groups, np.where(is_kept, places, own), sizes


def _index_points_by_group(
    members: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]],
    shape: tuple[int, ...],
) -> NDArray[np.intp]:
    """Return the index of each point, arranged by groups: (groups, *shape, returns).

    An index counts the points of all packets; `MISSING` stands for a lost packet.

    Args:
        members: for each packet, its group, its position in the group, and the size of the group,
            (n,).
        shape: the shape of the points of each packet.
    """
    groups, places, sizes = members
    size = int(sizes.max(initial=1))
    _, numbers = np.unique(groups, return_inverse=True)
    rows = np.full((int(numbers.max(initial=-1)) + 1, size), MISSING, np.intp)
    rows[numbers.reshape(-1), places] = np.arange(len(groups))
    width = int(np.prod(shape))
    inside = np.arange(width).reshape(shape)
    rows = rows.reshape(len(rows), *(1,) * len(shape), size)
    return np.where(rows == MISSING, MISSING, rows * width + inside[..., None])


def _split_axis(numbers: NDArray[Any]) -> NDArray[np.intp] | None:
    """Return the indices of points, arranged by firings: (n, *firings, returns)."""
    # The result is None if the packets do not have all returns at the same places.
    if not len(numbers) or (numbers != numbers[0]).any():
        return None
    first = numbers[0]
    size = int(first.max()) + 1
    places = [np.flatnonzero(first == number) for number in range(size)]
    if len({len(place) for place in places}) > 1:
        return None
    varying = [axis for axis in range(first.ndim) if np.diff(first, axis=axis).any()]
    if len(varying) > 1:
        return None
    shape = list(first.shape)
    for axis in varying:
        shape[axis] //= size
        if shape[axis] == 1:
            del shape[axis]
    rows = np.arange(len(numbers)).reshape(-1, *(1,) * len(shape), 1)
    inside = np.stack(places, axis=-1).reshape(*shape, size)
    indices: NDArray[np.intp] = rows * first.size + inside
    return indices


def _gather(cloud: PointCloud, indices: NDArray[np.intp]) -> NDArray[Any]:
    """Return a structured array of the points at some indices."""
    columns = {**cloud.columns, "valid": cloud.valid}
    is_missing = indices == MISSING
    kinds = [(name, column.dtype) for name, column in columns.items()]
    gathered = np.zeros(indices.shape, [*kinds, ("missing", np.bool_)])
    if len(cloud):
        for name, column in columns.items():
            gathered[name] = column[indices]
            if column.dtype.kind == "f":
                gathered[name][is_missing] = np.nan
            else:
                gathered[name][is_missing] = 0
    gathered["missing"] = is_missing
    return gathered
