"""What can be said of a traced expression without computing it: what it depends on, and sums taken apart.

A value is *full* where each point has its own, else *low*: then it is computed once for its packet or block, plainly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.frames.tracing import Node

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
