"""The columns of planned points, computed when they are first read.

They belong to a batch, or to a scan over several batches.

`Share` is the packets of one layout in a batch: their plan, and what is known of them plainly
(`Plain`). It has its columns made by what a back end compiles from the plan: `points.numpy_plan`,
or `points.numba_kernels` where that is asked for or pays.

`BatchColumns` is the source of a batch. A column is made for all its points at once, and slices
share it. Scans are stretches of batches (`cloud.Stretches`): small ones share the columns of a
block of points around them, large ones have theirs made for the packets that they are of and no
others, straight into arrays of their own, also where these packets are of several batches
(`Computed`).
"""

from __future__ import annotations

import bisect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from lidarspec.expressions.columns import Batch, Column, Fields, field_array
from lidarspec.expressions.graph import Node, evaluate
from lidarspec.frames.arrays import deep
from lidarspec.frames.frame_table import Group
from lidarspec.points import numpy_plan
from lidarspec.points.cloud import ColumnSource, Stretch, later
from lidarspec.points.conventions import (
    TYPES,
    Grids,
    grid_of,
    narrowed,
    numbers_of,
    seconds_since,
    turned_azimuth,
    vendor_turn,
)
from lidarspec.points.plain import PacketBatch
from lidarspec.points.plan import REMEMBERING, Maker, Plan

_MAIN = ("x", "y", "z", "intensity")

#: points of a scan from which on its columns are made for itself; smaller ones share those of so
#: many points.
LEAST = 1 << 14
SHARED = 1 << 16
#: bytes of a whole number that float64 holds exactly.
EXACT = 4


class Plain:
    """The plain results of nodes for one batch, each computed once.

    Results are columns if axes have to be named, else arrays.
    """

    def __init__(self, batch: Batch) -> None:
        self._fields = Fields(batch)
        self._table = batch.table
        self._columns: dict[Node, Any] = {}
        self._arrays: dict[Node, Any] = {}

    def column(self, node: Node) -> Column:
        """The result of a node."""
        if node not in self._columns:
            with np.errstate(all="ignore"):
                evaluate(node, self._columns, self._read)
        return self._columns[node]  # type: ignore[no-any-return]

    def array(self, node: Node) -> NDArray[Any]:
        """The array of a node's result, (n or 1, ...)."""
        if node not in self._arrays:
            with np.errstate(all="ignore"):
                evaluate(node, self._arrays, self._loaded)
        return self._arrays[node]  # type: ignore[no-any-return]

    def sent(self, node: Node, first: int, stop: int) -> NDArray[Any] | None:
        """Return the whole numbers of a field as sent, (n, ...).

        They are those of the packets from `first` to `stop`.

        None for what is no such field, or not in every packet.
        """
        if node.kind == "field":
            info = self._table.schema.fields.get(node.path)
        else:
            info = None
        if (
            info is None
            or info.scaled
            or info.dtype is None
            or info.dtype.kind not in "iu"
            or info.dtype.itemsize > EXACT
        ):
            return None
        if self._table.present(info.path) is not None:
            return None
        if stop - first == len(self._table):
            some = self._table
        else:
            some = self._table.take(np.arange(first, stop))
        return field_array(info, some, self._table.schema.depth(), raw=True)

    def know(self, node: Node, column: Column) -> None:
        """Take a result as given."""
        self._columns[node] = column

    def _read(self, node: Node) -> Any:
        if node.kind in ("field", "state"):
            return node.function(self._fields)
        return None

    def _loaded(self, node: Node) -> Any:
        if node in self._columns:
            return self._columns[node].array
        if node.kind == "field":
            return field_array(
                self._table.schema.fields[node.path], self._table, self._table.schema.depth()
            )
        if node.kind == "call":
            return None
        return self.column(node).array


