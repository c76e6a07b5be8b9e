"""Packets to points the fast way: by a plan where `points` can be traced, else by its plain evaluation.

What the columns of a cloud cost is paid when they are read. The values of a packet do not depend on the batch it is in.
"""

from __future__ import annotations

import math
import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.columns.columns import Batch, Carry, Column, Fields, called, field_array
from lidarspec.columns.graph import Node
from lidarspec.errors import SpecError
from lidarspec.packets.packets import Packets
from lidarspec.points.cloud import LazyCloud, PointCloud
from lidarspec.points.lazy_columns import Points
from lidarspec.points.numba_kernels.kernels import Kernel
from lidarspec.points.numpy_plan.program import Program
from lidarspec.points.plain import Evaluated, evaluate, points_function
from lidarspec.points.plan import Plan, plan_for, tables_of, worth_compiling
from lidarspec.wire.arrays import keep_freed_memory
from lidarspec.wire.frame_table import Group, Rows, ascends


class Values:
    """The plain results of nodes for one batch, each computed once."""

    def __init__(self, plan: Plan, batch: Batch) -> None:
        self._fields = Fields(batch)
        self._columns: list[Any] = [None] * len(plan.tape.nodes)
        self._by_path: dict[str, Any] = {}
        self._table = batch.table
        self._arrays: dict[Node | str, NDArray[Any]] = {}

    def column(self, node: Node) -> Column:
        """The result of a node."""
        if self._columns[node.number] is None and node.path in self._by_path:
            self._columns[node.number] = self._by_path[node.path]
        if self._columns[node.number] is None:
            for arg in node.args:
                if isinstance(arg, Node):
                    self.column(arg)
            with np.errstate(all="ignore"):
                self._columns[node.number] = node.column(self._columns, self._fields)
            if node.path:
                self._by_path[node.path] = self._columns[node.number]
        return self._columns[node.number]  # type: ignore[no-any-return]

    def array(self, node: Node) -> NDArray[Any]:
        """The array of a node's result, (n or 1, ...)."""
        column = self._columns[node.number]
        if column is not None:
            return column.array  # type: ignore[no-any-return]
        if node not in self._arrays:
            with np.errstate(all="ignore"):
                self._arrays[node] = self._array(node)
        return self._arrays[node]

    def _array(self, node: Node) -> NDArray[Any]:
        """The same as of its column, where no axes have to be named."""
        column = self._columns[node.number]
        column = self._by_path.get(node.path) if column is None else column
        if column is not None or node.kind not in ("field", "call"):
            return self.column(node).array
        known = self._arrays.get(node.path or node)
        if known is not None:
            return known
        if node.kind == "field":
            found = field_array(self._table.schema.fields[node.path], self._table, self._table.schema.depth())
        else:
            args = [value if arg is None else _deeper(self._array(arg), value) for arg, value in node.operands]
            found = called(node.function, args)
        self._arrays[node.path or node] = found
        return found

    def know(self, node: Node, column: Column) -> None:
        """Take a result as given."""
        self._columns[node.number] = column


def _deeper(array: NDArray[Any], axes: tuple[int, ...]) -> NDArray[Any]:
    return array.reshape(*array.shape, *axes) if axes else array


