"""The tree of a frame type as Lua tables, and the fields that Wireshark knows it by."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from lidarspec.bits import BitField
from lidarspec.checksums import Checksum, Crc, Fold15, Sum, WordXor, Xor, ZeroPadded
from lidarspec.export import Refused
from lidarspec.export.formulas import Formula, refs
from lidarspec.export.messages import Message
from lidarspec.export.tree import Blob, Block, Empty, Node, Number, Part, Repeat, Sealed, Select, Struct, When, formulas, nodes
from lidarspec.export.wireshark_text import Code, formula, quoted
from lidarspec.frames.schema import FieldInfo

#: elements of arrays say what is in them, where it is no more than this.
SUMMED = 4
Table = dict[str, Any]


def tables(message: Message, prefix: str) -> Table:
    """The root of a frame type as a table; `prefix` begins the names of its fields in Wireshark's filters."""
    return _Writer(message, prefix).node(message.root)


@dataclass
class _Writer:
    """What is known of one frame type while it is written."""

    message: Message
    prefix: str
    kept: set[str] = field(default_factory=set)
    marked: set[str] = field(default_factory=set)
    seals: set[str] = field(default_factory=set)
    types: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for node in nodes(self.message.root):
            self.kept |= {ref.path for value in formulas(node) for ref in refs(value)}
            if isinstance(node, Sealed):
                self.seals |= set(node.fields)
                self.marked |= set(node.over or ())
        self.kept |= self.seals

    def node(self, node: Node, path: str = "") -> Table:
        """A node as a table; `skip` says how many bytes it takes where it need not be looked at to measure the frame."""
        match node:
            case Number():
                return self._number(node)
            case Blob():
                return self._blob(node)
            case Block():
                return self._block(node)
            case Struct():
                return self._struct(node)
            case Sealed():
                return {"kind": "sealed", "name": node.name or None, "body": self.node(node.body), "seal": self._seal(node)}
            case Repeat():
                return self._repeat(node, path)
            case When():
                then, otherwise = self.node(node.then, path), self.node(node.otherwise, path)
                return {"kind": "when", "name": node.name, "condition": _function(node.condition), "yes": then, "no": otherwise}
            case Select():
                cases = {value: self.node(case, path) for value, case in node.cases}
                default = self.node(node.default, path)
                return {"kind": "select", "name": node.name, "key": _function(node.key), "cases": cases, "default": default}
            case Empty():
                return {"kind": "empty", "skip": 0}

    def _number(self, node: Number) -> Table:
        kind = {"uint": "UINT", "int": "INT", "float": "FLOAT"}[node.kind] + ("" if node.kind == "float" else str(_width(8 * node.size)))
        if node.kind == "float" and node.size == 8:
            kind = "DOUBLE"
        table: Table = {"kind": "number", "name": node.name, "type": node.kind, "size": node.size}
        table |= {"le": (node.order == "little" and node.size > 1) or None, **self._described(node.info, kind)}
        return table | {"skip": self._skip(node.info, node.size)}

    def _blob(self, node: Blob) -> Table:
        name = node.name or "constant"
        path = node.info.path if node.name else ".".join(part for part in (node.info.path, name) if part)
        new = self._new("BYTES", path, name, node.info.docs, "NONE")
        table: Table = {"kind": "bytes", "name": name, "field": new, "size": formula(node.size), "keep": self._keep(path)}
        table["const"] = Code(quoted(node.const)) if node.const is not None else None
        return table | {"skip": self._skip(node.info, node.size) if isinstance(node.size, int) and node.const is None else None}

    def _block(self, node: Block) -> Table:
        order = _word_order(node)
        parts = [self._part(node, part, order) for part in node.parts]
        looked_at = any("keep" in part or "const" in part for part in ({k: v for k, v in p.items() if v is not None} for p in parts))
        return {
            "kind": "block",
            "name": node.name,
            "size": node.size,
            "le": order == "little" or None,
            "is_struct": any(part.names for part in node.parts),
            "skip": None if looked_at else node.size,
            "parts": parts,
        }

    def _part(self, block: Block, part: Part, order: str | None) -> Table:
        spots = [segment.byte for segment in part.bits.segments]
        letters = "INT" if part.bits.signed else "UINT"
        is_masked = order is not None and part.bits.width < 8 * block.size
        kind = f"{letters}{8 * block.size if is_masked else _width(part.bits.width)}"
        mask = _mask(part.bits, block.size, order) if is_masked and order is not None else None
        label = ".".join(part.names) + "".join(f"[{index}]" for index in part.indices)
        return {
            "name": part.info.name,
            "label": label if label != part.info.name else None,
            "first": min(spots),
            "last": max(spots),
            "width": part.bits.width,
            "signed": part.bits.signed or None,
            "masked": is_masked or None,
            "segments": [[one.byte, one.low, one.mask.bit_count(), one.target] for one in part.bits.segments],
            **self._described(part.info, kind, mask),
        }

    def _struct(self, node: Struct) -> Table:
        members = []
        for member in node.members:
            path = ".".join(part for part in (node.path, member.name) if part)
            table = self.node(member, path)
            members.append(table | {"mark": path} if path in self.marked and member.name else table)
        sizes = [None if "mark" in member else member.get("skip") for member in members]
        total = None if None in sizes else sum(size for size in sizes if size is not None)
        return {"kind": "struct", "name": node.name or None, "skip": total, "members": members}

    def _repeat(self, node: Repeat, path: str) -> Table:
        element = self.node(node.element, path)
        size = element.get("skip")
        whole = size * node.count if isinstance(node.count, int) and size is not None else None
        few = isinstance(node.element, Block) or (isinstance(node.element, Struct) and len(_leaves(node.element)) <= SUMMED)
        summed = (few and bool(_leaves(node.element))) or None
        return {"kind": "repeat", "name": node.name, "count": formula(node.count), "summed": summed, "skip": whole, "element": element}

    def _described(self, info: FieldInfo, kind: str, mask: int | None = None) -> Table:
        """What a number says of itself, and its fields in Wireshark."""
        is_hex = (info.path in self.seals or info.const is not None) and kind.startswith("UINT")
        shown = "HEX" if is_hex else "NONE" if kind in ("FLOAT", "DOUBLE") else "DEC"
        table: Table = {"field": self._new(kind, info.path, info.name, info.docs, shown, info.labels, mask)}
        if info.scaled:
            table["physical"] = self._new("DOUBLE", f"{info.path}.physical", info.name, f"{info.docs} in {info.unit}".strip(), "NONE")
        table |= {"scale": info.scale if info.scaled else None, "offset": info.offset or None, "unit": info.unit or None}
        return table | {"labels": dict(info.labels) or None, "const": info.const, "keep": self._keep(info.path)}

    def _new(self, kind: str, path: str, name: str, docs: str, base: str, labels: Any = None, mask: int | None = None) -> Code:
        """A field of Wireshark; one name stands for numbers of one family only."""
        family = "".join(letter for letter in kind if letter.isalpha()) + "64" * kind.endswith("64")
        abbreviation = f"{self.prefix}.{path}"
        while self.types.setdefault(abbreviation, family) != family:
            abbreviation += "_"
        valued = "{" + ", ".join(f"[{value}] = {quoted(text)}" for value, text in labels.items()) + "}" if labels else "nil"
        masked = f"0x{mask:x}" if mask is not None else "nil"
        return Code(f"new({quoted(abbreviation)}, {quoted(name)}, ftypes.{kind}, base.{base}, {valued}, {masked}, {quoted(docs)})")

    def _keep(self, path: str) -> str | None:
        return path if path in self.kept else None

    def _skip(self, info: FieldInfo, size: int) -> int | None:
        return None if info.path in self.kept or info.const is not None else size

    def _seal(self, node: Sealed) -> Table:
        widths = dict(_widths(node))
        return {
            **_algorithm(node.algorithm),
            "fields": [{"path": path, "width": widths[path]} for path in node.fields],
            "first": node.over[0] if node.over else None,
            "last": node.over[1] if node.over else None,
            "big": node.algorithm.order == "big" or None,
            "is_wide": (len(node.fields) == 1 and widths[node.fields[0]] > 32) or None,
            "absent": dict.fromkeys(node.absent, True),
        }


