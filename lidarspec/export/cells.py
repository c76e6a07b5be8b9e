"""What a packet diagram shows of a frame: boxes in the order of the wire, groups that repeat, and parts that some headers leave out."""

from __future__ import annotations

from dataclasses import dataclass, replace

from lidarspec.export.formulas import Formula, Op, Ref
from lidarspec.export.messages import Message
from lidarspec.export.tree import Blob, Block, Empty, Node, Number, Part, Repeat, Sealed, Select, Struct, When, nodes
from lidarspec.wiretable import INDICES, Extent, bit_text, meaning, unit_text


@dataclass(frozen=True)
class Cell:
    """A box: `bits` wide, or with `bits` 0 of a size that only a header tells.

    Attributes:
        name: what is written in it; `detail`: below that; `said`: all there is to say of it.
        role: "const", "sum", "spare", "group" or "".
        offset: where it starts.
    """

    name: str
    bits: int
    detail: str
    said: str
    role: str
    offset: Extent


@dataclass(frozen=True)
class Group:
    """Boxes that stand together: repeated, or with `optional` there under a condition, as the label says."""

    label: str
    items: tuple[Item, ...]
    optional: bool = False


Item = Cell | Group


def cells(message: Message) -> tuple[Item, ...]:
    """The items of a frame type."""
    seals = {path: node for node in nodes(message.root) if isinstance(node, Sealed) for path in node.fields}
    return _Cells(seals, mixed=not byte_order(message)).visit(message.root, Extent(), 0)[0]


def byte_order(message: Message) -> str:
    """The byte order of all numbers of a frame type, "" where they differ or there are none of several bytes."""
    orders = {node.order for node in nodes(message.root) if isinstance(node, Number) and node.size > 1}
    return orders.pop() if len(orders) == 1 else ""


def phrase(formula: Formula) -> str:
    """A formula as people write it."""
    match formula:
        case Ref():
            return formula.path
        case Op(symbol, (operand,)):
            return f"{symbol} {phrase(operand)}" if symbol.isalpha() else f"{symbol}{phrase(operand)}"
        case Op(symbol, (left, right)):
            one, other = (f"({phrase(part)})" if isinstance(part, Op) else phrase(part) for part in (left, right))
            return f"{one} {symbol} {other}"
        case _:
            return str(formula)


