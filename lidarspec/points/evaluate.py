"""Packets to points: by plans where `points` can be traced, else by its plain evaluation.

What a batch is asked for at once is what later batches need: values that remember other packets,
and whether the plans hold. What the columns of its cloud cost is paid when they are read. The
values of a packet do not depend on the batch it is in.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import PluginError, SpecError
from lidarspec.expressions.columns import Batch, Carry, Column, Fields
from lidarspec.expressions.graph import Node
from lidarspec.frames.frame_table import Group, Rows, ascends
from lidarspec.points.batch_columns import BatchColumns
from lidarspec.points.cloud import LazyCloud, PointCloud
from lidarspec.points.conventions import Grids, grid_of
from lidarspec.points.plain import Evaluated, PacketBatch, evaluate_plainly, stamp_of
from lidarspec.points.plan import MODERATE, REMEMBERING, Plan, plan_for
from lidarspec.points.shares import PlainValues, Share

#: numbers that are looked at together, so that they stay in the cache.
_AT_ONCE = 1 << 15


def evaluate(
    packets: PacketBatch,
    carry: Carry | None = None,
    *,
    final: bool = True,
    epoch: int | None = None,
) -> Evaluated:
    """Return the points of a batch by the fastest applicable evaluation.

    The columns equal those of `evaluate_plainly` within a few units in the last place.

    Args:
        carry: what the batch before left.
        final: nothing follows; what depends on it becomes nan (by `following`), and no packet
            waits.
        epoch: the time that the cloud's stamp is, int64 ns; by default that of the first packet.

    Raises:
        PluginError: where the plugin's function fails or returns columns that do not fit; the cause
            is chained.
    """
    planned = _planned(packets, carry, final=final, epoch=epoch)
    if planned is not None:
        return planned
    return evaluate_plainly(packets, carry, final=final, epoch=epoch)


def _planned(
    packets: PacketBatch,
    carry: Carry | None,
    *,
    final: bool,
    epoch: int | None,
    alone: bool = False,
) -> Evaluated | None:
    """The points of a batch by plans; None where there is none for these packets.

    Args:
        alone: no batch follows that needs `Evaluated.carry`, and nobody asks for the counts.
    """
    table = packets.table
    if not isinstance(table, Rows) or not table.groups:
        return None
    batch = packets.batch(carry)
    function = packets.sensor.points_of(packets.frame)
    try:
        plans = [
            plan
            for group in table.groups
            if isinstance(plan := plan_for(function, batch, group), Plan)
        ]
    except Exception:
        return None  # the plain evaluation says what is wrong
    if len(plans) < len(table.groups):
        return None
    whole = PlainValues(batch)
    try:
        simple = alone and len(plans) == 1 and ascends(table.groups[0].where)
        remembered = {
            n.number: whole.column(n)
            for n in plans[0].eager
            if n.kind in (("state",) if simple else REMEMBERING)
        }
        shares = [
            _share(plan, batch, group, whole, remembered)
            for plan, group in zip(plans, table.groups, strict=True)
        ]
        if not all(_holds(share) for share in shares):
            return None
    except (SpecError, ValueError):
        return None
    if final:
        ready = len(packets)
    else:
        ready = min((column.ready for column in remembered.values()), default=len(packets))
    cloud = _cloud_of(packets, shares, batch, ready, stamp_of(packets, epoch))
    if alone:
        counts = np.empty(0, np.intp)
    else:
        counts = _counts(shares, len(packets))[:ready]
    return Evaluated(cloud, ready, batch.carried(ready), counts, Fields(batch), plans[0].axes)


def _share(
    plan: Plan, batch: Batch, group: Group, whole: PlainValues, remembered: Mapping[int, Column]
) -> Share:
    """A group with its plain results; those that remember other packets are of the whole batch."""
    is_whole = len(group.where) == len(batch) and ascends(group.where)
    if is_whole:
        return Share(plan, group, whole, batch)
    return Share.part(plan, batch, group, remembered)


def _holds(share: Share) -> bool:
    """Return whether a plan is valid for its packets.

    Their counts, and the values of factors and floating-point fields, are checked.
    """
    values = share.plain_values
    if any(len(values.column(node).steps()) != number for node, number in share.plan.tape.steps):
        return False
    lows = (values.array(node) for node in share.plan.positive)
    return all(bool(((low > 0) & np.isfinite(low)).all()) for low in lows) and all(
        _moderate(share, node) for node in share.plan.floats
    )


def _moderate(share: Share, node: Node) -> bool:
    """Return whether all numbers of a floating-point field are of moderate size.

    They are finite, and neither too small nor too large for float32.
    """
    leaf = share.plan.layout.leaves.get(node.path)
    if leaf is None:
        return False
    rows = share.group.rows
    step = max(_AT_ONCE // max(math.prod(leaf.shape), 1), 1)
    return all(
        _all_moderate(leaf.load(rows[start : start + step])) for start in range(0, len(rows), step)
    )


def _all_moderate(values: NDArray[Any]) -> bool:
    """Return whether floating-point numbers are all 0 or of moderate size.

    Without the sign, their bits are integers in the same order.
    """
    kind = np.dtype(f"u{values.dtype.itemsize}")
    least, most = np.clip(MODERATE, 0, np.finfo(values.dtype).max).astype(values.dtype).view(kind)
    sizes = values.view(kind) & np.array(np.iinfo(kind).max >> 1, kind)
    odd = sizes - least > most - least
    return not (odd.any() and sizes[odd].any())


def _cloud_of(
    packets: PacketBatch, shares: list[Share], batch: Batch, ready: int, stamp_ns: int
) -> LazyCloud:
    """The cloud of the first `ready` packets."""
    plan = shares[0].plan
    grids = None
    size = ready * plan.width
    if len(shares) > 1 or not ascends(shares[0].group.where):
        widths, which = np.zeros((2, len(packets)), np.intp)
        for number, share in enumerate(shares):
            widths[share.group.where], which[share.group.where] = share.plan.width, number
        grids = Grids(
            np.cumsum(widths),
            which,
            [grid_of(share.plan.shape, share.plan.axes) for share in shares],
        )
        starts = grids.ends - widths
        size = int(widths[:ready].sum())
        for share in shares:
            share.first = np.where(share.group.where < ready, starts[share.group.where], -1)
    return LazyCloud.of(
        BatchColumns(
            packets, shares, size, stamp_ns, grids=grids, nominal=batch.nominal or plan.nominal
        ),
        stamp_ns,
    )


def _counts(shares: list[Share], number: int) -> NDArray[Any]:
    """1 for each point, with the axes of the arrays, 0 in the padding of shorter ones."""
    if all(share.plan.shape == shares[0].plan.shape for share in shares):
        return np.broadcast_to(np.intp(1), (number, *shares[0].plan.shape))
    shape = tuple(
        max(lengths) for lengths in zip(*(share.plan.shape for share in shares), strict=True)
    )
    counts = np.zeros((number, *shape), np.bool_)
    for share in shares:
        corner: Any = (share.group.where, *(slice(0, length) for length in share.plan.shape))
        counts[corner] = 1
    return counts


def guarded(
    packets: PacketBatch, carry: Carry | None = None, *, final: bool, epoch: int
) -> Evaluated | None:
    """Return the points of a batch of a stream, None if the plugin fails.

    Failures are counted in the `Counters` of the packets.

    Args:
        carry: what the batch before left.
        final: nothing follows, so that no packet waits.
        epoch: the time that the cloud's stamp is, int64 ns.
    """
    try:
        points = evaluate(packets, carry, final=final, epoch=epoch)
    except SpecError as error:
        packets.stats.error(PluginError.of(error, f"points of {packets.frame}"), len(packets))
        return None
    packets.stats.nominal |= bool(points.cloud.nominal)
    return points


def cloud_of(packets: PacketBatch) -> PointCloud:
    """The points of packets that stand alone."""
    planned = _planned(packets, None, final=True, epoch=None, alone=True)
    return (planned if planned is not None else evaluate_plainly(packets)).cloud
