"""The packets of a batch that have the same layout, with their plan and their values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.expressions.columns import Batch, Column, Fields, field_array
from lidarspec.expressions.graph import Node, compute
from lidarspec.frames.arrays import add_axes
from lidarspec.frames.frame_table import LayoutRows
from lidarspec.points.plan import STATEFUL_KINDS, ColumnMaker, Plan

#: Integers with at most this number of bytes are exact in float64.
MAX_EXACT_BYTES = 4


class ReferenceValues:
    """The values of the nodes of expressions for one batch.

    The reference evaluator computes each value once.
    """

    def __init__(self, batch: Batch) -> None:
        self._fields = Fields(batch)
        self._table = batch.table
        self._columns: dict[Node, Any] = {}
        self._arrays: dict[Node, Any] = {}

    def column(self, node: Node) -> Column:
        """Return the value of a node as a column."""
        if node not in self._columns:
            with np.errstate(all="ignore"):
                compute(node, self._columns, self._read)
        return self._columns[node]  # type: ignore[no-any-return]

    def array(self, node: Node) -> NDArray[Any]:
        """Return the value of a node as an array, (n or 1, ...)."""
        if node not in self._arrays:
            with np.errstate(all="ignore"):
                compute(node, self._arrays, self._load)
        return self._arrays[node]  # type: ignore[no-any-return]

    def read_raw(self, node: Node, first: int, stop: int) -> NDArray[Any] | None:
        """Return the raw integers of a field, (n, ...), or None if it has none."""
        if node.kind == "field":
            info = self._table.schema.fields.get(node.path)
        else:
            info = None
        if (
            info is None
            or info.scaled
            or info.dtype is None
            or info.dtype.kind not in "iu"
            or info.dtype.itemsize > MAX_EXACT_BYTES
        ):
            return None
        if self._table.present(info.path) is not None:
            return None
        if stop - first == len(self._table):
            some = self._table
        else:
            some = self._table.take(np.arange(first, stop))
        return field_array(info, some, self._table.schema.depth(), raw=True)

    def set_value(self, node: Node, column: Column) -> None:
        """Set the value of a node."""
        self._columns[node] = column

    def _read(self, node: Node) -> Any:
        if node.kind in ("field", "state"):
            return node.function(self._fields)
        return None

    def _load(self, node: Node) -> Any:
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
class LayoutGroup:
    """The packets of a batch that have the same layout, with their plan and their values.

    Attributes:
        first: the index in the batch of the first point of each packet, (n,); -1 for a packet that
            waits for the next batch. None if all packets of the batch have this layout.
    """

    plan: Plan
    group: LayoutRows
    reference_values: ReferenceValues
    batch: Batch
    first: NDArray[np.intp] | None = None

    def __len__(self) -> int:
        return len(self.group.where)

    def compute_columns(
        self, maker: ColumnMaker, first: int, stop: int | None
    ) -> dict[str, NDArray[Any]]:
        """Return the columns that `maker` computes for some packets of the group.

        Args:
            first: the index of the first packet.
            stop: the index after the last packet; None for the end of the group.
        """
        rows = self.group.rows[first:stop]
        columns = maker.columns(len(rows))

        def values(node: Node) -> NDArray[Any]:
            array = self.reference_values.array(node)
            if len(array) > 1:
                return array[first:stop]
            return array

        maker.run(rows, values, columns)
        return columns

    def compute_by_reference(
        self, name: str, first: int = 0, stop: int | None = None
    ) -> NDArray[Any]:
        """Return one part of the result of `points`, by the reference evaluator.

        Args:
            name: the part, for example "range".
            first: the index of the first packet.
            stop: the index after the last packet; None for the end of the group.

        Returns:
            (stop - first, *plan.shape), float64 except for raw integers in `extra`.
        """
        stop = len(self) if stop is None else stop
        part = self.plan.parts[name]
        shape = (stop - first, *self.plan.shape)
        if isinstance(part, Node) and name in self.plan.extra:
            array = self.reference_values.read_raw(part, first, stop)
        else:
            array = None
        if array is None:
            if isinstance(part, Node):
                array = self.reference_values.array(part)
            else:
                array = np.asarray(part)
            if isinstance(part, Node) and len(array) > 1:
                array = array[first:stop]
        return np.broadcast_to(
            add_axes(array, len(shape) - 1) if isinstance(part, Node) else array, shape
        )

    @classmethod
    def make(
        cls, plan: Plan, batch: Batch, group: LayoutRows, remembered: Mapping[int, Column]
    ) -> LayoutGroup:
        """Return a group for some packets of a batch.

        Args:
            remembered: the values that depend on earlier packets, for the whole batch, by node
                number.
        """
        own = batch.of(group)
        share = cls(plan, group, ReferenceValues(own), own)
        for number, column in remembered.items():
            node = plan.tape.nodes[number]
            if len(column.array) > 1:
                array = column.array[group.where]
            else:
                array = column.array
            corner = (slice(None), *(slice(0, length) for length in node.shape))
            share.reference_values.set_value(node, Column(array[corner], node.sample.axes, own))
        return share

    def take(self, which: NDArray[np.intp]) -> LayoutGroup:
        """Return a group with some of the packets of this group."""
        remembered = {
            node.number: self.reference_values.column(node)
            for node in self.plan.eager_nodes
            if node.kind in STATEFUL_KINDS
        }
        return LayoutGroup.make(
            self.plan,
            self.batch,
            LayoutRows(self.group.layout, which, self.group.rows[which]),
            remembered,
        )
