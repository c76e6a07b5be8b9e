"""Trace a function of fields: record its steps as a graph by calling it once.

A sensor declares functions of the fields of a frame, such as the function that computes the points.
`trace` calls such a function, and returns its result and the `Trace` of its steps. A step is a
`Node`: a field, a state column, an elementwise call, or a step that depends on the order of
packets. A step that cannot be recorded, such as a branch that depends on data, raises
`UntraceableError`.

`traverse` iterates over the nodes of a graph. `compute` evaluates one node for given values of the
fields.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import NDArray

from lidarspec.errors import SpecError
from lidarspec.expressions.columns import NO_TRUTH, Batch, Column, Fields, align, call_aligned
from lidarspec.frames.frame_table import CompiledTable, LayoutRows, Table
from lidarspec.frames.schema import Schema, without_indices
from lidarspec.spec.tree import FieldInfo
from lidarspec.spec.vocabulary import ELEMENTWISE, AlongAxis


class UntraceableError(Exception):
    """The error for a function that cannot be evaluated with a graph.

    The message is the reason. The function is then called for each batch instead.
    """


@dataclass(frozen=True, eq=False)
class Node:
    """One step of a traced function.

    Attributes:
        kind: "field" (of the frame), "state" (a field of other frames), "call" (of an elementwise
            function), "rows" (rows of a table, from `Column.gather`), or the name of another method
            of `Column`: "shift", "latest", "on" or "running".
        function: for "call", a function of arrays that broadcast; for "field" and "state", a
            function of `Fields` that returns the column; otherwise a function of columns that
            returns a column.
        args: the arguments: nodes, numbers and arrays.
        sample: the result for the sample packets.
        number: the position of the node in the order of evaluation.
        path: for "field" and "state", the path in the traced function: "header.time" for
            ``f.header.time``, if the function has the parameter f.
    """

    kind: str
    function: Callable[..., Any]
    args: tuple[Any, ...]
    sample: Column
    number: int
    path: str = ""

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """The lengths of the axes after the axis of packets."""
        return self.sample.shape[1:]

    @cached_property
    def width(self) -> int:
        """The number of values of the node for each packet; 0 if all packets share them."""
        size = int(np.prod(self.shape, dtype=np.intp))
        if self.sample.shape[0] > 1:
            return size
        return 0

    @cached_property
    def fields(self) -> tuple[Node, ...] | None:
        """The fields that the node is computed from, each once.

        None if a step of the computation is not an elementwise call.
        """
        if self.kind == "field":
            return (self,)
        depth = max((len(arg.sample.axes) for arg in self.args if isinstance(arg, Node)), default=0)
        if self.kind != "call" or len(self.sample.axes) != depth:
            return None
        field_nodes: dict[Node, None] = {}
        for arg in self.args:
            if isinstance(arg, Node):
                fields = arg.fields
            elif np.size(arg) == 1:
                fields = ()
            else:
                fields = None
            if fields is None:
                return None
            field_nodes |= dict.fromkeys(fields)
        return tuple(field_nodes)

    @cached_property
    def _first(self) -> int:
        """The index of the first node among the arguments."""
        return next(place for place, arg in enumerate(self.args) if isinstance(arg, Node))

    @cached_property
    def _operands(self) -> list[tuple[bool, Any]]:
        """A pair for each argument.

        For a node, the pair is True and a shape: the axes of length 1 to append to the values. For
        a constant, the pair is False and the constant as an array.
        """
        depth = max(len(arg.sample.axes) for arg in self.args if isinstance(arg, Node))
        return [
            (
                (True, (1,) * (depth - len(arg.sample.axes)))
                if isinstance(arg, Node)
                else (False, np.asarray(arg))
            )
            for arg in self.args
        ]

    def value(self, args: list[Any]) -> Any:
        """Return the value of the node, given the values of its arguments."""
        if self.kind != "call":
            return self.function(*args)
        first = args[self._first]
        if isinstance(first, Column):
            return first.apply_function(self.function, *args)
        arrays = [
            known if not is_node else arg.reshape(*arg.shape, *known) if known else arg
            for arg, (is_node, known) in zip(args, self._operands, strict=True)
        ]
        return call_aligned(self.function, arrays)


@dataclass
class Trace:
    """The nodes of a traced function, and the conditions for using them.

    Attributes:
        nodes: the nodes in the order in which they were made.
        steps: for each call of `Column.steps`, the node of the column and the length of the result.
            The trace is valid only for packets with these lengths.
    """

    nodes: list[Node] = field(default_factory=list)
    steps: list[tuple[Node, int]] = field(default_factory=list)
    _read: dict[str, Node] = field(default_factory=dict)

    def add(
        self,
        kind: str,
        function: Callable[..., Any],
        args: tuple[Any, ...],
        sample: Column,
        path: str = "",
    ) -> TracedColumn:
        """Add a node, and return it as a traced column.

        Args:
            path: the path of the field, if the node reads a field. An existing node for this path
                is returned.
        """
        if path in self._read:
            return TracedColumn(self._read[path], self)
        node = Node(kind, function, tuple(map(get_node, args)), sample, len(self.nodes), path)
        self.nodes.append(node)
        if path:
            self._read[path] = node
        return TracedColumn(node, self)


class TracedColumn(NDArrayOperatorsMixin):
    """A column that records the operations on it; it has the same methods as `Column`."""

    def __init__(self, node: Node, tape: Trace) -> None:
        self.node = node
        self._tape = tape

    @property
    def known_values(self) -> NDArray[Any]:
        """The values of the sample packets, with which the function is traced."""
        return self.node.sample.array

    def __array_ufunc__(
        self, ufunc: np.ufunc, method: str, *inputs: Any, **kwargs: Any
    ) -> TracedColumn:
        if kwargs.get("out") is not None:
            raise SpecError("a column cannot be changed in place: write a new expression")
        if method != "__call__":
            raise UntraceableError(
                f"np.{ufunc.__name__}.{method} combines several elements of an array"
            )
        return self.apply_function(
            (lambda *arrays: ufunc(*arrays, **kwargs)) if kwargs else ufunc, *inputs
        )

    def __array_function__(
        self, function: Callable[..., Any], types: Any, args: Any, kwargs: Any
    ) -> TracedColumn:
        if function not in ELEMENTWISE:
            raise UntraceableError(f"np.{function.__name__} is not elementwise")
        return self.apply_function(
            (lambda *arrays: function(*arrays, **kwargs)) if kwargs else function, *args
        )

    def apply_function(self, function: Callable[..., Any], *values: Any) -> TracedColumn:
        """Record the call of a function of arrays."""
        samples = [
            value.node.sample if isinstance(value, TracedColumn) else value for value in values
        ]
        # Other operands are recorded as aligned arrays.
        arrays, _, _ = align(tuple(samples), self.node.sample.batch)
        table = _fold_table_rows(function, values, arrays)
        if table is not None:
            return TracedColumn(table[0], self._tape).gather(table[1])
        args = tuple(
            value if isinstance(value, TracedColumn | int | float) else array
            for value, array in zip(values, arrays, strict=True)
        )
        return self._tape.add(
            "call", function, args, self.node.sample.apply_function(function, *samples)
        )

    @property
    def index(self) -> AlongAxis:
        """The numbers 0, 1, 2 ... of the elements of the column's innermost array."""
        return self.node.sample.index

    def on(self, *axes: str) -> Any:
        """Record a call of `Column.on`."""
        sample = self.node.sample.on(*axes)
        if sample.array.size > self.node.sample.array.size:
            # The sample packets have no elements of the column's array.
            if not self.node.sample.array.size:
                return np.nan
            raise UntraceableError(
                f".on({', '.join(map(repr, axes))}) moves a column to a longer array"
            )
        if (
            sample.axes == self.node.sample.axes
            and sample.array.shape == self.node.sample.array.shape
        ):
            return self
        return self._tape.add("on", lambda column: column.on(*axes), (self,), sample)

    def gather(self, table: NDArray[np.float64]) -> TracedColumn:
        """Record a call of `Column.gather`."""
        return self._tape.add(
            "rows",
            lambda column, rows: column.gather(rows),
            (self, table),
            self.node.sample.gather(table),
        )

    def running(self) -> TracedColumn:
        """Record a call of `Column.running`."""
        return self._tape.add(
            "running", lambda column: column.running(), (self,), self.node.sample.running()
        )

    def steps(self) -> AlongAxis | NDArray[np.intp]:
        """Return `Column.steps` for the sample packets, and record its length."""
        indices = self.node.sample.steps()
        self._tape.steps.append((self.node, len(indices)))
        return indices

    def shift(self, step: int) -> TracedColumn:
        """Record a call of `Column.shift`."""
        return self._tape.add(
            "shift", lambda column: column.shift(step), (self,), self.node.sample.shift(step)
        )

    def latest(self, where: Any = None) -> TracedColumn:
        """Record a call of `Column.latest`."""
        if isinstance(where, TracedColumn):
            condition = where.node.sample
        else:
            condition = where
        return self._tape.add(
            "latest",
            lambda column, flags=None: column.latest(flags),
            (self, where),
            self.node.sample.latest(condition),
        )

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise UntraceableError(f"the function reads the attribute .{name} of a column")

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        raise UntraceableError("the function converts a column to an array")

    def __bool__(self) -> bool:
        raise SpecError(NO_TRUTH, rule="LS213")

    def __len__(self) -> int:
        raise UntraceableError("the function reads the length of a column")

    def __getitem__(self, index: Any) -> TracedColumn:
        """Record one element of an array field as a field."""
        node = self.node
        return self._tape.add(
            node.kind,
            lambda fields: node.function(fields)[index],
            (),
            node.sample[index],
            f"{node.path}[{index}]",
        )


