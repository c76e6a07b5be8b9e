"""Make the wire table of a frame type: offset, size and meaning of each field.

The table is made without the bytes of a frame. An offset or size that depends on header fields is
therefore a formula ("10 + 3*i").
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from lidarspec.spec import tree
from lidarspec.spec.bits import BitField
from lidarspec.spec.description import Frame
from lidarspec.spec.enum_values import format_code

INDICES = "ijklmn"


@dataclass(frozen=True)
class WireRow:
    """A row of a wire table.

    Attributes:
        offset: the offset of the first byte in the frame, as a number or a formula of header fields
            and indices.
        size: the size in bytes, as a number or a formula of header fields; "7 bits" for a number
            in a bit block.
        type: the type, such as "uint16 le" or "bytes"; for a number in a bit block its bits, the
            most significant first.
        field: the path, with names of indices for array elements, such as "points[i].distance".
        unit: the scale and unit, such as "0.01 deg".
        meaning: the documentation, constant, labels, checksum and condition of the field.
    """

    offset: str
    size: str
    type: str
    field: str
    unit: str = ""
    meaning: str = ""


@dataclass(frozen=True)
class SizeFormula:
    """A number of bytes, as the sum of a constant and of formulas."""

    number: int = 0
    terms: tuple[str, ...] = ()

    def __add__(self, other: SizeFormula) -> SizeFormula:
        return SizeFormula(self.number + other.number, self.terms + other.terms)

    def times(self, factor: int | str) -> SizeFormula:
        """Return the product of this size and `factor`."""
        if isinstance(factor, int):
            return SizeFormula(
                self.number * factor, tuple(f"{factor}*({term})" for term in self.terms)
            )
        if str(self) == "0":
            return self
        if self.terms:
            size = f"({self})"
        else:
            size = str(self)
        return SizeFormula(
            0,
            (
                (
                    factor
                    if size == "1"
                    else f"{size}*({factor})"
                    if " " in factor
                    else f"{size}*{factor}"
                ),
            ),
        )

    def __str__(self) -> str:
        return " + ".join(
            [str(self.number)] * (self.number > 0 or not self.terms) + list(self.terms)
        )


def wire_table(frame: Frame) -> tuple[WireRow, ...]:
    """Return the rows of a frame type in wire order."""
    checksums = {
        path: _describe_checksum(node)
        for node in tree.nodes(frame.tree)
        if isinstance(node, tree.ChecksummedStruct)
        for path in node.fields
    }
    return tuple(_iter_rows(frame.tree, "", SizeFormula(), "", checksums))


def frame_size(frame: Frame) -> str:
    """Return the size of a frame in bytes: a number or a formula of header fields."""
    return str(extent(frame.tree))


def extent(node: tree.Node, shown: str = "") -> SizeFormula:
    """Return the size of a node of the tree in bytes, as a formula.

    Args:
        shown: the path of the node. If the size is known only after the node was read, the result
            contains this path: "size(points[i].text)".
    """
    match node:
        case tree.Number() | tree.Block():
            return SizeFormula(node.size)
        case tree.Blob() if node.ending is not None:
            return _format_length(None, shown)
        case tree.Blob() | tree.Opaque():
            return _format_length(node.size, shown)
        case tree.Struct():
            return sum(
                (extent(member, _make_member_path(shown, member)) for member in node.members),
                SizeFormula(),
            )
        case tree.ChecksummedStruct():
            return extent(node.body, shown)
        case tree.Repeat():
            return extent(node.element, _make_element_path(shown)[0]).times(_format_count(node))
        case tree.PartSequence():
            return _format_length(node.within, shown)
        case tree.When() | tree.Select():
            sizes = {
                extent(branch, shown)
                for branch in tree.children(node)
                if not isinstance(branch, tree.Never)
            }
            if len(sizes) == 1:
                return sizes.pop()
            return _format_length(None, shown)
    return SizeFormula()


def _format_length(size: tree.Formula | None, shown: str) -> SizeFormula:
    """Return a size as `SizeFormula`; an unknown size becomes "size(PATH)"."""
    if isinstance(size, int):
        return SizeFormula(size)
    return SizeFormula(0, (f"size({shown})" if size is None else format_formula(size),))


def _format_count(node: tree.Repeat) -> int | str:
    if isinstance(node.count, int):
        return node.count
    return format_formula(node.count)


def _make_member_path(shown: str, member: tree.Node) -> str:
    """Return the path of a member of a struct."""
    return ".".join(filter(None, (shown, member.name or tree.UNNAMED)))


def _make_element_path(shown: str) -> tuple[str, str]:
    """Return the path of an array element, such as "points[i]", and the name of its index."""
    index = INDICES[shown.count("[") % len(INDICES)]
    return f"{shown}[{index}]", index


def _iter_rows(
    node: tree.Node, shown: str, start: SizeFormula, condition: str, checksums: Mapping[str, str]
) -> Iterator[WireRow]:
    """Yield the rows of a node that begins at `start` and exists under a condition."""
    match node:
        case tree.Struct():
            for member in node.members:
                below = _make_member_path(shown, member)
                yield from _iter_rows(member, below, start, condition, checksums)
                start = start + extent(member, below)
        case tree.ChecksummedStruct():
            yield from _iter_rows(node.body, shown, start, condition, checksums)
        case tree.Repeat():
            element, index = _make_element_path(shown)
            size = extent(node.element, element)
            says = "; ".join(filter(None, (condition, f"{_format_count(node)} elements of {size}")))
            yield WireRow(
                str(start), str(size.times(_format_count(node))), "array", shown, "", says
            )
            yield from _iter_rows(
                node.element, element, start + size.times(index), condition, checksums
            )
        case tree.PartSequence():
            element, _ = _make_element_path(shown)
            yield WireRow(
                str(start),
                str(extent(node, shown)),
                "parts",
                shown,
                "",
                "; ".join(filter(None, (condition, describe_end(node)))),
            )
            for kind in node.kinds:
                said = f"in parts of kind {kind.name}" if kind.name else ""
                yield from _iter_rows(
                    kind.element, element, SizeFormula(0, (f"at({element})",)), said, checksums
                )
        case tree.When() | tree.Select():
            for condition_text, branch in list_branches(node):
                yield from _iter_rows(branch, shown, start, condition_text, checksums)
        case tree.Check():
            yield WireRow(
                str(start),
                "0",
                "check",
                shown,
                "",
                "; ".join(filter(None, (condition, f"required: {format_formula(node.condition)}"))),
            )
        case tree.Never():
            yield WireRow(str(start), "0", "invalid frame", shown, "", condition)
        case tree.Block():
            for part in node.parts:
                yield _make_row(
                    part.info,
                    str(start),
                    *_describe_bits(part),
                    _make_part_path(shown, part),
                    condition,
                    checksums,
                )
        case tree.Number() | tree.Blob() | tree.Opaque():
            if isinstance(node, tree.Opaque) and node.size is None:
                length = "varies"
            else:
                length = str(extent(node, shown))
            if isinstance(node, tree.Blob):
                info = replace(node.info, const=node.const)
            else:
                info = node.info
            yield _make_row(
                info, str(start), length, _describe_type(node), shown, condition, checksums
            )


def _make_row(
    info: tree.FieldInfo,
    offset: str,
    size: str,
    kind: str,
    shown: str,
    condition: str,
    checksums: Mapping[str, str],
) -> WireRow:
    says = "; ".join(filter(None, (condition, describe_field(info), checksums.get(info.path, ""))))
    return WireRow(offset, size, kind, shown, format_unit(info), says)


def _make_part_path(shown: str, part: tree.BlockInteger) -> str:
    return ".".join(filter(None, (shown, *part.names))) + "".join(
        f"[{index}]" for index in part.indices
    )


def _describe_bits(part: tree.BlockInteger) -> tuple[str, str]:
    """Return the size and the type of a number in a bit block, as texts."""
    if part.info.dtype is None and part.bits.run is not None and part.bits.is_whole:
        order, _, size, _ = part.bits.run
        return (
            str(size),
            f"{'int' if part.bits.signed else 'uint'}{8 * size} {'be' if order == '>' else 'le'}",
        )
    return f"{part.bits.width} bit{'s' * (part.bits.width > 1)}", format_bits(part.bits)


def _describe_type(node: tree.Number | tree.Blob | tree.Opaque) -> str:
    match node:
        case tree.Number():
            return f"{node.kind}{8 * node.size}" + f" {node.order[0]}e" * (node.size > 1)
        case tree.Opaque():
            return node.form or node.kind
    form = "bytes" if node.info.adapter is None else node.info.adapter.form
    if node.ending is not None and not node.ending.mark:
        return f"{form} to the end of the datagram"
    if node.ending is not None and node.ending.terminator:
        return f"{form} up to {str(node.ending.terminator)[1:]}"
    return form


def list_branches(node: tree.When | tree.Select) -> list[tuple[str, tree.Node]]:
    """Return the alternatives of a node, each with its condition as text."""
    if isinstance(node, tree.When):
        condition_text = format_formula(node.condition)
        return [(f"if {condition_text}", node.then), (f"if not {condition_text}", node.otherwise)]
    key = format_formula(node.key)
    if isinstance(node.key, tree.Ref):
        labels = node.key.info.labels
    else:
        labels = {}
    cases = [(f"if {key} == {labels.get(value, value)!r}", case) for value, case in node.cases]
    return [*cases, (f"for all other values of {key}", node.default)]


def describe_end(node: tree.PartSequence) -> str:
    """Describe what determines the end of a sequence of parts."""
    if node.count is not None:
        return f"{format_formula(node.count)} parts of variable size"
    if node.within is not None:
        return f"parts that fill {format_formula(node.within)} bytes"
    until = node.kinds[0].until
    if until is not None:
        return f"parts up to the first part with {format_formula(until)}"
    assert node.size is not None
    following = ", ".join(
        dict.fromkeys(
            format_formula(kind.following) for kind in node.kinds if kind.following is not None
        )
    )
    return (
        f"the first part has {format_formula(node.size)} bytes; {following} in each part is the"
        " size of the next part, or 0 in the last part"
    )


def format_formula(formula: tree.Formula) -> str:
    """Return a formula as text, with the full paths of its fields.

    Returns "?" for a function that cannot be converted to a formula.
    """
    match formula:
        case tree.Op("==" | "!=" as symbol, (tree.Ref() as ref, int() as value)) if (
            value in ref.info.labels
        ):
            return f"{ref.path} {symbol} {ref.info.labels[value]!r}"
    if isinstance(formula, tree.Untraced):
        text = formula.text
    else:
        text = tree.format_formula(formula, lambda ref: ref.path, {})
    if _is_enclosed(text):
        return text[1:-1]
    return text


def _is_enclosed(text: str) -> bool:
    """Return whether the last character of a text closes the bracket at its start."""
    depths = list(itertools.accumulate((part == "(") - (part == ")") for part in text))
    return text.startswith("(") and depths.index(0) == len(text) - 1


def format_bits(bits: BitField) -> str:
    """Return a text for the bits of a value in its block, the most significant first.

    An example is "byte 1 bits 1-0, byte 0 bits 7-2".
    """
    parts = []
    for part in sorted(bits.segments, key=lambda segment: -segment.target):
        high = part.low + part.mask.bit_count() - 1
        parts.append(
            f"byte {part.byte} "
            + (f"bits {high}-{part.low}" if high > part.low else f"bit {part.low}")
        )
    return ("signed, " if bits.signed else "") + ", ".join(parts)


def format_unit(info: tree.FieldInfo) -> str:
    """Return scale, unit and offset of a field, such as "0.01 deg - 327.68"."""
    if not info.scaled:
        return info.unit
    if info.offset:
        shift = f" {'-' if info.offset < 0 else '+'} {abs(info.offset):g}"
    else:
        shift = ""
    return f"{info.scale:.10g} {info.unit}".strip() + shift


def describe_field(info: tree.FieldInfo) -> str:
    """Return the constant, formula, documentation and labels of a field as a text."""
    if info.const is not None:
        const = f"always {format_hex(info.const, info.bits)}"
    else:
        const = ""
    const = const or (
        f"only {tree.format_values(info.allowed)}"
        if info.allowed is not None and not info.labels
        else ""
    )
    if info.rebuilt is not None:
        follows = format_formula(info.rebuilt)
    else:
        follows = "?"
    labels = ", ".join(format_code(value, name) for value, name in info.labels.items())
    return "; ".join(
        filter(None, (const, "" if follows == "?" else f"= {follows}", info.docs, labels))
    )


def format_hex(value: object, bits: int) -> str:
    """Return bytes or an integer in hexadecimal."""
    if isinstance(value, bytes | bytearray):
        return value.hex(" ")
    if isinstance(value, int):
        return f"0x{value:0{-(-bits // 4)}x}"
    return repr(value)


def _describe_checksum(node: tree.ChecksummedStruct) -> str:
    """Return a description of a checksum, with the range of bytes that it covers."""
    if node.declared:
        name = node.declared.describe()
    else:
        name = "a checksum from the hook lidarspec_checksum"
    first, last = (path.removeprefix(f"{node.struct.path}.") for path in node.over or ("", ""))
    return f"{name} over " + (f"{first} to {last}" if first != last else first or "all other bytes")