@dataclass
class _Cells:
    seals: dict[str, Sealed]
    mixed: bool

    def visit(self, node: Node, start: Extent, depth: int) -> tuple[tuple[Item, ...], Extent]:
        """The items of a part that begins at `start`, and its size."""
        match node:
            case Sealed():
                return self.visit(node.body, start, depth)
            case Struct():
                return self._struct(node, start, depth)
            case Number():
                return (self._number(node, start),), Extent(node.size)
            case Blob():
                return self._blob(node, start)
            case Block():
                return tuple(self._block(node, start)), Extent(node.size)
            case Repeat():
                return self._repeat(node, start, depth)
            case When() | Select():
                return self._choice(node, start, depth)
            case Empty():
                return (), Extent()

    def _struct(self, node: Struct, start: Extent, depth: int) -> tuple[tuple[Item, ...], Extent]:
        items: list[Item] = []
        size = Extent()
        for member in node.members:
            found, more = self.visit(member, start + size, depth)
            named = isinstance(member, Struct | Sealed) or (isinstance(member, Block) and member.parts[0].names)
            items += [replace(item, name=f"{member.name}.{item.name}") if named and isinstance(item, Cell) else item for item in found]
            size = size + more
        return tuple(items), size

    def _number(self, node: Number, start: Extent) -> Cell:
        kind = {"uint": "u", "int": "s", "float": "float "}[node.kind] + str(8 * node.size)
        order = f" {node.order}" if node.size > 1 else ""
        said = f"{node.kind}{8 * node.size}{order}"
        short = f" {node.order[0]}e" if self.mixed and node.size > 1 else ""
        detail = " ".join(part for part in (kind + short, unit_text(node.info)) if part)
        return self._cell(node, 8 * node.size, detail, said, start)

    def _blob(self, node: Blob, start: Extent) -> tuple[tuple[Item, ...], Extent]:
        size = Extent(node.size) if isinstance(node.size, int) else Extent(0, (phrase(node.size),))
        if node.size == 0:
            return (), size
        detail = node.const.hex(" ") if node.const is not None and len(node.const) <= 8 else f"{size} byte{'s' * (str(size) != '1')}"
        bits = 8 * node.size if isinstance(node.size, int) else 0
        return (self._cell(node, bits, detail, "bytes", start),), size

    def _cell(self, node: Number | Blob, bits: int, detail: str, kind: str, start: Extent) -> Cell:
        path, seal = node.info.path, self.seals.get(node.info.path)
        if isinstance(node, Number) and node.info.const is not None:
            detail = f"{node.info.const:#0{2 * node.size + 2}x}" if isinstance(node.info.const, int) else str(node.info.const)
        sealed = "" if seal is None else seal.algorithm.describe()
        said = "; ".join(part for part in (path, kind, unit_text(node.info), meaning(node.info), sealed) if part)
        role = "sum" if seal else "const" if node.info.const is not None else "spare" if _is_spare(node.name) else ""
        return Cell(node.name or "(constant)", bits, detail, said, role, start)

    def _block(self, node: Block, start: Extent) -> list[Cell]:
        """A box for each run of bits of one value, in the order of the wire, the highest bit of each byte first."""
        runs = [(run.byte, run.low + run.mask.bit_count() - 1, run, part) for part in node.parts for run in part.bits.segments]
        found: list[tuple[Part, int, int, int]] = []
        for byte, _, run, part in sorted(runs, key=lambda entry: (entry[0], -entry[1])):
            low, high = run.target, run.target + run.mask.bit_count() - 1
            if found and found[-1][0] is part and found[-1][1] == high + 1:
                found[-1] = (part, low, *found[-1][2:])
            else:
                found.append((part, low, high, byte))
        return [self._run(node, part, low, high, start + Extent(byte)) for part, low, high, byte in found]

    def _run(self, node: Block, part: Part, low: int, high: int, start: Extent) -> Cell:
        whole = high - low + 1 == part.bits.width
        name = ".".join((*([node.name] if len(part.names) == 0 else part.names),)) + "".join(f"[{index}]" for index in part.indices)
        detail = "" if whole else f"{high}..{low}" if high > low else f"{low}"
        seal = self.seals.get(part.info.path)
        texts = (part.info.path, bit_text(part.bits), unit_text(part.info), meaning(part.info), seal.algorithm.describe() if seal else "")
        role = "sum" if seal else "const" if part.info.const is not None else "spare" if _is_spare(name) else ""
        unit = unit_text(part.info) if whole else ""
        return Cell(name, high - low + 1, detail or unit, "; ".join(text for text in texts if text), role, start)

    def _repeat(self, node: Repeat, start: Extent, depth: int) -> tuple[tuple[Item, ...], Extent]:
        index = INDICES[depth % len(INDICES)]
        count = node.count if isinstance(node.count, int) else phrase(node.count)
        _, element = self.visit(node.element, Extent(), depth + 1)
        items, _ = self.visit(node.element, start + element.times(index), depth + 1)
        return (Group(f"{node.name} \u00d7\u00a0{count}", items),), element.times(count)

    def _choice(self, node: When | Select, start: Extent, depth: int) -> tuple[tuple[Item, ...], Extent]:
        if isinstance(node, When):
            asked = phrase(node.condition)
            branches = [(f"if {asked}", node.then), (f"unless {asked}", node.otherwise)]
        else:
            key = phrase(node.key)
            branches = [*((f"if {key} == {value}", case) for value, case in node.cases), (f"for other {key}", node.default)]
        groups: list[Item] = []
        sizes = set()
        for label, branch in branches:
            items, size = self.visit(branch, start, depth)
            sizes.add(size)
            groups += [Group(label, items, optional=True)] if items else []
        return tuple(groups), sizes.pop() if len(sizes) == 1 else Extent(0, (f"size({node.name})",))


def _is_spare(name: str) -> bool:
    """Whether a field is there for nothing yet, by the names that manuals give such fields."""
    return name.startswith(("reserved", "unused", "spare", "zeros", "padding"))
