"""Write a Wireshark dissector in Lua for a sensor.

A dissector has two parts. ``wireshark.lua``, in the same folder, is the same for all sensors. It
finds and checks frames, and fills Wireshark's tree. This module writes the part that depends on the
sensor: a Lua table for each node of a frame tree (`_TableWriter`).

A formula becomes a Lua function of the field values. Numbers are floats in Wireshark's Lua, so
integer operations are calls of functions in ``wireshark.lua`` (`int.div`, `int.band`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib import resources
from typing import Any

from lidarspec._version import __version__
from lidarspec.exports import (
    ExportedFrame,
    ExportError,
    describe_left_out,
    find_references,
    find_required_formulas,
    list_frames,
)
from lidarspec.frames.layout_tree import find_fixed_constants
from lidarspec.framing.frame_engine import get_codec
from lidarspec.spec import (
    Checksum,
    Crc,
    Fletcher,
    Fold15,
    Sensor,
    Sum,
    Tcp,
    Udp,
    WordXor,
    Xor,
    ZeroPadded,
    tree,
)
from lidarspec.spec.bits import BitField

MAX_LINE_CHARS = 140


class LuaCode(str):
    """Lua code, which `lua` writes without quotes."""


_OPERATIONS = {
    "<<": "({} * 2 ^ {})",
    ">>": "int.div({}, 2 ^ {})",
    **{
        "//": "int.div({}, {})",
        "%": "int.mod({}, {})",
        "&": "int.band({}, {})",
        "|": "int.bor({}, {})",
        "^": "int.bxor({}, {})",
    },
    **{
        symbol: f"int.truth({{}} {'~=' if symbol == '!=' else symbol} {{}})"
        for symbol in tree.COMPARISONS
    },
    "not": "int.truth({} == 0)",
}


def format_formula(value: tree.Formula) -> LuaCode:
    """Return a formula as Lua code: a number, or a function of the field values."""
    if isinstance(value, int):
        return LuaCode(str(value))
    return _format_function(value)


def _format_function(value: tree.Formula, missing: str = "") -> LuaCode:
    """Return a formula as a Lua function of the field values.

    Args:
        missing: a Lua text that is appended to each value, e.g. `" or 0"` for fields that can be
            missing.
    """
    return LuaCode(
        "function(v) return"
        f" {tree.format_formula(value, lambda ref: f'(v[{quote_lua(ref.path)}]{missing})', _OPERATIONS)} end"
    )


def lua(value: Any, indent: str = "") -> str:
    """Return plain data as a Lua expression, on one line if it fits."""
    if isinstance(value, LuaCode):
        return str(value)
    if isinstance(value, str):
        return quote_lua(value)
    if isinstance(value, bool | int | float):
        return json.dumps(value, allow_nan=False)
    deeper = indent + "  "
    if isinstance(value, Mapping):
        entries = [
            f"{_format_key(key)} = {lua(item, deeper)}"
            for key, item in value.items()
            if item is not None
        ]
    else:
        entries = [lua(item, deeper) for item in value]
    line = "{" + ", ".join(entries) + "}"
    if len(indent) + len(line) <= MAX_LINE_CHARS and "\n" not in line:
        return line
    return "{\n" + "".join(f"{indent}  {entry},\n" for entry in entries) + indent + "}"


def _format_key(key: object) -> str:
    if isinstance(key, str) and key.isidentifier() and key.isascii():
        return key
    return f"[{lua(key)}]"


def quote_lua(text: str | bytes) -> str:
    """Return a Lua string; all bytes that are not printable ASCII are escaped."""
    data = text.encode() if isinstance(text, str) else text
    return (
        '"'
        + "".join(
            chr(byte) if 32 <= byte < 127 and byte not in b'"\\' else f"\\{byte:03d}"
            for byte in data
        )
        + '"'
    )


#: The maximum number of fields of an array element for which Wireshark shows their values in the
#: line of the element.
MAX_SUMMED_FIELDS = 4
Table = dict[str, Any]


class _TableWriter:
    """Writes the tables of one frame type.

    Attributes:
        prefix: the text before the path of a field in Wireshark's filters.
        kept: the paths of the fields that formulas or checksums use.
        marked: the paths of the first and the last member that each checksum covers.
        types: the type family (for example "uint") of each Wireshark field, by its name in filters.
    """

    def __init__(self, message: ExportedFrame, prefix: str) -> None:
        self.message = message
        self.prefix = prefix
        lengths = {
            path for node in tree.nodes(message.root) for path in find_required_formulas(node)
        }
        self.kept = (
            {ref.path for ref in find_references(message.root)} | message.checksums.keys() | lengths
        )
        self.marked = {
            path for checksum in message.checksums.values() for path in checksum.over or ()
        }
        self.types: dict[str, str] = {}

    def make_table(self, node: tree.Node, path: str = "") -> Table:
        """Return the table of a node."""
        match node:
            case tree.Number():
                return self._make_number_table(node)
            case tree.Blob():
                return self._make_blob_table(node)
            case tree.Block():
                return self._make_block_table(node)
            case tree.Struct():
                return self._make_struct_table(node)
            case tree.ChecksummedStruct():
                return {
                    "kind": "checksummed",
                    "name": node.name or None,
                    "body": self.make_table(node.body),
                    "checksum": self._make_checksum_table(node),
                }
            case tree.Repeat():
                return self._make_repeat_table(node, path)
            case tree.PartSequence():
                return self._make_parts_table(node)
            case tree.When():
                then = self.make_table(node.then, path)
                otherwise = self.make_table(node.otherwise, path)
                return {
                    "kind": "when",
                    "name": node.name,
                    "condition": _format_function(node.condition),
                    "yes": then,
                    "no": otherwise,
                }
            case tree.Select():
                cases = {value: self.make_table(case, path) for value, case in node.cases}
                default = self.make_table(node.default, path)
                return {
                    "kind": "select",
                    "name": node.name,
                    "key": _format_function(node.key),
                    "cases": cases,
                    "default": default,
                }
            case tree.Check():
                return {
                    "kind": "check",
                    "name": node.name,
                    "condition": _format_function(node.condition),
                }
            case tree.Never():
                return {"kind": "never"}
            case tree.Empty() | tree.Derived() | tree.Opaque():
                return {"kind": "empty", "skip": 0}

    def _make_number_table(self, node: tree.Number) -> Table:
        width = _find_width(8 * node.size)
        kind = {
            "uint": f"UINT{width}",
            "int": f"INT{width}",
            "float": "DOUBLE" if node.size == 8 else "FLOAT",
        }[node.kind]
        table: Table = {"kind": "number", "name": node.name, "type": node.kind, "size": node.size}
        table |= {
            "le": (node.order == "little" and node.size > 1) or None,
            **self._make_number_entries(node.info, kind),
        }
        return table | {"skip": self._find_skip_bytes(node.info, node.size)}

    def _make_blob_table(self, node: tree.Blob) -> Table:
        if node.ending is not None:
            raise ExportError(
                f"{node.info.path}: the export to Wireshark does not support bytes whose"
                " size depends on their content"
            )
        name = node.name or "constant"
        if node.name:
            path = node.info.path
        else:
            path = ".".join(filter(None, (node.info.path, name)))
        new = self._declare_field("BYTES", path, name, node.info.docs, "NONE")
        table: Table = {
            "kind": "bytes",
            "name": name,
            "field": new,
            "size": format_formula(node.size),
            "keep": self._name_if_kept(path),
        }
        table["const"] = LuaCode(quote_lua(node.const)) if node.const is not None else None
        return table | {
            "skip": (
                self._find_skip_bytes(node.info, node.size)
                if isinstance(node.size, int) and node.const is None
                else None
            )
        }

    def _make_block_table(self, node: tree.Block) -> Table:
        order = _find_word_order(node)
        parts = [self._make_part_table(node, part, order) for part in node.parts]
        looked_at = any(
            part[fact] is not None for fact in ("keep", "const", "allowed") for part in parts
        )
        return {
            "kind": "block",
            "name": node.name,
            "size": node.size,
            "le": order == "little" or None,
            "is_struct": any(part.names for part in node.parts),
            "skip": None if looked_at else node.size,
            "parts": parts,
        }

    def _make_part_table(
        self, block: tree.Block, part: tree.BlockInteger, order: str | None
    ) -> Table:
        offsets = [segment.byte for segment in part.bits.segments]
        is_masked = order is not None and part.bits.width < 8 * block.size
        if order is not None and is_masked:
            bits = 8 * block.size
            mask = ((1 << part.bits.width) - 1) << (
                _find_lowest_bit(part.bits, block.size, order) or 0
            )
        else:
            bits = _find_width(part.bits.width)
            mask = None
        kind = f"INT{bits}" if part.bits.signed else f"UINT{bits}"
        label = ".".join(part.names) + "".join(f"[{index}]" for index in part.indices)
        return {
            "name": part.info.name,
            "label": label if label != part.info.name else None,
            "first": min(offsets),
            "last": max(offsets),
            "width": part.bits.width,
            "signed": part.bits.signed or None,
            "masked": is_masked or None,
            "segments": [
                [bits.byte, bits.low, bits.mask.bit_count(), bits.target]
                for bits in part.bits.segments
            ],
            **self._make_number_entries(part.info, kind, mask),
        }

    def _make_struct_table(self, node: tree.Struct) -> Table:
        members = []
        for member in node.members:
            path = ".".join(filter(None, (node.path, member.name)))
            table = self.make_table(member, path)
            members.append(table | {"mark": path} if path in self.marked and member.name else table)
        sizes = [None if "mark" in member else member.get("skip") for member in members]
        total = None if None in sizes else sum(filter(None, sizes))
        inside = {
            path: value
            for below in tree.nodes(node)
            for path, value in find_required_formulas(below).items()
        }
        lengths = [
            {"path": path, "value": _format_function(value, " or 0")}
            for path, value in inside.items()
            if node.path == _find_common_path(path, *(ref.path for ref in tree.refs(value)))
        ]
        return {
            "kind": "struct",
            "name": node.name or None,
            "skip": total,
            "members": members,
            "lengths": lengths or None,
        }

    def _make_repeat_table(self, node: tree.Repeat, path: str) -> Table:
        element = self.make_table(node.element, path)
        size = element.get("skip")
        if isinstance(node.count, int) and size is not None:
            whole = size * node.count
        else:
            whole = None
        few = isinstance(node.element, tree.Block) or (
            isinstance(node.element, tree.Struct)
            and len(_list_numbers(node.element)) <= MAX_SUMMED_FIELDS
        )
        summed = (few and bool(_list_numbers(node.element))) or None
        return {
            "kind": "repeat",
            "name": node.name,
            "count": format_formula(node.count),
            "summed": summed,
            "skip": whole,
            "element": element,
        }

    def _make_parts_table(self, node: tree.PartSequence) -> Table:
        kinds = []
        for kind in node.kinds:
            if kind.until is not None:
                raise ExportError(
                    f"{node.axis}: the export to Wireshark does not support an array of parts that"
                    " ends at a certain value"
                )
            magic = [
                [offset, mask, value]
                for offset, (mask, value) in sorted(
                    find_fixed_constants(kind.root, self.message.frame.max_length).items()
                )
            ]
            after = node.following(kind)
            kinds.append(
                {
                    "magic": magic,
                    "element": self.make_table(kind.element),
                    "following": None if after is None else format_formula(after),
                }
            )
        rules = {"count": node.count, "size": node.size, "within": node.within}
        formulas = {
            name: None if rule is None else format_formula(rule) for name, rule in rules.items()
        }
        return {
            "kind": "parts",
            "name": node.name,
            "total": self._name_if_kept(node.total.path),
            **formulas,
            "kinds": kinds,
        }

    def _make_number_entries(
        self, info: tree.FieldInfo, kind: str, mask: int | None = None
    ) -> Table:
        """Return the table entries of a number: unit, scale, labels, limits, ProtoFields."""
        is_hex = (
            info.path in self.message.checksums or info.const is not None
        ) and kind.startswith("UINT")
        if is_hex:
            shown = "HEX"
        elif kind in ("FLOAT", "DOUBLE"):
            shown = "NONE"
        else:
            shown = "DEC"
        table: Table = {
            "field": self._declare_field(
                kind, info.path, info.name, info.docs, shown, info.labels, mask
            )
        }
        if info.scaled:
            table["physical"] = self._declare_field(
                "DOUBLE",
                f"{info.path}.physical",
                info.name,
                f"{info.docs} in {info.unit}".strip(),
                "NONE",
            )
        table |= {
            "scale": info.scale if info.scaled else None,
            "offset": info.offset or None,
            "unit": info.unit or None,
        }
        table |= {"labels": dict(info.labels) or None, "const": info.const}
        if info.allowed is None:
            table["allowed"] = None
        else:
            table["allowed"] = [list(run) for run in tree.find_runs(info.allowed)]
        return table | {"keep": self._name_if_kept(info.path)}

    def _declare_field(
        self,
        kind: str,
        path: str,
        name: str,
        docs: str,
        base: str,
        labels: Any = None,
        mask: int | None = None,
    ) -> LuaCode:
        """Return Lua code that declares a Wireshark field, and add the field to `types`."""
        family = "".join(letter for letter in kind if letter.isalpha())
        if kind.endswith("64"):
            family += "64"
        abbreviation = f"{self.prefix}.{path}"
        while self.types.setdefault(abbreviation, family) != family:
            abbreviation += "_"
        if labels:
            valued = (
                "{"
                + ", ".join(f"[{value}] = {quote_lua(text)}" for value, text in labels.items())
                + "}"
            )
        else:
            valued = "nil"
        masked = f"0x{mask:x}" if mask is not None else "nil"
        return LuaCode(
            f"new({quote_lua(abbreviation)}, {quote_lua(name)}, ftypes.{kind}, base.{base}, {valued},"
            f" {masked}, {quote_lua(docs)})"
        )

    def _name_if_kept(self, path: str) -> str | None:
        if path in self.kept:
            return path
        return None

    def _find_skip_bytes(self, info: tree.FieldInfo, size: int) -> int | None:
        if info.path in self.kept or info.const is not None or info.allowed is not None:
            return None
        return size

    def _make_checksum_table(self, node: tree.ChecksummedStruct) -> Table:
        widths = {info.path: info.bits for below in tree.nodes(node) for info in tree.infos(below)}
        return {
            **_make_algorithm_table(node.algorithm),
            "fields": [{"path": path, "width": widths[path]} for path in node.fields],
            "first": node.over[0] if node.over else None,
            "last": node.over[1] if node.over else None,
            "big": node.algorithm.order == "big" or None,
            "is_wide": (len(node.fields) == 1 and widths[node.fields[0]] > 32) or None,
            "absent": dict.fromkeys(node.absent, True),
        }


def _make_algorithm_table(algorithm: Checksum) -> Table:
    match algorithm:
        case Crc():
            digits = {name: f"{getattr(algorithm, name):x}" for name in ("poly", "init", "xorout")}
            return {
                "algorithm": "crc",
                "width": algorithm.width,
                **digits,
                "refin": algorithm.refin,
                "refout": algorithm.refout,
            }
        case Xor():
            return {"algorithm": "xor"}
        case Sum():
            return {"algorithm": "sum", "width": algorithm.width}
        case WordXor():
            halves = [half for size in algorithm.groups for half in range(size)]
            return {"algorithm": "word_xor", "head": algorithm.head, "halves": halves}
        case Fletcher():
            return {"algorithm": "fletcher"}
        case Fold15():
            return {"algorithm": "fold15"}
        case ZeroPadded():
            if isinstance(algorithm.algorithm, ZeroPadded):
                raise ExportError(
                    "the export to Wireshark does not support ZeroPadded inside ZeroPadded"
                )
            return {**_make_algorithm_table(algorithm.algorithm), "pad": algorithm.to}
    raise ExportError(
        f"the checksum {type(algorithm).__name__} is Python code and cannot be exported to"
        " Wireshark"
    )


def _list_numbers(node: tree.Node) -> list[tree.Node | tree.BlockInteger]:
    """Return the numbers in a node, or [] if the node has arrays or conditional parts."""
    below = list(tree.nodes(node))
    if any(isinstance(part, tree.Repeat | tree.When | tree.Select) for part in below):
        return []
    numbers = (part for part in below if isinstance(part, tree.Block | tree.Number))
    return [
        leaf
        for part in numbers
        for leaf in (part.parts if isinstance(part, tree.Block) else (part,))
    ]


def _find_common_path(*paths: str) -> str:
    """Return the path of the innermost struct that contains all of these fields."""
    parents = [path.split(".")[:-1] for path in paths]
    depth = next(
        (
            depth
            for depth in range(min(map(len, parents)))
            if len({names[depth] for names in parents}) > 1
        ),
        min(map(len, parents)),
    )
    return ".".join(parents[0][:depth])


def _find_width(bits: int) -> int:
    return next(width for width in (8, 16, 24, 32, 64) if bits <= width)


def _find_word_order(block: tree.Block) -> str | None:
    """Return the byte order in which a block is one integer; None if there is none."""
    orders = (
        order
        for order in ("big", "little")
        if all(_find_lowest_bit(part.bits, block.size, order) is not None for part in block.parts)
    )
    if block.size <= 4:
        return next(orders, None)
    return None


def _find_lowest_bit(bits: BitField, size: int, order: str) -> int | None:
    """Return the position of a field's lowest bit in its block, read as one integer.

    Returns None if the bits of the field are not contiguous in the integer.
    """
    places = (
        (run, run.byte if order == "little" else size - 1 - run.byte) for run in bits.segments
    )
    starts = {8 * byte + run.low - run.target for run, byte in places}
    if len(starts) == 1:
        return starts.pop()
    return None


#: The numbers that Wireshark (wtap) uses for the link types USER0 to USER15, which are reserved for
#: private use.
USER_LINKS = tuple(range(45, 61))

_HEAD = """\
-- {title}: a dissector for Wireshark and tshark, written by lidarspec {version}.
-- Source: {source}
{left_out}--
--     wireshark -X lua_script:THIS_FILE CAPTURE
--
-- or put it into the personal Lua plugins folder (Help, About Wireshark, Folders).
-- The dissector is used for UDP and TCP on the sensor's ports, for UDP on other ports if the constants match, and for captures of
-- link type USER0 to USER15. "lidarspec record SOURCE -s SENSOR -o FILE.pcap" writes such a capture of a serial line.
-- A field has its raw value. If it has a unit, FIELD.physical has the physical value; both can be used in filters.

