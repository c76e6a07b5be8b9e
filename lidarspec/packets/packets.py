"""Packets: frames of one type as columns, raw and physical, in stream order."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import SpecError, UnknownField
from lidarspec.expressions.columns import AROUND, Batch, physical
from lidarspec.frames.frame_table import Table
from lidarspec.frames.schema import Schema
from lidarspec.framing.results import Counters, Numbers, to_array
from lidarspec.notebook_display import make_display_method
from lidarspec.packets.clocks import part_times
from lidarspec.packets.imu import ImuSamples, read_samples
from lidarspec.points.cloud import PointCloud
from lidarspec.points.evaluate import evaluate
from lidarspec.spec.sensor import SensorDescription

#: what is known of each packet besides its fields.
_COLUMNS = ("offset", "time_ns", "host_ns", "index", "breaks")

#: numbers, or what makes them when they are asked for.
Index = Numbers | Callable[[], NDArray[np.int64]]
StateOf = tuple[Table | None, NDArray[np.intp]]


class Packets:
    """n frames of one type. Their arrays are to be read only: some share memory.

    Attributes:
        sensor, frame: whose, and of which type.
        table: their raw columns.
        time_ns: (n,) int64, by the sensor's clock, unwrapped; else the host's.
        host_ns: (n,) int64 arrival times; 0 where the caller gave none.
        breaks: (n,) True where something was lost before the packet.
        is_clocked: whether the packets are ordered by the sensor's clock instead of by a counter.
        state: for each other frame type, its frames and which of them was last before each packet.
        masked: (n,) packets that are missing before each since a masked sector leaves them out;
            None if there are none.
        stats: the counters of the decoder.
        backend: what makes points of them, "auto", "numpy" or "jit".
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
        self.is_clocked = order is not None
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
        """The first byte of each in the input, (n,)."""
        return to_array(self._offset)

    @cached_property
    def index(self) -> NDArray[np.int64]:
        """The number of each packet, (n,), including missing packets.

        It is the unwrapped counter of the sensor, if there is one.
        """
        if callable(self._index):
            return self._index()
        return to_array(self._index)

    @property
    def order(self) -> NDArray[np.int64]:
        """The position of each packet in order, (n,), equal for duplicates.

        It follows from the counter, or else from the clock, of datagrams.
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

        The value is nan if a frame lacks the field.

        Raises:
            UnknownField: with the closest known path.
        """
        info = self.table.schema.columns.get(path)
        if info is None:
            raise UnknownField(
                path, self.table.schema.columns, place=f"{self.sensor.id} {self.frame}"
            )
        return physical(info, self.table)

    def _ipython_key_completions_(self) -> list[str]:
        return list(self.table.schema.columns)

    @property
    def raw(self) -> NDArray[Any]:
        """The integers of the wire, a structured array (n,), nested as in the struct.

        Variable arrays are padded with 0.
        """
        columns = {path: self.table.raw(path) for path in self.table.schema.columns}
        array = np.zeros(len(self), _nested_dtype(self.table.schema, columns, ""))
        for path, column in columns.items():
            target = array
            for name in path.split("."):
                target = target[name]
            target[...] = column
        return array

    def count(self, array: str) -> NDArray[np.intp]:
        """Return the length of an array in each packet, (n,).

        Raises:
            UnknownField: for an array that the frame does not have.
        """
        if array in self.table.schema.parts:
            found = (
                self.table.parts(array, kind.name)[1]
                for kind in self.table.schema.parts[array].kinds
            )
            return sum(
                (np.bincount(which, minlength=len(self)) for which in found),
                np.zeros(len(self), np.intp),
            )
        if array not in self.table.schema.arrays:
            raise UnknownField(
                array,
                {*self.table.schema.arrays, *self.table.schema.parts},
                place=f"{self.sensor.id} {self.frame}",
            )
        return self.table.counts(array)

    def points(self) -> PointCloud:
        """The points of all packets in stream order, flat; columns are made when they are read.

        Raises:
            SpecError: where the sensor's `points` function fails, or returns columns that do not
                fit.
        """
        return evaluate(self.with_points).cloud

    def imu(self) -> ImuSamples:
        """Return the samples of the sensor's IMU in all packets, in stream order.

        Columns are in SI units. Each sample has its time.

        Raises:
            SpecError: where this frame type has nothing of an IMU, or its `imu` function fails or
                returns columns that do not fit.
        """
        path = self.sensor.parts_with("imu", self.frame)
        own = self.parts(path) if path else self
        return read_samples(self.sensor, own.frame, own.batch(), own.time_ns)

    def take(self, which: Any) -> Packets:
        """The packets that indices, a mask or a slice pick, with their times, offsets and state."""
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

    def _columns_at(self, indices: NDArray[np.intp]) -> dict[str, Any]:
        """Return what is known of some packets besides their fields, as `Packets` takes it."""
        columns: dict[str, Any] = {name: getattr(self, name)[indices] for name in _COLUMNS}
        order = None if self._order is None else self._order[indices]
        if self.masked is None:
            masked = None
        else:
            masked = self.masked[indices]
        return {**columns, "order": order, "masked": masked}

    def parts(self, path: str) -> Packets:
        """Return the parts of all packets, in stream order, as packets.

        They have the times, numbers and state of the frames that they are in.

        Args:
            path: of the parts; "tlvs.points" for one of several kinds.

        Raises:
            UnknownField: for parts that the frame does not have, and for several kinds of which
                none is named.
        """
        place = self.table.schema.within(path)
        if place is None:
            raise UnknownField(
                path, self.table.schema.parts, place=f"{self.sensor.id} {self.frame}"
            )
        axis, kind, below = place
        table, which = self.table.parts(axis, kind)
        columns = self._columns_at(which)
        columns["breaks"] = (
            np.diff(np.cumsum(self.breaks)[which], prepend=0) > 0
        )  # also of a frame without parts before
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
        """The packets that points are made of: these, or the parts in them."""
        path = self.sensor.parts_with("points", self.frame)
        if path:
            return self.parts(path)
        return self

    @property
    def frames(self) -> tuple[Table, NDArray[np.intp] | slice]:
        """The frames that they are, or that they are parts of, and the row of each there, (n,)."""
        table, which = self.state.get(AROUND, (None, slice(None)))
        if table is None:
            return (self.table, slice(None))
        return (table, which)

    def batch(self, carry: dict[int, NDArray[np.float64]] | None = None) -> Batch:
        """Return the packets as functions of a plugin receive them, through `Fields`.

        Args:
            carry: the state left by the previous batch.
        """
        return Batch(self.table, self.breaks, self.state, self.sensor.state, dict(carry or {}))


