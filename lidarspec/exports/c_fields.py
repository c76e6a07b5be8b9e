"""The offsets of fields as C expressions, and C functions that read the fields.

`CLayout` makes a `CEntry` for each node of a frame tree, with the offset of the node as a C
expression. `iter_functions` makes the C functions from the entries: accessors of fields, counts of
arrays, tests for optional fields, and conversions to the field's unit and the SI unit.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from lidarspec.exports import ExportedFrame, ExportError, find_references
from lidarspec.frames.wire_table import SizeFormula, describe_field, format_unit
from lidarspec.spec import tree

#: The C code of each operation. Comparisons contain a function call, because compilers warn of a
#: comparison with a value that a narrow type cannot have.
_OPERATIONS = {
    **{
        "//": "lidarspec_floor_div({}, {})",
        "%": "lidarspec_floor_mod({}, {})",
        "not": "(int64_t)!{}",
    },
    **{symbol: f"(lidarspec_int({{}}) {symbol} {{}})" for symbol in tree.COMPARISONS},
}
_INDICES = "ijklmnoq"


def name_index(depth: int) -> str:
    """Return the name of the index of the array at this depth."""
    return _INDICES[depth]


def format_parameters(depth: int) -> str:
    """Return the parameters of a C function for an entry inside `depth` arrays."""
    return ", ".join(
        ["const uint8_t *p", *(f"size_t {name_index(level)}" for level in range(depth))]
    )


def format_arguments(depth: int) -> str:
    """Return the arguments that match `format_parameters(depth)`."""
    return ", ".join(["p", *map(name_index, range(depth))])


def make_identifier(text: str) -> str:
    """Return a text as a part of a C name."""
    return re.sub(r"\W", "_", text.replace("[]", "_inner"), flags=re.ASCII)


def choose_number_type(fields: Sequence[tree.FieldInfo]) -> str:
    """Return a C type that can represent the values of all these fields."""
    if any(info.kind == "float" for info in fields):
        if max(info.bits for info in fields) > 32 or any(info.kind != "float" for info in fields):
            return "double"
        return "float"
    signed = any(info.dtype is not None and info.dtype.kind == "i" for info in fields)
    mixed = signed and any(info.dtype is not None and info.dtype.kind == "u" for info in fields)
    width = next(
        size
        for size in (8, 16, 32, 64)
        if max(info.bits for info in fields) + mixed <= size or size == 64
    )
    return f"{'int' if signed else 'uint'}{width}_t"


def format_comment(*texts: str) -> str:
    """Return a comment of one line; "" if the texts are empty."""
    text = (
        "; ".join(" ".join(part.split()) for part in texts if part)
        .replace("*/", "* /")
        .replace("/*", "/ *")
    )
    if text:
        return f"/* {text} */"
    return ""


def quote_text(text: str) -> str:
    """Return a text as a C string, in UTF-8."""
    data = text.encode()
    plain = all(32 <= byte < 127 and byte not in b'"\\?' for byte in data)
    if plain:
        return f'"{text}"'
    return quote_bytes(data)


def quote_bytes(data: bytes) -> str:
    """Return bytes as a C string of octal escapes."""
    return '"' + "".join(f"\\{byte:03o}" for byte in data) + '"'


class CCondition(NamedTuple):
    """A condition as a C expression.

    Attributes:
        is_fixed: whether the value is the same for all elements of the arrays around the
            expression.
    """

    text: str
    is_fixed: bool


@dataclass(frozen=True, eq=False)
class CEntry:
    """A node of a frame tree, at one position in the frame.

    Attributes:
        path: the path of the node, without indices; for an array, `Repeat.axis`.
        start: the offset of the first byte of the node in the frame.
        size: the size of the node in bytes.
        depth: the number of arrays around the node.
        loops: the C expression of the count of each array around the node, outermost first.
        part: the part of a bit block that is read; None for any other node.
    """

    path: str
    node: tree.Node
    start: SizeFormula
    size: SizeFormula
    depth: int = 0
    conditions: tuple[CCondition, ...] = ()
    loops: tuple[str, ...] = ()
    part: tree.BlockInteger | None = None

    @property
    def full_condition(self) -> str:
        """All conditions, joined to one C expression; "" if there is no condition."""
        return " && ".join(condition.text for condition in self.conditions)

    @property
    def fields(self) -> list[CEntry]:
        """One entry for each part of a bit block; for any other node, only this entry."""
        if isinstance(self.node, tree.Block):
            return [replace(self, part=part) for part in self.node.parts]
        return [self]

    @property
    def info(self) -> tree.FieldInfo:
        """The facts about the field, such as its path, scale and unit."""
        if self.part is not None:
            return self.part.info
        return tree.infos(self.node)[0]

    @property
    def indices(self) -> tuple[int, ...]:
        """The indices of this part in the arrays inside its bit block; () for other nodes."""
        if self.part is not None:
            return self.part.indices
        return ()

    @property
    def expression(self) -> str:
        """The C expression of the field's raw value."""
        node = self.node
        if self.part is not None:
            return _format_bits(self.part, self.start)
        assert isinstance(node, tree.Number)
        if node.size == 1:
            raw = f"p[{self.start}]"
        else:
            raw = format_word(self.start, node.size, node.order)
        if node.kind == "float":
            return f"{FLOAT_FUNCTIONS[node.size]}({raw})"
        if node.kind == "int":
            return f"lidarspec_signed({raw}, {8 * node.size})"
        return raw

    @property
    def span(self) -> tuple[int, SizeFormula]:
        """The offset of the field in the entry, and the offset after its last byte."""
        if self.part is None:
            return 0, self.size
        offsets = [segment.byte for segment in self.part.bits.segments]
        return min(offsets), SizeFormula(max(offsets) + 1)

    @property
    def condition(self) -> str:
        """The C condition under which a C function returns the value of this entry.

        This is `full_condition`. For a part in an array inside a bit block, the array indices must
        also be those of the part. The condition is "" if the function always returns this value.
        """
        inside = [
            f"{name_index(self.depth + level)} == {number}"
            for level, number in enumerate(self.indices)
        ]
        return " && ".join(filter(None, (self.full_condition, *inside)))