@dataclass(eq=False)
class Share:
    """The packets of one layout in a batch: their plan, the plain results, and where the first point of each goes, -1 for nowhere."""

    plan: Plan
    group: Group
    values: Values
    batch: Batch
    first: NDArray[np.intp] | None = None

    def program(self, names: tuple[str, ...], function: Any, backend: str) -> dict[str, NDArray[Any]]:
        """Columns made by a kernel or a program, for every packet of the group."""
        made = self.maker(names, function, backend, len(self.group.where))
        found = made.columns(len(self.group.where))
        self.fill(made, found, 0, len(self.group.where))
        return found

    def maker(self, names: tuple[str, ...], function: Any, backend: str, number: int) -> Program | Kernel:
        """What makes columns of so many packets: a kernel or a program."""
        if backend == "jit" or (backend == "auto" and worth_compiling(function, names, self.plan, number)):
            return self.plan.kernel(names, function)
        return self.plan.program(names, tables_of(function))

    def fill(self, maker: Program | Kernel, found: Mapping[str, NDArray[Any]], first: int, stop: int) -> None:
        """Fill the columns of some of the packets."""

        def values(node: Node) -> NDArray[Any]:
            array = self.values.array(node)
            return array[first:stop] if len(array) > 1 else array

        if stop - first == len(self.group.where):
            maker.run(self.group.rows, self.values.array, found)
        else:
            maker.run(self.group.rows[first:stop], values, found)
        if "x" in found and isinstance(maker, Program) and not self.is_safe and not self.plan.safe(values):
            made = [found[name] for name in "xyz" if name in found]
            bad = np.isnan(made).any(axis=0)
            for column in made:
                column[bad] = np.nan

    @cached_property
    def is_safe(self) -> bool:
        """Whether a nan marks all coordinates of a point alike; see `Plan.safe`."""
        return self.plan.safe(self.values.array)

    def plain(self, value: Any) -> NDArray[Any]:
        """A part of the result for every point of the group, evaluated plainly."""
        shape = (len(self.group.where), *self.plan.shape)
        array = self.values.array(value) if isinstance(value, Node) else np.asarray(value)
        if isinstance(value, Node):
            array = array.reshape(*array.shape, *(1,) * (len(shape) - array.ndim))
        return np.broadcast_to(array, shape)

    def some(self, which: NDArray[np.intp]) -> Share:
        """The same for some of the packets, by index."""
        batch = _picked(self.batch, Group(self.group.layout, which, self.group.rows[which]))
        values = Values(self.plan, batch)
        for node in self.plan.eager:
            if node.kind in ("shift", "latest", "state"):
                column = self.values.column(node)
                values.know(node, Column(column.array[which] if len(column.array) > 1 else column.array, column.axes, batch))
        return Share(self.plan, Group(self.group.layout, np.arange(len(which)), self.group.rows[:0]), values, batch)


def _picked(batch: Batch, group: Group) -> Batch:
    """The packets of a group, in its order, as a batch of their own."""
    state = {name: (frames, which[group.where]) for name, (frames, which) in batch.state.items()}
    table = Rows(batch.table.schema, [Group(group.layout, np.arange(len(group.where)), group.rows)])
    return Batch(table, batch.breaks[group.where], state, batch.defaults, nominal=batch.nominal)


def evaluated(packets: Packets, carry: Carry | None = None, *, final: bool = True, epoch: int | None = None) -> Evaluated:
    """The points of a batch; arguments, errors and result as of `points.evaluate`, its columns within a few units in the last place."""
    found = _planned(packets, carry, final=final, epoch=epoch)
    return found if found is not None else evaluate(packets, carry, final=final, epoch=epoch)


def _planned(packets: Packets, carry: Carry | None, *, final: bool, epoch: int | None, alone: bool = False) -> Evaluated | None:
    """The same by plans; None where there is none for these packets; `alone`: no batch follows that needs `Evaluated.carry`."""
    table = packets.table
    if not isinstance(table, Rows) or not table.groups:
        return None
    batch = packets.batch(carry)
    function = points_function(packets.sensor, packets.frame)
    try:
        plans = [plan_for(function, batch, group) for group in table.groups]
    except Exception:
        return None  # the plain evaluation says what is wrong
    if not all(isinstance(plan, Plan) for plan in plans):
        return None
    known: list[Plan] = [plan for plan in plans if isinstance(plan, Plan)]
    first, fields = Values(known[0], batch), Fields(batch)
    try:
        simple = alone and len(known) == 1 and ascends(table.groups[0].where)
        remembering = _remembered(known[0], first, ("state",) if simple else ("shift", "latest", "state"))
        shares = [_share(packets, batch, plan, group, first, remembering) for plan, group in zip(known, table.groups, strict=True)]
    except (SpecError, ValueError):
        return None
    if any(share is None for share in shares):
        return None
    ready = len(packets) if final else min((column.ready for column in remembering.values()), default=len(packets))
    base = epoch if epoch is not None else int(packets.time_ns[0]) if len(packets) else 0
    cloud, axes = _laid_out(packets, [share for share in shares if share is not None], batch, ready, base)
    counts = np.empty(0, np.intp) if alone else _counts([share for share in shares if share is not None], len(packets))[:ready]
    return Evaluated(cloud, ready, batch.carried(ready), counts, fields, axes)