local proto = Proto({name}, {title_quoted})
local int = {{}}

local fields = {{}}
local function new(abbreviation, name, type, shown, labels, mask, text)
  local key = table.concat({{abbreviation, type, shown, mask or 0}}, " ")
  fields[key] = fields[key] or ProtoField.new(name, abbreviation, type, labels, shown, mask, text)
  return fields[key]
end

local kind = new({name} .. ".frame", "frame type", ftypes.STRING, base.NONE)
local verdicts = {{[0] = "Bad", [1] = "Good", [2] = "Not filled"}}
local status = new({name} .. ".checksum.status", "checksum status", ftypes.UINT8, base.NONE, verdicts)
local marks = {{
  checksum = ProtoExpert.new({name} .. ".checksum.bad", "checksum wrong", expert.group.CHECKSUM, expert.severity.ERROR),
  constant = ProtoExpert.new({name} .. ".constant.bad", "not the expected constant", expert.group.MALFORMED, expert.severity.ERROR),
  length = ProtoExpert.new({name} .. ".length.bad", "not equal to the length of the part", expert.group.MALFORMED, expert.severity.ERROR),
  short = ProtoExpert.new({name} .. ".cut_off", "the frame ends before its last field", expert.group.MALFORMED, expert.severity.ERROR),
  skipped = ProtoExpert.new({name} .. ".skipped", "bytes outside frames", expert.group.UNDECODED, expert.severity.WARN),
  unsure = ProtoExpert.new({name} .. ".frame.unsure", "the frame may be of another type", expert.group.ASSUMPTION, expert.severity.NOTE),
}}
"""


def dissector(sensor: Sensor) -> str:
    """Return a Lua dissector for Wireshark.

    Raises:
        ExportError: if Python code decides the contents of a frame.
    """
    name = sensor.id.replace("-", "_")
    title = f"{sensor.vendor} {sensor.model}"
    link = sensor.links.get("data")
    if isinstance(link, Udp) and link.assembled is not None:
        raise ExportError(
            f"{sensor.id}: the export to Wireshark does not support messages that consist of"
            " several datagrams"
        )
    # The dissector shows the first type that matches. Incoming types come first, so bytes that
    # match both directions are shown as incoming. Types with more constants come before others,
    # because they match less often by chance.
    by_direction = sorted(
        list_frames(sensor),
        key=lambda message: (message.frame.direction, -len(get_codec(message.frame).prefix)),
    )
    about = {
        "title": title,
        "has_udp": any(isinstance(link, Udp) for link in sensor.links.values()),
        "is_stream": any(isinstance(link, Udp) and link.stream for link in sensor.links.values()),
        "announcing": {frame.after: True for frame in sensor.frames.values() if frame.after},
        "places": _list_ports(sensor),
        "frames": [_make_frame_entry(message, name) for message in by_direction],
    }
    left_out = describe_left_out(sensor)
    head = _HEAD.format(
        title=title,
        version=__version__,
        source=sensor.source,
        left_out=f"-- {left_out}\n" if left_out else "",
        name=quote_lua(name),
        title_quoted=quote_lua(title),
    )
    walker = (
        resources.files("lidarspec.exports").joinpath("wireshark.lua").read_text(encoding="utf-8")
    )
    return "\n".join([head, f"local sensor = {lua(about)}\n", walker])


def _make_frame_entry(message: ExportedFrame, name: str) -> dict[str, Any]:
    prefix = get_codec(message.frame).prefix
    return {
        "name": message.name,
        "longest": message.frame.max_length,
        "after": message.frame.after,
        "judged": True if message.frame.plausible else None,
        "sent": None if message.frame.direction == "in" else True,
        "magic": [[offset, mask, value] for offset, (mask, value) in sorted(prefix.items())],
        "root": _TableWriter(message, f"{name}.{message.name}").make_table(message.root),
    }


def _list_ports(sensor: Sensor) -> dict[str, list[int]]:
    """Return the ports or link types of a sensor, by the name of Wireshark's table."""
    links = sensor.links.values()
    patterns = {
        "udp.port": [port for link in links if isinstance(link, Udp) for port in link.ports],
        "tcp.port": [link.port for link in links if isinstance(link, Tcp) and link.port],
        "wtap_encap": list(USER_LINKS),
    }
    return {table: sorted(set(numbers)) for table, numbers in patterns.items() if numbers}
