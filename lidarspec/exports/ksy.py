"""Export a spec as a Kaitai Struct format for Kaitai's compiler, web IDE and visualizer.

Each frame type, and each struct in a frame type, becomes a Kaitai type. Kaitai has no absolute
paths, so formulas refer to a field by its path from the current type (`format_reference`).

A bit block becomes bit-sized integers if its parts are consecutive in one of Kaitai's two bit
orders. Otherwise the block becomes bytes, and Kaitai calculates each part from the bytes. Kaitai
cannot express checksums, plausibility tests and points.
"""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from lidarspec.exports import (
    ExportedFrame,
    ExportError,
    describe_left_out,
    list_frames,
    make_prefix,
)
from lidarspec.frames.wire_table import describe_field, format_unit
from lidarspec.spec import Sensor, tree
from lidarspec.spec.bits import BitField, Segment
from lidarspec.spec.fields import slug

#: A string that needs no quotes in YAML.
_PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_./()<>=+*-]*( [A-Za-z0-9_./()<>=+*;,-]+)*")
#: The maximum number of allowed values to list.
MAX_LISTED_VALUES = 16
_RESERVED_WORDS = {"true", "false", "yes", "no", "on", "off", "null", "y", "n"}


class HexNumber(int):
    """A number that is written in hexadecimal."""

    def __repr__(self) -> str:
        return f"0x{int(self):02x}"


def yaml(value: Mapping[str, Any]) -> str:
    """Return a document as YAML text."""
    return "\n".join(_iter_lines(value, "")) + "\n"


def _iter_lines(value: Any, indent: str) -> Iterator[str]:
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield from _iter_entry_lines(f"{indent}{_format_scalar(key)}:", part, indent + "  ")
    else:
        for part in value:
            if isinstance(part, Mapping) and part:
                first, *rest = _iter_lines(part, indent + "  ")
                yield f"{indent}- {first.lstrip()}"
                yield from rest
            else:
                yield from _iter_entry_lines(f"{indent}-", part, indent + "  ")


def _iter_entry_lines(head: str, part: Any, indent: str) -> Iterator[str]:
    if (isinstance(part, Mapping) and part) or (
        isinstance(part, list) and any(isinstance(item, Mapping | list) for item in part)
    ):
        yield head
        yield from _iter_lines(part, indent)
    elif isinstance(part, Mapping):
        yield f"{head} {{}}"
    elif isinstance(part, list):
        yield f"{head} [{', '.join(_format_scalar(item) for item in part)}]"
    else:
        yield f"{head} {_format_scalar(part)}"


def _format_scalar(value: Any) -> str:
    if isinstance(value, str) and _PLAIN.fullmatch(value) and value.lower() not in _RESERVED_WORDS:
        return value
    if isinstance(value, str | bool):
        return json.dumps(value, ensure_ascii=False)
    return repr(value)


def identifier(name: str) -> str:
    """Return a name in Kaitai's spelling."""
    return re.sub(r"[^a-z0-9_]", "_", name.lower())


#: The Kaitai types around an expression, outermost first. Each is given by the path of its struct,
#: or by None for a type without a struct, which contains a single part.
Scope = tuple[str | None, ...]


def format_reference(scope: Scope, ref: tree.Ref) -> str:
    """Return a field as an integer expression for the innermost type of `scope`.

    Raises:
        ExportError: if no type around the expression contains the field.
    """
    for up, path in enumerate(reversed(scope)):
        if path is not None and (path == "" or ref.path.startswith(f"{path}.")):
            names = ref.path.removeprefix(f"{path}.").split(".")
            return (
                "_parent." * up + ".".join(map(identifier, names)) + ".to_i" * (ref.info.bits == 1)
            )
    raise ExportError(f"a formula in Kaitai cannot refer to {ref.path}")


_OPERATIONS = {
    "//": "({} / {})",
    "not": "({} == 0 ? 1 : 0)",
    **{symbol: f"({{}} {symbol} {{}} ? 1 : 0)" for symbol in tree.COMPARISONS},
}


def format_integer(formula: tree.Formula, scope: Scope) -> str:
    """Return a formula as an integer expression."""
    return tree.format_formula(formula, functools.partial(format_reference, scope), _OPERATIONS)


