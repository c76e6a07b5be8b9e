"""Packet diagrams as manuals have them: rows of four bytes, every field a box, repeated parts drawn
once with their number.

A diagram is made in two steps. `_Cells` says what is shown of a frame tree: boxes in the order of
the wire (`Cell`), and groups that repeat or that some headers leave out (`Group`). `_Sheet` draws
these from top to bottom as SVG: a box across the end of a row goes on in the next, a group has rows
of its own with a bracket beside them, and a field too long to draw, or of no fixed length, is a
torn row.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from xml.sax.saxutils import escape, quoteattr

from lidarspec.exports import Message, messages
from lidarspec.frames.wire_table import (
    INDICES,
    Extent,
    bit_text,
    branches,
    extent,
    frame_size,
    meaning,
    phrase,
    ruled,
    unit_text,
)
from lidarspec.spec import Sensor, tree

#: how the names of fields begin that are there for nothing yet, in manuals.
SPARE = ("reserved", "unused", "spare", "zeros", "padding")


@dataclass(frozen=True)
class Cell:
    """A box: `bits` wide, or with `bits` 0 of a size that only a header tells.

    Attributes:
        name: what is written in it; `detail`: below that; `said`: all there is to say of it.
        role: "const", "sum", "spare", "group" or "".
        offset: where it starts.
    """

    name: str
    bits: int
    detail: str
    said: str
    role: str
    offset: Extent


@dataclass(frozen=True)
class Group:
    """Boxes that stand together: repeated, or with `optional` there under a condition, as the label
    says.
    """

    label: str
    items: tuple[Item, ...]
    optional: bool = False


Item = Cell | Group


def byte_order(message: Message) -> str:
    """The byte order of all numbers of a frame type, "" where they differ or there are none of
    several bytes.
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
class _Cells:
    """Makes the items of a frame type.

    Attributes:
        seals: path of a field that holds a checksum -> its seal.
        mixed: whether its numbers have several byte orders, so that each says its own.
    """

    seals: Mapping[str, tree.Sealed]
    mixed: bool

    def visit(self, node: tree.Node, start: Extent, depth: int) -> tuple[Item, ...]:
        """The items of a part that begins at `start`."""
        match node:
            case tree.Sealed():
                return self.visit(node.body, start, depth)
            case tree.Struct():
                return tuple(self._struct(node, start, depth))
            case tree.Number():
                return (self._number(node, start),)
            case tree.Blob() if node.size != 0:
                return (self._blob(node, start),)
            case tree.Block():
                return tuple(self._block(node, start))
            case tree.Repeat():
                return (self._repeat(node, start, depth),)
            case tree.Parts():
                kinds = [
                    (kind.name, self.visit(kind.element, Extent(0, ("i",)), depth + 1))
                    for kind in node.kinds
                ]
                if len(kinds) == 1:
                    items = kinds[0][1]
                else:
                    items = tuple(Group(name, items, optional=True) for name, items in kinds)
                return (Group(f"{node.name}: {ruled(node)}", items),)
            case tree.When() | tree.Select():
                parts = (
                    (label, self.visit(branch, start, depth)) for label, branch in branches(node)
                )
                return tuple(Group(label, items, optional=True) for label, items in parts if items)
        return ()

    def _struct(self, node: tree.Struct, start: Extent, depth: int) -> Iterator[Item]:
        for member in node.members:
            named = isinstance(member, tree.Struct | tree.Sealed) or (
                isinstance(member, tree.Block) and member.parts[0].names
            )
            for item in self.visit(member, start, depth):
                yield (
                    replace(item, name=f"{member.name}.{item.name}")
                    if named and isinstance(item, Cell)
                    else item
                )
            start = start + extent(member, member.name)

    def _number(self, node: tree.Number, start: Extent) -> Cell:
        width = 8 * node.size
        is_long = node.size > 1
        short = {"uint": "u", "int": "s", "float": "float "}[
            node.kind
        ] + f"{width}{f' {node.order[0]}e' * (self.mixed and is_long)}"
        detail = " ".join(filter(None, (short, unit_text(node.info))))
        if node.info.const is not None:
            if isinstance(node.info.const, int):
                detail = f"{node.info.const:#0{2 * node.size + 2}x}"
            else:
                detail = str(node.info.const)
        return self._cell(
            node.info,
            node.name,
            width,
            detail,
            f"{node.kind}{width}{f' {node.order}' * is_long}",
            start,
        )

    def _blob(self, node: tree.Blob, start: Extent) -> Cell:
        size = extent(node)
        if node.const is not None and len(node.const) <= 8:
            detail = node.const.hex(" ")
        else:
            detail = f"{size} byte{'s' * (str(size) != '1')}"
        return self._cell(node.info, node.name, 8 * size.number, detail, "bytes", start)

    def _block(self, node: tree.Block, start: Extent) -> list[Cell]:
        """A box for each run of bits of one value, in the order of the wire, the highest bit of
        each byte first.
        """
        segments = [
            (run.byte, run.low + run.mask.bit_count() - 1, run, part)
            for part in node.parts
            for run in part.bits.segments
        ]
        runs: list[tuple[tree.Part, int, int, int]] = []
        for byte, _, run, part in sorted(segments, key=lambda entry: (entry[0], -entry[1])):
            low = run.target
            high = run.target + run.mask.bit_count() - 1
            if runs and runs[-1][0] is part and runs[-1][1] == high + 1:
                runs[-1] = (part, low, *runs[-1][2:])
            else:
                runs.append((part, low, high, byte))
        return [
            self._run(node, part, low, high, start + Extent(byte)) for part, low, high, byte in runs
        ]

    def _run(self, node: tree.Block, part: tree.Part, low: int, high: int, start: Extent) -> Cell:
        """The box of some bits of a value, with their numbers where it has others, too."""
        width = high - low + 1
        name = (".".join(part.names) or node.name) + "".join(f"[{index}]" for index in part.indices)
        if high > low:
            numbers = f"{high}..{low}"
        else:
            numbers = f"{low}"
        if width == part.bits.width:
            detail = unit_text(part.info)
        else:
            detail = numbers
        return self._cell(part.info, name, width, detail, bit_text(part.bits), start)

    def _cell(
        self, info: tree.FieldInfo, name: str, bits: int, detail: str, kind: str, start: Extent
    ) -> Cell:
        seal = self.seals.get(info.path)
        if seal:
            role = "sum"
        elif info.const is not None:
            role = "const"
        elif name.startswith(SPARE):
            role = "spare"
        else:
            role = ""
        said = (
            info.path,
            kind,
            unit_text(info),
            meaning(info),
            seal.algorithm.describe() if seal else "",
        )
        return Cell(name or "(constant)", bits, detail, "; ".join(filter(None, said)), role, start)

    def _repeat(self, node: tree.Repeat, start: Extent, depth: int) -> Group:
        step = extent(node.element, node.name).times(INDICES[depth % len(INDICES)])
        count = node.count if isinstance(node.count, int) else phrase(node.count)
        return Group(
            f"{node.name} \u00d7\u00a0{count}", self.visit(node.element, start + step, depth + 1)
        )


