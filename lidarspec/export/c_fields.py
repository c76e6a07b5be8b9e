"""The functions that read one frame type: an accessor for each field, counts of arrays, and scaling."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass

from lidarspec.export.c_places import Places, Spot
from lidarspec.export.c_text import Extent, arguments, comment, identifier, index, number_type, parameters
from lidarspec.export.tree import Blob, Block, Number, Part, Repeat, Select, When
from lidarspec.frames.schema import FieldInfo
from lidarspec.wiretable import meaning, unit_text

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