def _format_part_formula(formula: tree.Formula, scope: Scope) -> str:
    """Return the Kaitai expression of a formula that is evaluated after each part.

    Args:
        formula: the formula, which tells whether another part follows. A path in it that begins
            with "_." is a field of the frame, and any other path is a field of the part.
    """

    def format_field(ref: tree.Ref) -> str:
        if ref.path.startswith("_."):  # a field of the frame
            return format_reference(scope, tree.Ref(ref.path[2:], ref.info))
        return ".".join(["_", *map(identifier, ref.path.split("."))])

    return tree.format_formula(formula, format_field, _OPERATIONS)


def to_condition(formula: tree.Formula, scope: Scope) -> str:
    """Return a Kaitai condition that is true if the value of a formula is not 0."""
    match formula:
        case tree.Op("not", (operand,)):
            return f"not ({to_condition(operand, scope)})"
        case tree.Op(symbol, (left, right)) if symbol in tree.COMPARISONS:
            return f"{format_integer(left, scope)} {symbol} {format_integer(right, scope)}"
        case int():
            if formula:
                return "true"
            return "false"
    return f"{format_integer(formula, scope)} != 0"


Attribute = dict[str, Any]

#: The maximum width of Kaitai's bit-sized integers. The next two constants are the sizes of
#: Kaitai's other integers and of its floats, in bytes.
MAX_BITS = 64
INTEGER_SIZES = (1, 2, 4, 8)
FLOAT_SIZES = (4, 8)


def make_block_type(
    block: tree.Block, doc: Callable[[tree.FieldInfo], Attribute]
) -> tuple[list[Attribute], dict[str, Attribute]]:
    """Return the attributes and the instances of a bit block's Kaitai type.

    Args:
        doc: a function that returns the documentation of a field.

    Raises:
        ExportError: for an integer that is too wide for Kaitai.
    """
    if any(part.bits.width > MAX_BITS for part in block.parts):
        raise ExportError(
            f"{block.info.path}: an integer of more than {MAX_BITS} bits is not supported"
        )
    ordered = _find_bit_order(block)
    if ordered is None:
        calculated = {
            _make_part_name(part): {"value": _assemble_part(part, "raw")} | doc(part.info)
            for part in block.parts
        }
        return [{"id": "raw", "size": block.size}], calculated
    seq: list[Attribute] = []
    instances: dict[str, Attribute] = {}
    for part in ordered[0]:
        name = _make_part_name(part)
        width = part.bits.width
        kind: Attribute = {"type": f"b{width}{ordered[1]}"}
        if part.bits.signed:
            instances[name] = {
                "value": f"{name}_bits - (({name}_bits >> {width - 1}) << {width})"
            } | doc(part.info)
            seq.append({"id": f"{name}_bits"} | kind)
        else:
            seq.append({"id": name} | kind | _make_valid(part) | doc(part.info))
    return seq, instances


def inline_block(
    block: tree.Block, more: Mapping[str, Any]
) -> tuple[Attribute, dict[str, Attribute]] | None:
    """Return the attribute and the instances of a bit block with a single integer.

    Args:
        more: further keys of the attribute.

    Returns:
        None if the block has several integers, or requires a type of its own for another reason.
    """
    if len(block.parts) != 1 or block.parts[0].names or block.parts[0].indices or not block.name:
        return None
    part = block.parts[0]
    name = identifier(block.name)
    ordered = _find_bit_order(block)
    if ordered is not None and not part.bits.signed and part.bits.width <= MAX_BITS:
        return {"id": name, "type": f"b{part.bits.width}{ordered[1]}", **more} | _make_valid(
            part
        ), {}
    if "repeat" in more:
        return None
    return {"id": f"{name}_raw", "size": block.size, **more}, {
        name: {"value": _assemble_part(part, f"{name}_raw")} | _copy_condition(more)
    }


