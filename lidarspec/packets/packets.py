"""Packets: frames of one type as columns, raw and physical, in stream order."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import SpecError, UnknownField
from lidarspec.expressions.columns import AROUND, Batch, load_physical
from lidarspec.frames.frame_table import Table
from lidarspec.frames.schema import Schema
from lidarspec.framing.results import Counters, Numbers, to_array
from lidarspec.notebook_display import make_display_method
from lidarspec.packets.clocks import part_times
from lidarspec.packets.imu import ImuSamples, read_samples
from lidarspec.points.cloud import PointCloud
from lidarspec.points.evaluate import evaluate
from lidarspec.spec.sensor import SensorDescription

#: The attributes of `Packets` that have one value for each packet.
_COLUMNS = ("offset", "time_ns", "host_ns", "index", "breaks")

#: The indices of packets, or a function that computes them when they are first read.
Index = Numbers | Callable[[], NDArray[np.int64]]
StateOf = tuple[Table | None, NDArray[np.intp]]


class Packets:
    """n frames of one type, in stream order, as read-only arrays.

    Attributes:
        sensor: the sensor.
        frame: the name of the frame type.
        table: the raw columns of the frames.
        time_ns: (n,) int64 ns by the sensor's clock, unwrapped; arrival times without a clock.
        host_ns: (n,) int64 arrival times, ns; 0 if unknown.
        breaks: (n,) bool, True if something was lost before the packet.
        is_ordered_by_clock: whether the packets are ordered by the sensor's clock instead of a
            counter.
        state: for each other frame type, a table of its frames, and an array (n,) with the row of
            the last frame before each packet.
        masked: (n,) how many packets a masked sector leaves out directly before each packet; None
            if no masked sector was found.
        stats: the counters of the decoder.
        backend: the back end that computes points: "auto", "numpy" or "jit".
    """

    def __init__(
        self,
        sensor: SensorDescription,
        frame: str,
        table: Table,
        *,
        offset: Numbers,
        time_ns: NDArray[np.int64],
        host_ns: NDArray[np.int64],
        index: Index,
        breaks: NDArray[np.bool_],
        state: Mapping[str, StateOf],
        stats: Counters,
        backend: str = "auto",
        order: NDArray[np.int64] | None = None,
        masked: NDArray[np.int64] | None = None,
    ) -> None:
        self.sensor = sensor
        self.frame = frame
        self.table = table
        self._order = order
        self.is_ordered_by_clock = order is not None
        self.masked = masked
        self._offset = offset
        self.time_ns = time_ns
        self.host_ns = host_ns
        self._index = index
        self.breaks = breaks
        self.state = state
        self.stats = stats
        self.backend = backend

    @cached_property
    def offset(self) -> NDArray[np.int64]:
        """The offset of each packet's first byte in the input, (n,)."""
        return to_array(self._offset)

    @cached_property
    def index(self) -> NDArray[np.int64]:
        """The index of each packet in the stream, (n,), with gaps for missing packets."""
        if callable(self._index):
            return self._index()
        return to_array(self._index)

    @property
    def order(self) -> NDArray[np.int64]:
        """The sort key of each packet, (n,); duplicates have the same key.

        For datagrams with a clock and no counter, the key is a time in ns. For all other packets,
        it is the index.
        """
        if self._order is None:
            return self.index
        return self._order

    def __len__(self) -> int:
        return len(self.table)

    def __repr__(self) -> str:
        if len(self) > 1:
            span = f", {(int(self.time_ns[-1]) - int(self.time_ns[0])) / 1e9:.3f} s"
        else:
            span = ""
        return f"Packets({len(self)} {self.frame} frames of {self.sensor.id}{span})"

    _repr_html_ = make_display_method("packets")

    def __getitem__(self, path: str) -> NDArray[np.float64]:
        """Return a field in its unit, float64, shape (n, *lengths of its arrays).

        Values are nan in frames that lack the field.

        Raises:
            UnknownField: if the frame has no such field.
        """
        info = self.table.schema.columns.get(path)
        if info is None:
            raise UnknownField(
                path, self.table.schema.columns, place=f"{self.sensor.id} {self.frame}"
            )
        return load_physical(info, self.table)

    def _ipython_key_completions_(self) -> list[str]:
        return list(self.table.schema.columns)

    @property
    def raw(self) -> NDArray[Any]:
        """The integers of the frames, a structured array (n,), nested as in the struct.

        Arrays of variable length are padded with 0.
        """
        columns = {path: self.table.raw(path) for path in self.table.schema.columns}
        array = np.zeros(len(self), _nested_dtype(self.table.schema, columns, ""))
        for path, column in columns.items():
            target = array
            for name in path.split("."):
                target = target[name]
            target[...] = column
        return array

    @property
    def frame_type(self) -> str:
        """The frame type of the packets; for parts, the type of the frames around them."""
        return self.frame.partition(".")[0]

    def count(self, array: str) -> NDArray[np.intp]:
        """Return the length of an array in each packet, (n,).

        Raises:
            UnknownField: if the frame does not have the array.
        """
        separate_parts = self.table.schema.separate_parts
        if array in separate_parts:
            found = (self.table.parts(array, kind.name)[1] for kind in separate_parts[array].kinds)
            return sum(
                (np.bincount(which, minlength=len(self)) for which in found),
                np.zeros(len(self), np.intp),
            )
        if array not in self.table.schema.arrays:
            raise UnknownField(
                array,
                {*self.table.schema.arrays, *separate_parts},
                place=f"{self.sensor.id} {self.frame}",
            )
        return self.table.counts(array)

    def points(self) -> PointCloud:
        """Return the points of all packets, flat, in stream order.

        Columns are computed when they are first read.

        Raises:
            SpecError: if the sensor's `points` function fails, or returns columns of a wrong shape.
        """
        return evaluate(self.with_points).cloud

    def returns(self) -> NDArray[Any]:
        """Return the points with the returns of each firing along the last axis.

        The fields of the structured array are the columns of the points, "valid", and "missing" for
        a return whose packet is lost. The shape depends on the sensor:

        - If the returns of a firing are in consecutive packets (`PacketCounter.returns`), the shape
          is (groups of packets, *shape of the points of a packet, returns).
        - If a packet contains all returns of its firings, at the same places in each packet, the
          shape is (packets, *shape of the firings of a packet, returns).
        - For all other sensors, the shape is (firings, returns).

        Raises:
            SpecError: as for `points`.
        """
        from lidarspec.packets.returns import arrange_returns

        packets = self.with_points
        return arrange_returns(packets, packets.index)

    def imu(self) -> ImuSamples:
        """Return the samples of the sensor's IMU in all packets, in SI units.

        Raises:
            SpecError: if this frame type has no IMU data, or if its `imu` function fails or returns
                columns of a wrong shape.
        """
        path = self.sensor.parts_with("imu", self.frame)
        own = self.parts(path) if path else self
        return read_samples(self.sensor, own.frame, own.batch(), own.time_ns)

    def take(self, which: Any) -> Packets:
        """Return some of the packets, with their times, offsets and state.

        Args:
            which: indices, a mask or a slice.
        """
        indices = np.arange(len(self))[which]
        columns = self._columns_at(indices)
        state = {name: (table, chosen[indices]) for name, (table, chosen) in self.state.items()}
        table = self.table.take(indices)
        return Packets(
            self.sensor,
            self.frame,
            table,
            **columns,
            state=state,
            stats=self.stats,
            backend=self.backend,
        )

    def with_times(self, time_ns: NDArray[np.int64]) -> Packets:
        """Return the packets with other times, (n,) ns."""
        packets = self.take(slice(None))
        packets.time_ns = time_ns
        return packets

    def _columns_at(self, indices: NDArray[np.intp]) -> dict[str, Any]:
        """Return the per-packet arguments of `Packets` for some of the packets."""
        columns: dict[str, Any] = {name: getattr(self, name)[indices] for name in _COLUMNS}
        order = None if self._order is None else self._order[indices]
        if self.masked is None:
            masked = None
        else:
            masked = self.masked[indices]
        return {**columns, "order": order, "masked": masked}

    def parts(self, path: str) -> Packets:
        """Return parts of the frames as packets of their own, in stream order.

        The parts are the structs in a field of type `Parts`, such as the blocks of a telegram.

        Args:
            path: the path of the field, such as "blocks". If the field has several kinds of parts,
                the path ends with the name of a kind, such as "tlvs.points".

        Raises:
            UnknownField: if the frame does not have these parts, or if there are several kinds and
                none is named.
        """
        place = self.table.schema.split_part_path(path)
        if place is None:
            raise UnknownField(
                path, self.table.schema.separate_parts, place=f"{self.sensor.id} {self.frame}"
            )
        axis, kind, below = place
        table, which = self.table.parts(axis, kind)
        columns = self._columns_at(which)
        # a break before a frame without parts counts too
        columns["breaks"] = np.diff(np.cumsum(self.breaks)[which], prepend=0) > 0
        columns["time_ns"] = part_times(self.sensor, (axis, kind), table, which, columns["time_ns"])
        state = {
            name: (frames, chosen[which])
            for name, (frames, chosen) in self.state.items()
            if name != AROUND
        }
        name = ".".join(filter(None, (self.frame, axis, kind)))
        parts = Packets(
            self.sensor,
            name,
            table,
            **columns,
            state={**state, AROUND: (self.table, which)},
            stats=self.stats,
            backend=self.backend,
        )
        if below:
            return parts.parts(below)
        return parts

    @property
    def with_points(self) -> Packets:
        """These packets, or the parts of their frames that contain the points."""
        path = self.sensor.parts_with("points", self.frame)
        if path:
            return self.parts(path)
        return self

    @property
    def frames(self) -> tuple[Table, NDArray[np.intp] | slice]:
        """The whole frames of the packets, and the row of each packet's frame, (n,).

        If the packets are parts of frames, these are the outer frames. Otherwise, they are the
        packets themselves, and a slice of all rows takes the place of the array.
        """
        table, which = self.state.get(AROUND, (None, slice(None)))
        if table is None:
            return (self.table, slice(None))
        return (table, which)

    def batch(self, carry: dict[int, NDArray[np.float64]] | None = None) -> Batch:
        """Return the batch that the functions of a plugin read through `Fields`.

        Args:
            carry: the values that these functions keep from the previous batch.
        """
        return Batch(self.table, self.breaks, self.state, self.sensor.state, dict(carry or {}))


