"""What a `points` function computes, as a graph: it is called once with columns that note down what is done to them.

Every traced column carries the plain result for two sample packets beside its node, so shapes and axes need no rules of
their own. What cannot be noted down (a branch on data, reductions, attributes of arrays) is `Untraceable`, with the reason.

What can be said of a traced expression without computing it: what it depends on, and sums taken apart.

A value is *full* where each point has its own, else *low*: then it is computed once for its packet or block, plainly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import NDArray

from lidarspec.columns.columns import ELEMENTWISE, Batch, Column, Fields
from lidarspec.errors import SpecError


class Untraceable(Exception):
    """Something that only plain evaluation can do; the text says what."""


@dataclass(frozen=True, eq=False)
class Node:
    """One step of the computation.

    Attributes:
        kind: "field", "state", "shift", "latest", "on" or "call".
        function: for "call" what is applied to arrays that broadcast; for the others what makes the column of a batch.
        args: nodes, numbers and arrays.
        sample: the result for the sample.
        number: position in the order of evaluation.
        path: of a field.
    """

    kind: str
    function: Callable[..., Any]
    args: tuple[Any, ...]
    sample: Column
    number: int
    path: str = ""

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """Lengths after the packets' axis."""
        return self.sample.shape[1:]

    @cached_property
    def width(self) -> int:
        """Values for each packet; 0 where all packets share them."""
        size = int(np.prod(self.shape, dtype=np.intp))
        return size if self.sample.shape[0] > 1 else 0

    @cached_property
    def operands(self) -> list[tuple[Node | None, Any]]:
        """What is called with: nodes, each with the axes that it lacks of the deepest; None with what is no node, as an array."""
        depth = max(len(arg.sample.axes) for arg in self.args if isinstance(arg, Node))
        return [(arg, (1,) * (depth - len(arg.sample.axes))) if isinstance(arg, Node) else (None, np.asarray(arg)) for arg in self.args]

    def column(self, values: list[Any], fields: Fields) -> Column:
        """The plain result for a batch, from the results of the nodes before."""
        args = [values[arg.number] if isinstance(arg, Node) else arg for arg in self.args]
        if self.kind in ("field", "state"):
            return self.function(fields)  # type: ignore[no-any-return]
        if self.kind == "call":
            first = next(arg for arg in args if isinstance(arg, Column))
            return first.applied(self.function, *args)
        return self.function(*args)  # type: ignore[no-any-return]


@dataclass
class Tape:
    """The nodes of a trace in the order in which they were made, and what was assumed.

    Attributes:
        nodes: in order.
        steps: (node, largest value) of counts whose indices were asked for: the trace holds for these only.
    """

    nodes: list[Node] = field(default_factory=list)
    steps: list[tuple[Node, int]] = field(default_factory=list)

    def add(self, kind: str, function: Callable[..., Any], args: tuple[Any, ...], sample: Column, path: str = "") -> Traced:
        """A new node, as a traced column."""
        plain = tuple(arg.node if isinstance(arg, Traced) else arg for arg in args)
        node = Node(kind, function, plain, sample, len(self.nodes), path)
        self.nodes.append(node)
        return Traced(node, self)


class Traced(NDArrayOperatorsMixin):
    """A column that notes down what is done to it; offers what `Column` offers to expressions."""

    def __init__(self, node: Node, tape: Tape) -> None:
        self.node, self._tape = node, tape

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **kwargs: Any) -> Traced:
        if kwargs.get("out") is not None:
            raise SpecError("columns cannot be changed in place; write a new expression instead")
        if method != "__call__":
            raise Untraceable(f"np.{ufunc.__name__}.{method} takes several values together")
        return self._called((lambda *arrays: ufunc(*arrays, **kwargs)) if kwargs else ufunc, inputs)

    def __array_function__(self, function: Callable[..., Any], types: Any, args: Any, kwargs: Any) -> Traced:
        if function not in ELEMENTWISE:
            raise Untraceable(f"np.{function.__name__} is not elementwise")
        return self._called((lambda *arrays: function(*arrays, **kwargs)) if kwargs else function, args)

    def applied(self, function: Callable[..., Any], *values: Any) -> Traced:
        """See `Column.applied`."""
        return self._called(function, values)

    def _called(self, function: Callable[..., Any], values: tuple[Any, ...]) -> Traced:
        samples = [value.node.sample if isinstance(value, Traced) else value for value in values]
        return self._tape.add("call", function, tuple(values), self.node.sample.applied(function, *samples))

    def on(self, *axes: str) -> Traced:
        """See `Column.on`."""
        return self._tape.add("on", lambda column: column.on(*axes), (self,), self.node.sample.on(*axes))

    def steps(self) -> NDArray[np.intp]:
        """See `Column.steps`."""
        found = self.node.sample.steps()
        self._tape.steps.append((self.node, len(found)))
        return found

    def shifted(self, step: int) -> Traced:
        """See `Column.shifted`."""
        return self._tape.add("shift", lambda column: column.shifted(step), (self,), self.node.sample.shifted(step))

    def latest(self, where: Any = None) -> Traced:
        """See `Column.latest`."""
        condition = where.node.sample if isinstance(where, Traced) else where
        return self._tape.add("latest", lambda column, flags=None: column.latest(flags), (self, where), self.node.sample.latest(condition))

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise Untraceable(f".{name} of a column")

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        raise Untraceable("a column is made an array")

    def __bool__(self) -> bool:
        raise Untraceable("a branch depends on data")

    def __len__(self) -> int:
        raise Untraceable("the length of a column")

    def __getitem__(self, index: Any) -> Any:
        raise Untraceable("a column is indexed")


