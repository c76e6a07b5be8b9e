"""List an explained frame, and differences between frames, as lines.

There is a line for each part, indented as the struct is nested, with bit fields drawn below. Lines
consist of spans with roles, which a terminal can colour; their texts alone are complete.
Differences are listed field by field and down to the bit.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import groupby

from lidarspec.explaining.formatting import (
    ExplainedRow,
    FieldDifference,
    FieldValue,
    TextSpan,
    bit_picture,
    number,
)
from lidarspec.frames.wire_table import format_hex

#: Bytes in a line, spaces of a level of nesting, and the maximum widths of the columns of bits and
#: of names.
LINED = 8
LEVEL = 2
PICTURES = 35
NAMES = 36

#: Bytes of a field in a line of its differences.
COMPARED = 4
#: Number of spans of a line that are columns, and the minimum width beside them for folding.
FIXED = 3
FOLDED = 24

Line = tuple[TextSpan, ...]


def join_text(line: Line) -> str:
    """Return a line without its roles."""
    return "".join(span.text for span in line).rstrip()


def fold(line: Line, width: int) -> Line:
    """Return a line with line breaks if it is wider than `width`.

    Continuation lines start below the text.
    """
    indent = sum(len(span.text) for span in line[:FIXED])
    if len(join_text(line)) <= width or indent + FOLDED > width:
        return line
    spans = list(line[:FIXED])
    column = indent
    for span in line[FIXED:]:
        for word in re.findall(r"\s*\S+", span.text):
            breaks = column + len(word) > width and column > indent
            part = f"\n{' ' * indent}{word.lstrip()}" if breaks else word
            spans.append(TextSpan(part, span.role))
            if breaks:
                column = len(part) - 1
            else:
                column = column + len(part)
    return tuple(spans)


def parents(path: str) -> list[str]:
    """Return the structs and elements in a path, outermost first.

    "a[0].b.c" is in "a[0]" and "a[0].b".
    """
    parts = path.split(".")
    return [".".join(parts[:depth]) for depth in range(1, len(parts))]


class Listing:
    """The lines of the rows of a frame, in columns.

    Args:
        every: draw the bits of all elements of an array, not only of the first.
    """

    def __init__(self, rows: Sequence[ExplainedRow], *, every: bool) -> None:
        self._rows = rows
        self._drawn = [
            any(value.bits for value in row.values) and (every or row.first) for row in rows
        ]
        self._bytes = min(max([1, *(len(row.data) for row in rows)]), LINED)
        pictures = [
            bit_picture(*part)
            for row, drawn in zip(rows, self._drawn, strict=True)
            if drawn
            for part in _bits(row)
        ]
        self._left = max(
            [
                3 * self._bytes - 1,
                *(len(picture) for picture in pictures if len(picture) <= PICTURES),
            ]
        )
        self._paths = min(
            max(
                (len(name) for index in range(len(rows)) for name in self._names(index)), default=0
            ),
            NAMES,
        )

    def lines(self) -> Iterator[Line]:
        """Yield the lines; structs and elements come before their contents."""
        above: list[str] = []
        for index, row in enumerate(self._rows):
            around = parents(row.path)
            for depth, path in enumerate(around):
                if path not in above[depth : depth + 1]:
                    yield self._line(row.offset, TextSpan(""), _indent_path(path, depth), [])
            above = around
            yield from self._row(row, len(around), drawn=self._drawn[index])

    def _row(self, row: ExplainedRow, depth: int, *, drawn: bool) -> Iterator[Line]:
        parts = [
            row.data[start : start + self._bytes] for start in range(0, len(row.data), self._bytes)
        ] or [b""]
        role = "hex" if row.right else "bad"
        yield self._line(
            row.offset,
            TextSpan(parts[0].hex(" "), role),
            _indent_path(row.path, depth),
            row.spans(drawn=drawn),
        )
        for row_number, part in enumerate(parts[1:], 1):
            yield (
                TextSpan(f"{row.offset + row_number * self._bytes:04x}  ", "offset"),
                TextSpan(part.hex(" "), role),
            )
        for value, picture in zip(row.values, _bits(row), strict=True) if drawn else ():
            words = [TextSpan(str(value) or value.raw.hex(" "))]
            words += [TextSpan(f" ({value.bits})", "docs")] * (
                len(value.masks) - value.masks.count(0) > 1 and bool(value.bits)
            )
            words += [TextSpan(f"; {value.docs}", "docs")] if value.docs else []
            if value.bits:
                drawing = TextSpan(bit_picture(*picture), "bits")
            else:
                drawing = TextSpan(picture[0].hex(" "), role)
            yield self._line(
                value.start,
                drawing,
                " " * LEVEL * (depth + 1) + value.path.removeprefix(f"{row.path}."),
                words,
            )

    def _line(self, offset: int, left: TextSpan, name: str, words: Sequence[TextSpan]) -> Line:
        padded = TextSpan(f"{left.text:<{self._left}}  ", left.role)
        return (
            TextSpan(f"{offset:04x}  ", "offset"),
            padded,
            TextSpan(f"{name:<{self._paths}}  ", "name"),
            *words,
        )

    def _names(self, index: int) -> Iterator[str]:
        row = self._rows[index]
        around = parents(row.path)
        yield from (_indent_path(path, depth) for depth, path in enumerate([*around, row.path]))
        if self._drawn[index]:
            yield from (
                " " * LEVEL * (len(around) + 1) + value.path.removeprefix(f"{row.path}.")
                for value in row.values
            )


def _bits(row: ExplainedRow) -> list[tuple[bytes, bytes]]:
    """Return the bytes and the bit masks of each value."""
    return [
        (row.data[value.start - row.offset :][: len(value.masks)], value.masks)
        for value in row.values
    ]


def _indent_path(path: str, depth: int) -> str:
    return " " * LEVEL * depth + path.rpartition(".")[2]


def list_differences(differences: list[FieldDifference], sizes: tuple[int, int]) -> Iterator[Line]:
    """Yield the differences of two frames: each field with both values and its bits.

    Args:
        sizes: the sizes of the frames in bytes.
    """
    for missing, group in groupby(differences, lambda difference: difference.missing):
        if missing:
            yield _missing(list(group), missing)
            continue
        for difference in group:
            yield from _lines(difference)
    length = f"{' and '.join(map(str, dict.fromkeys(sizes)))} bytes"
    bits = sum(mask.bit_count() for difference in differences for mask in difference.masks)
    fields = len(differences)
    differing = (
        f"{bits} bit{'s' * (bits != 1)} in {fields} field{'s' * (fields != 1)} of {length} differ"
    )
    yield (TextSpan(differing if fields else f"{length}, all identical", "note"),)


def _lines(difference: FieldDifference) -> Iterator[Line]:
    old = difference.before
    new = difference.after
    assert old is not None
    assert new is not None
    if difference.change:
        change = f" ({difference.change})"
    else:
        change = ""
    if new.start != old.start:
        moved = f" (in the second frame at {new.start:04x})"
    else:
        moved = ""
    values = f"{_format_value(old)} -> {_format_value(new)}{change}{moved}"
    yield (
        TextSpan(f"{old.start:04x}  ", "offset"),
        TextSpan(f"{difference.path}  ", "name"),
        TextSpan(values),
    )
    masks = difference.masks
    for start in range(0, len(masks), COMPARED):
        part = slice(start, start + COMPARED)
        if any(masks[part]):
            for sign, data, role in (
                ("-", difference.first, "bad"),
                ("+", difference.second, "good"),
            ):
                bits = bit_picture(data[part], masks[part])
                yield (
                    TextSpan(f"{'':6}{sign} "),
                    TextSpan(f"{data[part].hex(' '):<{3 * COMPARED - 1}}  ", "hex"),
                    TextSpan(bits, role),
                )


def _missing(group: list[FieldDifference], which: str) -> Line:
    paths = [difference.path for difference in group]
    if len(paths) == 1:
        names = paths[0]
    else:
        names = f"{paths[0]} to {paths[-1]}"
    return (TextSpan(f"{'':6}{names}  ", "name"), TextSpan(f"only in the {which} frame"))


def _format_value(value: FieldValue) -> str:
    text = str(value)
    return text or (
        format_hex(value.raw, 0) if isinstance(value.raw, bytes) else str(number(value.raw))
    )