def as_block(node: tree.Node) -> tree.Node:
    """Return an integer of an unusual size as a block, any other node unchanged."""
    if not isinstance(node, tree.Number) or node.kind == "float" or node.size in INTEGER_SIZES:
        return node
    targets = [
        8 * (byte if node.order == "little" else node.size - 1 - byte) for byte in range(node.size)
    ]
    segments = tuple(Segment(byte, 0xFF, 0, target) for byte, target in enumerate(targets))
    part = tree.BlockInteger(
        node.info, BitField((), segments, 8 * node.size, node.kind == "int"), (), ()
    )
    return tree.Block(node.name, node.info, node.size, (part,))


def _make_part_name(part: tree.BlockInteger) -> str:
    """Return the name of a part of a bit block in the block's Kaitai type."""
    return identifier("_".join([*(part.names or ("value",)), *map(str, part.indices)]))


def _list_allowed_values(info: tree.FieldInfo) -> Attribute:
    """Return the Kaitai entry that lists the allowed values; {} if there are too many."""
    if info.allowed and len(info.allowed) <= MAX_LISTED_VALUES:
        return {"valid": {"any-of": list(info.allowed)}}
    return {}


def _make_valid(part: tree.BlockInteger) -> Attribute:
    if part.info.const is None:
        if part.bits.width > 1:
            return _list_allowed_values(part.info)
        return {}
    return {"valid": bool(part.info.const) if part.bits.width == 1 else part.info.const}


def _copy_condition(more: Mapping[str, Any]) -> Attribute:
    """Return the entry "if" of `more` as a dict; {} if there is none."""
    if "if" in more:
        return {"if": more["if"]}
    return {}


def _find_bit_order(block: tree.Block) -> tuple[list[tree.BlockInteger], str] | None:
    """Return the parts of a block as Kaitai reads them, and the order "be" or "le".

    Returns None if Kaitai cannot read the block in either order.
    """
    if sum(part.bits.width for part in block.parts) != 8 * block.size:
        return None
    for suffix in ("be", "le"):
        starts = [_find_starts(part.bits, suffix) for part in block.parts]
        if all(len(of_part) == 1 for of_part in starts):
            return sorted(
                block.parts, key=lambda part: min(_find_starts(part.bits, suffix))
            ), suffix
    return None


def _find_starts(bits: BitField, suffix: str) -> set[int]:
    """Return the bit positions at which a field begins according to its segments.

    If there is only one position, the bits of the field are consecutive, and Kaitai can read it.

    Args:
        suffix: the bit order, "be" or "le".
    """
    ahead = ((segment, segment.low - segment.target) for segment in bits.segments)
    return {
        8 * segment.byte + (bits_ahead if suffix == "le" else 8 - bits.width - bits_ahead)
        for segment, bits_ahead in ahead
    }


def _assemble_part(part: tree.BlockInteger, raw: str) -> str:
    """Return the Kaitai expression that calculates a part from its block's bytes."""
    terms = []
    for segment in part.bits.segments:
        if segment.mask == 0xFF:
            byte = f"{raw}[{segment.byte}]"
        else:
            byte = f"({raw}[{segment.byte}] & {segment.mask:#04x})"
        shift = segment.target - segment.low
        terms.append(f"({byte} {'<<' if shift > 0 else '>>'} {abs(shift)})" if shift else byte)
    value = " | ".join(terms)
    if part.bits.width == 1:
        return f"({value}) != 0"
    if part.bits.signed:
        return f"({value}) - ((({value}) >> {part.bits.width - 1}) << {part.bits.width})"
    return value


def ksy(sensor: Sensor) -> str:
    """Return the sensor's frame types as a .ksy document.

    The document parses a sequence of data frames, or of frames of the first type if the sensor has
    no data frames.

    Raises:
        ExportError: if Kaitai cannot express the spec: half-precision floats, Python code, or names
            that differ only in case.
    """
    frames = list_frames(sensor)
    main = next((message for message in frames if message.frame.data), frames[0])
    types = {identifier(message.name): _frame(sensor, message) for message in frames}
    if len(types) < len(frames):
        raise ExportError(
            f"{sensor.id}: two frame types have names that differ only in case, but Kaitai requires"
            " lower case"
        )
    name = identifier(make_prefix(sensor))
    remarks = [
        sensor.source,
        f"Made by lidarspec export ksy {sensor.id}",
        "Checksums are not checked",
        describe_left_out(sensor),
    ]
    document = {
        "meta": {"id": name, "title": f"{sensor.vendor} {sensor.model}", "ks-version": "0.10"},
        "doc": ". ".join(filter(None, remarks)) + ".",
        "seq": [{"id": "frames", "type": identifier(main.name), "repeat": "eos"}],
        "types": types,
    }
    return yaml(document)