def format_size_arguments(node: tree.Node, depth: int) -> str:
    """Return the arguments for calling a size function inside `depth` arrays."""
    is_own = any(ref.info.axes for ref in find_references(node))
    if is_own:
        return format_arguments(depth)
    return ", ".join(["p", *["0"] * depth])


class CLayout:
    """The entries of a frame type, in wire order.

    Attributes:
        name: a function (path, ending) that returns a C name.
        size: size of a frame, in bytes.

    Raises:
        ExportError: if an offset depends on the sizes of the array elements before it.
    """

    def __init__(self, message: ExportedFrame, name: Callable[[str, str], str]) -> None:
        self.message = message
        self.name = name
        self.entries: list[CEntry] = []
        top = CEntry("", message.root, SizeFormula(), SizeFormula())
        self.size = self.compute_size(top)
        self._visit(top)

    def find_entries(self, path: str) -> list[CEntry]:
        """Return the entries of the numbers, bytes or bits at a path."""
        return [
            entry
            for entry in self.entries
            if any(info.path == path for info in tree.infos(entry.node))
        ]

    def find_whole(self, path: str) -> CEntry:
        """Return the entry of a node with all its elements and alternatives."""
        return next(entry for entry in self.entries if entry.path == path)

    def format_formula(self, value: tree.Formula) -> str:
        """Return a formula as a C expression of type int64_t.

        Raises:
            ExportError: if its value may exceed 64-bit integers.
        """
        if tree.width(value) > tree.MAX_FORMULA_BITS:
            raise ExportError("the value of a formula may exceed 64 bits")

        def format_field(ref: tree.Ref) -> str:
            arguments = format_arguments(len(ref.info.axes))
            return f"(int64_t){self.name(ref.path, '')}({arguments})"

        return tree.format_formula(value, format_field, _OPERATIONS)

    def format_length(self, value: tree.Formula) -> str:
        """Return a number of elements or bytes as a C expression."""
        if isinstance(value, int):
            return str(value)
        return f"(size_t)({self.format_formula(value)})"

    def count(self, node: tree.Repeat, depth: int) -> int | str:
        """Return the length of an array; a C expression if the length varies.

        Args:
            depth: the number of arrays around the array.
        """
        if isinstance(node.count, int):
            return node.count
        return f"(int64_t){self.name(node.axis, 'count')}({format_size_arguments(node, depth)})"

    def compute_size(self, entry: CEntry) -> SizeFormula:
        """Return the size of an entry."""
        match entry.node:
            case tree.Number() | tree.Block():
                return SizeFormula(entry.node.size)
            case tree.Blob(size=int() as size):
                return SizeFormula(size)
            case tree.Blob() if entry.node.ending is not None:
                raise ExportError(
                    f"{entry.path}: the export to C does not support bytes whose size depends on"
                    " their content"
                )
            case tree.Blob():
                return SizeFormula(
                    0,
                    (
                        (
                            f"(int64_t){self.name(entry.path, 'size')}"
                            f"({format_size_arguments(entry.node, entry.depth)})"
                        ),
                    ),
                )
            case tree.Repeat():
                return self._find_element_size(entry, entry.node).times(
                    self.count(entry.node, entry.depth)
                )
            case tree.When() | tree.Select():
                sizes = self.list_sizes(entry)
                if len({str(size) for _, size in sizes}) == 1:
                    return sizes[0][1]
                arguments = format_size_arguments(entry.node, entry.depth)
                return SizeFormula(
                    0, (f"(int64_t){self.make_size_function_name(entry)}({arguments})",)
                )
            case tree.PartSequence():
                raise ExportError(
                    f"{entry.path}: the export to C does not support parts with an offset"
                    " that depends on the sizes of earlier parts"
                )
            case tree.Empty() | tree.Derived():
                return SizeFormula()
        return sum((self.compute_size(below) for below in self._iter_members(entry)), SizeFormula())

    def make_size_function_name(self, entry: CEntry) -> str:
        """Return the name of the C function for the size of a `When` or `Select` node."""
        choices = [
            node
            for node in tree.nodes(self.message.root)
            if isinstance(node, tree.When | tree.Select)
        ]
        alike = [id(node) for node in choices if node.name == entry.node.name]
        return self.name(entry.path, f"extent{alike.index(id(entry.node)) or ''}")

    def list_sizes(self, entry: CEntry) -> list[tuple[str, SizeFormula]]:
        """Return the sizes of the alternatives of a node, each with its condition."""
        return [
            (condition.text, self.compute_size(below))
            for condition, below in self._list_cases(entry)
        ]

    def _visit(self, entry: CEntry) -> None:
        """Add an entry and all entries inside it to the layout."""
        node = entry.node
        if not isinstance(node, tree.Empty | tree.Derived):
            if isinstance(node, tree.Repeat):
                path = node.axis
            else:
                path = entry.path
            self.entries.append(replace(entry, path=path, size=self.compute_size(entry)))
        if isinstance(node, tree.Repeat):
            step = self._find_element_size(entry, node).times(f"(int64_t){name_index(entry.depth)}")
            loops = (*entry.loops, str(self.count(node, entry.depth)))
            self._visit(
                replace(
                    entry,
                    node=node.element,
                    start=entry.start + step,
                    depth=entry.depth + 1,
                    loops=loops,
                )
            )
        elif isinstance(node, tree.When | tree.Select):
            for condition, below in self._list_cases(entry):
                self._visit(replace(below, conditions=(*entry.conditions, condition)))
        else:
            start = entry.start
            for below in self._iter_members(entry):
                self._visit(replace(below, start=start))
                start = start + self.compute_size(below)

    def _iter_members(self, entry: CEntry) -> Iterator[CEntry]:
        """Yield an entry for each member of a struct."""
        # the entries have the start of the struct instead of the start of the member
        node = entry.node
        if isinstance(node, tree.ChecksummedStruct):
            yield replace(entry, node=node.body)
        elif isinstance(node, tree.Struct):
            for member in node.members:
                yield replace(
                    entry, node=member, path=".".join(filter(None, (node.path, member.name)))
                )

    def _find_element_size(self, entry: CEntry, node: tree.Repeat) -> SizeFormula:
        size = self.compute_size(replace(entry, node=node.element, depth=entry.depth + 1))
        if size.terms and any(node.axis in ref.info.axes for ref in find_references(node.element)):
            raise ExportError(
                f"{node.axis}: the export to C does not support elements with an offset that"
                " depends on the sizes of earlier elements"
            )
        return size

    def _list_cases(self, entry: CEntry) -> list[tuple[CCondition, CEntry]]:
        """Return the alternatives of a node, each with its condition."""
        node = entry.node
        is_fixed = not any(
            ref.info.axes for value in tree.formulas(node) for ref in tree.refs(value)
        )
        if isinstance(node, tree.When):
            holds = self.format_formula(node.condition)
            if isinstance(node.condition, tree.Op) and node.condition.symbol in tree.COMPARISONS:
                holds = holds[1:-1]
            else:
                holds = f"{holds} != 0"
            cases = [(holds, node.then), (f"!({holds})", node.otherwise)]
        else:
            assert isinstance(node, tree.Select)
            key = self.format_formula(node.key)
            others = " && ".join(f"{key} != {value}" for value, _ in node.cases) or "1"
            cases = [
                *((f"{key} == {value}", case) for value, case in node.cases),
                (others, node.default),
            ]
        return [(CCondition(text, is_fixed), replace(entry, node=case)) for text, case in cases]