@dataclass(eq=False)
class Share:
    """The packets of one layout in a batch, with their plan and plain results.

    `first` is the index of the first point of each packet, -1 for none.
    """

    plan: Plan
    group: Group
    known: Plain
    batch: Batch
    first: NDArray[np.intp] | None = None

    def __len__(self) -> int:
        return len(self.group.where)

    def fill(
        self, maker: Maker, columns: Mapping[str, NDArray[Any]], first: int, stop: int
    ) -> None:
        """Fill the columns of the packets from `first` to `stop`."""

        def values(node: Node) -> NDArray[Any]:
            array = self.known.array(node)
            if len(array) > 1:
                return array[first:stop]
            return array

        if stop - first == len(self):
            maker.run(self.group.rows, self.known.array, columns)
        else:
            maker.run(self.group.rows[first:stop], values, columns)

    def plain(self, name: str, first: int = 0, stop: int | None = None) -> NDArray[Any]:
        """Return a part of the result of `points`, evaluated plainly.

        It has every point of the packets from `first` to `stop` (None: all).

        Its shape is that of the plan, behind the packets.

        A further column of whole numbers that is a field as it stands is of their type, all others
        of float64.
        """
        stop = len(self) if stop is None else stop
        part = self.plan.parts[name]
        shape = (stop - first, *self.plan.shape)
        if isinstance(part, Node) and name in self.plan.extra:
            array = self.known.sent(part, first, stop)
        else:
            array = None
        if array is None:
            if isinstance(part, Node):
                array = self.known.array(part)
            else:
                array = np.asarray(part)
            if isinstance(part, Node) and len(array) > 1:
                array = array[first:stop]
        return np.broadcast_to(
            deep(array, len(shape) - 1) if isinstance(part, Node) else array, shape
        )

    @classmethod
    def part(
        cls, plan: Plan, batch: Batch, group: Group, remembered: Mapping[int, Column]
    ) -> Share:
        """Return the share of some packets of a batch.

        Args:
            remembered: results for all packets, by the number of a node that uses other packets.
        """
        own = batch.of(group)
        share = cls(plan, group, Plain(own), own)
        for number, column in remembered.items():
            node = plan.tape.nodes[number]
            if len(column.array) > 1:
                array = column.array[group.where]
            else:
                array = column.array
            corner = (slice(None), *(slice(0, length) for length in node.shape))
            share.known.know(node, Column(array[corner], node.sample.axes, own))
        return share

    def some(self, which: NDArray[np.intp]) -> Share:
        """The share of some of the packets, by index, with what is known of them plainly."""
        remembered = {
            node.number: self.known.column(node)
            for node in self.plan.eager
            if node.kind in REMEMBERING
        }
        return Share.part(
            self.plan,
            self.batch,
            Group(self.group.layout, which, self.group.rows[which]),
            remembered,
        )


def maker_of(plan: Plan, names: tuple[str, ...], backend: str, number: int) -> Maker:
    """Return an object that computes columns for `number` frames.

    It is a kernel if `backend` requires one, or if it allows one and that pays.
    """
    if backend in ("auto", "jit"):
        try:
            from lidarspec.points import numba_kernels
        except ImportError:  # a back end that may be left out
            if backend == "jit":
                raise
        else:
            kernel = numba_kernels.compile(plan, names, None if backend == "jit" else number)
            if kernel is not None:
                return kernel
    return numpy_plan.compile(plan, names)


