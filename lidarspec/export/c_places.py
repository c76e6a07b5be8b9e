"""Where everything in a frame type stands, as C expressions of its bytes and of array indices."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from lidarspec.export import Refused
from lidarspec.export.c_text import Extent, arguments, formula, index, truth
from lidarspec.export.formulas import Formula, refs
from lidarspec.export.messages import Message
from lidarspec.export.tree import Blob, Block, Empty, Node, Number, Repeat, Sealed, Select, Struct, When, formulas, nodes

_NONE = Extent()


class Condition(NamedTuple):
    """A C expression, and whether it depends on nothing in arrays."""

    text: str
    is_fixed: bool


@dataclass(frozen=True, eq=False)
class Spot:
    """One place of a node.

    Attributes:
        path: of the node, without indices; of an array that of its axis.
        node: what stands there.
        start, size: in bytes.
        depth: number of arrays that it is in.
        conditions: what has to hold for it to be there.
        loops: for each of those arrays the C expression of its count.
    """

    path: str
    node: Node
    start: Extent = _NONE
    size: Extent = _NONE
    depth: int = 0
    conditions: tuple[Condition, ...] = ()
    loops: tuple[str, ...] = ()


def given(node: Node, depth: int) -> str:
    """The arguments by which a size is asked for in so many arrays; where it is the same for all elements, it is that of the first."""
    is_own = any(ref.info.axes for below in nodes(node) for value in formulas(below) for ref in refs(value))
    return arguments(depth) if is_own else ", ".join(["p", *["0"] * depth])


@dataclass
class Places:
    """All places of a frame type, in the order of the wire.

    Args:
        message: the frame type.
        name: the C name of what stands at a path, given as its path and an ending.

    Raises:
        Refused: where a place cannot be computed without reading all elements before it.
    """

    message: Message
    name: Callable[[str, str], str]
    spots: list[Spot] = field(default_factory=list)
    size: Extent = field(init=False)

    def __post_init__(self) -> None:
        top = Spot("", self.message.root)
        self.size = self.extent(top)
        self._visit(top)

    def named(self, path: str) -> list[Spot]:
        """Every place of the numbers, bytes or bits at a path: one, unless alternatives have it each."""
        found = []
        for spot in self.spots:
            if isinstance(spot.node, Block):
                found += [spot] * any(part.info.path == path for part in spot.node.parts)
            elif isinstance(spot.node, Number | Blob):
                found += [spot] * (spot.path == path)
        return found

    def whole(self, path: str) -> Spot:
        """The place of the part at a path, of whatever kind: all of an array, all alternatives."""
        return next(spot for spot in self.spots if spot.path == path)

    def formula(self, value: Formula) -> str:
        """A formula as C."""
        return formula(value, self.name)

    def count(self, node: Repeat, depth: int) -> int | str:
        """The number of elements of an array in so many others: a number, or C."""
        if isinstance(node.count, int):
            return node.count
        return f"(int64_t){self.name(node.axis, 'count')}({given(node, depth)})"

    def extent(self, spot: Spot) -> Extent:
        """The size of what stands somewhere."""
        match spot.node:
            case Number() | Block():
                return Extent(spot.node.size)
            case Blob(size=int() as size):
                return Extent(size)
            case Blob():
                return Extent(0, (f"(int64_t){self.name(spot.path, 'size')}({given(spot.node, spot.depth)})",))
            case Repeat():
                return self._element(spot, spot.node).times(self.count(spot.node, spot.depth))
            case When() | Select():
                sizes = self.sizes(spot)
                if len({str(size) for _, size in sizes}) == 1:
                    return sizes[0][1]
                return Extent(0, (f"(int64_t){self.extent_name(spot)}({given(spot.node, spot.depth)})",))
            case Empty():
                return Extent()
        return sum((self.extent(below) for below in self._below(spot)), Extent())

    def extent_name(self, spot: Spot) -> str:
        """The function that gives the size of a part with alternatives; one of these may be the alternative of another."""
        alike = [id(node) for node in nodes(self.message.root) if isinstance(node, When | Select) and node.name == spot.node.name]
        return self.name(spot.path, f"extent{alike.index(id(spot.node)) or ''}")

    def sizes(self, spot: Spot) -> list[tuple[str, Extent]]:
        """The sizes of the alternatives at a place, each with its condition."""
        return [(condition.text, self.extent(below)) for condition, below in self._cases(spot)]

    def _visit(self, spot: Spot) -> None:
        """Note a place and all in it."""
        node = spot.node
        if not isinstance(node, Empty):
            path = node.axis if isinstance(node, Repeat) else spot.path
            self.spots.append(replace(spot, path=path, size=self.extent(spot)))
        if isinstance(node, Repeat):
            step = self._element(spot, node).times(f"(int64_t){index(spot.depth)}")
            loops = (*spot.loops, str(self.count(node, spot.depth)))
            self._visit(replace(spot, node=node.element, start=spot.start + step, depth=spot.depth + 1, loops=loops))
        elif isinstance(node, When | Select):
            for condition, below in self._cases(spot):
                self._visit(replace(below, conditions=(*spot.conditions, condition)))
        else:
            start = spot.start
            for below in self._below(spot):
                self._visit(replace(below, start=start))
                start = start + self.extent(below)

    def _below(self, spot: Spot) -> Iterator[Spot]:
        """The members of a struct, their places left out."""
        node = spot.node
        if isinstance(node, Sealed):
            yield replace(spot, node=node.body)
        elif isinstance(node, Struct):
            for member in node.members:
                yield replace(spot, node=member, path=".".join(part for part in (node.path, member.name) if part))

    def _element(self, spot: Spot, node: Repeat) -> Extent:
        size = self.extent(replace(spot, node=node.element, depth=spot.depth + 1))
        used = [ref for below in nodes(node.element) for value in formulas(below) for ref in refs(value)]
        if size.terms and any(node.axis in ref.info.axes for ref in used):
            raise Refused(f"{node.axis}: its elements differ in size, so that none has a place of its own without reading those before it")
        return size

    def _cases(self, spot: Spot) -> list[tuple[Condition, Spot]]:
        node = spot.node
        is_fixed = not any(ref.info.axes for value in formulas(node) for ref in refs(value))
        if isinstance(node, When):
            named = [(truth(node.condition, self.name), node.then), (f"!({truth(node.condition, self.name)})", node.otherwise)]
            return [(Condition(text, is_fixed), replace(spot, node=below)) for text, below in named]
        assert isinstance(node, Select)
        key = self.formula(node.key)
        others = " && ".join(f"{key} != {value}" for value, _ in node.cases) or "1"
        named = [*((f"{key} == {value}", case) for value, case in node.cases), (others, node.default)]
        return [(Condition(text, is_fixed), replace(spot, node=below)) for text, below in named]