#: For each unit: its SI unit as part of a C name, and the factor and offset of the conversion.
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
#: The C function that converts the bits of a float, by the size of the float in bytes.
FLOAT_FUNCTIONS = {2: "lidarspec_half", 4: "lidarspec_float", 8: "lidarspec_double"}


def format_word(start: SizeFormula, size: int, order: str) -> str:
    """Return the C expression of an unsigned integer of several bytes."""
    return f"lidarspec_{'le' if order == 'little' else 'be'}(p + {start}, {size})"


def _format_bits(part: tree.BlockInteger, start: SizeFormula) -> str:
    wide = "uint64_t" if part.bits.width > 32 else "uint32_t"
    terms = []
    for segment in part.bits.segments:
        byte = f"p[{start + SizeFormula(segment.byte)}]"
        term = f"({wide})" + (f"({byte} & 0x{segment.mask:02x}u)" if segment.mask != 0xFF else byte)
        shift = segment.target - segment.low
        terms.append(f"{term} {'<<' if shift > 0 else '>>'} {abs(shift)}" if shift else term)
    if len(terms) > 1:
        value = " | ".join(f"({term})" for term in terms)
    else:
        value = terms[0]
    if part.bits.signed:
        return f"lidarspec_signed({value}, {part.bits.width})"
    return value


