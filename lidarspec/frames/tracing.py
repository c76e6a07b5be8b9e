"""What a `points` function computes, as a graph: it is called once with columns that note down what is done to them.

Every traced column carries the plain result for two sample packets beside its node, so shapes and axes need no rules of
their own. What cannot be noted down (a branch on data, reductions, attributes of arrays) is `Untraceable`, with the reason.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import NDArray

from lidarspec.errors import SpecError
from lidarspec.frames.access import Fields
from lidarspec.frames.columns import ELEMENTWISE, Batch, Column


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
