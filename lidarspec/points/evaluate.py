"""Evaluate the points of packets by plans, or by the reference evaluator.

Plans are used if the `points` function can be traced. Columns are computed when they are first
read. The points of a packet do not depend on the batch that contains it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import PluginError, SpecError
from lidarspec.expressions.columns import Batch, Carry, Column
from lidarspec.expressions.graph import Node
from lidarspec.frames.arrays import repeat
from lidarspec.frames.frame_table import CompiledTable, LayoutRows
from lidarspec.points.batch_columns import BatchColumns
from lidarspec.points.conventions import Grids, make_grid
from lidarspec.points.layout_groups import LayoutGroup, ReferenceValues
from lidarspec.points.plan import MODERATE_SIZES, STATEFUL_KINDS, Plan, plan_for
from lidarspec.points.reference_evaluator import (
    EvaluatedPoints,
    PacketBatch,
    evaluate_plainly,
    find_stamp,
)

#: The number of floats that are checked together, so that they fit in the cache of the processor.
NUMBERS_CHECKED_TOGETHER = 1 << 15


def evaluate(
    packets: PacketBatch,
    carry: Carry | None = None,
    *,
    final: bool = True,
    stamp_ns: int | None = None,
) -> EvaluatedPoints:
    """Return the points of a batch, evaluated in the fastest possible way.

    Args:
        carry: the state left by the previous batch.
        final: whether no packets follow. If True, the result has the points of all packets.
        stamp_ns: the stamp of the cloud, int64 ns; by default the time of the first packet.

    Raises:
        PluginError: if the plugin's function fails or returns columns of a wrong shape.
    """
    planned = _evaluate_by_plans(packets, carry, final=final, stamp_ns=stamp_ns)
    if planned is not None:
        return planned
    return evaluate_plainly(packets, carry, final=final, stamp_ns=stamp_ns)


def _evaluate_by_plans(
    packets: PacketBatch, carry: Carry | None, *, final: bool, stamp_ns: int | None
) -> EvaluatedPoints | None:
    """Return the points of a batch, evaluated by plans; None without a valid plan."""
    table = packets.table
    if not isinstance(table, CompiledTable) or not table.groups:
        return None
    batch = packets.batch(carry)
    function = packets.sensor.points_of(packets.frame)
    plans = list[Plan]()
    try:
        for group in table.groups:
            plan = plan_for(function, batch, group)
            if not isinstance(plan, Plan):
                return None
            plans.append(plan)
    except Exception:
        return None  # the reference evaluator reports the error
    whole = ReferenceValues(batch)
    try:
        remembered = {
            node.number: whole.column(node)
            for node in plans[0].eager_nodes
            if node.kind in STATEFUL_KINDS
        }
        shares = [
            _make_group(plan, batch, group, whole, remembered)
            for plan, group in zip(plans, table.groups, strict=True)
        ]
        are_valid = all(_is_valid(share) for share in shares)
    except (SpecError, ValueError):
        return None
    if not are_valid:
        return None
    ready = len(packets)
    if not final:
        ready = min((column.ready for column in remembered.values()), default=ready)
    source = _make_source(packets, shares, batch, ready, find_stamp(packets, stamp_ns))
    counts = _mark_points(shares, len(packets))[:ready]
    return EvaluatedPoints(source, ready, counts, plans[0].axes, batch)


def _make_group(
    plan: Plan,
    batch: Batch,
    group: LayoutRows,
    whole: ReferenceValues,
    remembered: Mapping[int, Column],
) -> LayoutGroup:
    """Return the packets of one layout with their plan.

    Args:
        whole: the values of the whole batch.
        remembered: the values that depend on earlier packets, for the whole batch, by node number.
    """
    is_whole = len(group.where) == len(batch) and group.is_in_order
    if is_whole:
        return LayoutGroup(plan, group, whole, batch)
    return LayoutGroup.make(plan, batch, group, remembered)


def _is_valid(share: LayoutGroup) -> bool:
    """Return whether the plan of a group is valid for the packets of the group."""
    values = share.reference_values
    for node, number in share.plan.tape.steps:
        if len(values.column(node).steps()) != number:
            return False
    for node in share.plan.positive:
        factors = values.array(node)
        if not ((factors > 0) & np.isfinite(factors)).all():
            return False
    return all(_is_moderate(share, node) for node in share.plan.floats)


def _is_moderate(share: LayoutGroup, node: Node) -> bool:
    """Return whether all numbers of a field are suitable for computation in float32."""
    leaf = share.plan.layout.leaves.get(node.path)
    if leaf is None:
        return False
    rows = share.group.rows
    step = max(NUMBERS_CHECKED_TOGETHER // max(math.prod(leaf.shape), 1), 1)
    return all(
        _are_moderate(leaf.load(rows[start : start + step])) for start in range(0, len(rows), step)
    )


def _are_moderate(values: NDArray[Any]) -> bool:
    """Return whether all numbers are 0 or within `MODERATE_SIZES`."""
    # Without their sign bits, floats can be compared as integers, which is faster.
    kind = np.dtype(f"u{values.dtype.itemsize}")
    least, most = (
        np.clip(MODERATE_SIZES, 0, np.finfo(values.dtype).max).astype(values.dtype).view(kind)
    )
    sizes = values.view(kind) & np.array(np.iinfo(kind).max >> 1, kind)
    odd = sizes - least > most - least
    return not (odd.any() and sizes[odd].any())


def _make_source(
    packets: PacketBatch, shares: list[LayoutGroup], batch: Batch, ready: int, stamp_ns: int
) -> BatchColumns:
    """Return the columns of points for the first packets; `ready` is their number."""
    plan = shares[0].plan
    grids = None
    size = ready * plan.width
    if len(shares) > 1 or not shares[0].group.is_in_order:
        widths = np.zeros(len(packets), np.intp)
        which = np.zeros(len(packets), np.intp)
        for number, share in enumerate(shares):
            widths[share.group.where] = share.plan.width
            which[share.group.where] = number
        each = [make_grid(share.plan.shape, share.plan.axes) for share in shares]
        grids = Grids(np.cumsum(widths), which, each)
        starts = grids.ends - widths
        size = int(widths[:ready].sum())
        for share in shares:
            share.first = np.where(share.group.where < ready, starts[share.group.where], -1)
    nominal = batch.nominal or plan.nominal
    return BatchColumns(packets, shares, size, stamp_ns, grids=grids, nominal=nominal)


def _mark_points(shares: list[LayoutGroup], number: int) -> NDArray[Any]:
    """Return an array with 1 for each point and 0 for padding, (number, *lengths)."""
    if len(shares) == 1 or len({share.plan.shape for share in shares}) == 1:
        return repeat(1, number, *shares[0].plan.shape)
    shape = tuple(
        max(lengths) for lengths in zip(*(share.plan.shape for share in shares), strict=True)
    )
    counts = np.zeros((number, *shape), np.bool_)
    for share in shares:
        corner: Any = (share.group.where, *(slice(0, length) for length in share.plan.shape))
        counts[corner] = 1
    return counts


def evaluate_guarded(
    packets: PacketBatch, carry: Carry | None = None, *, final: bool, stamp_ns: int
) -> EvaluatedPoints | None:
    """Return the points of a batch of a stream; None if the plugin fails.

    Args:
        carry: the state left by the previous batch.
        final: whether no packets follow. If True, the points of all packets are returned.
        stamp_ns: the stamp of the cloud, int64 ns.
    """
    try:
        points = evaluate(packets, carry, final=final, stamp_ns=stamp_ns)
    except SpecError as error:
        packets.stats.count_error(PluginError.of(error, f"points of {packets.frame}"), len(packets))
        return None
    packets.stats.nominal |= bool(points.source.nominal)
    return points