def _frame(sensor: Sensor, message: ExportedFrame) -> Attribute:
    try:
        return _KaitaiWriter(message.checksums).make_struct_type(message.root, ())
    except ExportError as refused:
        raise ExportError(f"{sensor.id} {message.name}: {refused}") from None


@dataclass
class _KaitaiType:
    """A Kaitai type under construction."""

    seq: list[Attribute] = field(default_factory=list)
    instances: dict[str, Attribute] = field(default_factory=dict)
    enums: dict[str, Attribute] = field(default_factory=dict)
    types: dict[str, Attribute] = field(default_factory=dict)

    def finish(self, path: str) -> Attribute:
        """Return the finished type.

        Raises:
            ExportError: if two members have the same name.
        """
        ids = [part["id"] for part in self.seq if "id" in part] + list(self.instances)
        twice = next((name for name in ids if ids.count(name) > 1), None)
        if twice:
            raise ExportError(
                f"{path or 'the frame'} has two members with the Kaitai name {twice!r}"
            )
        return {name: part for name, part in vars(self).items() if part or name == "seq"}


def _find_terminator(path: str, ending: tree.Ending) -> int:
    """Return the byte that ends a field of bytes.

    Raises:
        ExportError: if the end is not a single byte after the content.
    """
    if ending.is_content:
        raise ExportError(f"{path}: Kaitai does not support numbers of variable size")
    if len(ending.terminator) != 1:
        raise ExportError(f"{path}: Kaitai supports only one byte as the terminator of bytes")
    return ending.terminator[0]


