"""Plain data as YAML: mappings, lists, strings, numbers and booleans in block style, short lists of numbers in one line.

Counts, conditions and keys as Kaitai writes them, with fields by their way from the type that asks.

Bit blocks in Kaitai: integers of so many bits where they stand in a row in one of its two bit orders, else calculated from bytes.

A spec as a Kaitai Struct format, for its compiler, its web IDE and its visualizer.

A frame type becomes a type, and so does each struct in it. Bit blocks become bit-sized integers where Kaitai's two bit orders
can say them, else bytes and calculated instances; a field with a scale gets an instance with the physical value. Checksums,
plausibility and what points are made of cannot be said in Kaitai: checksums are named in the documentation of their fields.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from lidarspec.exports import Refused
from lidarspec.exports.formulas import Formula, Op, Ref
from lidarspec.exports.messages import Message, messages
from lidarspec.exports.tree import Blob, Block, Empty, Node, Number, Part, Repeat, Sealed, Select, Struct, When, nodes
from lidarspec.spec.bits import BitField, Segment
from lidarspec.spec.fields import slug
from lidarspec.spec.sensor import Sensor
from lidarspec.wire.schema import FieldInfo
from lidarspec.wire.wire_table import meaning, unit_text

#: a string that means the same without quotes.
_PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_./()<>=+*-]*( [A-Za-z0-9_./()<>=+*;,-]+)*")
_WORDS = {"true", "false", "yes", "no", "on", "off", "null", "y", "n"}


class Byte(int):
    """A number that is written in hexadecimal."""

    def __repr__(self) -> str:
        return f"0x{int(self):02x}"


def yaml(value: Mapping[str, Any]) -> str:
    """The text of a document."""
    return "\n".join(_lines(value, "")) + "\n"


def _lines(value: Any, indent: str) -> Iterator[str]:
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield from _entry(f"{indent}{_scalar(key)}:", part, indent + "  ")
    else:
        for part in value:
            if isinstance(part, Mapping) and part:
                first, *rest = _lines(part, indent + "  ")
                yield f"{indent}- {first.lstrip()}"
                yield from rest
            else:
                yield from _entry(f"{indent}-", part, indent + "  ")


def _entry(head: str, part: Any, indent: str) -> Iterator[str]:
    if (isinstance(part, Mapping) and part) or (_is_list(part) and any(isinstance(item, Mapping | list) for item in part)):
        yield head
        yield from _lines(part, indent)
    elif isinstance(part, Mapping):
        yield f"{head} {{}}"
    elif _is_list(part):
        yield f"{head} [{', '.join(_scalar(item) for item in part)}]"
    else:
        yield f"{head} {_scalar(part)}"


def _is_list(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str)


def _scalar(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return value if _PLAIN.fullmatch(value) and value.lower() not in _WORDS else json.dumps(value, ensure_ascii=False)
    return repr(value)


COMPARISONS = {"==", "!=", "<", "<=", ">", ">="}


def identifier(name: str) -> str:
    """A name as Kaitai takes it."""
    return re.sub(r"[^a-z0-9_]", "_", name.lower())


@dataclass(frozen=True)
class Names:
    """The types that a place stands in, outermost first, by the path of their struct; None for one that has no struct."""

    levels: tuple[str | None, ...] = ()

    def inside(self, path: str) -> Names:
        """In the type of the struct at a path."""
        return Names((*self.levels, path))

    def wrapped(self) -> Names:
        """In a type that holds one part alone."""
        return Names((*self.levels, None))

    def way(self, ref: Ref) -> str:
        """The way from here to a field.

        Raises:
            Refused: to one that no type around this place holds.
        """
        for up, path in enumerate(reversed(self.levels)):
            if path is not None and (path == "" or ref.path.startswith(f"{path}.")):
                below = ref.path[len(path) + 1 :] if path else ref.path
                return "_parent." * up + ".".join(identifier(name) for name in below.split("."))
        raise Refused(f"{ref.path} cannot be reached in Kaitai")


def number(formula: Formula, names: Names) -> str:
    """A formula as an integer."""
    match formula:
        case Ref():
            return names.way(formula) + (".to_i" if formula.info.bits == 1 else "")
        case Op(symbol) if symbol in COMPARISONS or symbol == "not":
            return f"({truth(formula, names)} ? 1 : 0)"
        case Op(symbol, (operand,)):
            return f"({symbol}{number(operand, names)})"
        case Op(symbol, (left, right)):
            return f"({number(left, names)} {'/' if symbol == '//' else symbol} {number(right, names)})"
        case _:
            return str(formula)


def truth(formula: Formula, names: Names) -> str:
    """A formula as a condition: not 0."""
    match formula:
        case Op("not", (operand,)):
            return f"not ({truth(operand, names)})"
        case Op(symbol, (left, right)) if symbol in COMPARISONS:
            return f"{number(left, names)} {symbol} {number(right, names)}"
        case int():
            return "true" if formula else "false"
        case _:
            return f"{number(formula, names)} != 0"


BitAttribute = dict[str, Any]

#: bits that Kaitai reads in one go.
WIDEST = 64
#: bytes of its other integers.
SIZES = (1, 2, 4, 8)


def block_type(block: Block, doc: Callable[[Part], BitAttribute]) -> tuple[list[BitAttribute], dict[str, BitAttribute]]:
    """The attributes and the instances of the type of a block, with what is said of each part.

    Raises:
        Refused: for an integer that is too wide for Kaitai.
    """
    if any(part.bits.width > WIDEST for part in block.parts):
        raise Refused(f"{block.info.path}: an integer of more than {WIDEST} bits")
    rows, suffix = _from_high(block), "be"
    if rows is None:
        rows, suffix = _from_low(block), "le"
    if rows is None:
        found = {_name(part): {"value": _assembled(part, "raw")} | doc(part) for part in block.parts}
        return [{"id": "raw", "size": block.size}], found
    seq: list[BitAttribute] = []
    instances: dict[str, BitAttribute] = {}
    for part in rows:
        name, width = _name(part), part.bits.width
        kind: BitAttribute = {"type": f"b{width}{suffix}"}
        if part.bits.signed:
            instances[name] = {"value": f"{name}_bits - (({name}_bits >> {width - 1}) << {width})"} | doc(part)
            seq.append({"id": f"{name}_bits"} | kind)
        else:
            seq.append({"id": name} | kind | _valid(part) | doc(part))
    return seq, instances


def inline(block: Block, more: Mapping[str, Any]) -> tuple[BitAttribute, dict[str, BitAttribute]] | None:
    """The attribute and the instances of a block that is one plain integer; None for any other block."""
    if len(block.parts) != 1 or block.parts[0].names or block.parts[0].indices or not block.name:
        return None
    part, name = block.parts[0], identifier(block.name)
    for order, suffix in ((_from_high, "be"), (_from_low, "le")):
        if order(block) is not None and not part.bits.signed and part.bits.width <= WIDEST:
            return {"id": name, "type": f"b{part.bits.width}{suffix}", **more} | _valid(part), {}
    if "repeat" in more:
        return None
    conditions = {"if": more["if"]} if "if" in more else {}
    return {"id": f"{name}_raw", "size": block.size, **more}, {name: {"value": _assembled(part, f"{name}_raw"), **conditions}}


def odd(node: Number) -> Block | None:
    """An integer of a size that Kaitai has no type for, as a block of one part; None for any other number."""
    if node.kind == "float" or node.size in SIZES:
        return None
    targets = [8 * (place if node.order == "little" else node.size - 1 - place) for place in range(node.size)]
    runs = tuple(Segment(place, 0xFF, 0, target) for place, target in enumerate(targets))
    return Block(node.name, node.info, node.size, (Part(node.info, BitField((), runs, 8 * node.size, node.kind == "int"), (), ()),))


def _name(part: Part) -> str:
    """What a part is called in the type of its block."""
    return identifier("_".join([*(part.names or ("value",)), *(str(index) for index in part.indices)]))


def _valid(part: Part) -> BitAttribute:
    if part.info.const is None:
        return {}
    return {"valid": bool(part.info.const) if part.bits.width == 1 else part.info.const}


def _from_high(block: Block) -> Sequence[Part] | None:
    """The parts in the order in which reading from each byte's highest bit meets them; None where that does not make them."""
    starts = _starts(block, lambda byte, bit: 8 * byte + 7 - bit, lambda part, target: part.bits.width - 1 - target)
    return None if starts is None else [part for _, part in starts]


