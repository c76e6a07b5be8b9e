"""Draw packet diagrams as SVG, in the style of vendor manuals.

A row has four bytes, and each field is a box. A repeated part is drawn once, with its count.

`_ItemBuilder` converts a frame tree to boxes (`DiagramBox`) and groups of boxes (`BoxGroup`).
`_Sheet` draws the boxes from top to bottom.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from xml.sax.saxutils import escape, quoteattr

from lidarspec.exports import ExportedFrame, list_frames
from lidarspec.frames.wire_table import (
    INDICES,
    SizeFormula,
    describe_end,
    describe_field,
    extent,
    format_bits,
    format_formula,
    format_unit,
    frame_size,
    list_branches,
)
from lidarspec.spec import Sensor, tree

#: Prefixes that manuals use in the names of fields without a meaning.
SPARE_PREFIXES = ("reserved", "unused", "spare", "zeros", "padding")


@dataclass(frozen=True)
class DiagramBox:
    """A box of a diagram.

    Attributes:
        bits: the size of the field in bits; 0 if the size depends on the header.
        detail: the text below the title.
        tooltip: the full description.
        role: "const", "sum", "spare" or ""; it decides the colour.
        offset: the offset of the first byte.
    """

    name: str
    bits: int
    detail: str
    tooltip: str
    role: str
    offset: SizeFormula


@dataclass(frozen=True)
class BoxGroup:
    """A group of boxes that are repeated together, or that are optional together.

    Attributes:
        label: the number of repetitions, or the condition under which the group exists.
        is_optional: whether some frames do not contain the group.
    """

    label: str
    items: tuple[Item, ...]
    is_optional: bool = False


Item = DiagramBox | BoxGroup


def find_byte_order(message: ExportedFrame) -> str:
    """Return the byte order of all numbers of a frame type.

    Returns "" if the byte orders differ, or if all numbers have a single byte.
    """
    orders = {
        node.order
        for node in tree.nodes(message.root)
        if isinstance(node, tree.Number) and node.size > 1
    }
    if len(orders) == 1:
        return orders.pop()
    return ""


@dataclass
class _ItemBuilder:
    """Converts the tree of a frame type to items.

    Attributes:
        checksums: as in `ExportedFrame`.
        has_both_orders: whether the frame has numbers in both byte orders.
    """

    checksums: Mapping[str, tree.ChecksummedStruct]
    has_both_orders: bool

    def visit(self, node: tree.Node, start: SizeFormula, depth: int) -> tuple[Item, ...]:
        """Return the items of a node that begins at `start`.

        Args:
            depth: the number of arrays around the node.
        """
        match node:
            case tree.ChecksummedStruct():
                return self.visit(node.body, start, depth)
            case tree.Struct():
                return tuple(self._iter_struct_items(node, start, depth))
            case tree.Number():
                return (self._make_number_cell(node, start),)
            case tree.Blob() if node.size != 0:
                return (self._make_blob_cell(node, start),)
            case tree.Block():
                return tuple(self._make_block_cells(node, start))
            case tree.Repeat():
                return (self._make_repeat_group(node, start, depth),)
            case tree.PartSequence():
                kinds = [
                    (kind.name, self.visit(kind.element, SizeFormula(0, ("i",)), depth + 1))
                    for kind in node.kinds
                ]
                if len(kinds) == 1:
                    items = kinds[0][1]
                else:
                    items = tuple(BoxGroup(name, items, is_optional=True) for name, items in kinds)
                return (BoxGroup(f"{node.name}: {describe_end(node)}", items),)
            case tree.When() | tree.Select():
                parts = (
                    (label, self.visit(branch, start, depth))
                    for label, branch in list_branches(node)
                )
                return tuple(
                    BoxGroup(label, items, is_optional=True) for label, items in parts if items
                )
        return ()

    def _iter_struct_items(
        self, node: tree.Struct, start: SizeFormula, depth: int
    ) -> Iterator[Item]:
        for member in node.members:
            named = isinstance(member, tree.Struct | tree.ChecksummedStruct) or (
                isinstance(member, tree.Block) and member.parts[0].names
            )
            for item in self.visit(member, start, depth):
                yield (
                    replace(item, name=f"{member.name}.{item.name}")
                    if named and isinstance(item, DiagramBox)
                    else item
                )
            start = start + extent(member, member.name)

    def _make_number_cell(self, node: tree.Number, start: SizeFormula) -> DiagramBox:
        width = 8 * node.size
        is_long = node.size > 1
        short = {"uint": "u", "int": "s", "float": "float "}[
            node.kind
        ] + f"{width}{f' {node.order[0]}e' * (self.has_both_orders and is_long)}"
        detail = " ".join(filter(None, (short, format_unit(node.info))))
        if node.info.const is not None:
            if isinstance(node.info.const, int):
                detail = f"{node.info.const:#0{2 * node.size + 2}x}"
            else:
                detail = str(node.info.const)
        return self._make_cell(
            node.info,
            node.name,
            width,
            detail,
            f"{node.kind}{width}{f' {node.order}' * is_long}",
            start,
        )

    def _make_blob_cell(self, node: tree.Blob, start: SizeFormula) -> DiagramBox:
        size = extent(node, node.name)
        if node.const is not None and len(node.const) <= 8:
            detail = node.const.hex(" ")
        else:
            detail = f"{size} byte{'s' * (str(size) != '1')}"
        return self._make_cell(node.info, node.name, 8 * size.number, detail, "bytes", start)

    def _make_block_cells(self, node: tree.Block, start: SizeFormula) -> list[DiagramBox]:
        """Return a box for each contiguous run of bits of one value, in wire order."""
        segments = [
            (run.byte, run.low + run.mask.bit_count() - 1, run, part)
            for part in node.parts
            for run in part.bits.segments
        ]
        runs: list[tuple[tree.BlockInteger, int, int, int]] = []
        for byte, _, run, part in sorted(segments, key=lambda entry: (entry[0], -entry[1])):
            low = run.target
            high = run.target + run.mask.bit_count() - 1
            if runs and runs[-1][0] is part and runs[-1][1] == high + 1:
                runs[-1] = (part, low, *runs[-1][2:])
            else:
                runs.append((part, low, high, byte))
        return [
            self._make_run_cell(node, part, low, high, start + SizeFormula(byte))
            for part, low, high, byte in runs
        ]

    def _make_run_cell(
        self, node: tree.Block, part: tree.BlockInteger, low: int, high: int, start: SizeFormula
    ) -> DiagramBox:
        """Return the box of the bits `low` to `high` of a value."""
        width = high - low + 1
        name = (".".join(part.names) or node.name) + "".join(f"[{index}]" for index in part.indices)
        if high > low:
            numbers = f"{high}..{low}"
        else:
            numbers = f"{low}"
        if width == part.bits.width:
            detail = format_unit(part.info)
        else:
            detail = numbers
        return self._make_cell(part.info, name, width, detail, format_bits(part.bits), start)

    def _make_cell(
        self, info: tree.FieldInfo, name: str, bits: int, detail: str, kind: str, start: SizeFormula
    ) -> DiagramBox:
        checksum = self.checksums.get(info.path)
        if checksum:
            role = "sum"
        elif info.const is not None:
            role = "const"
        elif name.startswith(SPARE_PREFIXES):
            role = "spare"
        else:
            role = ""
        description = (
            info.path,
            kind,
            format_unit(info),
            describe_field(info),
            checksum.algorithm.describe() if checksum else "",
        )
        tooltip = "; ".join(filter(None, description))
        return DiagramBox(name or "(constant)", bits, detail, tooltip, role, start)

    def _make_repeat_group(self, node: tree.Repeat, start: SizeFormula, depth: int) -> BoxGroup:
        step = extent(node.element, node.name).times(INDICES[depth % len(INDICES)])
        count = node.count if isinstance(node.count, int) else format_formula(node.count)
        return BoxGroup(
            f"{node.name} \u00d7\u00a0{count}", self.visit(node.element, start + step, depth + 1)
        )


#: The number of bits in a row.
ROW_BITS = 32
#: The width of a bit, in pixels.
BIT_WIDTH_PX = 22
#: The height of a row, in pixels.
ROW_HEIGHT_PX = 46
#: The width of the column of offsets at the left, in pixels.
LEFT_MARGIN_PX = 104
#: The width of a level of brackets at the right, in pixels.
BRACKET_WIDTH_PX = 136
#: The margin around the drawing, in pixels.
MARGIN_PX = 16
#: The size in bits of the longest field that is drawn in full. A longer field is drawn as a cut
#: row.
MAX_DRAWN_BITS = 128
#: The maximum number of letters of an offset that is written in one line.
MAX_OFFSET_LETTERS = 13
#: The fill colour of each role.
FILLS = {"": "#ffffff", "const": "#e4e8ee", "sum": "#fde7b8", "spare": "#f4f4f2"}
#: The colour of names.
NAME_COLOUR = "#1c2430"
#: The colour of details and offsets.
DETAIL_COLOUR = "#64707f"
#: The colour of lines.
LINE_COLOUR = "#4a5565"
#: The width of a letter as a share of the font size.
LETTER_ASPECT = 0.61
#: The font size of names, in pixels.
NAME_SIZE_PX = 13
#: The font size of details, in pixels.
DETAIL_SIZE_PX = 10.5
#: The smallest font size of names, in pixels.
MIN_NAME_SIZE_PX = 8


def svg(sensor: Sensor) -> str:
    """Return an SVG document with the diagrams of all frame types of a sensor.

    Raises:
        ExportError: if the content of a frame depends on Python code.
    """
    sheet = _Sheet()
    for message in list_frames(sensor, omit_encoded=False):
        size = frame_size(message.frame)
        order = find_byte_order(message)
        detail = f"{size} byte{'s' * (size != '1')}" + (
            f", integers {order}-endian" if order else ""
        )
        sheet.draw_title(f"{sensor.vendor} {sensor.model}: {message.name}", detail)
        sheet.draw_items(
            _ItemBuilder(message.checksums, has_both_orders=not order).visit(
                message.root, SizeFormula(), 0
            ),
            0,
        )
        sheet.close()
    return sheet.make_document(f"{sensor.id}: packet diagrams")


#: The piece of a box in one row: its left edge and upper edge in pixels, and its width in bits.
Piece = tuple[float, float, int]


@dataclass
class _Sheet:
    """A drawing that is made from top to bottom.

    Attributes:
        top: the upper edge of the current row, in pixels.
        used: the bits of the current row that are already drawn.
        deepest: the maximum number of nested brackets so far.
    """

    parts: list[str] = field(default_factory=list)
    top: float = MARGIN_PX
    used: int = 0
    deepest: int = 0

    def draw_title(self, text: str, detail: str) -> None:
        """Draw the name of a frame type, and the byte and bit numbers above its first row."""
        self.parts.append(_format_text(MARGIN_PX, self.top + 14, text, 15, weight="bold"))
        self.parts.append(_format_text(MARGIN_PX, self.top + 31, detail, 11.5, fill=DETAIL_COLOUR))
        self.top += 48
        for byte in range(ROW_BITS // 8):
            self.parts.append(
                _format_text(
                    LEFT_MARGIN_PX + (8 * byte + 4) * BIT_WIDTH_PX,
                    self.top,
                    f"byte {byte}",
                    10.5,
                    fill=DETAIL_COLOUR,
                    anchor="middle",
                )
            )
        for bit in range(ROW_BITS):
            self.parts.append(
                _format_text(
                    LEFT_MARGIN_PX + (bit + 0.5) * BIT_WIDTH_PX,
                    self.top + 13,
                    str(7 - bit % 8),
                    8.5,
                    fill=DETAIL_COLOUR,
                    anchor="middle",
                )
            )
        self.top += 18

    def draw_items(self, items: Sequence[Item], depth: int) -> None:
        """Draw boxes and groups one after another."""
        for item in items:
            if isinstance(item, BoxGroup):
                self._draw_group(item, depth)
            elif item.bits == 0 or item.bits > MAX_DRAWN_BITS:
                self._draw_cut_row(item)
            else:
                self._draw_box(item)

    def close(self) -> None:
        """End the last row of a frame type, and leave space before the next frame type."""
        self._end_row()
        self.top += 26

    def make_document(self, title: str) -> str:
        """Return the whole SVG document."""
        width = (
            LEFT_MARGIN_PX + ROW_BITS * BIT_WIDTH_PX + MARGIN_PX + BRACKET_WIDTH_PX * self.deepest
        )
        height = self.top - 26 + MARGIN_PX
        head = (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}"'
            f' width="{width:g}" height="{height:g}" font-family="Helvetica, Arial, sans-serif">'
        )
        return "\n".join(
            [
                head,
                f"<title>{escape(title)}</title>",
                '<rect width="100%" height="100%" fill="#ffffff"/>',
                *self.parts,
                "</svg>",
                "",
            ]
        )

    def _end_row(self) -> None:
        if self.used:
            self.top = self.top + ROW_HEIGHT_PX
            self.used = 0

    def _draw_group(self, group: BoxGroup, depth: int) -> None:
        """Draw a group from the start of a new row, with a bracket at the right."""
        self._end_row()
        self.deepest = max(self.deepest, depth + 1 + _find_nesting_depth(group))
        top = self.top
        self.draw_items(group.items, depth)
        self._end_row()
        x = (
            LEFT_MARGIN_PX
            + ROW_BITS * BIT_WIDTH_PX
            + 8
            + BRACKET_WIDTH_PX * _find_nesting_depth(group)
        )
        path = f"M{x} {top + 2:g}h6v{self.top - top - 4:g}h-6"
        dashes = ' stroke-dasharray="4 3"' if group.is_optional else ""
        self.parts.append(
            f'<path d="{path}" fill="none" stroke="{LINE_COLOUR}" stroke-width="1.4"{dashes}/>'
        )
        self.parts += _draw_bracket_label(x + 12, (top + self.top) / 2, group.label)

    def _draw_box(self, cell: DiagramBox) -> None:
        """Draw a field, which may continue in the next row, with its name in the widest part."""
        pieces: list[Piece] = []
        left = cell.bits
        lead = self.used % 8
        while left:
            if self.used == 0:
                self._draw_offset(cell, (lead + cell.bits - left) // 8)
            taken = min(left, ROW_BITS - self.used)
            pieces.append((LEFT_MARGIN_PX + self.used * BIT_WIDTH_PX, self.top, taken))
            self.used = self.used + taken
            left = left - taken
            if self.used == ROW_BITS:
                self._end_row()
        widest = max(range(len(pieces)), key=lambda index: pieces[index][2])
        self.parts += _draw_outline(pieces, cell)
        for index, (x, y, bits) in enumerate(pieces):
            if index == widest:
                self.parts += _draw_label(x, y, bits * BIT_WIDTH_PX, cell)
            elif len(pieces) == 2 and not _touches(*pieces):
                self.parts += _draw_label(
                    x,
                    y,
                    bits * BIT_WIDTH_PX,
                    replace(cell, name=f"({cell.name})", detail=""),
                    fill=DETAIL_COLOUR,
                )

    def _draw_cut_row(self, cell: DiagramBox) -> None:
        """Draw a field as one row with jagged cuts."""
        self._end_row()
        self._draw_offset(cell, 0)
        width = ROW_BITS * BIT_WIDTH_PX
        self.parts += _draw_outline([(LEFT_MARGIN_PX, self.top, ROW_BITS)], cell)
        for share in (0.12, 0.88):
            x = LEFT_MARGIN_PX + share * width
            step = ROW_HEIGHT_PX / 3
            path = f"M{x - 4:g} {self.top:g}l8 {step:g}l-8 {step:g}l8 {step:g}"
            self.parts.append(f'<path d="{path}" fill="none" stroke="{DETAIL_COLOUR}"/>')
        self.parts += _draw_label(LEFT_MARGIN_PX, self.top, width, cell)
        self.top = self.top + ROW_HEIGHT_PX
        self.used = 0

    def _draw_offset(self, cell: DiagramBox, more: int) -> None:
        """Write the offset of the current row at the left of the row.

        Args:
            cell: the first field of the row.
            more: number of bytes of this field that are already drawn in the rows above.
        """
        text = str(cell.offset + SizeFormula(more))
        middle = text.find(" + ", len(text) // 2 - 4)
        if len(text) <= MAX_OFFSET_LETTERS or middle < 0:
            lines = [text]
        else:
            lines = [text[: middle + 2], text[middle + 3 :]]
        for index, line in enumerate(lines):
            y = self.top + ROW_HEIGHT_PX / 2 + 4 + 13 * (index - (len(lines) - 1) / 2)
            size = min(11, (LEFT_MARGIN_PX - 12) / (LETTER_ASPECT * len(line)))
            self.parts.append(
                _format_text(LEFT_MARGIN_PX - 8, y, line, size, fill=DETAIL_COLOUR, anchor="end")
            )


def _find_nesting_depth(group: BoxGroup) -> int:
    """Return the number of levels of groups inside a group; 0 if it has only boxes."""
    return max(
        (1 + _find_nesting_depth(item) for item in group.items if isinstance(item, BoxGroup)),
        default=0,
    )


def _draw_outline(pieces: Sequence[Piece], cell: DiagramBox) -> Iterator[str]:
    """Yield the filled pieces of a box, and their common outline."""
    rects = "".join(
        f'<rect x="{x:g}" y="{y:g}" width="{bits * BIT_WIDTH_PX}" height="{ROW_HEIGHT_PX}"/>'
        for x, y, bits in pieces
    )
    yield f'<g fill="{FILLS[cell.role]}"><title>{escape(cell.tooltip)}</title>{rects}</g>'
    path = ""
    for index, piece in enumerate(pieces):
        x, y, bits = piece
        end = x + bits * BIT_WIDTH_PX
        path += f"M{x:g} {y:g}v{ROW_HEIGHT_PX}M{end:g} {y:g}v{ROW_HEIGHT_PX}"
        before = pieces[index - 1] if index else None
        if index + 1 < len(pieces):
            after = pieces[index + 1]
        else:
            after = None
        path += (
            f"M{max(x, _right_edge(before)):g} {y:g}H{end:g}"
            if before is None or _right_edge(before) < end
            else ""
        )
        path += (
            f"M{x:g} {y + ROW_HEIGHT_PX:g}H{end:g}"
            if after is None or not _touches(piece, after)
            else ""
        )
        path += f"M{x:g} {y:g}H{before[0]:g}" if before and before[0] > x else ""
        path += (
            f"M{_right_edge(after):g} {y + ROW_HEIGHT_PX:g}H{end:g}"
            if after and _touches(piece, after) and _right_edge(after) < end
            else ""
        )
    yield f'<path d="{path}" fill="none" stroke="{LINE_COLOUR}"/>'


def _right_edge(piece: Piece | None) -> float:
    if piece is None:
        return 0
    return piece[0] + piece[2] * BIT_WIDTH_PX


def _touches(piece: Piece, other: Piece) -> bool:
    """Return whether one of two pieces is directly above the other."""
    return abs(piece[1] - other[1]) == ROW_HEIGHT_PX and max(piece[0], other[0]) < min(
        _right_edge(piece), _right_edge(other)
    )


def _draw_label(
    x: float, y: float, width: float, cell: DiagramBox, fill: str = NAME_COLOUR
) -> Iterator[str]:
    """Yield the name and the detail of a box in the largest font size that fits."""
    room = width - 5
    if LETTER_ASPECT * MIN_NAME_SIZE_PX * len(cell.name) > room:
        cell = replace(cell, name=cell.name.rpartition(".")[2])
    size = min(NAME_SIZE_PX, room / (LETTER_ASPECT * len(cell.name)))
    middle = x + width / 2
    if size < MIN_NAME_SIZE_PX and len(cell.name) > 1:
        tall = min(NAME_SIZE_PX - 2, (ROW_HEIGHT_PX - 4) / (LETTER_ASPECT * len(cell.name)))
        if tall >= MIN_NAME_SIZE_PX - 1:
            text = cell.name
        else:
            text = cell.name[: int((ROW_HEIGHT_PX - 4) / (LETTER_ASPECT * (MIN_NAME_SIZE_PX - 1)))]
        tall = max(tall, MIN_NAME_SIZE_PX - 1)
        turned = f' transform="rotate(-90 {middle:g} {y + ROW_HEIGHT_PX / 2:g})"'
        yield _format_text(
            middle,
            y + ROW_HEIGHT_PX / 2 + tall * 0.35,
            text,
            tall,
            fill=fill,
            anchor="middle",
            more=turned,
        )
        return
    has_room = cell.detail and LETTER_ASPECT * DETAIL_SIZE_PX * len(cell.detail) <= room
    yield _format_text(
        middle,
        y + ROW_HEIGHT_PX / 2 + (-1 if has_room else size * 0.35),
        cell.name,
        size,
        fill=fill,
        anchor="middle",
    )
    if has_room:
        yield _format_text(
            middle,
            y + ROW_HEIGHT_PX / 2 + 13,
            cell.detail,
            DETAIL_SIZE_PX,
            fill=DETAIL_COLOUR,
            anchor="middle",
        )


def _draw_bracket_label(x: float, y: float, label: str) -> Iterator[str]:
    """Yield the label of a bracket, split into lines that fit at its right."""
    lines = [""]
    room = (BRACKET_WIDTH_PX - 30) / (LETTER_ASPECT * 12)
    for word in label.split(" "):
        if lines[-1] and len(lines[-1]) + 1 + len(word) > room:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    for index, line in enumerate(lines):
        size = min(12, (BRACKET_WIDTH_PX - 30) / (LETTER_ASPECT * len(line)))
        yield _format_text(
            x, y + 4 + 15 * (index - (len(lines) - 1) / 2), line, size, weight="bold"
        )


def _format_text(
    x: float,
    y: float,
    text: str,
    size: float,
    *,
    fill: str = NAME_COLOUR,
    anchor: str = "",
    weight: str = "",
    more: str = "",
) -> str:
    extra = "".join(
        f" {name}={quoteattr(value)}"
        for name, value in (("text-anchor", anchor), ("font-weight", weight))
        if value
    )
    return (
        f'<text x="{x:g}" y="{y:g}" font-size="{size:.3g}"'
        f' fill="{fill}"{extra}{more}>{escape(text)}</text>'
    )