def _remembered(plan: Plan, values: Values, kinds: tuple[str, ...]) -> dict[int, Column]:
    """The results that depend on other packets, of the whole batch, in the order in which `points` asks for them."""
    return {node.number: values.column(node) for node in plan.eager if node.kind in kinds}


def _share(packets: Packets, batch: Batch, plan: Plan, group: Group, whole: Values, remembered: dict[int, Column]) -> Share | None:
    """A group with its plain results; None where the plan was made for other counts, or a factor is not positive."""
    values = whole
    if len(group.where) != len(packets) or not ascends(group.where):
        batch = _picked(batch, group)
        values = Values(plan, batch)
        for number, column in remembered.items():
            node = plan.tape.nodes[number]
            corner: Any = (slice(None), *(slice(0, length) for length in node.shape))
            array = column.array[group.where] if len(column.array) > 1 else column.array
            values.know(node, Column(array[corner], node.sample.axes, batch))
    for node, number in plan.tape.steps:
        if len(values.column(node).steps()) != number:
            return None
    for node in plan.positive:
        low = values.array(node)
        if not ((low > 0) & np.isfinite(low)).all():
            return None
    return Share(plan, group, values, batch)


def _laid_out(packets: Packets, shares: list[Share], batch: Batch, ready: int, base: int) -> tuple[LazyCloud, tuple[str | None, ...]]:
    """The cloud of the first `ready` packets, and the axes of its points."""
    one = len(shares) == 1 and ascends(shares[0].group.where)
    plan = shares[0].plan
    size = ready * plan.width
    if not one:
        widths = np.zeros(len(packets), np.intp)
        for share in shares:
            widths[share.group.where] = share.plan.width
        starts = np.cumsum(widths) - widths
        size = int(widths[:ready].sum())
        for share in shares:
            share.first = np.where(share.group.where < ready, starts[share.group.where], -1)
    same = all(share.plan.shape == plan.shape for share in shares)
    organised = same and len(plan.shape) >= 2 and plan.shape[-1] > 1
    cloud = LazyCloud.of(
        Points(packets, shares, size, base),
        stamp_ns=base,
        shape=(ready * math.prod(plan.shape[:-1]), plan.shape[-1]) if organised else None,
        nominal=np.bool_(batch.nominal or plan.result.nominal),
    )
    return cloud, plan.axes


def _counts(shares: list[Share], number: int) -> NDArray[Any]:
    """1 for each point, with the axes of the arrays, 0 in the padding of shorter ones."""
    if all(share.plan.shape == shares[0].plan.shape for share in shares):
        return np.broadcast_to(np.intp(1), (number, *shares[0].plan.shape))
    shape = tuple(max(lengths) for lengths in zip(*(share.plan.shape for share in shares), strict=True))
    found = np.zeros((number, *shape), np.bool_)
    for share in shares:
        corner: Any = (share.group.where, *(slice(0, length) for length in share.plan.shape))
        found[corner] = 1
    return found


def guarded(packets: Packets, carry: Carry | None = None, *, final: bool, epoch: int) -> Evaluated | None:
    """`evaluated` for streams, which raise on nothing: a failing plugin is counted and gives no points."""
    try:
        return evaluated(packets, carry, final=final, epoch=epoch)
    except SpecError:
        packets.stats.error(traceback.format_exc())
        return None


def cloud_of(packets: Packets) -> PointCloud:
    found = _planned(packets, None, final=True, epoch=None, alone=True)
    return (found if found is not None else evaluate(packets)).cloud


keep_freed_memory()
