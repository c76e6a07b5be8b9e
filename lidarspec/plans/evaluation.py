"""Packets to points the fast way: by a plan where `points` can be traced, else by its plain evaluation.

What the columns of a cloud cost is paid when they are read. The values of a packet do not depend on the batch it is in.
"""

from __future__ import annotations

import math
import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.allocation import keep_freed_memory
from lidarspec.clouds import LazyCloud, PointCloud, axis_matrix, narrowed
from lidarspec.errors import SpecError
from lidarspec.frames.access import Fields
from lidarspec.frames.columns import Batch, Carry, Column
from lidarspec.frames.tables import Group, Rows
from lidarspec.frames.tracing import Node
from lidarspec.packets import Packets, install_points
from lidarspec.plans.kernels import Kernel, spread_out
from lidarspec.plans.plan import Plan, plan_for, tables_of, worth_compiling
from lidarspec.plans.program import Program
from lidarspec.points import Evaluated, evaluate, points_function

_MAIN = ("x", "y", "z", "intensity")


class Values:
    """The plain results of nodes for one batch, each computed once."""

    def __init__(self, plan: Plan, batch: Batch) -> None:
        self._fields = Fields(batch)
        self._columns: list[Any] = [None] * len(plan.tape.nodes)
        self._by_path: dict[str, Any] = {}

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
        return self.column(node).array

    def know(self, node: Node, column: Column) -> None:
        """Take a result as given."""
        self._columns[node.number] = column


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

        maker.run(self.group.rows[first:stop], values, found)
        if "x" in found and isinstance(maker, Program) and not self.plan.safe(values):
            made = [found[name] for name in "xyz" if name in found]
            bad = np.isnan(made).any(axis=0)
            for column in made:
                column[bad] = np.nan

    def plain(self, value: Any) -> NDArray[Any]:
        """A part of the result for every point of the group, evaluated plainly."""
        shape = (len(self.group.where), *self.plan.shape)
        array = self.values.array(value) if isinstance(value, Node) else np.asarray(value)
        if isinstance(value, Node):
            array = array.reshape(*array.shape, *(1,) * (len(shape) - array.ndim))
        return np.broadcast_to(array, shape)


