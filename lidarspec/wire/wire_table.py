"""The wire table of a frame type, drawn from its struct: where each field stands, how wide it is, what it means.

Nothing here knows a frame's bytes, so what depends on a header is a formula of its fields ("10 + 3*i"), and a part
that only some headers have is marked with the condition.
"""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass, field, replace
from typing import Any

import construct
from construct import Array, Bytes, BytesInteger, Construct, FormatField, Struct

from lidarspec.spec.bits import BitField
from lidarspec.spec.construct_layer import UNNAMED, fields_below, peeled, probed, unwrap
from lidarspec.spec.description import Frame
from lidarspec.spec.fields import Checksummed
from lidarspec.spec.tree import FieldInfo

INDICES = "ijklmn"
_ITEM = re.compile(r"\['(\w+)'\]")
_FIELD = re.compile(r"\bthis(?:\.\w+)+")


@dataclass(frozen=True)
class WireRow:
    """One line of a wire table.

    Attributes:
        offset: first byte, counted from the start of the frame; a formula where that depends on a header or an index.
        size: in bytes, or "7 bits"; a formula where it depends on a header.
        type: "uint16 le", "bytes", or the bits of a block from the most significant on.
        field: path, array elements by index names: "points[i].distance".
        unit: unit and scale: "0.01 deg".
        meaning: the author's text, constant, labels, checksum, condition.
    """

    offset: str
    size: str
    type: str
    field: str
    unit: str = ""
    meaning: str = ""


@dataclass(frozen=True)
class Extent:
    """A number of bytes: a constant, and formulas of header fields and indices added to it."""

    number: int = 0
    terms: tuple[str, ...] = ()

    def __add__(self, other: Extent) -> Extent:
        return Extent(self.number + other.number, self.terms + other.terms)

    def times(self, factor: int | str) -> Extent:
        """The extent of so many elements."""
        if isinstance(factor, int):
            return Extent(self.number * factor, tuple(f"{factor}*({term})" for term in self.terms))
        if str(self) == "0":
            return self
        size = f"({self})" if self.terms else str(self)
        return Extent(0, (factor if size == "1" else f"{size}*({factor})" if " " in factor else f"{size}*{factor}",))

    def __str__(self) -> str:
        return " + ".join([str(self.number)] * (self.number > 0 or not self.terms) + list(self.terms))


def wire_table(frame: Frame) -> tuple[WireRow, ...]:
    """The rows of a frame type in the order of the wire."""
    table = _Table()
    table.visit(frame.prepared, _Place(FieldInfo("")), Extent())
    return tuple(table.rows)


def frame_size(frame: Frame) -> str:
    """The length of a frame in bytes: a number, or a formula of its header fields."""
    return str(_Table().visit(frame.prepared, _Place(FieldInfo("")), Extent()))


@dataclass(frozen=True)
class _Place:
    """Where in the tree a construct stands: what is said of it, how it is called, and what it depends on."""

    info: FieldInfo
    shown: str = ""
    depth: int = 0
    condition: str = ""


@dataclass
class _Table:
    """The rows found so far, and what is to be said of the fields that hold checksums."""

    rows: list[WireRow] = field(default_factory=list)
    seals: dict[str, str] = field(default_factory=dict)

    def visit(self, con: Construct, place: _Place, start: Extent) -> Extent:
        """Add the rows of a construct that begins at `start`; its size."""
        inner, info = peeled(con, place.info)
        place = replace(place, info=info)
        if unwrap(inner, bits=False) is not unwrap(inner):
            return self._block(inner, place, start)
        if isinstance(inner, Checksummed):
            for name in inner.fields:
                self.seals[_joined(info.path, name)] = _sealed(inner)
            return self.visit(inner.subcon, place, start)
        if isinstance(inner, Struct):
            return self._struct(inner, place, start)
        if isinstance(inner, Array):
            return self._array(inner, place, start)
        if isinstance(inner, construct.IfThenElse | construct.Switch):
            return self._choice(inner, place, start)
        return Extent() if inner is construct.Pass else self._leaf(inner, place, start)

    def _struct(self, con: Struct, place: _Place, start: Extent) -> Extent:
        size = Extent()
        for child in con.subcons:
            name = child.name or UNNAMED
            info = FieldInfo(_joined(place.info.path, name), place.info.axes)
            size = size + self.visit(child, replace(place, info=info, shown=_joined(place.shown, name)), start + size)
        return size

    def _array(self, con: Array, place: _Place, start: Extent) -> Extent:
        index = INDICES[place.depth % len(INDICES)]
        count = con.count if isinstance(con.count, int) else formula(con.count, place.info.path)
        below = replace(place, depth=place.depth + 1, shown=f"{place.shown}[{index}]")
        element = _Table().visit(con.subcon, below, Extent())
        whole = element.times(count)
        self.rows.append(WireRow(str(start), str(whole), "array", place.shown, "", _text(f"{count} elements of {element}", place, "")))
        self.visit(con.subcon, below, start + element.times(index))
        return whole

    def _choice(self, con: Any, place: _Place, start: Extent) -> Extent:
        if isinstance(con, construct.Switch):
            key = formula(con.keyfunc, place.info.path)
            branches = [(f"if {key} == {value!r}", case) for value, case in con.cases.items()] + [
                (f"for other values of {key}", con.default)
            ]
        else:
            asked = formula(con.condfunc, place.info.path)
            branches = [(f"if {asked}", con.thensubcon), (f"unless {asked}", con.elsesubcon)]
        sizes = {self.visit(branch, replace(place, condition=condition), start) for condition, branch in branches}
        return sizes.pop() if len(sizes) == 1 else Extent(0, (f"size({place.shown})",))

    def _leaf(self, con: Construct, place: _Place, start: Extent) -> Extent:
        size, kind = _sized(con, place.info.path)
        info = fields_below(con, place.info).get(place.info.path, place.info)
        self._add(WireRow(str(start), str(size or "varies"), kind, place.shown), info, place)
        return size or Extent(0, (f"size({place.shown})",))

    def _block(self, con: Construct, place: _Place, start: Extent) -> Extent:
        size = int(con.sizeof())
        infos = fields_below(con, place.info)
        for bits in probed(con, size) or ():
            names = ".".join(key for key in bits.keys if isinstance(key, str))
            indices = "".join(f"[{key}]" for key in bits.keys if isinstance(key, int))
            row = WireRow(str(start), f"{bits.width} bit{'s' * (bits.width > 1)}", bit_text(bits), _joined(place.shown, names) + indices)
            self._add(row, infos[_joined(place.info.path, names)], place)
        return Extent(size)

    def _add(self, row: WireRow, info: FieldInfo, place: _Place) -> None:
        self.rows.append(replace(row, unit=unit_text(info), meaning=_text(meaning(info), place, self.seals.get(info.path, ""))))