def join_packets(parts: Sequence[Packets]) -> Packets:
    """Return the packets of several batches of one stream as one batch, in this order."""
    if len(parts) == 1:
        return parts[0]
    head = parts[0]
    state = {}
    for name in head.state:
        tables = [part.state[name][0] for part in parts]
        batches = [table for table in tables if table is not None]
        starts = np.cumsum([0] + [0 if table is None else len(table) for table in tables])
        which = [
            np.where(part.state[name][1] < 0, -1, part.state[name][1] + start)
            for part, start in zip(parts, starts[:-1], strict=True)
        ]
        state[name] = (join_tables(batches) if batches else None, np.concatenate(which))
    columns: dict[str, Any] = {
        key: np.concatenate([getattr(part, key) for part in parts]) for key in _COLUMNS
    }
    if all(part.is_ordered_by_clock for part in parts):
        columns["order"] = np.concatenate([part.order for part in parts])
    if any(part.masked is not None for part in parts):
        columns["masked"] = np.concatenate(
            [
                np.zeros(len(part), np.int64) if part.masked is None else part.masked
                for part in parts
            ]
        )
    table = join_tables([part.table for part in parts])
    return Packets(
        head.sensor,
        head.frame,
        table,
        **columns,
        state=state,
        stats=parts[-1].stats,
        backend=head.backend,
    )