class TracedFields:
    """What `points` is given while it is traced: the fields of the sample, noted down."""

    def __init__(self, real: Any, tape: Tape, names: tuple[str, ...] = ()) -> None:
        self._real, self._tape, self._names = real, tape, names

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        found, names = getattr(self._real, name), (*self._names, name)
        if not isinstance(found, Column):
            return TracedFields(found, self._tape, names)
        kind = "state" if names[0] == "state" else "field"
        return self._tape.add(kind, lambda fields: walked(fields, names), (), found, ".".join(names))


def walked(fields: Any, names: tuple[str, ...]) -> Any:
    """The attribute of an attribute ... of fields."""
    for name in names:
        fields = getattr(fields, name)
    return fields


def trace(function: Callable[[Any], Any], sample: Batch) -> tuple[Any, Tape]:
    """What the function returns for traced columns, and what it did.

    Raises:
        Untraceable: where that cannot be noted down.
    """
    tape = Tape()
    with np.errstate(all="ignore"):
        return function(TracedFields(Fields(sample), tape)), tape


#: one-argument functions that are a multiplication.
_FACTORS = {
    np.negative: -1.0,
    np.positive: 1.0,
    np.deg2rad: np.pi / 180,
    np.radians: np.pi / 180,
    np.rad2deg: 180 / np.pi,
    np.degrees: 180 / np.pi,
}


@dataclass(frozen=True, eq=False)
class Term:
    """A part of a sum: `full` times a number, or `low` (None: 1) times a row of numbers that every packet shares."""

    row: NDArray[np.float64]
    low: Node | None = None
    full: Node | None = None

    def times(self, factor: Any) -> Term:
        """The same, multiplied by a number or row."""
        return Term(self.row * factor, self.low, self.full)


def is_full(value: Any, width: int) -> bool:
    """Whether each of the `width` points of a packet has its own value."""
    return isinstance(value, Node) and value.width == width


def only_field(node: Node) -> Node | None:
    """The one field that an expression depends on besides numbers; None where there is no such one."""
    found: dict[str, Node] = {}
    waiting = [node]
    while waiting:
        this = waiting.pop()
        if this.kind == "field":
            found[this.path] = this
        elif this.kind != "call" or any(not isinstance(arg, Node) and np.size(arg) != 1 for arg in this.args):
            return None
        if len(found) > 1:
            return None
        waiting += [arg for arg in this.args if isinstance(arg, Node)]
    return next(iter(found.values()), None)


def chosen(node: Node, width: int) -> tuple[Node, Any, Any] | None:
    """The condition of a ``np.where`` that packets or blocks decide, and what it chooses from, each a number or full of one field."""
    if node.kind != "call" or node.function is not np.where or len(node.args) != 3:
        return None
    condition, *options = node.args
    fits = [only_field(o) is not None and is_full(o, width) if isinstance(o, Node) else np.size(o) == 1 for o in options]
    if not isinstance(condition, Node) or is_full(condition, width) or not all(fits):
        return None
    return condition, *(o if isinstance(o, Node) else float(np.asarray(o).reshape(())) for o in options)  # type: ignore[return-value]


def key(node: Node) -> tuple[Any, ...]:
    """What makes two expressions of one field the same."""
    if node.kind == "field":
        return ("field", node.path)
    return (node.function, *(key(arg) if isinstance(arg, Node) else np.asarray(arg).item() for arg in node.args))


def terms(value: Any, width: int) -> list[Term]:
    """An expression as a sum."""
    if not isinstance(value, Node):
        return [Term(np.asarray(value, np.float64))]
    if not is_full(value, width) and value.width:
        return [Term(np.ones(()), low=value)]
    function, args = value.function, value.args
    if value.kind == "call" and only_field(value) is None:
        if function in _FACTORS:
            return _scaled(value, terms(args[0], width), _FACTORS[function])
        if function in (np.add, np.subtract):
            sign = 1.0 if function is np.add else -1.0
            return terms(args[0], width) + [term.times(sign) for term in terms(args[1], width)]
        if function in (np.multiply, np.true_divide) and not isinstance(args[1], Node):
            factor = np.asarray(args[1], np.float64) if function is np.multiply else 1 / np.asarray(args[1], np.float64)
            return _scaled(value, terms(args[0], width), factor)
        if function is np.multiply and not isinstance(args[0], Node):
            return _scaled(value, terms(args[1], width), np.asarray(args[0], np.float64))
    return [Term(np.ones(()), full=value)]


def _scaled(value: Node, parts: list[Term], factor: Any) -> list[Term]:
    """A sum times a factor; in one piece where a full part would be multiplied by a row."""
    if np.ndim(factor) and any(part.full is not None for part in parts):
        return [Term(np.ones(()), full=value)]
    return [part.times(factor) for part in parts]


def split_level(parts: list[Term], depth: int) -> int | None:
    """The axis from which on only rows vary, and before which only low values do; None where they cross."""
    level = max((last_axis(part.low.shape) for part in parts if part.low is not None), default=0)
    for part in parts:
        lengths = (1,) * (depth - part.row.ndim) + part.row.shape
        if any(length > 1 for length in lengths[:level]):
            return None
    return level


def last_axis(shape: tuple[int, ...]) -> int:
    """One more than the last axis that is longer than 1."""
    return max((index + 1 for index, length in enumerate(shape) if length > 1), default=0)