def _from_low(block: Block) -> Sequence[Part] | None:
    """The same from each byte's lowest bit."""
    starts = _starts(block, lambda byte, bit: 8 * byte + bit, lambda _, target: target)
    return None if starts is None else [part for _, part in starts]


def _starts(block: Block, place: Callable[[int, int], int], inside: Callable[[Part, int], int]) -> list[tuple[int, Part]] | None:
    """Where each part starts, if its bits follow each other from there on and the parts fill the block."""
    found = []
    for part in block.parts:
        starts = {
            place(run.byte, run.low + step) - inside(part, run.target + step)
            for run in part.bits.segments
            for step in range(run.mask.bit_count())
        }
        if len(starts) != 1:
            return None
        found.append((starts.pop(), part))
    found.sort(key=lambda pair: pair[0])
    return found if sum(part.bits.width for _, part in found) == 8 * block.size else None


def _assembled(part: Part, raw: str) -> str:
    """A part as an expression of the block's bytes."""
    pieces = []
    for run in part.bits.segments:
        byte = f"{raw}[{run.byte}]" if run.mask == 0xFF else f"({raw}[{run.byte}] & {run.mask:#04x})"
        shift = run.target - run.low
        pieces.append(f"({byte} {'<<' if shift > 0 else '>>'} {abs(shift)})" if shift else byte)
    value = " | ".join(pieces)
    if part.bits.width == 1:
        return f"({value}) != 0"
    return f"({value}) - ((({value}) >> {part.bits.width - 1}) << {part.bits.width})" if part.bits.signed else value