@dataclass
class _KaitaiWriter:
    """Writes the types of one frame.

    Attributes:
        checksums: as in `ExportedFrame`.
    """

    checksums: Mapping[str, tree.ChecksummedStruct]

    def make_struct_type(
        self, node: tree.Struct | tree.ChecksummedStruct, scope: Scope
    ) -> Attribute:
        """Return the Kaitai type of a struct inside the types of `scope`."""
        kaitai = _KaitaiType()
        for member in node.struct.members:
            self._add_member(kaitai, member, (*scope, node.struct.path))
        return kaitai.finish(node.struct.path)

    def _add_member(self, kaitai: _KaitaiType, node: tree.Node, scope: Scope, **more: Any) -> None:
        """Add a member to a type; `more` contains further keys of the attribute."""
        node = as_block(node)
        match node:
            case tree.Empty() | tree.Derived():
                return
            case tree.Check():
                kaitai.seq.append(
                    {
                        "id": identifier(node.name),
                        "size": 0,
                        "valid": {"expr": to_condition(node.condition, scope)},
                        **more,
                    }
                )
            case tree.Never():
                kaitai.seq.append(
                    {"id": identifier(node.name), "size": 0, "valid": {"expr": "false"}, **more}
                )
            case tree.When(otherwise=tree.Empty()):
                self._add_member(
                    kaitai, node.then, scope, **more, **{"if": to_condition(node.condition, scope)}
                )
            case tree.When():
                cases = {"1": node.then, "0": node.otherwise}
                self._add_switch(
                    kaitai,
                    node.name,
                    f"{to_condition(node.condition, scope)} ? 1 : 0",
                    cases,
                    scope,
                    **more,
                )
            case tree.Select():
                cases = {str(value): case for value, case in node.cases} | {"_": node.default}
                self._add_switch(
                    kaitai, node.name, format_integer(node.key, scope), cases, scope, **more
                )
            case tree.Repeat():
                self._add_repeat(kaitai, node, scope, **more)
            case tree.PartSequence():
                self._add_parts(kaitai, node, scope, **more)
            case tree.Block() if (plain := inline_block(node, more)) is not None:
                kaitai.seq.append(plain[0] | self._make_doc(node.info))
                kaitai.instances |= plain[1]
                self._add_physical(kaitai, node.info, more)
            case tree.Number() | tree.Blob():
                kaitai.seq.append(self._make_plain(node, scope) | more)
                self._add_physical(kaitai, node.info, more)
            case _:
                self._add_typed(kaitai, node.name, node, scope, **more)

    def _add_parts(
        self, kaitai: _KaitaiType, node: tree.PartSequence, scope: Scope, **more: Any
    ) -> None:
        """Add the attribute of a sequence of frames in the frame, all of the same type."""
        if len(node.kinds) > 1:
            raise ExportError(
                f"{node.axis}: Kaitai cannot distinguish kinds of parts by their constants"
            )
        (kind,), name = node.kinds, identifier(node.name)
        if node.within is not None:
            inner = _KaitaiType(
                [{"id": "value", "type": "part", "repeat": "eos"}],
                types={"part": self._make_type(kind.element, (*scope, None))},
            )
            kaitai.types[name] = inner.finish(node.axis)
            kaitai.seq.append(
                {"id": name, "type": name, "size": _format_size(node.within, scope), **more}
            )
            return
        if node.count is not None:
            more |= {"repeat": "expr", "repeat-expr": _format_size(node.count, scope)}
        elif node.size is not None and kind.following is not None:
            ends = _format_part_formula(kind.following, scope)
            if "if" in more:
                condition = f"({more['if']}) and {format_integer(node.size, scope)} != 0"
            else:
                condition = f"{format_integer(node.size, scope)} != 0"
            more |= {"repeat": "until", "repeat-until": f"{ends} == 0", "if": condition}
        elif kind.until is not None:
            ends = _format_part_formula(kind.until, scope)
            more |= {"repeat": "until", "repeat-until": f"{ends} != 0"}
        self._add_typed(kaitai, node.name, kind.element, scope, **more)

    def _add_typed(
        self, kaitai: _KaitaiType, name: str, node: tree.Node, scope: Scope, **more: Any
    ) -> None:
        """Add a new type for `node`, and an attribute of this type."""
        name = identifier(name)
        kaitai.types[name] = self._make_type(node, scope)
        kaitai.seq.append({"id": name, "type": name, **more})

    def _make_type(self, node: tree.Node, scope: Scope) -> Attribute:
        """Return the Kaitai type of a node."""
        if isinstance(node, tree.Struct | tree.ChecksummedStruct):
            return self.make_struct_type(node, scope)
        kaitai = _KaitaiType()
        if isinstance(node, tree.Block):
            kaitai.seq, kaitai.instances = make_block_type(node, self._make_doc)
            for part in node.parts:
                if not part.indices:
                    self._add_physical(kaitai, part.info, {}, name="_".join(part.names) or "value")
            return kaitai.finish(node.info.path)
        self._add_member(kaitai, _rename_to_value(node), (*scope, None))
        return kaitai.finish(node.name)

    def _add_repeat(
        self, kaitai: _KaitaiType, node: tree.Repeat, scope: Scope, **more: Any
    ) -> None:
        more |= {"repeat": "expr", "repeat-expr": _format_size(node.count, scope)}
        element = as_block(node.element)
        if isinstance(element, tree.Number | tree.Blob):
            kaitai.seq.append(
                self._make_plain(element, scope) | {"id": identifier(node.name)} | more
            )
        elif isinstance(element, tree.Block) and (plain := inline_block(element, more)) is not None:
            kaitai.seq.append(plain[0] | self._make_doc(element.info))
        else:
            self._add_typed(kaitai, node.name, element, scope, **more)

    def _add_switch(
        self,
        kaitai: _KaitaiType,
        name: str,
        key: str,
        cases: Mapping[str, tree.Node],
        scope: Scope,
        **more: Any,
    ) -> None:
        types = {}
        for value, case in cases.items():
            if value == "_" and isinstance(case, tree.Empty):
                continue
            types[value] = identifier(
                f"{name}_{'other' if value == '_' else value.replace('-', 'minus_')}"
            )
            if isinstance(case, tree.Empty):
                kaitai.types[types[value]] = {"seq": []}
            else:
                kaitai.types[types[value]] = self._make_type(case, scope)
        kaitai.seq.append(
            {"id": identifier(name), "type": {"switch-on": key, "cases": types}, **more}
        )

    def _make_plain(self, node: tree.Number | tree.Blob, scope: Scope) -> Attribute:
        """Return the attribute of a number or of bytes."""
        head = {"id": identifier(node.name)} if node.name else {}
        if isinstance(node, tree.Blob):
            kind: Attribute
            if node.ending is not None and not node.ending.mark:
                kind = {"size-eos": True}
            elif node.ending is not None:
                kind = {"terminator": HexNumber(_find_terminator(node.info.path, node.ending))}
            elif node.const is not None:
                kind = {"contents": [HexNumber(byte) for byte in node.const]}
            else:
                kind = {"size": _format_size(node.size, scope)}
            return head | kind | self._make_doc(node.info)
        letter = {"uint": "u", "int": "s", "float": "f"}[node.kind]
        if node.kind == "float" and node.size not in FLOAT_SIZES:
            raise ExportError(
                f"{node.info.path}: Kaitai supports floats of 4 and 8 bytes, but this float has"
                f" {node.size} bytes"
            )
        if node.size > 1:
            order = {"little": "le", "big": "be"}[node.order]
        else:
            order = ""
        if node.info.const is None:
            const = _list_allowed_values(node.info)
        else:
            const = {"valid": node.info.const}
        return head | {"type": f"{letter}{node.size}{order}"} | const | self._make_doc(node.info)

    def _make_doc(self, info: tree.FieldInfo) -> Attribute:
        checksum = self.checksums.get(info.path)
        if checksum is None:
            checksum_note = ""
        else:
            covered = _describe_covered(checksum)
            checksum_note = (
                f"{checksum.algorithm.describe()} over {covered}, which is not checked here"
            )
        if info.is_enforced:
            unchecked = "a length, which is not checked here"
        else:
            unchecked = ""
        text = "; ".join(
            filter(None, (format_unit(info), describe_field(info), unchecked, checksum_note))
        )
        if text:
            return {"doc": text}
        return {}

    def _add_physical(
        self, kaitai: _KaitaiType, info: tree.FieldInfo, more: Mapping[str, Any], *, name: str = ""
    ) -> None:
        """Add instances for the physical value and the name of a field, if it has them."""
        own = identifier(name or info.name)
        if info.labels and own:
            kaitai.enums[own] = _make_enum(info.labels)
            number = f"{own}.to_i" if info.bits == 1 else own
            kaitai.instances[f"{own}_name"] = {
                "value": number,
                "enum": own,
                **_copy_condition(more),
            }
        if info.scaled and own:
            value = f"{own} * {info.scale!r}" + (f" + {info.offset!r}" if info.offset else "")
            kaitai.instances[f"{own}_{slug(info.unit) or 'physical'}"] = {
                "value": value.replace("+ -", "- "),
                **_copy_condition(more),
            }


