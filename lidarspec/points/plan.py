"""Plan the columns of a sensor's points as expressions of its fields.

The `points` function is traced once for each layout. `Plan` converts the result of
`points` to one expression for each column, by the formulas of `points.conventions`. A back end
compiles the plan to a `ColumnMaker`, which computes the columns.

The columns of a `Cartesian` result are computed in float64. The columns of a `Polar` result may be
computed in float32. This requires that the floating-point fields of a batch are within
`MODERATE_SIZES`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any, Protocol
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from lidarspec.expressions import graph
from lidarspec.expressions.columns import Batch, align_points
from lidarspec.expressions.graph import (
    Node,
    TracedColumn,
    UntraceableError,
    get_only_field,
    has_value_per_point,
)
from lidarspec.frames.frame_table import LayoutRows
from lidarspec.frames.layout import Bytes2D, Layout, Leaf
from lidarspec.points.conventions import (
    coordinates,
    find_direction,
    is_zero,
    mark_invalid,
    place_points,
    returned_range,
    shown_range,
)
from lidarspec.points.lookup_tables import is_always_finite
from lidarspec.points.reference_evaluator import list_extra_types, list_parts
from lidarspec.spec.results import Cartesian, Polar
from lidarspec.spec.vocabulary import AlongAxis, row_numbers

PointsFunction = Callable[[Any], Any]

#: A function that returns the value of a node, (n or 1, ...), by the reference evaluator.
Values = Callable[[Node], NDArray[Any]]

#: The kinds of nodes that depend on other packets, other batches or other frames.
STATEFUL_KINDS = ("shift", "latest", "state")

#: The smallest and the largest absolute value, other than 0, of floating-point fields that can be
#: computed in float32 and in another order with enough precision.
MODERATE_SIZES = 2.0**-60, 2.0**60


class ColumnMaker(Protocol):
    """A compiled program that computes some columns of frames of one layout."""

    def columns(self, number: int) -> dict[str, NDArray[Any]]:
        """Return uninitialized arrays for the columns of frames, (number * width,) each."""

    def run(self, rows: Bytes2D, values: Values, columns: Mapping[str, NDArray[Any]]) -> None:
        """Fill the columns of all frames.

        Args:
            rows: the frames, (n, size), evenly spaced in memory.
            values: a function that returns the value of a node, (n or 1, ...).
            columns: the arrays to fill, by name.
        """


class Plan:
    """A plan that computes the points of frames with one layout.

    Attributes:
        tape: the traced operations of `points`.
        parts: the parts of the result of `points`, by name, as nodes or constant arrays.
        shape: the shape of the points of a packet, one length for each axis in `axes`.
        expressions: the columns that back ends compute, by name, as nodes or arrays.
        raw_fields: for each column in `extra` that consists of the raw integers of a field: this
            field, by the name of the column.
        exact: whether coordinates and range are computed in float64 in the written order.
        positive: nodes whose values have to be positive numbers for the plan to be valid.
        varying: the arrays whose lengths differ from frame to frame.
        tables: the lookup tables of back ends, shared by the plans of the function.

    Raises:
        UntraceableError: if only the reference evaluator can compute the points.
    """

    def __init__(self, function: PointsFunction, sample: Batch, layout: Layout) -> None:
        result, self.tape = graph.trace(function, sample)
        self._schema = schema = sample.table.schema
        if not isinstance(result, Polar | Cartesian):
            raise UntraceableError(
                f"`points` returns a {type(result).__name__}, not Polar or Cartesian"
            )
        self.function = function
        self.layout = layout
        self.nominal = result.nominal
        parts = list_parts(result)
        samples = {
            name: part.node.sample if isinstance(part, TracedColumn) else part
            for name, part in parts.items()
        }
        arrays, self.axes, _, shape = align_points(samples, sample)
        self.extra = list_extra_types(result, samples)
        parts = {
            name: part if isinstance(part, TracedColumn) else array
            for (name, part), array in zip(parts.items(), arrays, strict=True)
        }
        self.parts = {name: graph.get_node(part) for name, part in parts.items()}
        self.shape = shape[1:]
        self.varying = {name for name, count in schema.arrays.items() if not isinstance(count, int)}
        self.tables = _TABLES.setdefault(function, {})
        self.programs: dict[tuple[str, ...], ColumnMaker] = {}
        self.kernels: dict[tuple[str, ...], ColumnMaker] = {}
        if 0 in self.shape:
            raise UntraceableError("the packets have no points")
        self.exact = isinstance(result, Cartesian)
        if not any(
            has_value_per_point(self.parts[name], self.width)
            for name in ("xyz" if self.exact else ["range"])
        ):
            raise UntraceableError(
                f"`points` does not return {'coordinates' if self.exact else 'a range'} for each"
                " point of a packet"
            )
        self.positive = list[Node]()
        named = {
            name: part for name, part in list_parts(result).items() if isinstance(part, AlongAxis)
        }
        if self.exact:
            expressions = self._make_cartesian_columns(parts)
        else:
            expressions = self._make_polar_columns(parts, named)
        intensity = parts.get("intensity")
        if intensity is not None:
            if self._may_be_nan(intensity):
                expressions["intensity"] = np.nan_to_num(intensity)
            else:
                expressions["intensity"] = intensity
        expressions |= {
            name: self.parts[name] for name, kind in self.extra.items() if kind.dtype == np.float32
        }
        self.raw_fields = {
            name: leaf
            for name, kind in self.extra.items()
            if (leaf := self._find_sent_field(self.parts[name], kind.dtype)) is not None
        }
        expressions |= {name: self.parts[name] for name in self.raw_fields}
        self.expressions = {name: graph.get_node(value) for name, value in expressions.items()}

    @cached_property
    def width(self) -> int:
        """The number of points of a packet."""
        return math.prod(self.shape)

    @cached_property
    def is_level(self) -> bool:
        """Whether all points are in the horizontal plane through the sensor."""
        upright = [self.parts[name] for name in (["z"] if self.exact else ["elevation", "oz"])]
        return all(not isinstance(part, Node) and is_zero(part) for part in upright)

    @cached_property
    def floats(self) -> list[Node]:
        """The floating-point fields that have to be within `MODERATE_SIZES`."""
        if self.exact:
            return []
        return self._list_floats(
            *(part for name, part in self.parts.items() if not self.is_exact(name))
        )

    def is_exact(self, name: str) -> bool:
        """Return whether a column is computed in float64 as written, and then rounded."""
        return self.exact or name == "intensity" or name in self.extra

    def _find_sent_field(self, part: Any, dtype: np.dtype[Any]) -> Leaf | None:
        """Return the field whose raw integers are a column in `extra`, or None.

        Args:
            part: the expression of the column.
            dtype: the type of the column.
        """
        if isinstance(part, Node) and part.kind == "field":
            leaf = self.layout.leaves.get(part.path)
        else:
            leaf = None
        if (
            leaf is None
            or not has_value_per_point(part, self.width)
            or leaf.info.scaled
            or leaf.info.kind != "int"
        ):
            return None
        if (
            leaf.info.dtype == dtype
            and len(leaf.shape) == len(leaf.strides)
            and dtype.itemsize <= 4
        ):
            return leaf
        return None

    def _list_floats(self, *values: Any) -> list[Node]:
        """Return the floating-point fields that values depend on."""
        return [
            node
            for node in graph.traverse(*values)
            if node.kind == "field" and self._schema.fields[node.path].kind == "float"
        ]

    def _may_be_nan(self, value: Any) -> bool:
        return isinstance(value, TracedColumn) and (
            bool(self._list_floats(value)) or not is_always_finite(value.node, self.layout.leaves)
        )

    @cached_property
    def eager_nodes(self) -> list[Node]:
        """The nodes to compute for every batch, in order."""
        # They keep values between batches or are checked for each batch, or are inputs of such
        # nodes.
        wanted = [node for node in self.tape.nodes if node.kind in STATEFUL_KINDS]
        wanted += [node for node, _ in self.tape.steps] + self.positive
        return sorted(graph.traverse(*wanted), key=lambda node: node.number)

    def _make_polar_columns(
        self, parts: Mapping[str, Any], named: Mapping[str, AlongAxis]
    ) -> dict[str, Any]:
        """Return the columns of a `Polar` result."""
        distance = mark_invalid(self._mark_distance(parts["range"]), parts["invalid"])
        azimuth, elevation, *origin = (
            named.get(name, parts[name]) for name in ("azimuth", "elevation", "ox", "oy", "oz")
        )
        places = coordinates(distance, azimuth, elevation, origin)
        columns = {
            "range": shown_range(parts["range"], parts["invalid"]),
            "azimuth": parts["azimuth"],
        }
        return dict(zip("xyz", places, strict=True)) | columns

    def _make_cartesian_columns(self, parts: Mapping[str, Any]) -> dict[str, Any]:
        """Return the columns of a `Cartesian` result."""
        places = parts["x"], parts["y"], parts["z"]
        measured, azimuth, elevation = find_direction(*places)
        columns = {
            "range": shown_range(measured, parts["invalid"]),
            "azimuth": azimuth,
            "elevation": elevation,
        }
        return dict(zip("xyz", place_points(places, parts["invalid"]), strict=True)) | columns

    def _mark_distance(self, measured: TracedColumn) -> Any:
        """Return the distance of points, nan without a return."""
        # The field shows whether there is a return only if the factor is positive.
        node = measured.node
        if get_only_field(node) is None and node.kind == "call" and node.function is np.multiply:
            for full, low in (node.args, node.args[::-1]):
                if (
                    has_value_per_point(full, self.width)
                    and get_only_field(full) is not None
                    and isinstance(low, Node)
                    and not has_value_per_point(low, self.width)
                ):
                    self.positive.append(low)
                    return returned_range(TracedColumn(full, self.tape)) * TracedColumn(
                        low, self.tape
                    )
        return returned_range(measured)

    def has_finite_directions(self, values: Callable[[Node], NDArray[Any]]) -> bool:
        """Return whether all azimuths and elevations of a batch are finite.

        Args:
            values: a function that returns the value of a node for the batch.
        """
        if not self._may_have_finite_directions:
            return False
        for term in self._directions:
            if term.low is not None and not np.isfinite(values(term.low)).all():
                return False
            if term.full is not None and term.full.kind == "rows":
                index, table = term.full.args
                if (row_numbers(values(index), len(table)) >= len(table) - 1).any():
                    return False
        return True

    @cached_property
    def _may_have_finite_directions(self) -> bool:
        """Whether azimuth and elevation are finite, as far as is known without a batch."""
        fixed = all(
            isinstance(part, Node) or np.isfinite(part).all() for part in self._given_directions
        )
        return fixed and all(
            np.isfinite(term.row).all() and (term.full is None or self._is_finite(term.full))
            for term in self._directions
        )

    @cached_property
    def _directions(self) -> list[graph.Term]:
        return [term for node in self.directions for term in graph.split_sum(node, self.width)]

    @property
    def directions(self) -> list[Node]:
        """Azimuth and elevation, if they depend on data."""
        return [part for part in self._given_directions if isinstance(part, Node)]

    @property
    def _given_directions(self) -> tuple[Any, ...]:
        if self.exact:
            return ()
        return (self.parts["azimuth"], self.parts["elevation"])

    def _is_finite(self, node: Node) -> bool:
        """Return whether an expression is finite for all values of its field."""
        if node.kind == "rows":  # the last row, for indices outside of the table, is nan
            return bool(np.isfinite(node.args[1][:-1]).all())
        options = graph.find_choice(node, self.width)
        if options is not None:
            return all(
                self._is_finite(option) if isinstance(option, Node) else bool(np.isfinite(option))
                for option in options[1:]
            )
        return is_always_finite(node, self.layout.leaves)


#: The lookup tables of each `points` function, shared by its plans. The key of a table includes the
#: `FieldInfo`, because several sensors may share a function.
_TABLES: WeakKeyDictionary[PointsFunction, dict[Any, NDArray[Any]]] = WeakKeyDictionary()


def plan_for(function: PointsFunction, batch: Batch, group: LayoutRows) -> Plan | UntraceableError:
    """Return the plan for a group of frames, or the reason why it has none."""
    notes = group.layout.notes
    if function not in notes:
        try:
            notes[function] = Plan(function, graph.make_sample(batch, group), group.layout)
        except UntraceableError as reason:
            notes[function] = reason
    plan: Plan | UntraceableError = notes[function]
    return plan