Attribute = dict[str, Any]

#: bytes of a float that Kaitai can read.
FLOATS = (4, 8)


def ksy(sensor: Sensor) -> str:
    """The sensor's frame types as a .ksy document; parsed with it is a row of data frames, or of the only frame type.

    Raises:
        Refused: for what Kaitai cannot say: half-precision floats, Python code, names that are one name there.
    """
    found = messages(sensor)
    main = next((message for message in found if message.frame.data), found[0])
    types = {identifier(message.name): _frame(sensor, message) for message in found}
    if len(types) < len(found):
        raise Refused(f"{sensor.id}: two frame types have one name in Kaitai, where names are in lower case")
    name = identifier(sensor.id)
    document = {
        "meta": {"id": name if name[0].isalpha() else f"lidar_{name}", "title": f"{sensor.vendor} {sensor.model}", "ks-version": "0.10"},
        "doc": f"{sensor.source}. Made by lidarspec export ksy {sensor.id}. Checksums are not checked.",
        "seq": [{"id": "frames", "type": identifier(main.name), "repeat": "eos"}],
        "types": types,
    }
    return yaml(document)


def _frame(sensor: Sensor, message: Message) -> Attribute:
    sealed = {path: seal for seal in _seals(message.root) for path in seal.fields}
    try:
        return _Types(sealed).struct(message.root, Names())
    except Refused as refused:
        raise Refused(f"{sensor.id} {message.name}: {refused}") from None


def _seals(node: Node) -> Iterator[Sealed]:
    yield from (found for found in nodes(node) if isinstance(found, Sealed))


@dataclass
class _Type:
    """A Kaitai type while it is written."""

    seq: list[Attribute] = field(default_factory=list)
    instances: dict[str, Attribute] = field(default_factory=dict)
    types: dict[str, Attribute] = field(default_factory=dict)

    def done(self, path: str) -> Attribute:
        """The type as Kaitai has it.

        Raises:
            Refused: where two members have one name.
        """
        ids = [part["id"] for part in self.seq if "id" in part] + list(self.instances)
        twice = next((name for name in ids if ids.count(name) > 1), None)
        if twice:
            raise Refused(f"{path or 'the frame'} has two members that are called {twice!r} in Kaitai")
        parts = {"seq": self.seq, "instances": self.instances, "types": self.types}
        return {name: part for name, part in parts.items() if part or name == "seq"}