#: bits in a row, pixels of a bit and of a row, of the offsets at the left, of a level of brackets,
#: and around everything.
BITS = 32
BIT = 22
ROW = 46
LEFT = 104
LEVEL = 136
EDGE = 16
#: bits that are drawn in full; a longer field is a torn row.
LONGEST = 128
#: letters of an offset in one line.
FORMULA = 13
FILLS = {"": "#ffffff", "const": "#e4e8ee", "sum": "#fde7b8", "spare": "#f4f4f2"}
INK, FAINT, LINE = "#1c2430", "#64707f", "#4a5565"
#: width of a letter in its size, and the sizes of names and of what stands below them.
LETTER = 0.61
NAMED = 13
DETAILED = 10.5
SMALLEST = 8


def svg(sensor: Sensor) -> str:
    """The frame types of a sensor, one below the other, as an SVG document.

    Raises:
        Refused: where a frame holds a part that only Python code can decide.
    """
    sheet = _Sheet()
    for message in messages(sensor, on_wire=False):
        size = frame_size(message.frame)
        order = byte_order(message)
        detail = f"{size} byte{'s' * (size != '1')}" + (
            f", integers {order}-endian" if order else ""
        )
        sheet.title(f"{sensor.vendor} {sensor.model}: {message.name}", detail)
        sheet.items(_Cells(message.seals, mixed=not order).visit(message.root, Extent(), 0), 0)
        sheet.close()
    return sheet.document(f"{sensor.id}: packet diagrams")


#: left edge, upper edge and bits of what a field has of a row.
Piece = tuple[float, float, int]