def join_tables(tables: Sequence[Any]) -> Table:
    """Return the rows of several tables of one frame type as one table, in this order."""
    return tables[0] if len(tables) == 1 else type(tables[0]).join(tables)  # type: ignore[no-any-return]


def _nested_dtype(
    schema: Schema, columns: Mapping[str, NDArray[Any]], prefix: str
) -> np.dtype[Any]:
    """Return the structured dtype of one level of the struct."""
    members: list[Any] = []
    seen: set[str] = set()
    for path, info in schema.columns.items():
        if not path.startswith(prefix):
            continue
        name, _, below = path[len(prefix) :].partition(".")
        if name in seen:
            continue
        seen.add(name)
        here = prefix + name
        if len(_find_meanings(schema, here)) > 1:
            raise SpecError(
                "the field is a value in some frames, and a struct or an array in others: read"
                " each column of the field by its full name",
                path=here,
            )
        own = [index for index, axis in enumerate(info.axes) if axis.rstrip("[]") == here]
        # values that are not numbers are lists, without array axes
        is_array = columns[path].ndim > 1
        shape = tuple(columns[path].shape[1 + index] for index in own if is_array)
        if below:
            kind = _nested_dtype(schema, columns, f"{here}.")
        else:
            kind = columns[path].dtype
        members.append((name, kind, shape) if shape else (name, kind))
    return np.dtype(members)


def _find_meanings(schema: Schema, here: str) -> set[tuple[bool, int]]:
    """Return the different meanings of a path in the frames.

    Each is (is_value, depth): whether the path is a value, not a struct, and the number of array
    axes of the path itself.
    """
    # A struct with branches can have a value in one branch, and a struct in another one.
    parts = [
        (path, info)
        for path, info in schema.columns.items()
        if path == here or path.startswith(f"{here}.")
    ]
    return {
        (path == here, sum(axis.rstrip("[]") == here for axis in info.axes)) for path, info in parts
    }
