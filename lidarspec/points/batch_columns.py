"""The columns of the points of a batch, computed by plans when they are read.

Columns are computed for the whole batch or for a large slice of it. Small slices share a block of
points.
"""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarspec.expressions.graph import Node
from lidarspec.frames.arrays import add_axes
from lidarspec.points.backends import compile_columns
from lidarspec.points.column_sources import ColumnSource
from lidarspec.points.conventions import (
    TYPES,
    Grids,
    convert_numbers,
    make_grid,
    narrow_angle,
    seconds_since,
    turn_azimuth,
    vendor_turn,
)
from lidarspec.points.layout_groups import LayoutGroup
from lidarspec.points.reference_evaluator import PacketBatch

#: The columns that one program or kernel computes together.
COMPILED_TOGETHER = ("x", "y", "z", "intensity")
#: The columns of a slice of at least `MIN_OWN_POINTS` points are computed for this slice alone.
#: Smaller slices share the columns of a block of `BLOCK_POINTS` points.
MIN_OWN_POINTS = 1 << 14
BLOCK_POINTS = 1 << 16


class PointBlock(NamedTuple):
    """The points of a batch from `start` to `stop - 1`, and their columns computed so far."""

    start: int
    stop: int
    computed: dict[str, NDArray[Any]]


class BatchColumns(ColumnSource):
    """The columns of the points of a batch.

    Args:
        packets: the packets of the batch.
        shares: the packets of the batch, grouped by layout.
        size: the number of points, without the points of packets that wait for the next batch.
        base: the time that the column "time" counts from, int64 ns.
        grids: the organisation of the points of each packet.
        nominal: whether a default calibration is used.
    """

    def __init__(
        self,
        packets: PacketBatch,
        shares: Sequence[LayoutGroup],
        size: int,
        base: int,
        *,
        grids: Grids | None,
        nominal: bool,
    ) -> None:
        self._packets = packets
        self._shares = shares
        self._plan = shares[0].plan
        self._turn = vendor_turn(packets.sensor)
        self.is_level = self._turn is None and all(share.plan.is_level for share in shares)
        self._main_columns = [
            name
            for name in COMPILED_TOGETHER
            if name in self._plan.expressions and not (name == "z" and self.is_level)
        ]
        # Packets of one layout in order have all their points one after another.
        self._is_regular = len(shares) == 1 and shares[0].first is None
        self.extra = self._plan.extra
        self.size = size
        self.base = base
        self.grids = grids
        self.nominal = nominal
        if grids:
            self.grid = grids.grid_between(0, size)
        else:
            self.grid = make_grid(self._plan.shape, self._plan.axes)
        self._computed: dict[str, NDArray[Any]] = {}
        self._blocks: list[PointBlock] = []

    def columns(self, names: Sequence[str], start: int, stop: int) -> dict[str, NDArray[Any]]:
        if any(name in self._main_columns for name in names):
            others = [name for name in names if name not in self._main_columns]
            names = [*self._main_columns, *others]
        missing = [name for name in names if name not in self._computed]
        is_whole = not self._is_regular or self.size <= BLOCK_POINTS or stop - start == self.size
        if is_whole or not missing:
            self._computed |= self._compute(missing, 0, self.size)
            return _slice_columns(self._computed, names, slice(start, stop))
        # A slice at an end of the batch is a part of a scan over several batches.
        is_at_end = start == 0 or stop == self.size
        if is_at_end or stop - start >= MIN_OWN_POINTS:
            return self._compute(names, start, stop)
        return self._read_blocks(names, start, stop)

    def _read_blocks(self, names: Sequence[str], start: int, stop: int) -> dict[str, NDArray[Any]]:
        pieces: list[dict[str, NDArray[Any]]] = []
        index = start
        while index < stop:
            block = self._get_block(index)
            missing = [name for name in names if name not in block.computed]
            block.computed.update(self._compute(missing, block.start, block.stop))
            inside = slice(index - block.start, stop - block.start)
            pieces.append(_slice_columns(block.computed, names, inside))
            index = block.stop
        if len(pieces) == 1:
            return pieces[0]
        return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}

    def _get_block(self, index: int) -> PointBlock:
        """Return the block that contains the point at an index; make it on first use."""
        place = bisect.bisect(self._blocks, index, key=lambda block: block.start)
        if place and index < self._blocks[place - 1].stop:
            return self._blocks[place - 1]
        if place < len(self._blocks):
            limit = self._blocks[place].start
        else:
            limit = self.size
        width = self._plan.width
        start = index // width * width
        length = max(BLOCK_POINTS // width, 1) * width
        block = PointBlock(start, min(start + length, limit), {})
        self._blocks.insert(place, block)
        return block

    def _compute(self, names: Sequence[str], start: int, stop: int) -> dict[str, NDArray[Any]]:
        """Compute columns of the points from `start` to `stop`.

        Args:
            names: the names of the columns. Columns that are compiled together have to be requested
                together.
        """
        main = [name for name in names if name in self._main_columns]
        sent = [
            name for name in names if all(name in share.plan.raw_fields for share in self._shares)
        ]
        if len(sent) + len(main) == 1 or self._turn is not None:
            sent = []
        columns: dict[str, NDArray[Any]] = {}
        if main or sent:
            columns = self._fill((*main, *sent), start, stop)
        if main and self._turn is not None:
            columns |= _turn_coordinates(columns, self._turn)
        for name in names:
            if name not in columns:
                columns |= self._compute_single(name, start, stop)
        return columns

    def _compute_single(self, name: str, start: int, stop: int) -> dict[str, NDArray[Any]]:
        """Return a dict with one column; it is empty if the sensor lacks the column."""
        if name == "z":  # of a level source; otherwise it is one of the main columns
            return {}
        if name == "time":
            first, last = self._packet_range(start, stop)
            times = [self._compute_times(share, first, last) for share in self._shares]
            return {name: self._flatten(times, np.dtype(np.float64), start, stop)}
        if name in self._plan.expressions and name not in self._plan.raw_fields:
            return self._compute_compiled(name, start, stop)
        if name in self._plan.parts:
            return {name: self._compute_by_reference(name, start, stop)}
        return {}

    def _compute_compiled(self, name: str, start: int, stop: int) -> dict[str, NDArray[Any]]:
        names: tuple[str, ...] = (name,)
        if name in ("range", "azimuth") and self._packets.backend == "jit":
            names = ("range", "azimuth")  # one kernel in place of two
        columns = self._fill(names, start, stop)
        if "azimuth" in columns:
            angles = columns["azimuth"]
            if self._turn is not None:
                columns["azimuth"] = narrow_angle(turn_azimuth(angles, self._turn))
            elif angles.dtype != np.float32:
                columns["azimuth"] = narrow_angle(angles)
        return columns

    def _compute_by_reference(self, name: str, start: int, stop: int) -> NDArray[Any]:
        first, last = self._packet_range(start, stop)
        values = [share.compute_by_reference(name, first, last) for share in self._shares]
        column = self._flatten(values, np.result_type(*values), start, stop)
        if name in self._plan.extra:
            return self._plan.extra[name].column(column)
        if name == "elevation":
            return column.astype(TYPES[name], copy=False)
        return convert_numbers(column, TYPES[name])

    def _fill(self, names: tuple[str, ...], start: int, stop: int) -> dict[str, NDArray[Any]]:
        """Return columns computed by a program or a kernel."""
        first, last = self._packet_range(start, stop)
        filled = []
        for share in self._shares:
            count = len(share.group.rows[first:last])
            maker = compile_columns(share.plan, names, self._packets.backend, count)
            filled.append(share.compute_columns(maker, first, last))
        return {
            name: self._flatten([columns[name] for columns in filled], column.dtype, start, stop)
            for name, column in filled[0].items()
        }

    def _packet_range(self, start: int, stop: int) -> tuple[int, int | None]:
        """Return the packets of the points from `start` to `stop` as (first, end)."""
        # With several layouts, the range is (0, None), which means all packets.
        if not self._is_regular:
            return 0, None
        width = self._plan.width
        return start // width, -(-stop // width)

    def _flatten(
        self, values: Sequence[NDArray[Any]], dtype: np.dtype[Any], start: int, stop: int
    ) -> NDArray[Any]:
        """Return a column of the points from `start` to `stop`, in stream order.

        Args:
            values: for each layout, the values of all points in the packets of `_packet_range`.
        """
        if self._is_regular:
            skipped = start % self._plan.width
            column = values[0].reshape(-1)[skipped : skipped + stop - start]
            return column.astype(dtype, copy=False)
        column = np.empty(self.size, dtype)
        for share, part in zip(self._shares, values, strict=True):
            assert share.first is not None
            scatter_points(part, share.first, share.plan.width, column)
        return column

    def _compute_times(
        self, share: LayoutGroup, first: int, last: int | None
    ) -> NDArray[np.float64]:
        """Return the times of points, (packets, *shape), in seconds since `base`."""
        times = self._packets.time_ns[share.group.where[first:last]]
        offsets = seconds_since(times, self.base)
        return np.asarray(
            share.compute_by_reference("time", first, last)
            + add_axes(offsets, len(share.plan.shape))
        )

    def times_at(self, indices: NDArray[np.intp]) -> NDArray[np.float64]:
        if not self._is_regular or "time" in self._computed:
            return super().times_at(indices)
        share = self._shares[0]
        packets, places = np.divmod(indices, self._plan.width)
        if isinstance(self._plan.parts["time"], Node):
            few = share.take(packets).compute_by_reference("time")
        else:
            few = share.compute_by_reference("time")[packets]
        offsets = seconds_since(self._packets.time_ns[packets], self.base)
        return np.asarray(few.reshape(len(packets), -1)[np.arange(len(packets)), places] + offsets)


def _slice_columns(
    columns: dict[str, NDArray[Any]], names: Sequence[str], part: slice
) -> dict[str, NDArray[Any]]:
    return {name: columns[name][part] for name in names if name in columns}


def scatter_points(
    values: NDArray[Any], first: NDArray[np.intp], width: int, column: NDArray[Any]
) -> None:
    """Copy the values of points into a column, packet by packet.

    Args:
        values: the values, `width` for each packet.
        first: the index in `column` of the first point of each packet; -1 to leave out a packet.
        width: the number of points of a packet.
        column: the array to write to.
    """
    has_points = first >= 0
    rows = np.ascontiguousarray(values.reshape(len(first), width), column.dtype)
    starts = first
    if not has_points.all():
        rows = rows[has_points]
        starts = first[has_points]
    if rows.size:
        piece = np.dtype((np.void, rows.shape[1] * rows.itemsize))
        windows: NDArray[Any] = np.ndarray(
            (len(column) - width + 1,), piece, column.data, 0, column.strides
        )
        windows[starts] = rows.view(piece).reshape(-1)


def _turn_coordinates(
    columns: dict[str, NDArray[Any]], turn: NDArray[np.float64]
) -> dict[str, NDArray[Any]]:
    """Return x, y and z in the vendor's axes.

    Args:
        turn: the (3, 3) matrix from REP-103 to the vendor's axes, with entries 0, 1 and -1.
    """
    turned = {}
    for axis, row in zip("xyz", turn, strict=True):
        source = int(np.flatnonzero(row)[0])
        turned[axis] = columns["xyz"[source]] * np.float32(row[source])
    return turned
