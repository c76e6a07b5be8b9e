"""Values, formulas and places as C.

Where everything in a frame type stands, as C expressions of its bytes and of array indices.

The functions that read one frame type: an accessor for each field, counts of arrays, and scaling.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from lidarspec.exports import Refused
from lidarspec.exports.messages import Message
from lidarspec.spec.tree import (
    Blob,
    Block,
    Empty,
    FieldInfo,
    Formula,
    Node,
    Number,
    Op,
    Part,
    Ref,
    Repeat,
    Sealed,
    Select,
    Struct,
    When,
    formulas,
    nodes,
    refs,
)
from lidarspec.wire.wire_table import meaning, unit_text

#: bits of a value that a formula in 64-bit integers may reach.
MOST_BITS = 62
_CALLED = {"//": "lidarspec_floor_div", "%": "lidarspec_floor_mod"}
COMPARISONS = frozenset({"==", "!=", "<", "<=", ">", ">="})
#: (path, ending) -> the C name of a function.
Name = Callable[[str, str], str]
_INDICES = "ijklmnoq"


@dataclass(frozen=True)
class Extent:
    """A number of bytes: a constant, and C expressions added to it."""

    number: int = 0
    terms: tuple[str, ...] = ()

    def __add__(self, other: Extent) -> Extent:
        return Extent(self.number + other.number, self.terms + other.terms)

    def times(self, factor: int | str) -> Extent:
        """The extent of so many of them."""
        if isinstance(factor, int) and not self.terms:
            return Extent(self.number * factor)
        if str(self) == "0":
            return self
        return Extent(0, (str(factor) if str(self) == "1" else f"{self.grouped} * {factor}",))

    @property
    def grouped(self) -> str:
        """As a factor in a product."""
        return f"({self})" if len(self.terms) + (self.number != 0) > 1 else str(self)

    def __str__(self) -> str:
        return " + ".join([str(self.number)] * (self.number != 0 or not self.terms) + list(self.terms))


def index(depth: int) -> str:
    """The name of an array index by its depth."""
    return _INDICES[depth]


def parameters(depth: int) -> str:
    """The parameters of a function for what is in so many arrays."""
    return ", ".join(["const uint8_t *p", *(f"size_t {index(level)}" for level in range(depth))])


def arguments(depth: int) -> str:
    """The arguments of a call of such a function."""
    return ", ".join(["p", *map(index, range(depth))])


def identifier(text: str) -> str:
    """A text as a part of a C name."""
    return re.sub(r"\W", "_", text.replace("[]", "_inner"), flags=re.ASCII)


def formula(value: Formula, name: Name) -> str:
    """A formula as a C expression of type int64_t; `name` gives the functions of a path.

    Raises:
        Refused: where 64-bit integers cannot hold what it may come to.
    """
    if bits(value) > MOST_BITS:
        raise Refused("a formula that may pass what a 64-bit integer holds")
    return _term(value, name)


def truth(value: Formula, name: Name) -> str:
    """A formula as a C condition; raises as `formula`."""
    text = formula(value, name)
    return text[1:-1] if isinstance(value, Op) and value.symbol in COMPARISONS else f"{text} != 0"


def _term(value: Formula, name: Name) -> str:
    if isinstance(value, Ref):
        return f"(int64_t){name(value.path, '')}({arguments(len(value.info.axes))})"
    if isinstance(value, Op):
        args = [_term(arg, name) for arg in value.args]
        if value.symbol == "not":
            return f"(int64_t)!{args[0]}"
        if len(args) == 1:
            return f"(-{args[0]})"
        if value.symbol in _CALLED:
            return f"{_CALLED[value.symbol]}({args[0]}, {args[1]})"
        if value.symbol in COMPARISONS:  # through a function: compilers warn of what a narrow number can never be
            return f"(lidarspec_int({args[0]}) {value.symbol} {args[1]})"
        return f"({args[0]} {value.symbol} {args[1]})"
    return f"({value})" if value < 0 else str(value)


def bits(value: Formula) -> int:
    """How many bits, besides a sign, a formula takes at most."""
    if isinstance(value, Ref):
        return value.info.bits
    if isinstance(value, int):
        return value.bit_length()
    args = [bits(arg) for arg in value.args]
    match value.symbol:
        case "+" | "-":
            return max(args) + 1
        case "*":
            return sum(args)
        case "<<":
            most = value.args[1] if isinstance(value.args[1], int) else (1 << args[1]) - 1 if args[1] < 8 else 99
            return args[0] + most
        case "//" | ">>":
            return args[0] + 1
        case "not":
            return 1
    return 1 if value.symbol in COMPARISONS else max(args)


def number_type(infos: Sequence[FieldInfo]) -> str:
    """The C type that holds what any of these fields holds."""
    if any(info.kind == "float" for info in infos):
        return "double" if max(info.bits for info in infos) > 32 or any(info.kind != "float" for info in infos) else "float"
    signed = any(info.dtype is not None and info.dtype.kind == "i" for info in infos)
    mixed = signed and any(info.dtype is not None and info.dtype.kind == "u" for info in infos)
    width = next(size for size in (8, 16, 32, 64) if max(info.bits for info in infos) + mixed <= size or size == 64)
    return f"{'int' if signed else 'uint'}{width}_t"


def comment(*texts: str) -> str:
    """A comment of one line, whatever the texts hold; "" where they hold nothing."""
    text = "; ".join(" ".join(part.split()) for part in texts if part).replace("*/", "* /").replace("/*", "/ *")
    return f"/* {text} */" if text else ""


def quoted(data: bytes) -> str:
    """Bytes as a C string, each as a literal of its own, so that no escape runs into the next."""
    return '"' + "".join(f"\\{byte:03o}" for byte in data) + '"'


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


#: unit -> the SI unit that it is a multiple of, as part of a C name; factor and offset.
SI: dict[str, tuple[str, float, float]] = {
    "cm": ("m", 0.01, 0),
    "mm": ("m", 0.001, 0),
    "ms": ("s", 1e-3, 0),
    "us": ("s", 1e-6, 0),
    "ns": ("s", 1e-9, 0),
    "deg": ("rad", math.pi / 180, 0),
    "deg/s": ("rad_per_s", math.pi / 180, 0),
    "rpm": ("rad_per_s", math.pi / 30, 0),
    "degC": ("K", 1, 273.15),
    "mV": ("V", 1e-3, 0),
    "mA": ("A", 1e-3, 0),
    "kHz": ("Hz", 1e3, 0),
}
#: bytes of a float -> the function that makes it of its bits.
FLOATS = {2: "lidarspec_half", 4: "lidarspec_float", 8: "lidarspec_double"}


@dataclass(frozen=True)
class Piece:
    """One way to read a field: at one of its places, one of its elements in a bit block."""

    spot: Spot
    part: Part | None = None

    @property
    def info(self) -> FieldInfo:
        """The field."""
        assert self.part is not None or isinstance(self.spot.node, Number | Blob)
        return self.part.info if self.part is not None else self.spot.node.info  # type: ignore[union-attr]

    @property
    def expression(self) -> str:
        """What is read there, as C."""
        node, spot = self.spot.node, self.spot
        if self.part is not None:
            return _bits(self.part, spot)
        assert isinstance(node, Number)
        raw = (
            f"p[{spot.start}]" if node.size == 1 else f"lidarspec_{'le' if node.order == 'little' else 'be'}(p + {spot.start}, {node.size})"
        )
        if node.kind == "float":
            return f"{FLOATS[node.size]}({raw})"
        return f"lidarspec_signed({raw}, {8 * node.size})" if node.kind == "int" else raw

    @property
    def condition(self) -> str:
        """When it is there; "" for always."""
        inside = [f"{index(self.spot.depth + level)} == {place}" for level, place in enumerate(self.part.indices if self.part else ())]
        return " && ".join([*(condition.text for condition in self.spot.conditions), *inside])


def _bits(part: Part, spot: Spot) -> str:
    wide = "uint64_t" if part.bits.width > 32 else "uint32_t"
    terms = []
    for one in part.bits.segments:
        byte = f"p[{spot.start + Extent(one.byte)}]"
        term = f"({byte} & 0x{one.mask:02x}u)" if one.mask != 0xFF else byte
        term = f"({wide}){term}"
        shift = one.target - one.low
        terms.append(f"{term} {'<<' if shift > 0 else '>>'} {abs(shift)}" if shift else term)
    value = " | ".join(f"({term})" for term in terms) if len(terms) > 1 else terms[0]
    return f"lidarspec_signed({value}, {part.bits.width})" if part.bits.signed else value


def pieces(places: Places, path: str) -> list[Piece]:
    """All ways to read a field."""
    found = []
    for spot in places.named(path):
        if isinstance(spot.node, Block):
            found += [Piece(spot, part) for part in spot.node.parts if part.info.path == path]
        else:
            found.append(Piece(spot))
    return found


def fields(places: Places) -> Iterator[str]:
    """The functions of all fields in the order of the wire; one that stands in several alternatives comes with the last."""
    last: dict[tuple[str, str], int] = {}
    owned = [list(dict.fromkeys(_functions(spot))) for spot in places.spots]
    for number, functions in enumerate(owned):
        last |= dict.fromkeys(functions, number)
    extents = list(_extents(places))
    yield from (text.partition("\n")[0].partition(" {")[0] + ";" for text in extents)
    for number, functions in enumerate(owned):
        for kind, path in functions:
            if last[kind, path] == number:
                yield from _MADE[kind](places, path)
    yield from extents


def _functions(spot: Spot) -> Iterator[tuple[str, str]]:
    """What is made for a place: ("field", path), ("count", axis) or, in a bit block, ("inner", axis)."""
    if isinstance(spot.node, Block):
        for part in spot.node.parts:
            yield from (("inner", axis) for axis in _inner(part))
            yield "field", part.info.path
    elif isinstance(spot.node, Number) or (isinstance(spot.node, Blob) and spot.node.name):
        yield "field", spot.path
    elif isinstance(spot.node, Repeat):
        yield "count", spot.path


def _extents(places: Places) -> Iterator[str]:
    """The sizes of parts that have alternatives of several sizes."""
    for spot in places.spots:
        if isinstance(spot.node, When | Select):
            sizes = places.sizes(spot)
            if len({str(size) for _, size in sizes}) > 1:
                ways = [*((condition, f"(size_t)({size})") for condition, size in sizes[:-1]), ("", f"(size_t)({sizes[-1][1]})")]
                yield _function("size_t", places.extent_name(spot), spot.depth, ways)


def _inner(part: Part) -> tuple[str, ...]:
    """The arrays inside a bit block that a part of it is in."""
    return part.info.axes[len(part.info.axes) - len(part.indices) :]


def _inner_count(places: Places, axis: str) -> Iterator[str]:
    """The number of elements of an array inside a bit block."""
    found = [(spot, part) for spot in places.spots if isinstance(spot.node, Block) for part in spot.node.parts if axis in _inner(part)]
    spot, part = found[0]
    level = _inner(part).index(axis)
    count = max(part.indices[level] for _, part in found) + 1
    yield _function("size_t", places.name(axis, "count"), spot.depth + level, [("", str(count))])


def _count(places: Places, axis: str) -> Iterator[str]:
    spots = [spot for spot in places.spots if spot.path == axis and isinstance(spot.node, Repeat)]
    ways = []
    for spot in spots:
        assert isinstance(spot.node, Repeat)
        count = str(spot.node.count) if isinstance(spot.node.count, int) else f"(size_t)({places.formula(spot.node.count)})"
        ways.append((" && ".join(condition.text for condition in spot.conditions), count))
    yield _function("size_t", places.name(axis, "count"), spots[0].depth, ways)


def _field(places: Places, path: str) -> Iterator[str]:
    found = pieces(places, path)
    infos, name = [piece.info for piece in found], places.name(path, "")
    part = found[0].part
    depth = found[0].spot.depth + (len(part.indices) if part else 0)
    yield from _labels(infos[0], name)
    yield comment(unit_text(infos[0]), meaning(infos[0]))
    if isinstance(found[0].spot.node, Blob):
        yield from _bytes(places, path, [piece.spot for piece in found])
        return
    kind = number_type(infos)
    ways = [(piece.condition, f"({kind}){_grouped(piece.expression)}") for piece in found]
    yield _function(kind, name, depth, ways)
    if any(piece.spot.conditions for piece in found):
        conditions = [" && ".join(condition.text for condition in piece.spot.conditions) or "1" for piece in found]
        yield _present(places, path, depth, conditions)
    if infos[0].scaled or infos[0].unit:
        yield from _scaling(infos[0], name, kind)


def _bytes(places: Places, path: str, spots: list[Spot]) -> Iterator[str]:
    ways, sizes, name = [], [], places.name(path, "")
    for spot in spots:
        assert isinstance(spot.node, Blob)
        condition = " && ".join(condition.text for condition in spot.conditions)
        size = str(spot.node.size) if isinstance(spot.node.size, int) else f"(size_t)({places.formula(spot.node.size)})"
        ways.append((condition, f"p + ({spot.start})"))
        sizes.append((condition, size))
    depth = spots[0].depth
    yield _function("size_t", places.name(path, "size"), depth, sizes)
    yield _function("const uint8_t *", name, depth, ways)
    if any(spot.conditions for spot in spots):
        yield _present(places, path, depth, [condition or "1" for condition, _ in ways])


def _present(places: Places, path: str, depth: int, conditions: list[str]) -> str:
    both = " || ".join(f"({condition})" for condition in dict.fromkeys(conditions))
    return _function("int", places.name(path, "present"), depth, [("", both)])


def _function(kind: str, name: str, depth: int, ways: list[tuple[str, str]]) -> str:
    """A function that gives the first value whose condition holds, else 0."""
    used = " ".join(condition + " " + value for condition, value in ways)
    lines = [f"    (void){argument};" for argument in arguments(depth).split(", ") if not _mentions(used, argument)]
    for condition, value in ways:
        lines.append(f"    if ({condition}) return {value};" if condition else f"    return {value};")
    if ways[-1][0]:
        lines.append("    return 0;")
    space = "" if kind.endswith("*") else " "
    if len(lines) == 1:
        return f"static inline {kind}{space}{name}({parameters(depth)}) {{ {lines[0].strip()} }}"
    return "\n".join([f"static inline {kind}{space}{name}({parameters(depth)})", "{", *lines, "}"])


def _mentions(text: str, name: str) -> bool:
    return re.search(rf"\b{name}\b", text) is not None


def _grouped(expression: str) -> str:
    return f"({expression})" if " " in expression and not expression.startswith(("lidarspec_", "p[")) else expression


def _labels(info: FieldInfo, name: str) -> Iterator[str]:
    for value, label in info.labels.items():
        yield f"#define {name.upper()}_{identifier(label).upper()} {value}"


def _scaling(info: FieldInfo, name: str, kind: str) -> Iterator[str]:
    """From the raw number to the field's unit, and to the SI unit where that is another one."""
    yield _conversion(f"{name}_to_{_unit_name(info.unit)}", kind, info.scale, info.offset)
    if info.unit in SI:
        unit, factor, offset = SI[info.unit]
        yield _conversion(f"{name}_to_{unit}", kind, info.scale * factor, info.offset * factor + offset)


def _conversion(name: str, kind: str, scale: float, offset: float) -> str:
    text = f"(double)raw * {float(scale)!r}" + (f" {'-' if offset < 0 else '+'} {abs(float(offset))!r}" if offset else "")
    return f"static inline double {name}({kind} raw) {{ return {text}; }}"


def _unit_name(unit: str) -> str:
    named = unit.replace("/", "_per_").replace("%", "percent").replace("^", "").replace("**", "")
    return identifier(named) if named else "value"


_MADE = {"field": _field, "count": _count, "inner": _inner_count}
