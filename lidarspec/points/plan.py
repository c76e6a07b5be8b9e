"""The plan of a sensor's points: `points` traced once for a layout, and its columns as expressions.

`Plan` knows how points become coordinates (by `points.conventions`, as the plain evaluation does),
and which values have to be known of a batch before they are computed. It computes nothing: a
`ColumnMaker` does, which a back end compiles from it (`points.numpy_plan`, `points.numba_kernels`).
Plans are kept with the layout that they are for, so a stream of packets traces nothing again.

Points by coordinates are three expressions and a mask (`conventions.place_points`), their range and
angles further ones. They are exact: computed in float64 as they are written, whatever
floating-point fields hold. Points by direction are computed in another order and partly in float32:
their plan holds where what a batch has in floating-point fields is of moderate size (`MODERATE`).
Columns under names of a sensor's own are further expressions where they are float32, exact too, or
whole numbers of a field as it was sent; others are what `points` says, in their type.
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
    is_full,
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
from lidarspec.points.lookup_tables import is_number
from lidarspec.points.reference_evaluator import list_extra_types, list_parts
from lidarspec.spec.results import Cartesian, Polar
from lidarspec.spec.vocabulary import AlongAxis, row_numbers

PointsFunction = Callable[[Any], Any]

#: the plain result of a node for the frames under way, shape (n or 1, ...).
Values = Callable[[Node], NDArray[Any]]

#: steps that remember something between packets or batches, or that other frames decide.
REMEMBERING = ("shift", "latest", "state")

#: the least and the most that a floating-point field may hold, if it is not 0, where float32 and
#: another order of sums have to do no harm.
MODERATE = 2.0**-60, 2.0**60


class ColumnMaker(Protocol):
    """Makes some columns of the points of frames of one layout."""

    def columns(self, number: int) -> dict[str, NDArray[Any]]:
        """Return the columns of so many frames, by name, to be filled: (number * width,) each."""

    def run(self, rows: Bytes2D, values: Values, columns: Mapping[str, NDArray[Any]]) -> None:
        """Fill the columns of all frames.

        Args:
            rows: the frames, at one distance from each other.
            values: the plain result of a node for these frames, shape (n or 1, ...).
            columns: flat, contiguous and as long as `columns` makes them.
        """


class Plan:
    """The plan by which the points of frames of one layout are computed.

    Attributes:
        function: the `points` function.
        layout: of the frames.
        tape: what `points` computes.
        parts: what it returned, by name, as nodes or as what no data decides.
        shape: of the points of a packet, one length for each axis in `axes`.
        expressions: the columns that back ends make, by name, as nodes or as what no data decides.
        extra: what the columns under names of the sensor's own hold, by name.
        sent: those of `extra` that are whole numbers of a field as they were sent, and the field's
            place.
        exact: whether coordinates and range are computed in float64 as they are written, as all
            other columns are.
        positive: nodes whose values have to be positive numbers, or the plan does not hold.
        nominal: whether a default calibration stands in for the sensor's own.
        varying: the arrays whose lengths differ from frame to frame.
        tables: those of back ends, by what they are of, shared by the plans of the function.
        programs, kernels: what back ends made, by the names of the columns.

    Raises:
        Untraceable: where only plain evaluation can do it; the text says why.
    """

    def __init__(self, function: PointsFunction, sample: Batch, layout: Layout) -> None:
        result, self.tape = graph.trace(function, sample)
        self._schema = schema = sample.table.schema
        if not isinstance(result, Polar | Cartesian):
            raise UntraceableError(f"a result of type {type(result).__name__}")
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
            raise UntraceableError("packets without points")
        self.exact = isinstance(result, Cartesian)
        if not any(
            is_full(self.parts[name], self.width) for name in ("xyz" if self.exact else ["range"])
        ):
            raise UntraceableError(
                f"points that share {'coordinates' if self.exact else 'a range'}"
            )
        self.positive = list[Node]()
        named = {
            name: part for name, part in list_parts(result).items() if isinstance(part, AlongAxis)
        }
        if self.exact:
            expressions = self._by_coordinates(parts)
        else:
            expressions = self._by_direction(parts, named)
        intensity = parts.get("intensity")
        if intensity is not None:
            if self._may_be_nan(intensity):
                expressions["intensity"] = np.nan_to_num(intensity)
            else:
                expressions["intensity"] = intensity
        expressions |= {
            name: self.parts[name] for name, kind in self.extra.items() if kind.dtype == np.float32
        }
        self.sent = {
            name: leaf
            for name, kind in self.extra.items()
            if (leaf := self._sent(self.parts[name], kind.dtype)) is not None
        }
        expressions |= {name: self.parts[name] for name in self.sent}
        self.expressions = {name: graph.get_node(value) for name, value in expressions.items()}

    @cached_property
    def width(self) -> int:
        """Points of a packet."""
        return math.prod(self.shape)

    @cached_property
    def level(self) -> bool:
        """Whether all points lie in the horizontal plane through the sensor."""
        upright = [self.parts[name] for name in (["z"] if self.exact else ["elevation", "oz"])]
        return all(not isinstance(part, Node) and is_zero(part) for part in upright)

    @cached_property
    def floats(self) -> list[Node]:
        """The floating-point fields that have to be of moderate size.

        Otherwise the plan is not valid.
        """
        if self.exact:
            return []
        return self._floats_of(
            *(part for name, part in self.parts.items() if not self.is_exact(name))
        )

    def is_exact(self, name: str) -> bool:
        """Return whether a column is computed in float64 as it is written, and rounded then."""
        return self.exact or name == "intensity" or name in self.extra

    def _sent(self, part: Any, dtype: np.dtype[Any]) -> Leaf | None:
        """Return the place of the field that is equal to a further column.

        Returns None unless each point has its own value of such a field, of the same type.
        """
        if isinstance(part, Node) and part.kind == "field":
            leaf = self.layout.leaves.get(part.path)
        else:
            leaf = None
        if (
            leaf is None
            or not is_full(part, self.width)
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

    def _floats_of(self, *values: Any) -> list[Node]:
        """Return the floating-point fields that values are made of."""
        return [
            node
            for node in graph.traverse(*values)
            if node.kind == "field" and self._schema.fields[node.path].kind == "float"
        ]

    def _may_be_nan(self, value: Any) -> bool:
        return isinstance(value, TracedColumn) and (
            bool(self._floats_of(value)) or not is_number(value.node, self.layout.leaves)
        )

    @cached_property
    def eager(self) -> list[Node]:
        """The nodes to compute for every batch.

        They remember values between batches, or are inputs of such nodes.
        """
        wanted = [node for node in self.tape.nodes if node.kind in REMEMBERING]
        wanted += [node for node, _ in self.tape.steps] + self.positive
        return sorted(graph.traverse(*wanted), key=lambda node: node.number)

    def _by_direction(
        self, parts: Mapping[str, Any], named: Mapping[str, AlongAxis]
    ) -> dict[str, Any]:
        """Return the columns that back ends make from the parts of `Polar`.

        Args:
            named: the parts with named arrays.
        """
        distance = mark_invalid(self._distance(parts["range"]), parts["invalid"])
        azimuth, elevation, *origin = (
            named.get(name, parts[name]) for name in ("azimuth", "elevation", "ox", "oy", "oz")
        )
        places = coordinates(distance, azimuth, elevation, origin)
        columns = {
            "range": shown_range(parts["range"], parts["invalid"]),
            "azimuth": parts["azimuth"],
        }
        return dict(zip("xyz", places, strict=True)) | columns

    def _by_coordinates(self, parts: Mapping[str, Any]) -> dict[str, Any]:
        """Return the columns that back ends make, of the parts of `Cartesian`."""
        places = parts["x"], parts["y"], parts["z"]
        measured, azimuth, elevation = find_direction(*places)
        columns = {
            "range": shown_range(measured, parts["invalid"]),
            "azimuth": azimuth,
            "elevation": elevation,
        }
        return dict(zip("xyz", place_points(places, parts["invalid"]), strict=True)) | columns

    def _distance(self, measured: TracedColumn) -> Any:
        """Return the distance of a return, nan without a return.

        If a low value only scales the distance, that value has to be positive.
        """
        node = measured.node
        if get_only_field(node) is None and node.kind == "call" and node.function is np.multiply:
            for full, low in (node.args, node.args[::-1]):
                if (
                    is_full(full, self.width)
                    and get_only_field(full) is not None
                    and isinstance(low, Node)
                    and not is_full(low, self.width)
                ):
                    self.positive.append(low)
                    return returned_range(TracedColumn(full, self.tape)) * TracedColumn(
                        low, self.tape
                    )
        return returned_range(measured)

    def safe(self, values: Callable[[Node], NDArray[Any]]) -> bool:
        """Return whether all directions are finite if their inputs are.

        In that case a nan marks all coordinates alike.
        """
        if not self._may_be_safe:
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
    def _may_be_safe(self) -> bool:
        """Whether all values of the directions that are known in advance are finite.

        Values that are known only with a batch are not checked.
        """
        fixed = all(
            isinstance(part, Node) or np.isfinite(part).all() for part in self._directions_given
        )
        return fixed and all(
            np.isfinite(term.row).all() and (term.full is None or self._finite(term.full))
            for term in self._directions
        )

    @cached_property
    def _directions(self) -> list[graph.Term]:
        return [term for node in self.directed for term in graph.split_sum(node, self.width)]

    @property
    def directed(self) -> list[Node]:
        """Azimuth and elevation, as far as data decides them."""
        return [part for part in self._directions_given if isinstance(part, Node)]

    @property
    def _directions_given(self) -> tuple[Any, ...]:
        if self.exact:
            return ()
        return (self.parts["azimuth"], self.parts["elevation"])

    def _finite(self, node: Node) -> bool:
        """Return whether an expression is a number for every value that its field can have."""
        if node.kind == "rows":  # of a table of numbers, if the indices are in it
            return bool(np.isfinite(node.args[1][:-1]).all())
        options = graph.find_choice(node, self.width)
        if options is not None:
            return all(
                self._finite(option) if isinstance(option, Node) else bool(np.isfinite(option))
                for option in options[1:]
            )
        return is_number(node, self.layout.leaves)


#: tables by what they are of, shared by the plans of a `points` function, which several sensors may
#: have: a field is told by its info.
_TABLES: WeakKeyDictionary[PointsFunction, dict[Any, NDArray[Any]]] = WeakKeyDictionary()


def plan_for(function: PointsFunction, batch: Batch, group: LayoutRows) -> Plan | UntraceableError:
    """Return the plan for frames of a group's layout, or the reason why there is none.

    The layout keeps it.
    """
    notes = group.layout.notes
    if function not in notes:
        try:
            notes[function] = Plan(function, graph.make_sample(batch, group), group.layout)
        except UntraceableError as reason:
            notes[function] = reason
    plan: Plan | UntraceableError = notes[function]
    return plan