@dataclass
class _Sheet:
    """A drawing while it grows downwards: `top` is the upper edge of the current row, `used` how
    many of its bits are taken.
    """

    parts: list[str] = field(default_factory=list)
    top: float = EDGE
    used: int = 0
    deepest: int = 0

    def title(self, text: str, detail: str) -> None:
        """The name of a frame type above its rows, then bytes and bits above the first of them."""
        self.parts.append(_text(EDGE, self.top + 14, text, 15, weight="bold"))
        self.parts.append(_text(EDGE, self.top + 31, detail, 11.5, fill=FAINT))
        self.top += 48
        for byte in range(BITS // 8):
            self.parts.append(
                _text(
                    LEFT + (8 * byte + 4) * BIT,
                    self.top,
                    f"byte {byte}",
                    10.5,
                    fill=FAINT,
                    anchor="middle",
                )
            )
        for bit in range(BITS):
            self.parts.append(
                _text(
                    LEFT + (bit + 0.5) * BIT,
                    self.top + 13,
                    str(7 - bit % 8),
                    8.5,
                    fill=FAINT,
                    anchor="middle",
                )
            )
        self.top += 18

    def items(self, items: Sequence[Item], depth: int) -> None:
        """Boxes and groups one after another."""
        for item in items:
            if isinstance(item, Group):
                self._group(item, depth)
            elif item.bits == 0 or item.bits > LONGEST:
                self._torn(item)
            else:
                self._box(item)

    def close(self) -> None:
        """End the last row and leave room before what comes next."""
        self._row_ends()
        self.top += 26

    def document(self, title: str) -> str:
        """All of it."""
        width = LEFT + BITS * BIT + EDGE + LEVEL * self.deepest
        height = self.top - 26 + EDGE
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

    def _row_ends(self) -> None:
        if self.used:
            self.top = self.top + ROW
            self.used = 0

    def _group(self, group: Group, depth: int) -> None:
        """A part with a bracket at its right; it has rows of its own."""
        self._row_ends()
        self.deepest = max(self.deepest, depth + 1 + _depth(group))
        top = self.top
        self.items(group.items, depth)
        self._row_ends()
        x = LEFT + BITS * BIT + 8 + LEVEL * _depth(group)
        path = f"M{x} {top + 2:g}h6v{self.top - top - 4:g}h-6"
        dashes = ' stroke-dasharray="4 3"' if group.optional else ""
        self.parts.append(
            f'<path d="{path}" fill="none" stroke="{LINE}" stroke-width="1.4"{dashes}/>'
        )
        self.parts += _lines(x + 12, (top + self.top) / 2, group.label)

    def _box(self, cell: Cell) -> None:
        """A field in as many pieces as it takes rows; the name stands in the widest."""
        pieces: list[Piece] = []
        left = cell.bits
        lead = self.used % 8
        while left:
            if self.used == 0:
                self._offset(cell, (lead + cell.bits - left) // 8)
            taken = min(left, BITS - self.used)
            pieces.append((LEFT + self.used * BIT, self.top, taken))
            self.used = self.used + taken
            left = left - taken
            if self.used == BITS:
                self._row_ends()
        widest = max(range(len(pieces)), key=lambda index: pieces[index][2])
        self.parts += _outlined(pieces, cell)
        for index, (x, y, bits) in enumerate(pieces):
            if index == widest:
                self.parts += _label(x, y, bits * BIT, cell)
            elif len(pieces) == 2 and not _below(*pieces):
                self.parts += _label(
                    x, y, bits * BIT, replace(cell, name=f"({cell.name})", detail=""), fill=FAINT
                )

    def _torn(self, cell: Cell) -> None:
        """A field too long to draw, or of no known length: a row with a wavy cut."""
        self._row_ends()
        self._offset(cell, 0)
        width = BITS * BIT
        self.parts += _outlined([(LEFT, self.top, BITS)], cell)
        for share in (0.12, 0.88):
            x = LEFT + share * width
            path = f"M{x - 4:g} {self.top:g}l8 {ROW / 3:g}l-8 {ROW / 3:g}l8 {ROW / 3:g}"
            self.parts.append(f'<path d="{path}" fill="none" stroke="{FAINT}"/>')
        self.parts += _label(LEFT, self.top, width, cell)
        self.top = self.top + ROW
        self.used = 0

    def _offset(self, cell: Cell, more: int) -> None:
        """The offset of a row, so many bytes after the field's, left of it; a long formula in two
        lines.
        """
        text = str(cell.offset + Extent(more))
        middle = text.find(" + ", len(text) // 2 - 4)
        if len(text) <= FORMULA or middle < 0:
            lines = [text]
        else:
            lines = [text[: middle + 2], text[middle + 3 :]]
        for index, line in enumerate(lines):
            y = self.top + ROW / 2 + 4 + 13 * (index - (len(lines) - 1) / 2)
            size = min(11, (LEFT - 12) / (LETTER * len(line)))
            self.parts.append(_text(LEFT - 8, y, line, size, fill=FAINT, anchor="end"))


def _depth(group: Group) -> int:
    """How many groups are nested in one."""
    return max((1 + _depth(item) for item in group.items if isinstance(item, Group)), default=0)


def _outlined(pieces: Sequence[Piece], cell: Cell) -> Iterator[str]:
    """The box of a field: its pieces filled, and lines around them but not between two of them."""
    rects = "".join(
        f'<rect x="{x:g}" y="{y:g}" width="{bits * BIT}" height="{ROW}"/>' for x, y, bits in pieces
    )
    yield f'<g fill="{FILLS[cell.role]}"><title>{escape(cell.said)}</title>{rects}</g>'
    path = ""
    for index, piece in enumerate(pieces):
        x, y, bits = piece
        end = x + bits * BIT
        path += f"M{x:g} {y:g}v{ROW}M{end:g} {y:g}v{ROW}"
        before = pieces[index - 1] if index else None
        if index + 1 < len(pieces):
            after = pieces[index + 1]
        else:
            after = None
        path += (
            f"M{max(x, _end(before)):g} {y:g}H{end:g}"
            if before is None or _end(before) < end
            else ""
        )
        path += f"M{x:g} {y + ROW:g}H{end:g}" if after is None or not _below(piece, after) else ""
        path += f"M{x:g} {y:g}H{before[0]:g}" if before and before[0] > x else ""
        path += (
            f"M{_end(after):g} {y + ROW:g}H{end:g}"
            if after and _below(piece, after) and _end(after) < end
            else ""
        )
    yield f'<path d="{path}" fill="none" stroke="{LINE}"/>'


def _end(piece: Piece | None) -> float:
    if piece is None:
        return 0
    return piece[0] + piece[2] * BIT


def _below(one: Piece, other: Piece) -> bool:
    """Whether two pieces of a field touch, one above the other."""
    return abs(one[1] - other[1]) == ROW and max(one[0], other[0]) < min(_end(one), _end(other))


def _label(x: float, y: float, width: float, cell: Cell, fill: str = INK) -> Iterator[str]:
    """The name of a field and what it is, as large as there is room; a name that fits nowhere is
    written upright.
    """
    room = width - 5
    if LETTER * SMALLEST * len(cell.name) > room:
        cell = replace(cell, name=cell.name.rpartition(".")[2])
    size = min(NAMED, room / (LETTER * len(cell.name)))
    middle = x + width / 2
    if size < SMALLEST and len(cell.name) > 1:
        tall = min(NAMED - 2, (ROW - 4) / (LETTER * len(cell.name)))
        if tall >= SMALLEST - 1:
            text = cell.name
        else:
            text = cell.name[: int((ROW - 4) / (LETTER * (SMALLEST - 1)))]
        tall = max(tall, SMALLEST - 1)
        turned = f' transform="rotate(-90 {middle:g} {y + ROW / 2:g})"'
        yield _text(
            middle, y + ROW / 2 + tall * 0.35, text, tall, fill=fill, anchor="middle", more=turned
        )
        return
    has_room = cell.detail and LETTER * DETAILED * len(cell.detail) <= room
    yield _text(
        middle,
        y + ROW / 2 + (-1 if has_room else size * 0.35),
        cell.name,
        size,
        fill=fill,
        anchor="middle",
    )
    if has_room:
        yield _text(middle, y + ROW / 2 + 13, cell.detail, DETAILED, fill=FAINT, anchor="middle")


def _lines(x: float, y: float, label: str) -> Iterator[str]:
    """The label of a bracket, in lines that fit its level."""
    lines = [""]
    room = (LEVEL - 30) / (LETTER * 12)
    for word in label.split(" "):
        if lines[-1] and len(lines[-1]) + 1 + len(word) > room:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    for index, line in enumerate(lines):
        size = min(12, (LEVEL - 30) / (LETTER * len(line)))
        yield _text(x, y + 4 + 15 * (index - (len(lines) - 1) / 2), line, size, weight="bold")


def _text(
    x: float,
    y: float,
    text: str,
    size: float,
    *,
    fill: str = INK,
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
