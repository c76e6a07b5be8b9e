"""A spec as a Kaitai Struct format, for its compiler, its web IDE and its visualizer.

A frame type becomes a type, and so does each struct in it. Bit blocks become bit-sized integers where Kaitai's two bit orders
can say them, else bytes and calculated instances; a field with a scale gets an instance with the physical value. Checksums,
plausibility and what points are made of cannot be said in Kaitai: checksums are named in the documentation of their fields.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from lidarspec.export import Refused
from lidarspec.export.expressions import Names, identifier, number, truth
from lidarspec.export.formulas import Formula
from lidarspec.export.kaitai_bits import block_type, inline, odd
from lidarspec.export.messages import Message, messages
from lidarspec.export.tree import Blob, Block, Empty, Node, Number, Repeat, Sealed, Select, Struct, When, nodes
from lidarspec.export.yaml import Byte, yaml
from lidarspec.frames.schema import FieldInfo
from lidarspec.spec import Sensor
from lidarspec.units import slug
from lidarspec.wiretable import meaning, unit_text

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
