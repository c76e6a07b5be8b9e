"""List an explained frame, and the differences between two frames, as lines.

A line consists of spans with roles, from which a terminal chooses colours.
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
    draw_bits,
    to_json_number,
)
from lidarspec.frames.wire_table import format_hex

#: The maximum number of bytes of a frame in a line.
LINE_BYTES = 8
#: The number of spaces for each level of nesting.
INDENT = 2
#: The maximum width of the column with bytes and bits.
MAX_BITS_WIDTH = 35
#: The maximum width of the column with names.
MAX_NAME_WIDTH = 36
#: The number of bytes of a field in a line of its differences.
DIFFERENCE_LINE_BYTES = 4
#: The number of spans at the start of a line that are columns. The text after the columns can be
#: folded.
COLUMN_COUNT = 3
#: The minimum width of the text after the columns. If less width is left, lines are not folded.
MIN_FOLDED_WIDTH = 24

Line = tuple[TextSpan, ...]


def join_text(line: Line) -> str:
    """Return the text of a line, without the roles of its spans."""
    return "".join(span.text for span in line).rstrip()


def fold(line: Line, width: int) -> Line:
    """Break a line that is wider than `width` characters into several lines."""
    indent = sum(len(span.text) for span in line[:COLUMN_COUNT])
    if len(join_text(line)) <= width or indent + MIN_FOLDED_WIDTH > width:
        return line
    spans = list(line[:COLUMN_COUNT])
    column = indent
    for span in line[COLUMN_COUNT:]:
        for word in re.findall(r"\s*\S+", span.text):
            breaks = column + len(word) > width and column > indent
            part = f"\n{' ' * indent}{word.lstrip()}" if breaks else word
            spans.append(TextSpan(part, span.role))
            if breaks:
                column = len(part) - 1
            else:
                column = column + len(part)
    return tuple(spans)


def list_parents(path: str) -> list[str]:
    """Return the paths of the structs that contain a field, outermost first.

    For example, "a[0].b.c" gives ["a[0]", "a[0].b"].
    """
    parts = path.split(".")
    return [".".join(parts[:depth]) for depth in range(1, len(parts))]


class Listing:
    """Formats the rows of a frame as lines with aligned columns.

    Args:
        every: whether to draw the bits of all elements of an array, instead of only the first.
    """

    def __init__(self, rows: Sequence[ExplainedRow], *, every: bool) -> None:
        self._rows = rows
        self._drawn = [
            any(value.bits for value in row.values) and (every or row.is_in_first_element)
            for row in rows
        ]
        self._bytes = min(max([1, *(len(row.data) for row in rows)]), LINE_BYTES)
        pictures = [
            draw_bits(*part)
            for row, drawn in zip(rows, self._drawn, strict=True)
            if drawn
            for part in _split_bits(row)
        ]
        self._left = max(
            [
                3 * self._bytes - 1,
                *(len(picture) for picture in pictures if len(picture) <= MAX_BITS_WIDTH),
            ]
        )
        self._paths = min(
            max(
                (len(name) for index in range(len(rows)) for name in self._iter_names(index)),
                default=0,
            ),
            MAX_NAME_WIDTH,
        )

    def lines(self) -> Iterator[Line]:
        """Yield the lines; the line of a struct comes before its contents."""
        previous: list[str] = []
        for index, row in enumerate(self._rows):
            containers = list_parents(row.path)
            for depth, path in enumerate(containers):
                if path not in previous[depth : depth + 1]:
                    yield self._make_line(row.offset, TextSpan(""), _indent_path(path, depth), [])
            previous = containers
            yield from self._iter_row_lines(row, len(containers), drawn=self._drawn[index])

    def _iter_row_lines(self, row: ExplainedRow, depth: int, *, drawn: bool) -> Iterator[Line]:
        parts = [
            row.data[start : start + self._bytes] for start in range(0, len(row.data), self._bytes)
        ] or [b""]
        role = "hex" if row.matches_spec else "bad"
        yield self._make_line(
            row.offset,
            TextSpan(parts[0].hex(" "), role),
            _indent_path(row.path, depth),
            row.spans(omits_values=drawn),
        )
        for row_number, part in enumerate(parts[1:], 1):
            yield (
                TextSpan(f"{row.offset + row_number * self._bytes:04x}  ", "offset"),
                TextSpan(part.hex(" "), role),
            )
        for value, picture in zip(row.values, _split_bits(row), strict=True) if drawn else ():
            words = [TextSpan(str(value) or value.raw.hex(" "))]
            words += [TextSpan(f" ({value.bits})", "docs")] * (
                len(value.masks) - value.masks.count(0) > 1 and bool(value.bits)
            )
            words += [TextSpan(f"; {value.docs}", "docs")] if value.docs else []
            if value.bits:
                drawing = TextSpan(draw_bits(*picture), "bits")
            else:
                drawing = TextSpan(picture[0].hex(" "), role)
            yield self._make_line(
                value.start,
                drawing,
                " " * INDENT * (depth + 1) + value.path.removeprefix(f"{row.path}."),
                words,
            )

    def _make_line(self, offset: int, left: TextSpan, name: str, words: Sequence[TextSpan]) -> Line:
        padded = TextSpan(f"{left.text:<{self._left}}  ", left.role)
        return (
            TextSpan(f"{offset:04x}  ", "offset"),
            padded,
            TextSpan(f"{name:<{self._paths}}  ", "name"),
            *words,
        )

    def _iter_names(self, index: int) -> Iterator[str]:
        row = self._rows[index]
        around = list_parents(row.path)
        yield from (_indent_path(path, depth) for depth, path in enumerate([*around, row.path]))
        if self._drawn[index]:
            yield from (
                " " * INDENT * (len(around) + 1) + value.path.removeprefix(f"{row.path}.")
                for value in row.values
            )


def _split_bits(row: ExplainedRow) -> list[tuple[bytes, bytes]]:
    """Return the bytes and the bit masks of each value of a row."""
    return [
        (row.data[value.start - row.offset :][: len(value.masks)], value.masks)
        for value in row.values
    ]


def _indent_path(path: str, depth: int) -> str:
    return " " * INDENT * depth + path.rpartition(".")[2]


def list_differences(differences: list[FieldDifference], sizes: tuple[int, int]) -> Iterator[Line]:
    """Yield lines with the differences of two frames, and a last line with a summary.

    Args:
        sizes: the sizes of the frames, in bytes.
    """
    for only_in, group in groupby(differences, lambda difference: difference.only_in):
        if only_in:
            yield _make_only_in_line(list(group), only_in)
            continue
        for difference in group:
            yield from _iter_difference_lines(difference)
    length = f"{' and '.join(map(str, dict.fromkeys(sizes)))} bytes"
    bits = sum(mask.bit_count() for difference in differences for mask in difference.masks)
    fields = len(differences)
    differing = (
        f"{length}; {bits} different bit{'s' * (bits != 1)} in {fields} field{'s' * (fields != 1)}"
    )
    yield (TextSpan(differing if fields else f"{length}; the frames are identical", "note"),)


def _iter_difference_lines(difference: FieldDifference) -> Iterator[Line]:
    old = difference.before
    new = difference.after
    assert old is not None
    assert new is not None
    if difference.change:
        change = f" ({difference.change})"
    else:
        change = ""
    if new.start != old.start:
        moved = f" (at {new.start:04x} in the second frame)"
    else:
        moved = ""
    values = f"{_format_value(old)} -> {_format_value(new)}{change}{moved}"
    yield (
        TextSpan(f"{old.start:04x}  ", "offset"),
        TextSpan(f"{difference.path}  ", "name"),
        TextSpan(values),
    )
    masks = difference.masks
    for start in range(0, len(masks), DIFFERENCE_LINE_BYTES):
        part = slice(start, start + DIFFERENCE_LINE_BYTES)
        if any(masks[part]):
            for sign, data, role in (
                ("-", difference.first, "bad"),
                ("+", difference.second, "good"),
            ):
                bits = draw_bits(data[part], masks[part])
                yield (
                    TextSpan(f"{'':6}{sign} "),
                    TextSpan(f"{data[part].hex(' '):<{3 * DIFFERENCE_LINE_BYTES - 1}}  ", "hex"),
                    TextSpan(bits, role),
                )


def _make_only_in_line(group: list[FieldDifference], which: str) -> Line:
    """Return a line for consecutive fields that only one frame has.

    Args:
        which: the frame that has the fields, "first" or "second".
    """
    paths = [difference.path for difference in group]
    if len(paths) == 1:
        names = paths[0]
    else:
        names = f"{paths[0]} to {paths[-1]}"
    return (TextSpan(f"{'':6}{names}  ", "name"), TextSpan(f"only in the {which} frame"))


def _format_value(value: FieldValue) -> str:
    text = str(value)
    return text or (
        format_hex(value.raw, 0) if isinstance(value.raw, bytes) else str(to_json_number(value.raw))
    )