class TracedFields:
    """The fields of the sample packets, as columns that record the operations on them."""

    def __init__(
        self,
        real: Any,
        tape: Trace,
        path: str = "",
        read: Callable[[Any], Any] = lambda fields: fields,
    ) -> None:
        self._real = real
        self._tape = tape
        self._path = path
        self._read = read

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        path = f"{self._path}.{name}".lstrip(".")
        before = self._read
        value, read = getattr(self._real, name), lambda fields: getattr(before(fields), name)
        if isinstance(value, AlongAxis):
            return value
        if not isinstance(value, Column):
            return TracedFields(value, self._tape, path, read)
        if not value.frame:
            _check_raw(value.batch.table.schema, without_indices(path)[0])
        return self._tape.add(
            "state" if self._real._is_of_other_frames else "field", read, (), value, path
        )

    def __getitem__(self, index: Any) -> TracedFields:
        before = self._read
        return TracedFields(
            self._real[index],
            self._tape,
            f"{self._path}[{index}]",
            lambda fields: before(fields)[index],
        )


def _check_raw(schema: Schema, path: str) -> None:
    """Raise UntraceableError if a field is not sent as a number."""
    if path in schema.derived:
        raise UntraceableError(f"{path} is not sent; it is computed from other fields")
    if schema.find_sequence(path) is not None:
        raise UntraceableError(f"{path} is in an array whose elements have different sizes")
    if schema.fields[path].adapter is not None:
        raise UntraceableError(f"a Python function computes the values of {path}")


