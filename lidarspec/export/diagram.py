"""Packet diagrams as manuals have them: rows of four bytes, every field a box, repeated parts drawn once with their number."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from xml.sax.saxutils import escape, quoteattr

from lidarspec.export.cells import Cell, Group, Item, cells
from lidarspec.export.messages import messages
from lidarspec.spec import Sensor
from lidarspec.wiretable import frame_size

#: bits in a row, pixels of a bit and of a row, of the offsets at the left, of a level of brackets, and around everything.
BITS, BIT, ROW, LEFT, LEVEL, EDGE = 32, 22, 46, 104, 172, 16
#: bits that are drawn in full; a longer field is a torn row.
LONGEST = 128
FILLS = {"": "#ffffff", "const": "#e4e8ee", "sum": "#fde7b8", "spare": "#f4f4f2"}
INK, FAINT, LINE = "#1c2430", "#64707f", "#4a5565"
#: width of a letter in its size, and the sizes of names and of what stands below them.
LETTER, NAMED, DETAILED, SMALLEST = 0.56, 13, 10.5, 8


def svg(sensor: Sensor) -> str:
    """The frame types of a sensor, one below the other, as an SVG document.

    Raises:
        Refused: where a frame holds a part that only Python code can decide.
    """
    sheet = _Sheet()
    for message in messages(sensor):
        size = frame_size(message.frame)
        sheet.title(f"{sensor.vendor} {sensor.model}: {message.name}", f"{size} bytes" if size != "1" else "1 byte")
        sheet.ruler()
        sheet.items(cells(message), 0)
        sheet.close()
    return sheet.document(f"{sensor.id}: packet diagrams")


@dataclass
class _Sheet:
    """A drawing while it grows downwards: `top` is the upper edge of the current row, `used` how many of its bits are taken."""

    parts: list[str] = field(default_factory=list)
    top: float = EDGE
    used: int = 0
    deepest: int = 0

    def title(self, text: str, detail: str) -> None:
        """The name of a frame type above its rows."""
        self.parts.append(_text(EDGE, self.top + 14, text, 15, weight="bold"))
        self.parts.append(_text(EDGE, self.top + 31, detail, 11.5, fill=FAINT))
        self.top += 48

    def ruler(self) -> None:
        """Bytes and bits above the first row."""
        for byte in range(BITS // 8):
            self.parts.append(_text(LEFT + (8 * byte + 4) * BIT, self.top, f"byte {byte}", 10.5, fill=FAINT, anchor="middle"))
        for bit in range(BITS):
            self.parts.append(_text(LEFT + (bit + 0.5) * BIT, self.top + 13, str(7 - bit % 8), 8.5, fill=FAINT, anchor="middle"))
        self.top += 18

    def items(self, found: Sequence[Item], depth: int) -> None:
        """Boxes and groups one after another."""
        for item in found:
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
        width, height = LEFT + BITS * BIT + EDGE + LEVEL * self.deepest, self.top - 26 + EDGE
        head = (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" width="{width:g}" height="{height:g}" '
            'font-family="Helvetica, Arial, sans-serif">'
        )
        return "\n".join(
            [head, f"<title>{escape(title)}</title>", '<rect width="100%" height="100%" fill="#ffffff"/>', *self.parts, "</svg>", ""]
        )

    def _row_ends(self) -> None:
        if self.used:
            self.top, self.used = self.top + ROW, 0

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
        self.parts.append(f'<path d="{path}" fill="none" stroke="{LINE}" stroke-width="1.4"{dashes}/>')
        self.parts += _lines(x + 12, (top + self.top) / 2, group.label)

    def _box(self, cell: Cell) -> None:
        """A field in as many pieces as it takes rows; the name stands in the widest."""
        pieces = []
        left = cell.bits
        while left:
            if self.used == 0:
                self._offset(cell, cell.bits - left)
            taken = min(left, BITS - self.used)
            pieces.append((LEFT + self.used * BIT, self.top, taken))
            self.used, left = self.used + taken, left - taken
            if self.used == BITS:
                self._row_ends()
        widest = max(range(len(pieces)), key=lambda index: pieces[index][2])
        for index, (x, y, bits) in enumerate(pieces):
            self.parts.append(_rect(x, y, bits * BIT, ROW, cell))
            if index == widest:
                self.parts += _label(x, y, bits * BIT, cell)

    def _torn(self, cell: Cell) -> None:
        """A field too long to draw, or of no known length: a row with a wavy cut."""
        self._row_ends()
        self._offset(cell, 0)
        width = BITS * BIT
        self.parts.append(_rect(LEFT, self.top, width, ROW, cell))
        for share in (0.12, 0.88):
            x = LEFT + share * width
            self.parts.append(
                f'<path d="M{x - 4:g} {self.top:g}l8 {ROW / 3:g}l-8 {ROW / 3:g}l8 {ROW / 3:g}" fill="none" stroke="{FAINT}"/>'
            )
        self.parts += _label(LEFT, self.top, width, cell)
        self.top, self.used = self.top + ROW, 0

    def _offset(self, cell: Cell, bits: int) -> None:
        """The offset of a row, left of it."""
        text = cell.offset if not bits else str(int(cell.offset) + bits // 8) if cell.offset.isdigit() else f"{cell.offset} + {bits // 8}"
        size = max(min(11, (LEFT - EDGE - 10) / (LETTER * len(text))), SMALLEST - 1)
        self.parts.append(_text(LEFT - 8, self.top + ROW / 2 + 4, text, size, fill=FAINT, anchor="end"))


def _depth(group: Group) -> int:
    """How many groups are nested in one."""
    return max((1 + _depth(item) for item in group.items if isinstance(item, Group)), default=0)


def _rect(x: float, y: float, width: float, height: float, cell: Cell) -> str:
    place = f'x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}"'
    return f'<rect {place} fill="{FILLS[cell.role]}" stroke="{LINE}"><title>{escape(cell.said)}</title></rect>'


def _label(x: float, y: float, width: float, cell: Cell) -> Iterator[str]:
    """The name of a field and what it is, as large as there is room; a name that fits nowhere is written upright."""
    room = width - 5
    size = min(NAMED, room / (LETTER * len(cell.name)))
    middle = x + width / 2
    if size < SMALLEST and len(cell.name) > 1:
        tall = min(NAMED - 2, (ROW - 4) / (LETTER * len(cell.name)))
        text = cell.name if tall >= SMALLEST - 1 else cell.name[: int((ROW - 4) / (LETTER * (SMALLEST - 1)))]
        tall = max(tall, SMALLEST - 1)
        turned = f' transform="rotate(-90 {middle:g} {y + ROW / 2:g})"'
        yield _text(middle, y + ROW / 2 + tall * 0.35, text, tall, anchor="middle", more=turned)
        return
    fits = cell.detail and LETTER * DETAILED * len(cell.detail) <= room
    yield _text(middle, y + ROW / 2 + (-1 if fits else size * 0.35), cell.name, size, anchor="middle")
    if fits:
        yield _text(middle, y + ROW / 2 + 13, cell.detail, DETAILED, fill=FAINT, anchor="middle")


def _lines(x: float, y: float, label: str) -> Iterator[str]:
    """The label of a bracket, in lines that fit its level."""
    lines, room = [""], (LEVEL - 30) / (LETTER * 12)
    for word in label.split(" "):
        if lines[-1] and len(lines[-1]) + 1 + len(word) > room:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    for index, line in enumerate(lines):
        size = min(12, (LEVEL - 30) / (LETTER * len(line)))
        yield _text(x, y + 4 + 15 * (index - (len(lines) - 1) / 2), line, size, weight="bold")


def _text(x: float, y: float, text: str, size: float, *, fill: str = INK, anchor: str = "", weight: str = "", more: str = "") -> str:
    extra = "".join(f" {name}={quoteattr(value)}" for name, value in (("text-anchor", anchor), ("font-weight", weight)) if value)
    return f'<text x="{x:g}" y="{y:g}" font-size="{size:.3g}" fill="{fill}"{extra}{more}>{escape(text)}</text>'