def _make_enum(labels: Mapping[int, str]) -> Attribute:
    """Return a Kaitai enum of named numbers, with the original names as documentation."""
    members: dict[Any, Any] = {}
    taken = set[str]()
    for code, label in labels.items():
        name = identifier(label)
        if not name[:1].isalpha():
            name = f"code_{name}"
        if name in taken:
            name = f"{name}_{code}"
        taken.add(name)
        members[code] = name if name == label else {"id": name, "doc": label}
    return members


def _format_size(formula: tree.Formula, scope: Scope) -> int | str:
    if isinstance(formula, int):
        return formula
    return format_integer(formula, scope)


def _rename_to_value(node: tree.Node) -> tree.Node:
    """Return an array element or an alternative with the name `value`."""
    if isinstance(node, tree.Number):
        parent = node.info.path.rpartition(".")[0]
        return replace(node, info=replace(node.info, path=f"{parent}.value" if parent else "value"))
    if isinstance(node, tree.ChecksummedStruct | tree.Derived):
        return node
    return replace(node, name="value")


def _describe_covered(checksum: tree.ChecksummedStruct) -> str:
    if checksum.over is None:
        return "all other bytes"
    first, last = (path.rpartition(".")[2] for path in checksum.over)
    if first == last:
        return first
    return f"{first} to {last}"