def _fold_table_rows(
    function: Callable[..., Any], values: Sequence[Any], arrays: Sequence[Any]
) -> tuple[Node, NDArray[np.float64]] | None:
    """Replace ``function(table[indices])`` by ``function(table)[indices]``.

    The function is then computed once for the table, not for the rows of each packet.

    Returns:
        The node of the indices, and the table of the results. None if the arguments are not table
        rows with the same indices and constants, or if the results have another shape or dtype than
        the table.
    """
    nodes = [value.node for value in values if isinstance(value, TracedColumn)]
    if any(node.kind != "rows" or node.args[0] is not nodes[0].args[0] for node in nodes):
        return None
    (index, first), shape = nodes[0].args, nodes[0].sample.array.shape
    has_rows = shape[-1] == first.shape[1] and index.sample.array.shape[len(shape) - 1 :] in (
        (),
        (1,),
    )
    known: list[Any] = []
    for value, array in zip(values, arrays, strict=True):
        if isinstance(value, TracedColumn):
            known.append(value.node.args[1])
        elif np.size(value) == 1 or (
            has_rows and array.shape[-1] == np.size(array) == first.shape[1]
        ):
            known.append(np.asarray(array).reshape(-1))
        else:
            return None
    table = call_aligned(function, known)
    if table.dtype == np.float64 and table.shape == first.shape:
        return (index, table)
    return None