def join_packets(parts: Sequence[Packets]) -> Packets:
    """Batches of one stream, one after another."""
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
    if all(part.is_clocked for part in parts):
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
    """Several tables of one frame type, one after another."""
    return tables[0] if len(tables) == 1 else type(tables[0]).join(tables)  # type: ignore[no-any-return]


def _nested_dtype(
    schema: Schema, columns: Mapping[str, NDArray[Any]], prefix: str
) -> np.dtype[Any]:
    """Return the structured dtype of one level of the struct.

    Raises:
        SpecError: One name is a value, a struct or an array in different branches.
    """
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
        if len(_forms(schema, here)) > 1:
            raise SpecError(
                "its branches are a value, a struct or an array: request its columns one by one",
                path=here,
            )
        own = [index for index, axis in enumerate(info.axes) if axis.rstrip("[]") == here]
        is_array = columns[path].ndim > 1  # values that are no numbers stand in lists
        shape = tuple(columns[path].shape[1 + index] for index in own if is_array)
        if below:
            kind = _nested_dtype(schema, columns, f"{here}.")
        else:
            kind = columns[path].dtype
        members.append((name, kind, shape) if shape else (name, kind))
    return np.dtype(members)


def _forms(schema: Schema, here: str) -> set[tuple[bool, int]]:
    """Return the forms of a name in the branches that have it.

    A form is whether it is a value, and the number of arrays of its own.
    """
    parts = [
        (path, info)
        for path, info in schema.columns.items()
        if path == here or path.startswith(f"{here}.")
    ]
    return {
        (path == here, sum(axis.rstrip("[]") == here for axis in info.axes)) for path, info in parts
    }