def find_accesses(layout: CLayout, path: str) -> list[CEntry]:
    """Return one entry for each alternative that contains a field."""
    return [
        access
        for entry in layout.find_entries(path)
        for access in entry.fields
        if access.info.path == path
    ]


def iter_functions(layout: CLayout) -> Iterator[str]:
    """Yield the C functions of all fields, in wire order."""
    functions = [
        function for entry in layout.entries for function in dict.fromkeys(_iter_writers(entry))
    ]
    extents = list(_iter_size_functions(layout))
    yield from (text.partition("\n")[0].partition(" {")[0] + ";" for text in extents)
    for write, path in reversed(dict.fromkeys(reversed(functions))):
        yield from write(layout, path)
    yield from extents


#: A function that yields one or more C functions for the field or array at a path.
Writer = Callable[[CLayout, str], Iterator[str]]


def _iter_writers(entry: CEntry) -> Iterator[tuple[Writer, str]]:
    """Yield (writer, path) for each C function of an entry."""
    if isinstance(entry.node, tree.Block):
        for part in entry.node.parts:
            yield from ((_write_inner_count, axis) for axis in _find_inner_axes(part))
            yield _write_field, part.info.path
    elif isinstance(entry.node, tree.Number) or (
        isinstance(entry.node, tree.Blob) and entry.node.name
    ):
        yield _write_field, entry.path
    elif isinstance(entry.node, tree.Repeat):
        yield _write_count, entry.path


def _iter_size_functions(layout: CLayout) -> Iterator[str]:
    """Yield a C function for the size of each node whose alternatives differ in size."""
    for entry in layout.entries:
        if isinstance(entry.node, tree.When | tree.Select):
            sizes = layout.list_sizes(entry)
            if len({str(size) for _, size in sizes}) > 1:
                ways = [
                    *((condition, f"(size_t)({size})") for condition, size in sizes[:-1]),
                    ("", f"(size_t)({sizes[-1][1]})"),
                ]
                yield _format_function(
                    "size_t", layout.make_size_function_name(entry), entry.depth, ways
                )


def _find_inner_axes(part: tree.BlockInteger) -> tuple[str, ...]:
    """Return the paths of the arrays around a part, inside its bit block."""
    return part.info.axes[len(part.info.axes) - len(part.indices) :]


def _write_inner_count(layout: CLayout, axis: str) -> Iterator[str]:
    """Yield the C function that returns the length of an array inside a bit block."""
    inside = [
        (access, access.part)
        for entry in layout.entries
        for access in entry.fields
        if access.part and axis in _find_inner_axes(access.part)
    ]
    entry, part = inside[0]
    level = _find_inner_axes(part).index(axis)
    count = max(part.indices[level] for _, part in inside) + 1
    yield _format_function(
        "size_t", layout.name(axis, "count"), entry.depth + level, [("", str(count))]
    )


