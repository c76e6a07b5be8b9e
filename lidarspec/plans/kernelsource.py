"""The source of a kernel: the columns of a plan as one loop over packets, blocks and points, which reads the frames' bytes.

Each value is computed in the loop at which it varies: what a packet has once outside the loop over its blocks, and so on.
Where sines and cosines of each point's own angle are left, the points of a few packets go through scratch arrays into a
second, flat loop, which computes several at a time. Lengths and places stand in the text as numbers where all frames have
the same, else they are arguments, so that one kernel serves all lengths.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lidarspec.angles import LookUp, side_by_side
from lidarspec.frames.tracing import Node
from lidarspec.plans.expressions import is_full, only_field
from lidarspec.plans.kernelparts import TEMPLATES, is_cheap, line
from lidarspec.plans.kernelwriter import Value, Writer
from lidarspec.plans.windows import every_value, possible, window

#: points of which the scratch arrays stay in the fastest cache.
CHUNK = 2048
#: half turns up to which an angle is kept in float32 in a table.
SMALL = 0.125


@dataclass(frozen=True, eq=False)
class Later:
    """A product or sum (`sign`) of float32 values, one of which is the sine or cosine of an angle that the flat loop takes."""

    sign: str
    parts: tuple[Any, ...]


@dataclass(frozen=True, eq=False)
class Trig:
    """The cosine or sine of an angle, by its number."""

    name: str
    angle: int


class Expressions(Writer):
    """Writes traced expressions into the loops, each value where it varies."""

    def double(self, value: Any, depth: int = 0) -> Value:
        """An expression in float64, or a condition."""
        if not isinstance(value, Node):
            return self.constant(value, depth)
        return self.once(("double", value), lambda: self._double(value))  # type: ignore[no-any-return]

    def _double(self, node: Node) -> Value:
        if node.kind == "field":
            return self._physical(node)
        if node.kind == "call" and not self.shared(node):
            source = only_field(node)
            if source is not None and is_full(source, self.width) and not is_cheap(node):
                found = self.looked_up(node, source, np.float64, 1.0)
                if found is not None:
                    return found
            return self._call(node)
        return self.given(node)

    def shared(self, node: Node) -> bool:
        """Whether an expression is made of other frames' fields only: then NumPy computes it, mostly once for all packets."""
        return self.once(("shared", node), lambda: self._shared(node))  # type: ignore[no-any-return]

    def _shared(self, node: Node) -> bool:
        if node.kind in ("state", "on"):
            return node.kind == "state" or self.shared(node.args[0])
        return node.kind == "call" and all(self.shared(arg) for arg in node.args if isinstance(arg, Node))

    def _call(self, node: Node) -> Value:
        depth = max(len(arg.shape) for arg in node.args if isinstance(arg, Node))
        if any(np.ndim(arg) > depth + 1 or (np.ndim(arg) == depth + 1 and len(arg) != 1) for arg in node.args if not isinstance(arg, Node)):
            return self.given(node)
        if node.function is side_by_side and len(node.shape) == depth + 1:
            parts = [self.double(arg, depth) for arg in node.args]
            chain = "".join(f"{part.text} if i{depth} == {at} else " for at, part in enumerate(parts[:-1]))
            return self.let(2 + depth, f"{chain}{parts[-1].text}") if len(parts) > 1 else parts[0]
        if len(node.shape) != depth:
            return self.given(node)
        if isinstance(node.function, LookUp) and len(node.function.entries):
            index, table = self.double(node.args[0]), self.array(node.function.entries)
            return self.let(index.level, f"looked_up({table}, {index.text})")
        if node.function is np.where and len(node.args) == 3:
            return self._where(*(self.double(arg, depth) for arg in node.args))
        template = self._template(node)
        if template is None:
            return self.given(node)
        args = [self.double(arg, depth) for arg in node.args]
        return self.let(max(arg.level for arg in args), template.format(*(arg.text for arg in args)))

    def _template(self, node: Node) -> str | None:
        kinds = [arg.sample.array.dtype.kind if isinstance(arg, Node) else np.asarray(arg).dtype.kind for arg in node.args]
        if all(kind == "b" for kind in kinds):
            logical: dict[Any, str] = {np.bitwise_and: "({} & {})", np.bitwise_or: "({} | {})", np.invert: "(not {})"}
            logical |= {np.logical_and: "({} & {})", np.logical_or: "({} | {})", np.logical_not: "(not {})"}
            return logical.get(node.function)
        found = TEMPLATES.get(node.function)
        return found if found is not None and found.count("{}") == len(node.args) else None

    def _where(self, condition: Value, first: Value, second: Value) -> Value:
        level = max(condition.level, first.level, second.level)
        return self.let(level, f"{first.text} if {condition.text} else {second.text}")

    def _physical(self, node: Node) -> Value:
        leaf = self.layout.leaves.get(node.path)
        raw = self.raw(leaf) if leaf is not None else None
        if raw is None or leaf is None:
            return self.given(node)
        info = leaf.info
        return self.let(
            raw.level, f"{raw.text} * {float(info.scale)!r} + {float(info.offset)!r}" if info.scaled else f"np.float64({raw.text})"
        )

    def single(self, value: Any, *, exact: bool = False, root: bool = False) -> Any:
        """An expression in float32: a `Value`, or a `Later` that the flat loop completes.

        Args:
            exact: as the plain evaluation rounds it.
            root: sums are those of places, which may be taken in float32.
        """
        if not isinstance(value, Node):
            return self.constant(value, len(self.shape), "float32")
        return self.once(("single", value, exact), lambda: self._single(value, exact=exact, root=root))

    def _single(self, node: Node, *, exact: bool, root: bool) -> Any:
        found = self._of_field(node, exact=exact)
        if found is not None:
            return found
        if is_full(node, self.width) and node.kind == "call" and not exact:
            if node.function is np.multiply or (root and node.function in (np.add, np.subtract)):
                sign = {np.multiply: "*", np.add: "+", np.subtract: "-"}[node.function]
                return self.combined(sign, *(self.single(arg) for arg in node.args))
            if node.function in (np.cos, np.sin) and is_full(node.args[0], self.width):
                return Trig(node.function.__name__, self.angle_of(node.args[0]))
        made = self.double(node)
        return self.let(made.level, f"np.float32({made.text if not exact else f'number({made.text})'})")

    def combined(self, sign: str, first: Any, second: Any) -> Any:
        """A product or sum; in the loops where both parts are there."""
        if isinstance(first, Value) and isinstance(second, Value):
            return self.let(max(first.level, second.level), f"{first.text} {sign} {second.text}")
        return Later(sign, (first, second))

    def _of_field(self, node: Node, *, exact: bool) -> Value | None:
        """An expression of one field that each point has: by a straight line or a table."""
        source = only_field(node)
        leaf = self.layout.leaves.get(source.path) if source is not None and is_full(source, self.width) else None
        if leaf is None or source is None or window(leaf) is None:
            return None
        values = every_value(node, leaf)
        assert values is not None
        straight = line(leaf, values, exact=exact)
        raw = self.raw(leaf) if straight is not None else None
        if straight is not None and raw is not None:
            return self.let(self.inner, straight.text(raw.text))
        if node.function in (np.cos, np.sin) and node.args[0] in self.both:
            return self.beside(node, leaf)
        return self.looked_up(node, source, np.float32, 1.0)

    def angle_of(self, node: Node) -> int:
        """The number of an angle whose cosine or sine the flat loop takes."""

        def make() -> int:
            self.angles.append(self.angle(node, 1 / np.pi, len(node.shape)))
            return len(self.angles) - 1

        return int(self.once(("angle", node), make))

    def angle(self, value: Any, factor: float, depth: int) -> Value:
        """An angle times a factor that makes half turns of it, in float64."""
        if not isinstance(value, Node):
            return self.constant(np.asarray(value) * factor, depth)
        if not is_full(value, self.width) or value.kind != "call" or self.shared(value):
            return self._scaled(value, factor)
        source = only_field(value)
        if source is not None and not is_cheap(value):
            found = self._small_angle(value, source, factor)
            return found if found is not None else self._scaled(value, factor)
        return self._sum(value, factor)

    def _sum(self, node: Node, factor: float) -> Value:
        function, args = node.function, node.args
        depth = max(len(arg.shape) for arg in args if isinstance(arg, Node))
        simple = {np.negative: -1.0, np.positive: 1.0, np.deg2rad: np.pi / 180, np.radians: np.pi / 180}
        if function in simple:
            return self.angle(args[0], factor * simple[function], depth)
        if function in (np.add, np.subtract):
            first, second = (self.angle(arg, factor, depth) for arg in args)
            return self.let(max(first.level, second.level), f"{first.text} {'+' if function is np.add else '-'} {second.text}")
        if function is np.multiply and any(not isinstance(arg, Node) for arg in args):
            known, other = args if not isinstance(args[0], Node) else args[::-1]
            if np.size(known) == 1:
                return self.angle(other, factor * float(np.asarray(known).reshape(())), depth)
            row, made = self.constant(np.asarray(known) * factor, depth), self.double(other)
            return self.let(max(row.level, made.level), f"{made.text} * {row.text}")
        if function is np.where and len(args) == 3:
            return self._where(self.double(args[0], depth), *(self.angle(arg, factor, depth) for arg in args[1:]))
        return self._scaled(node, factor)

    def _scaled(self, node: Node, factor: float) -> Value:
        made = self.double(node)
        return self.let(made.level, f"{made.text} * {factor!r}")

    def _small_angle(self, node: Node, source: Node, factor: float) -> Value | None:
        """An angle by one field: a table in float32 where that is exact enough."""
        values = possible(node, self.layout.leaves)
        if values is None:
            return None
        with np.errstate(all="ignore"):
            short = bool(np.nanmax(np.abs(values[~np.isinf(values)] * factor), initial=0) <= SMALL)
        return self.looked_up(node, source, np.float32 if short else np.float64, factor)