class Computed(ColumnSource):
    """Columns made for these points alone, each once.

    Args:
        parts: stretches of batches of one plan whose packets are whole but for the first and the
            last one; or all points of one batch.
        made: columns made before, to be added to.
    """

    def __init__(
        self, parts: Sequence[tuple[BatchColumns, int, int]], made: dict[str, NDArray[Any]]
    ) -> None:
        self._parts = parts
        self._made = made
        self.size = sum(stop - start for _, start, stop in parts)
        self.base = parts[0][0].base
        self._packets = parts[0][0].packets
        self._shares = parts[0][0].shares
        self.extra = parts[0][0].extra
        self._turn = vendor_turn(self._packets.sensor)

    def column(self, name: str) -> NDArray[Any] | None:
        if name not in self._made:
            self._made |= self._columns(name)
        return self._made.get(name)

    def holds(self, name: str) -> bool:
        return name in self._made

    def prepare(self, names: Sequence[str]) -> None:
        plans = [share.plan for share in self._shares]
        sent = [
            name
            for name in names
            if name not in self._made and all(name in plan.sent for plan in plans)
        ]
        if set(_MAIN).intersection(names) - self._made.keys():
            main = self._main_names
        else:
            main = ()
        if sent and len(sent) + len(main) > 1 and self._turn is None:
            self._made |= self._compiled((*main, *sent))

    def _columns(self, name: str) -> dict[str, NDArray[Any]]:
        if name == "intensity" and name not in self._shares[0].plan.parts:
            return {}
        if name in _MAIN:
            return self._main(name)
        if name == "valid":
            return {name: ~np.isnan(self._x())}
        if name in self._shares[0].plan.expressions and name not in self._shares[0].plan.sent:
            columns = self._compiled(
                ("range", "azimuth")
                if name in ("range", "azimuth") and self._packets.backend == "jit"
                else (name,)
            )
            if "azimuth" in columns:
                return columns | {"azimuth": self._azimuth(columns["azimuth"])}
            return columns
        if name == "time":
            times = [
                batch.times_of(share, *packets) + later(batch, self.base)
                for batch, share, packets in self._pieces()
            ]
            return {name: self._joined(times, np.float64)}
        if name not in self._shares[0].plan.parts:
            return {}
        plain = [share.plain(name, *packets) for _, share, packets in self._pieces()]
        column = self._joined(plain, np.result_type(*plain))
        if name == "elevation":
            return {name: column.astype(TYPES[name], copy=False)}
        extra = self._shares[0].plan.extra.get(name)
        return {name: numbers_of(column, TYPES[name]) if extra is None else extra.column(column)}

    def _main(self, name: str) -> dict[str, NDArray[Any]]:
        """Return the columns that are computed together.

        If all points are level, the height is made only on request.
        """
        if name not in self._main_names and name == "z":
            x = self._x()
            return {"z": np.where(np.isnan(x), x, np.float32(0))}
        columns = self._compiled(self._main_names)
        if self._turn is None:
            return columns
        turned = dict(columns)
        for axis, row in zip(
            "xyz", self._turn, strict=True
        ):  # each is one of REP-103's, or its opposite
            source = int(np.flatnonzero(row)[0])
            turned[axis] = columns["xyz"[source]] * np.float32(row[source])
        return turned

    @property
    def _main_names(self) -> tuple[str, ...]:
        """The columns that are made together, whichever of them is asked for."""
        level = self._turn is None and all(share.plan.level for share in self._shares)
        return tuple(
            n for n in _MAIN if n in self._shares[0].plan.expressions and not (n == "z" and level)
        )

    def _x(self) -> NDArray[Any]:
        return cast("NDArray[Any]", self.column("x"))

    def _azimuth(self, angles: NDArray[Any]) -> NDArray[np.float32]:
        """Azimuths in the axes that are asked for, narrowed where a kernel has not done so."""
        if self._turn is None and angles.dtype == np.float32:
            return angles
        return narrowed(angles if self._turn is None else turned_azimuth(angles, self._turn))

    def _compiled(self, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
        """Columns that back ends make."""
        pieces = self._pieces()
        backend = self._packets.backend
        if not self._is_even:
            each = []
            for _, share, (first, stop) in pieces:
                maker = maker_of(share.plan, names, backend, stop - first)
                each.append(maker.columns(stop - first))
                share.fill(maker, each[-1], first, stop)
            return {
                name: self._joined([columns[name] for columns in each], each[0][name].dtype)
                for name in names
            }
        plan = self._shares[0].plan
        number = sum(stop - first for _, _, (first, stop) in pieces)
        maker = maker_of(plan, names, backend, number)
        columns = maker.columns(number)
        start = 0
        for _, share, (first, stop) in pieces:
            end = start + (stop - first) * plan.width
            share.fill(
                maker, {name: column[start:end] for name, column in columns.items()}, first, stop
            )
            start = end
        return {name: self._trimmed(column) for name, column in columns.items()}

    @property
    def _is_even(self) -> bool:
        """Whether the packets all have one layout, and stand in order."""
        return self._parts[0][0].even is not None

    def _pieces(self) -> list[tuple[BatchColumns, Share, tuple[int, int]]]:
        """Return the shares that the points are in, and the range of packets of each."""
        if not self._is_even:
            batch = self._parts[0][0]
            return [(batch, share, (0, len(share))) for share in batch.shares]
        width = self._shares[0].plan.width
        return [
            (batch, batch.shares[0], (start // width, -(-stop // width)))
            for batch, start, stop in self._parts
        ]

    def _joined(self, parts: Sequence[NDArray[Any]], dtype: Any) -> NDArray[Any]:
        """What each piece has, in stream order, the points of packets that wait left out."""
        flat = [part.reshape(-1) for part in parts]
        if self._is_even:
            return self._trimmed(flat[0] if len(flat) == 1 else np.concatenate(flat)).astype(
                dtype, copy=False
            )
        column = np.empty(self.size, dtype)
        for share, values in zip(self._shares, flat, strict=True):
            assert share.first is not None
            spread_out(values, share.first, share.plan.width, column)
        return column

    def _trimmed(self, column: NDArray[Any]) -> NDArray[Any]:
        """A column of whole packets without the points before and after."""
        skipped = self._parts[0][1] % self._shares[0].plan.width
        return column[skipped : skipped + self.size]


def spread_out(
    values: NDArray[Any], first: NDArray[np.intp], width: int, column: NDArray[Any]
) -> None:
    """Write the points of packets, `width` each, at the index of each packet's first.

    Index -1 leaves a packet out.
    """
    kept = first >= 0
    rows = np.ascontiguousarray(values.reshape(len(first), width), column.dtype)
    starts = first
    if not kept.all():
        rows = rows[kept]
        starts = first[kept]
    if rows.size:
        piece = np.dtype((np.void, rows.shape[1] * rows.itemsize))
        windows: NDArray[Any] = np.ndarray(
            (len(column) - width + 1,), piece, column.data, 0, column.strides
        )
        windows[starts] = rows.view(piece).reshape(-1)


class Block(NamedTuple):
    """Points of a batch, from `start` to `stop`, and the columns made of them so far."""

    start: int
    stop: int
    made: dict[str, NDArray[Any]]


class BatchColumns(ColumnSource):
    """The points of a batch.

    Args:
        packets: of the batch.
        shares: these, by their layouts.
        size: the number of points, those of packets that wait left out.
        base: the time that times count from, ns.
        grids, nominal: as of all sources.
    """

    def __init__(
        self,
        packets: PacketBatch,
        shares: Sequence[Share],
        size: int,
        base: int,
        *,
        grids: Grids | None,
        nominal: bool,
    ) -> None:
        self.packets = packets
        self.shares = shares
        self.extra = shares[0].plan.extra
        self.size = size
        self.base = base
        self.grids = grids
        self.nominal = nominal
        if grids:
            self.grid = grids.between(0, size)
        else:
            self.grid = grid_of(shares[0].plan.shape, shares[0].plan.axes)
        self._made: dict[str, NDArray[Any]] = {}
        self._blocks: list[Block] = []

    @property
    def even(self) -> Share | None:
        """The share of all packets, where they have one layout and stand in order."""
        if len(self.shares) == 1 and self.shares[0].first is None:
            return self.shares[0]
        return None

    def column(self, name: str) -> NDArray[Any] | None:
        if name not in self._made:
            Computed([(self, 0, self.size)], self._made).column(name)
        return self._made.get(name)

    def holds(self, name: str) -> bool:
        return name in self._made

    def prepare(self, names: Sequence[str]) -> None:
        Computed([(self, 0, self.size)], self._made).prepare(names)

    def part(self, name: str, start: int, stop: int) -> NDArray[Any] | None:
        """Return a column of some points.

        The column is made for the whole block of points around them, so that later requests find
        it.
        """
        if self.even is None or self.holds(name) or self.size <= SHARED:
            return super().part(name, start, stop)
        pieces: list[NDArray[Any]] = []
        at = start
        while at < stop:
            first, end, made = self._block(at)
            column = Computed([(self, first, end)], made).column(name)
            if column is None:
                return None
            pieces.append(column[at - first : stop - first])
            at = end
        if len(pieces) == 1:
            return pieces[0]
        return np.concatenate(pieces)

    def _block(self, at: int) -> Block:
        """Return the block of points around an index, which are computed together.

        Blocks do not overlap.
        """
        index = bisect.bisect(self._blocks, at, key=lambda block: block.start)
        if index and at < self._blocks[index - 1].stop:
            return self._blocks[index - 1]
        width = self.shares[0].plan.width
        if index < len(self._blocks):
            after = self._blocks[index].start
        else:
            after = self.size
        start = at // width * width
        block = Block(start, min(start + max(SHARED // width, 1) * width, after), {})
        self._blocks.insert(index, block)
        return block

    def together(self, parts: Sequence[Stretch]) -> ColumnSource | None:
        """Return a source of the columns of these stretches alone.

        Returns None unless they are many points, in order, of packets of one layout.
        """
        sources = [part.source for part in parts]
        batches = [
            source
            for source in sources
            if isinstance(source, BatchColumns) and source.even is not None
        ]
        if len(batches) < len(parts) or sum(part.size for part in parts) < LEAST:
            return None
        plan = self.shares[0].plan
        inner = [*(part.stop for part in parts[:-1]), *(part.start for part in parts[1:])]
        if any(batch.shares[0].plan is not plan for batch in batches) or any(
            at % plan.width for at in inner
        ):
            return None
        return Computed(
            [(batch, part.start, part.stop) for batch, part in zip(batches, parts, strict=True)], {}
        )

    def times_at(self, indices: NDArray[np.intp]) -> NDArray[np.float64]:
        share = self.even
        if share is None or self.holds("time"):
            return super().times_at(indices)
        packets, places = np.divmod(indices, share.plan.width)
        if isinstance(share.plan.parts["time"], Node):
            few = share.some(packets).plain("time")
        else:
            few = share.plain("time")[packets]
        offsets = seconds_since(self.packets.time_ns[packets], self.base)
        return np.asarray(few.reshape(len(packets), -1)[np.arange(len(packets)), places] + offsets)

    def times_of(self, share: Share, first: int, stop: int) -> NDArray[np.float64]:
        """Return the times of all points of some packets of a share, (packets, *shape).

        Times are in seconds since `base`. `shape` is that of the plan.
        """
        offsets = seconds_since(self.packets.time_ns[share.group.where[first:stop]], self.base)
        return np.asarray(share.plain("time", first, stop) + deep(offsets, len(share.plan.shape)))