def get_node(value: Any) -> Any:
    """Return the node of a traced column; return other values unchanged."""
    if isinstance(value, TracedColumn):
        return value.node
    return value


def trace(function: Callable[[Any], Any], sample: Batch) -> tuple[Any, Trace]:
    """Call a function with traced columns, and return its result and the trace of its steps.

    Raises:
        UntraceableError: if a step cannot be recorded.
    """
    tape = Trace()
    with np.errstate(all="ignore"):
        return function(TracedFields(Fields(sample), tape)), tape


def make_sample(batch: Batch, group: LayoutRows) -> Batch:
    """Return a batch for tracing: two copies of the first frame of a group."""
    # With two packets, values that all packets share can be recognized: they are there once.
    return batch.of(
        LayoutRows(group.layout, group.where[[0, 0]], np.ascontiguousarray(group.rows[[0, 0]]))
    )


def traverse(*values: Any, into: Callable[[Node], bool] = lambda node: True) -> Iterator[Node]:
    """Yield each node that the given values depend on, once.

    Args:
        values: nodes, traced columns, or constants, which have no nodes.
        into: a function that returns whether the arguments of a node are visited too.
    """
    seen = set[Node]()
    waiting = [get_node(value) for value in values]
    while waiting:
        node = waiting.pop()
        if isinstance(node, Node) and node not in seen:
            seen.add(node)
            yield node
            waiting += node.args if into(node) else ()


def compute(
    node: Node, results: dict[Node, Any], source: Callable[[Node], Any] = lambda node: None
) -> Any:
    """Compute the value of a node and of the nodes that it depends on.

    Args:
        results: the known values of nodes, to which new values are added.
        source: a function that returns the value of a node if it is known, for example for a field.
            If the function returns None, the node is computed.

    Returns:
        A column if the values of the fields are columns, otherwise an array.
    """
    value = results.get(node)
    if value is None:
        value = source(node)
        if value is None:
            value = node.value(
                [
                    compute(arg, results, source) if isinstance(arg, Node) else arg
                    for arg in node.args
                ]
            )
        results[node] = value
    return value


def get_only_field(node: Node) -> Node | None:
    """Return the only field of an expression; None if it has several fields or none."""
    if node.fields is not None and len(node.fields) == 1:
        return node.fields[0]
    return None