class Points:
    """The columns of the points of a batch, made when they are asked for; what a `LazyCloud` reads from."""

    def __init__(self, packets: Packets, shares: list[Share], size: int, base: int) -> None:
        self._packets, self._shares, self.size, self._base = packets, shares, size, base
        self._function = points_function(packets.sensor, packets.frame)
        self._made: dict[str, NDArray[Any]] = {}
        axes = packets.sensor.vendor_axes if packets.sensor.options.get("frame") == "vendor" else None
        self._turn = None if axes is None else axis_matrix(axes)

    def column(self, name: str) -> NDArray[Any] | None:
        """A column of `PointCloud`; None where the sensor has none."""
        if name not in self._made:
            self._made |= self._columns(name)
        return self._made.get(name)

    def _columns(self, name: str) -> dict[str, NDArray[Any]]:
        parts = self._shares[0].plan.parts
        if name in _MAIN:
            return self._coordinates(name, parts)
        if name == "valid":
            x = self.column("x")
            assert x is not None
            return {"valid": ~np.isnan(x)}
        if name in ("range", "azimuth"):
            found = self._programmed(("range", "azimuth") if self._packets.backend == "jit" else (name,))
            return found | {"azimuth": self._azimuth(found["azimuth"])} if "azimuth" in found else found
        if name == "time":
            return {"time": self._joined([self._times(share) for share in self._shares], np.float64)}
        if name == "elevation":
            return {name: self._joined([share.plain(share.plan.parts[name]) for share in self._shares], np.float32)}
        types: dict[str, Any] = {"ring": np.uint16, "return_index": np.uint8}
        return (
            {name: self._joined([np.nan_to_num(share.plain(share.plan.parts[name])) for share in self._shares], types[name])}
            if name in parts
            else {}
        )

    def _coordinates(self, name: str, parts: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
        """The columns that are made together; where all points are level, the height only when it is asked for."""
        level = self._turn is None and all(share.plan.level for share in self._shares)
        if level and name == "z":
            x = self.column("x")
            assert x is not None
            return {"z": np.where(np.isnan(x), x, np.float32(0))}
        return self._turned(self._programmed(tuple(n for n in _MAIN if n in parts or (n in "xyz" and not (level and n == "z")))))

    def _azimuth(self, angles: NDArray[Any]) -> NDArray[np.float32]:
        """Azimuths in the axes that are asked for, narrowed where a kernel has not done so."""
        if self._turn is None and angles.dtype == np.float32:
            return angles
        if self._turn is not None:
            direction = self._turn[:2, :2] @ np.stack([np.cos(angles), np.sin(angles)])
            angles = np.arctan2(direction[1], direction[0])
        return narrowed(angles)

    def _turned(self, found: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Coordinates in the vendor's axes, where those are asked for; each is one of REP-103's, or its opposite."""
        if self._turn is None:
            return found
        made = dict(found)
        for name, row in zip("xyz", self._turn, strict=True):
            source = int(np.flatnonzero(row)[0])
            made[name] = found["xyz"[source]] * np.float32(row[source])
        return made

    def _times(self, share: Share) -> NDArray[np.float64]:
        offsets = (self._packets.time_ns[share.group.where] - self._base) * 1e-9
        return np.asarray(share.plain(share.plan.parts["time"]) + offsets.reshape(-1, *(1,) * len(share.plan.shape)))

    def time_at(self, index: int) -> float:
        """One value of the column "time"."""
        share = self._shares[0]
        if len(self._shares) > 1 or share.first is not None:
            found = self.column("time")
            assert found is not None
            return float(found[index])
        row, spot = divmod(index, share.plan.width)
        offset = (self._packets.time_ns[share.group.where[row]] - self._base) * 1e-9
        return float(share.plain(share.plan.parts["time"])[row].flat[spot] + offset)

    def _programmed(self, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
        found = [share.program(names, self._function, self._packets.backend) for share in self._shares]
        return {name: self._joined([part[name] for part in found], found[0][name].dtype) for name in names}

    def _joined(self, parts: list[NDArray[Any]], dtype: Any) -> NDArray[Any]:
        """The points of all layouts in stream order, those of packets that wait left out."""
        if len(parts) == 1 and self._shares[0].first is None:
            flat = parts[0].reshape(-1)[: self.size]
            return flat.astype(dtype, copy=False)
        found = np.empty(self.size, dtype)
        for share, part in zip(self._shares, parts, strict=True):
            assert share.first is not None
            spread_out(part.reshape(-1), share.first, share.plan.width, found, compiled=self._packets.backend == "jit")
        return found


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
        simple = alone and len(known) == 1 and _in_order(table.groups[0].where)
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
    if len(group.where) != len(packets) or not _in_order(group.where):
        state = {name: (frames, which[group.where]) for name, (frames, which) in batch.state.items()}
        table = Rows(batch.table.schema, [Group(group.layout, np.arange(len(group.where)), group.rows)])
        batch = Batch(table, batch.breaks[group.where], state, batch.defaults, nominal=batch.nominal)
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
    one = len(shares) == 1 and _in_order(shares[0].group.where)
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


def _in_order(where: NDArray[np.intp]) -> bool:
    return bool((where[1:] > where[:-1]).all())


def guarded(packets: Packets, carry: Carry | None = None, *, final: bool, epoch: int) -> Evaluated | None:
    """`evaluated` for streams, which raise on nothing: a failing plugin is counted and gives no points."""
    try:
        return evaluated(packets, carry, final=final, epoch=epoch)
    except SpecError:
        packets.stats.error(traceback.format_exc())
        return None


def _cloud(packets: Packets) -> PointCloud:
    found = _planned(packets, None, final=True, epoch=None, alone=True)
    return (found if found is not None else evaluate(packets)).cloud


keep_freed_memory()
install_points(_cloud)