def _write_count(layout: CLayout, axis: str) -> Iterator[str]:
    arrays = [
        (entry, entry.node.count)
        for entry in layout.entries
        if entry.path == axis and isinstance(entry.node, tree.Repeat)
    ]
    ways = [(entry.full_condition, layout.format_length(count)) for entry, count in arrays]
    yield _format_function("size_t", layout.name(axis, "count"), arrays[0][0].depth, ways)


def _write_field(layout: CLayout, path: str) -> Iterator[str]:
    """Yield the C functions of a field: for value, presence and unit conversions."""
    ways = find_accesses(layout, path)
    name = layout.name(path, "")
    first = ways[0]
    depth = first.depth + len(first.indices)
    yield from (
        f"#define {name.upper()}_{make_identifier(label).upper()} {value}"
        for value, label in first.info.labels.items()
    )
    yield format_comment(format_unit(first.info), describe_field(first.info))
    if isinstance(first.node, tree.Blob):
        kind = ""
        sizes = [
            (access.full_condition, layout.format_length(access.node.size))
            for access in ways
            if isinstance(access.node, tree.Blob)
        ]
        yield _format_function("size_t", layout.name(path, "size"), depth, sizes)
        yield _format_function(
            "const uint8_t *",
            name,
            depth,
            [(access.full_condition, f"p + ({access.start})") for access in ways],
        )
    else:
        kind = choose_number_type([access.info for access in ways])
        yield _format_function(
            kind,
            name,
            depth,
            [(access.condition, f"({kind}){_parenthesize(access.expression)}") for access in ways],
        )
    if any(access.conditions for access in ways):
        places = dict.fromkeys(access.full_condition or "1" for access in ways)
        yield _format_function(
            "int",
            layout.name(path, "present"),
            depth,
            [("", " || ".join(f"({where})" for where in places))],
        )
    if kind and (first.info.scaled or first.info.unit):
        yield from _iter_conversions(first.info, name, kind)
    if first.info.labels:
        yield _write_names(first.info.labels, layout.name(path, "name"))


def _write_names(labels: Mapping[int, str], name: str) -> str:
    """Return the C function that returns the name of a number, or NULL."""
    cases = [f"    case {code}: return {quote_text(label)};" for code, label in labels.items()]
    head = f"static inline const char *{name}(long long code)"
    return "\n".join([head, "{", "    switch (code) {", *cases, "    }", "    return NULL;", "}"])


def _format_function(kind: str, name: str, depth: int, ways: list[tuple[str, str]]) -> str:
    """Return a C function that returns the first value whose condition is true.

    The C function returns 0 if no condition is true.

    Args:
        depth: the number of arrays around the field.
        ways: the condition and the value of each alternative; the condition "" is always true.
    """
    used = " ".join(condition + " " + value for condition, value in ways)
    lines = [
        f"    (void){argument};"
        for argument in format_arguments(depth).split(", ")
        if not re.search(rf"\b{argument}\b", used)
    ]
    lines += [
        f"    if ({condition}) return {value};" if condition else f"    return {value};"
        for condition, value in ways
    ]
    lines += ["    return 0;"] * bool(ways[-1][0])
    space = "" if kind.endswith("*") else " "
    head = f"static inline {kind}{space}{name}({format_parameters(depth)})"
    if len(lines) == 1:
        return f"{head} {{ {lines[0].strip()} }}"
    return "\n".join([head, "{", *lines, "}"])


def _parenthesize(expression: str) -> str:
    if " " in expression and not expression.startswith(("lidarspec_", "p[")):
        return f"({expression})"
    return expression


def _iter_conversions(info: tree.FieldInfo, name: str, kind: str) -> Iterator[str]:
    """Yield C functions that convert a raw number to the field's unit and to SI."""
    yield _format_conversion(f"{name}_to_{_unit_name(info.unit)}", kind, info.scale, info.offset)
    if info.unit in SI:
        unit, factor, offset = SI[info.unit]
        yield _format_conversion(
            f"{name}_to_{unit}", kind, info.scale * factor, info.offset * factor + offset
        )


def _format_conversion(name: str, kind: str, scale: float, offset: float) -> str:
    text = f"(double)raw * {float(scale)!r}" + (
        f" {'-' if offset < 0 else '+'} {abs(float(offset))!r}" if offset else ""
    )
    return f"static inline double {name}({kind} raw) {{ return {text}; }}"


def _unit_name(unit: str) -> str:
    return (
        make_identifier(
            unit.replace("/", "_per_").replace("%", "percent").replace("^", "").replace("**", "")
        )
        or "value"
    )