@dataclass
class _Types:
    """Writes the types of one frame."""

    seals: Mapping[str, Sealed]

    def struct(self, node: Struct | Sealed, names: Names) -> Attribute:
        """The type of a struct; `names` says which types it stands in."""
        body = node.body if isinstance(node, Sealed) else node
        made = _Type()
        for member in body.members:
            self._member(made, member, names.inside(body.path))
        return made.done(body.path)

    def _member(self, made: _Type, node: Node, names: Names, **more: Any) -> None:
        """Add a part to a type, with what else is said of its attribute."""
        match node:
            case Empty():
                return
            case When(otherwise=Empty()):
                self._member(made, node.then, names, **more, **{"if": truth(node.condition, names)})
            case When():
                cases = {"1": node.then, "0": node.otherwise}
                self._switch(made, node.name, f"{truth(node.condition, names)} ? 1 : 0", cases, names, **more)
            case Select():
                cases = {str(value): case for value, case in node.cases} | {"_": node.default}
                self._switch(made, node.name, number(node.key, names), cases, names, **more)
            case Repeat():
                self._repeat(made, node, names, **more)
            case Number() if (block := odd(node)) is not None:
                self._member(made, block, names, **more)
            case Block() if (found := inline(node, more)) is not None:
                made.seq.append(found[0] | self._doc(node.info))
                made.instances |= found[1]
                self._physical(made, node.info, more)
            case Number() | Blob():
                made.seq.append(self._plain(node, names) | more)
                self._physical(made, node.info, more)
            case _:
                name = identifier(node.name)
                made.types[name] = self._type(node, names)
                made.seq.append({"id": name, "type": name, **more})

    def _type(self, node: Node, names: Names) -> Attribute:
        """A type for any part: its own, or one that holds it as `value`."""
        if isinstance(node, Struct | Sealed):
            return self.struct(node, names)
        made = _Type()
        if isinstance(node, Block):
            docs = {id(part): self._doc(part.info) for part in node.parts}
            made.seq, made.instances = block_type(node, lambda part: docs[id(part)])
            for part in node.parts:
                if not part.indices:
                    self._physical(made, part.info, {}, name="_".join(part.names) or "value")
            return made.done(node.info.path)
        self._member(made, _value(node), names.wrapped())
        return made.done(node.name)

    def _repeat(self, made: _Type, node: Repeat, names: Names, **more: Any) -> None:
        more |= {"repeat": "expr", "repeat-expr": _size(node.count, names)}
        element = (odd(node.element) if isinstance(node.element, Number) else None) or node.element
        if isinstance(element, Number | Blob):
            made.seq.append(self._plain(element, names) | {"id": identifier(node.name)} | more)
            return
        if isinstance(element, Block) and (found := inline(element, more)) is not None:
            made.seq.append(found[0] | self._doc(element.info))
            return
        name = identifier(node.name)
        made.types[name] = self._type(element, names)
        made.seq.append({"id": name, "type": name, **more})

    def _switch(self, made: _Type, name: str, key: str, cases: Mapping[str, Node], names: Names, **more: Any) -> None:
        types = {}
        for value, case in cases.items():
            if value == "_" and isinstance(case, Empty):
                continue
            types[value] = identifier(f"{name}_{'other' if value == '_' else value.replace('-', 'minus_')}")
            made.types[types[value]] = {"seq": []} if isinstance(case, Empty) else self._type(case, names)
        made.seq.append({"id": identifier(name), "type": {"switch-on": key, "cases": types}, **more})

    def _plain(self, node: Number | Blob, names: Names) -> Attribute:
        """The attribute of a number or of bytes."""
        head = {"id": identifier(node.name)} if node.name else {}
        if isinstance(node, Blob):
            size = _size(node.size, names)
            kind: Attribute = {"size": size} if node.const is None else {"contents": [Byte(byte) for byte in node.const]}
            return head | kind | self._doc(node.info)
        letter = {"uint": "u", "int": "s", "float": "f"}[node.kind]
        if node.kind == "float" and node.size not in FLOATS:
            raise Refused(f"{node.info.path}: a float of {node.size} bytes, and Kaitai knows those of 4 and 8")
        order = {"little": "le", "big": "be"}[node.order] if node.size > 1 else ""
        const = {} if node.info.const is None else {"valid": node.info.const}
        return head | {"type": f"{letter}{node.size}{order}"} | const | self._doc(node.info)

    def _doc(self, info: FieldInfo) -> Attribute:
        seal = self.seals.get(info.path)
        said = [unit_text(info), meaning(info), "" if seal is None else f"{seal.algorithm.describe()} over {_span(seal)}; not checked here"]
        text = "; ".join(part for part in said if part)
        return {"doc": text} if text else {}

    def _physical(self, made: _Type, info: FieldInfo, more: Mapping[str, Any], *, name: str = "") -> None:
        """An instance with the physical value of a field that has a scale."""
        own = identifier(name or info.name)
        if not info.scaled or not own:
            return
        value = f"{own} * {info.scale!r}" + (f" + {info.offset!r}" if info.offset else "")
        conditions = {"if": more["if"]} if "if" in more else {}
        made.instances[f"{own}_{slug(info.unit) or 'physical'}"] = {"value": value.replace("+ -", "- "), **conditions}


def _size(formula: Formula, names: Names) -> int | str:
    """A number of bytes or elements."""
    return formula if isinstance(formula, int) else number(formula, names)


def _value(node: Node) -> Node:
    """The part of an array or a choice as the one member of a type of its own."""
    if isinstance(node, Number):
        parent = node.info.path.rpartition(".")[0]
        return replace(node, info=replace(node.info, path=f"{parent}.value" if parent else "value"))
    return node if isinstance(node, Sealed) else replace(node, name="value")


def _span(seal: Sealed) -> str:
    if seal.over is None:
        return "all other bytes"
    first, last = (path.rpartition(".")[2] for path in seal.over)
    return first if first == last else f"{first} to {last}"