def _widths(node: Sealed) -> Iterator[tuple[str, int]]:
    """The fields of a struct and how many bits each has."""
    for below in nodes(node):
        if isinstance(below, Block):
            yield from ((part.info.path, part.bits.width) for part in below.parts)
        elif isinstance(below, Number | Blob):
            yield below.info.path, below.info.bits


def _algorithm(algorithm: Checksum) -> Table:
    match algorithm:
        case Crc():
            digits = {name: f"{getattr(algorithm, name):x}" for name in ("poly", "init", "xorout")}
            return {"algorithm": "crc", "width": algorithm.width, **digits, "refin": algorithm.refin, "refout": algorithm.refout}
        case Xor():
            return {"algorithm": "xor"}
        case Sum():
            return {"algorithm": "sum", "width": algorithm.width}
        case WordXor():
            halves = [half for size in algorithm.groups for half in range(size)]
            return {"algorithm": "word_xor", "head": algorithm.head, "halves": halves}
        case Fold15():
            return {"algorithm": "fold15"}
        case ZeroPadded():
            if isinstance(algorithm.algorithm, ZeroPadded):
                raise Refused("a checksum padded twice")
            return {**_algorithm(algorithm.algorithm), "pad": algorithm.to}
    raise Refused(f"the checksum {type(algorithm).__name__} is Python code, which Wireshark does not run")


def _function(value: Formula) -> Code:
    return Code(f"function() return {value} end") if isinstance(value, int) else formula(value)


def _leaves(node: Node) -> list[Node | Part]:
    """The numbers in a node; none where it holds arrays or parts that come and go."""
    found: list[Node | Part] = []
    for below in nodes(node):
        if isinstance(below, Repeat | When | Select):
            return []
        found += list(below.parts) if isinstance(below, Block) else [below] if isinstance(below, Number) else []
    return found


def _width(bits: int) -> int:
    return next(width for width in (8, 16, 24, 32, 64) if bits <= width)


def _word_order(block: Block) -> str | None:
    """The byte order by which all parts are runs of bits of one word, which Wireshark can draw; None where there is none."""
    if block.size > 4:
        return None
    for order in ("big", "little"):
        if all(_run(part.bits, block.size, order) is not None for part in block.parts):
            return order
    return None


def _run(bits: BitField, size: int, order: str) -> int | None:
    """The lowest bit of a field in the word that a block is, None where it is no run of bits in order."""
    places = {
        8 * (segment.byte if order == "little" else size - 1 - segment.byte) + segment.low - segment.target for segment in bits.segments
    }
    return places.pop() if len(places) == 1 else None


def _mask(bits: BitField, size: int, order: str) -> int:
    return ((1 << bits.width) - 1) << (_run(bits, size, order) or 0)