@dataclass(frozen=True, eq=False)
class Expression:
    """An elementwise expression of fields that are all in the same array of the frame.

    Attributes:
        node: the node of the expression.
        fields: the fields of the expression, each once.
    """

    node: Node
    fields: tuple[FieldInfo, ...]

    @classmethod
    def of(cls, node: Node, schema: Schema) -> Expression:
        """Return a node as an expression.

        Raises:
            UntraceableError: if the node depends on fields of different arrays, or on anything that
                is not a field of the frame.
        """
        if node.fields is None:
            raise UntraceableError(
                "the expression depends on values that are not fields of the frame"
            )
        infos = tuple(schema.fields[source.path] for source in node.fields)
        if len({info.axes for info in infos}) != 1:
            raise UntraceableError("the expression combines fields of different arrays")
        return cls(node, infos)

    def values(self, raw: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
        """Return the values of the expression, given the raw values of the fields by path.

        All arrays have the same shape. The result is nan if a field has no value.
        """
        (values,) = evaluate_expressions([self], raw)
        return values


def evaluate_expressions(
    expressions: Sequence[Expression], raw: Mapping[str, NDArray[Any]]
) -> list[NDArray[Any]]:
    """Return `Expression.values` of each expression; common nodes are computed once."""
    infos = {info.path: info for expression in expressions for info in expression.fields}
    results = dict[Node, Any]()
    with np.errstate(all="ignore"):
        columns = {
            path: info.physical(np.asarray(raw.get(path, np.nan), np.float64))
            for path, info in infos.items()
        }
        return [
            np.asarray(compute(expression.node, results, lambda node: columns.get(node.path)))
            for expression in expressions
        ]


#: The maximum number of cached values of a term.
MAX_CACHED_VALUES = 64

#: A function that converts the values of a term to integers, (n,) or (1,), given the values and the
#: number of packets n.
IntegerConverter = Callable[[Any, int], NDArray[np.int64]]


class HeaderFunction:
    """Evaluates a function of header fields, and caches the terms of its result.

    Args:
        function: a function of `Fields` that returns a column, or several columns (the terms).
        to_integers: a function that converts the values of a term to integers, for example seconds
            to nanoseconds. The sum of the terms is then exact.
    """

    def __init__(self, function: Callable[[Any], Any], to_integers: IntegerConverter) -> None:
        self._function = function
        self._to_integers = to_integers
        self._terms: list[_TermEvaluator] | None = None
        self._is_tried = False

    def __call__(self, batch: Batch) -> list[NDArray[np.int64]]:
        """Return the integers of each term, (n,), or (1,) if they are the same in all packets."""
        table = batch.table
        if not self._is_tried and isinstance(table, CompiledTable):
            self._is_tried, self._terms = True, self._split_terms(batch, table)
        if self._terms is None:
            return [
                self._to_integers(term, len(batch))
                for term in _to_terms(self._function(Fields(batch)))
            ]
        return [term(table) for term in self._terms]

    def _split_terms(self, batch: Batch, table: CompiledTable) -> list[_TermEvaluator] | None:
        try:
            traced, _ = trace(self._function, make_sample(batch, table.groups[0]))
            return [
                _TermEvaluator(Expression.of(term.node, table.schema), self._to_integers)
                for term in _to_terms(traced)
            ]
        except Exception:  # calling the function itself reports the error
            return None


def _to_terms(terms: Any) -> Sequence[Any]:
    if isinstance(terms, tuple | list):
        return terms
    return (terms,)


class _TermEvaluator:
    """Evaluates one term of a `HeaderFunction`, and caches its values.

    Raises:
        UntraceableError: if a field is optional or in an array.
    """

    def __init__(self, expression: Expression, to_integers: IntegerConverter) -> None:
        if any(info.axes or info.optional for info in expression.fields):
            raise UntraceableError(
                "the expression uses a field that is optional or inside an array"
            )
        self._expression = expression
        self._to_integers = to_integers
        self._known: dict[tuple[Any, ...], NDArray[np.int64]] = {}

    def __call__(self, table: Table) -> NDArray[np.int64]:
        columns = [table.raw(info.path) for info in self._expression.fields]
        if self._expression.node.kind == "field":
            return self._compute(columns)
        changes = np.zeros(len(table), np.bool_)
        for column in columns:
            changes[1:] |= column[1:] != column[:-1]
        starts = np.flatnonzero(changes)
        if not len(starts):
            return self._get_cached([column[:1] for column in columns])
        if 2 * len(starts) > len(table):
            return self._compute(columns)
        starts = np.concatenate([[0], starts])
        values = self._compute([column[starts] for column in columns])
        return np.repeat(values, np.diff(starts, append=len(table)))

    def _get_cached(self, columns: list[NDArray[Any]]) -> NDArray[np.int64]:
        """Return the integer for one packet, (1,); compute it if the cache lacks it.

        Args:
            columns: the raw values of the fields, (1,) each.
        """
        key = tuple(column.item(0) for column in columns)
        cached = self._known.get(key)
        if cached is None:
            cached = self._compute(columns)
            if len(self._known) >= MAX_CACHED_VALUES:
                self._known.clear()
            self._known[key] = cached
        return cached

    def _compute(self, columns: list[NDArray[Any]]) -> NDArray[np.int64]:
        raw = {
            info.path: column for info, column in zip(self._expression.fields, columns, strict=True)
        }
        return self._to_integers(self._expression.values(raw), len(columns[0]))


@lru_cache(maxsize=256)
def header_function(
    function: Callable[[Any], Any], schema: Schema, to_integers: IntegerConverter
) -> HeaderFunction:
    """Return the `HeaderFunction` of a function and a schema, cached."""
    return HeaderFunction(function, to_integers)


def split_condition(node: Node) -> Iterator[Node]:
    """Split a condition at its "and" operators, and yield the operands."""
    both = node.kind == "call" and node.function in (np.bitwise_and, np.logical_and)
    if both and all(
        isinstance(arg, Node) and arg.sample.array.dtype == np.bool_ for arg in node.args
    ):
        for arg in node.args:
            yield from split_condition(arg)
    else:
        yield node


#: The functions of one argument that multiply it by a number, and these numbers.
FACTORS = {np.negative: -1.0, np.positive: 1.0, np.deg2rad: np.pi / 180, np.radians: np.pi / 180}
FACTORS |= {np.rad2deg: 180 / np.pi, np.degrees: 180 / np.pi}


@dataclass(frozen=True, eq=False)
class Term:
    """A term of a sum: a factor, multiplied by a node if there is one.

    Attributes:
        row: the factor: a number, or a row of numbers that all packets share.
        low: the node, if it has one value for each packet or for each block of points; else None.
        full: the node, if it has one value for each point; else None.
    """

    row: NDArray[np.float64]
    low: Node | None = None
    full: Node | None = None

    def times(self, factor: Any) -> Term:
        """Return the term multiplied by a number, or by a row of numbers."""
        return Term(self.row * factor, self.low, self.full)


def has_value_per_point(value: Any, width: int) -> bool:
    """Return whether a value is a node with a value for each of `width` points."""
    return isinstance(value, Node) and value.width == width


def find_choice(node: Node, width: int) -> tuple[Node, Any, Any] | None:
    """Return the condition and the two options of a simple ``np.where``, or None.

    The condition has one value for each packet or block. Each option is a number, or an expression
    of one field.
    """
    if node.kind != "call" or node.function is not np.where or len(node.args) != 3:
        return None
    condition, *options = node.args
    fits = [
        get_only_field(o) is not None and has_value_per_point(o, width)
        if isinstance(o, Node)
        else np.size(o) == 1
        for o in options
    ]
    if not isinstance(condition, Node) or has_value_per_point(condition, width) or not all(fits):
        return None
    return condition, *(
        o if isinstance(o, Node) else float(np.asarray(o).reshape(())) for o in options
    )  # type: ignore[return-value]


def is_nan_where(node: Node) -> bool:
    """Return whether a node is ``np.where(condition, nan, value)``."""
    if (
        node.function is not np.where
        or len(node.args) != 3
        or isinstance(node.args[1], Node)
        or np.size(node.args[1]) > 1
    ):
        return False
    return isinstance(node.args[2], Node) and bool(np.isnan(node.args[1]).all())


def make_key(node: Node) -> tuple[Any, ...]:
    """Return a key that is equal for equal expressions of one field."""
    if node.kind == "field":
        return ("field", node.path)
    return (
        node.function,
        *(make_key(arg) if isinstance(arg, Node) else np.asarray(arg).item() for arg in node.args),
    )


def split_sum(value: Any, width: int) -> list[Term]:
    """Return the terms of a sum; an expression that is not a sum is the only term."""
    if not isinstance(value, Node):
        return [Term(np.asarray(value, np.float64))]
    if not has_value_per_point(value, width) and value.width:
        return [Term(np.ones(()), low=value)]
    function = value.function
    args = value.args
    if value.kind == "call" and get_only_field(value) is None:
        if function in FACTORS:
            return _scale_terms(value, split_sum(args[0], width), FACTORS[function])
        if function in (np.add, np.subtract):
            sign = 1.0 if function is np.add else -1.0
            return split_sum(args[0], width) + [
                term.times(sign) for term in split_sum(args[1], width)
            ]
        if function in (np.multiply, np.true_divide) and not isinstance(args[1], Node):
            if function is np.multiply:
                factor = np.asarray(args[1], np.float64)
            else:
                factor = 1 / np.asarray(args[1], np.float64)
            return _scale_terms(value, split_sum(args[0], width), factor)
        if function is np.multiply and not isinstance(args[0], Node):
            return _scale_terms(value, split_sum(args[1], width), np.asarray(args[0], np.float64))
    return [Term(np.ones(()), full=value)]


def _scale_terms(value: Node, parts: list[Term], factor: Any) -> list[Term]:
    """Return the terms of the product of a sum and a factor.

    Args:
        value: the node of the product. If the factor is a row, and a term of the sum has a value
            for each point, this node is returned as the only term.
        parts: the terms of the sum.
        factor: a number, or a row of numbers that all packets share.
    """
    if np.ndim(factor) and any(part.full is not None for part in parts):
        return [Term(np.ones(()), full=value)]
    return [part.times(factor) for part in parts]


def count_used_axes(shape: tuple[int, ...]) -> int:
    """Return the number of axes up to the last axis with a length above 1."""
    return max((index + 1 for index, length in enumerate(shape) if length > 1), default=0)