def formula(expression: Any, path: str = "") -> str:
    """An expression in the part at `path`, with its fields by their whole paths; "?" for a function that cannot be read."""
    text = repr(expression)
    if " at 0x" in text:
        return "?"
    text = _FIELD.sub(lambda found: _resolved(found[0], path), _ITEM.sub(r".\1", text))
    return text[1:-1] if _enclosed(text) else text


def _enclosed(text: str) -> bool:
    """Whether the first bracket of a text closes at its end."""
    depths = list(itertools.accumulate((part == "(") - (part == ")") for part in text))
    return text.startswith("(") and depths.index(0) == len(text) - 1


def _resolved(text: str, path: str) -> str:
    """``this.count`` or ``this._.count`` as the path from the top of the frame."""
    scope = path.split(".")[:-1]
    for name in text.split(".")[1:]:
        scope = [] if name == "_root" else scope[:-1] if name == "_" else [*scope, name]
    return ".".join(scope)


def bit_text(bits: BitField) -> str:
    """The bits of a value in its block, the most significant first: "byte 1 bits 1-0, byte 0 bits 7-2"."""
    parts = []
    for part in sorted(bits.segments, key=lambda segment: -segment.target):
        high = part.low + part.mask.bit_count() - 1
        parts.append(f"byte {part.byte} " + (f"bits {high}-{part.low}" if high > part.low else f"bit {part.low}"))
    return ("signed, " if bits.signed else "") + ", ".join(parts)


def unit_text(info: FieldInfo) -> str:
    """Unit and scale of a field: "0.01 deg", "0.01 deg - 327.68"."""
    if not info.scaled:
        return info.unit
    shift = f" {'-' if info.offset < 0 else '+'} {abs(info.offset):g}" if info.offset else ""
    return f"{info.scale:.10g} {info.unit}".strip() + shift


def meaning(info: FieldInfo) -> str:
    """What is said of a field: its constant, what it follows from, its text, the names of its values."""
    const = hexed(info.const, info.bits) if info.const is not None else ""
    labels = ", ".join(f"{value} {name}" for value, name in info.labels.items())
    follows = formula(info.rebuilt, info.path) if info.rebuilt is not None else "?"
    return "; ".join(part for part in (const and f"always {const}", follows != "?" and f"= {follows}", info.docs, labels) if part)


def hexed(value: object, bits: int) -> str:
    """Bytes and integers in hexadecimal, integers with all digits of their width."""
    if isinstance(value, bytes | bytearray):
        return value.hex(" ")
    return f"0x{value:0{-(-bits // 4)}x}" if isinstance(value, int) else repr(value)


def _text(known: str, place: _Place, seal: str) -> str:
    return "; ".join(part for part in (place.condition, known, seal) if part)


def _sealed(con: Checksummed) -> str:
    name = con.algorithm.describe() if con.algorithm else "a checksum that a hook supplies"
    if con.over is None:
        return f"{name} over all other bytes"
    return f"{name} over {con.over[0]}" + (f" to {con.over[-1]}" if len(con.over) > 1 else "")


def _joined(path: str, name: str) -> str:
    return f"{path}.{name}" if path and name else path or name


def _sized(con: Construct, path: str) -> tuple[Extent | None, str]:
    """Size and type of a leaf; no size where only its bytes tell."""
    if isinstance(con, FormatField):
        code = con.fmtstr[-1]
        kind = "float" if code in "efd" else "uint" if code.isupper() else "int"
        order = {">": " be", "<": " le"}.get(con.fmtstr[0], "") if con.length > 1 else ""
        return Extent(con.length), f"{kind}{8 * con.length}{order}"
    if isinstance(con, BytesInteger) and isinstance(con.length, int):
        kind = "int" if con.signed else "uint"
        return Extent(con.length), f"{kind}{8 * con.length}{' le' if con.swapped else ' be'}"
    if isinstance(con, Bytes):
        size = Extent(con.length) if isinstance(con.length, int) else Extent(0, (formula(con.length, path),))
        return size, "bytes"
    return None, _terminated(con)


def _terminated(con: Construct) -> str:
    """The type of a field without a size of its own."""
    below = con
    while isinstance(below, construct.Subconstruct):
        if isinstance(below, construct.NullTerminated):
            return f"text up to {str(below.term)[1:]}"
        below = below.subcon
    return type(con).__name__
