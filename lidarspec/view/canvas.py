"""Pictures made of characters in cells, with braille characters for dots.

A cell has 2 columns and 4 rows of dots. Each cell has a character and an ink, which is an index of
`INKS`. An ink is shown in true colour, 256 colours, 16 colours or without colour, depending on the
terminal.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from itertools import groupby
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from rich.color import Color, ColorSystem
from rich.text import Text

from lidarspec.errors import escape_controls
from lidarspec.points.appearance import RAMP_STEPS
from lidarspec.points.colours import Rgb, make_ramp

Depth = Literal["truecolor", "256", "standard", "none"]

#: SGR codes (terminal colours) for the colour ramp on terminals with 16 colours, from dark to
#: light.
_STANDARD = (94, 36, 92, 93)
#: indices of the inks that are not part of the ramp.
PLAIN, STRONG, FAINT, LABEL, GOOD, ALARM = range(6)
#: number of dots in a cell, horizontally and vertically.
DOTS_ACROSS = 2
DOTS_DOWN = 4
#: the bit of each dot of a braille character, by row and column.
BITS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]], np.int64)
BLANK = 0x2800
_SPACE = ord(" ")
#: character -> its replacement in ASCII. A braille character is replaced by the character of
#: `_BY_DOTS` at the index of its number of dots.
ASCII = {
    "▲": "^",
    "▶": ">",
    "▼": "v",
    "◀": "<",
    "│": "|",
    "─": "-",
    "━": "#",
    "°": "d",
    "●": "*",
    "‖": "=",
    "±": "+",
    "·": ".",
}
_BY_DOTS = " ..::oo##"


@dataclass(frozen=True)
class TextStyle:
    """A colour and a weight.

    Attributes:
        rgb: the colour; None for the default colour of the terminal.
        standard: the SGR code of the nearest of the 16 standard colours; None for the default
            colour.
        bold: whether the weight is bold.
        faint: whether the weight is faint.
    """

    rgb: Rgb | None = None
    standard: int | None = None
    bold: bool = False
    faint: bool = False


_FIXED = (
    TextStyle(),
    TextStyle(bold=True),
    TextStyle((98, 100, 112), 90, faint=True),
    TextStyle((150, 154, 168), 37),
    TextStyle((96, 216, 110), 92, bold=True),
    TextStyle((255, 92, 87), 91, bold=True),
)
#: the first ink of the colour ramp, for the lowest values.
FIRST_STEP = len(_FIXED)
_SCALE = tuple(
    TextStyle(rgb, _STANDARD[step * len(_STANDARD) // RAMP_STEPS])
    for step, rgb in enumerate(make_ramp("dark", RAMP_STEPS))
)
INKS: tuple[TextStyle, ...] = (*_FIXED, *_SCALE)


@functools.cache
def sgr(ink: int, depth: Depth) -> str:
    """Return the escape sequence that selects an ink."""
    chosen = INKS[ink]
    parts = ["0"]
    if chosen.bold:
        parts.append("1")
    if depth == "none" or chosen.rgb is None:
        parts += ["2"] * chosen.faint
    elif depth == "standard":
        parts.append(str(chosen.standard))
    else:
        if depth == "truecolor":
            shown = ColorSystem.TRUECOLOR
        else:
            shown = ColorSystem.EIGHT_BIT
        parts += Color.from_rgb(*chosen.rgb).downgrade(shown).get_ansi_codes()
    return f"\x1b[{';'.join(parts)}m"


def style(ink: int) -> str:
    """Return the style of the library rich for an ink."""
    chosen = INKS[ink]
    if chosen.rgb is None:
        colour = ""
    else:
        colour = "#" + "".join(f"{part:02x}" for part in chosen.rgb)
    return " ".join(part for part in ("bold" if chosen.bold else "", colour) if part)


@dataclass(frozen=True, eq=False)
class CellGrid:
    """A picture as characters and inks.

    Attributes:
        codes: the characters as code points, (height, width) int32.
        inks: the ink of each character, as an index of `INKS`, (height, width) int16.
    """

    codes: NDArray[np.int32]
    inks: NDArray[np.int16]

    @classmethod
    def blank(cls, width: int, height: int) -> CellGrid:
        """Return a picture of spaces."""
        return cls(np.full((height, width), _SPACE, np.int32), np.zeros((height, width), np.int16))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in cells."""
        return self.codes.shape[1], self.codes.shape[0]

    def write(self, row: int, column: int, text: str, ink: int = PLAIN) -> None:
        """Write text that begins at a cell; omit characters outside the picture."""
        width, height = self.size
        if not 0 <= row < height or column >= width:
            return
        text = escape_controls(text).replace("\n", " ")
        text = text[max(-column, 0) :][: width - max(column, 0)]
        column = max(column, 0)
        self.codes[row, column : column + len(text)] = [ord(character) for character in text]
        self.inks[row, column : column + len(text)] = ink

    def paste(self, row: int, column: int, other: CellGrid) -> None:
        """Copy the parts of another picture that fit into this picture.

        Args:
            row, column: the cell for the upper left corner of the other picture.
        """
        width = min(other.size[0], self.size[0] - column)
        height = min(other.size[1], self.size[1] - row)
        if width > 0 and height > 0:
            self.codes[row : row + height, column : column + width] = other.codes[:height, :width]
            self.inks[row : row + height, column : column + width] = other.inks[:height, :width]

    def lines(self) -> list[str]:
        """Return the characters without colours, line by line."""
        return ["".join(map(chr, row)) for row in self.codes.tolist()]

    def text(self) -> Text:
        """Return the picture as a coloured text of the library rich."""
        text = Text(no_wrap=True)
        for number, (line, inks) in enumerate(zip(self.lines(), self.inks.tolist(), strict=True)):
            start = 0
            for ink, run in groupby(inks):
                end = start + sum(1 for _ in run)
                text.append(line[start:end], style(ink))
                start = end
            if number < len(self.codes) - 1:
                text.append("\n")
        return text

    def ascii(self) -> CellGrid:
        """Return the picture in ASCII, for terminals without Unicode."""
        codes = self.codes.copy()
        for character in set(np.unique(codes).tolist()):
            if character > 0x7E:
                dots = (character - BLANK).bit_count()
                codes[codes == character] = ord(
                    _BY_DOTS[dots]
                    if BLANK <= character < BLANK + 256
                    else ASCII.get(chr(character), "?")
                )
        return CellGrid(codes, self.inks)


class Canvas:
    """Dots and labels on a grid of cells.

    Attributes:
        width: number of columns of cells.
        height: number of rows of cells.
        ramp: the column of the points that determines their colours, such as "range".
        dots: the dots of points, (4 * height, 2 * width) bool.
        lines: the dots of rings and axes, (4 * height, 2 * width) bool.
        steps: the colour of each cell's points, as a step of the colour ramp, (height, width)
            int16; -1 for cells without points.
        labels: (row, column) of a cell -> its character and ink, for the cells of labels.
    """

    def __init__(self, width: int, height: int, ramp: str = "range") -> None:
        self.width = width
        self.height = height
        self.ramp = ramp
        self.dots, self.lines = np.zeros((2, DOTS_DOWN * height, DOTS_ACROSS * width), np.bool_)
        self.steps = np.full((height, width), -1, np.int16)
        self.labels: dict[tuple[int, int], tuple[str, int]] = {}

    def plot(self, column: NDArray[Any], row: NDArray[Any], shade: NDArray[Any]) -> None:
        """Set the dots of the points that are on the canvas.

        Args:
            column, row: fractional coordinates in dots, (n,).
            shade: positions on the colour ramp, from 0 (first colour) to 1 (last colour), (n,).
        """
        across, down, inside = self._to_dots(column, row)
        self.dots[down, across] = True
        steps = np.clip(shade[inside] * RAMP_STEPS, 0, RAMP_STEPS - 1).astype(np.uint8)
        order = np.argsort(RAMP_STEPS - steps if self.ramp == "range" else steps, kind="stable")
        self.steps[down[order] // DOTS_DOWN, across[order] // DOTS_ACROSS] = steps[order]

    def draw_line(self, column: NDArray[Any], row: NDArray[Any]) -> None:
        """Set the dots of a ring or an axis.

        Args:
            column, row: fractional coordinates in dots, (n,).
        """
        across, down, _ = self._to_dots(column, row)
        self.lines[down, across] = True

    def label(
        self, row: int, column: int, text: str, ink: int = LABEL, *, over: bool = False
    ) -> bool:
        """Write text that begins at a cell, if there is space for the text.

        Args:
            over: whether the text may hide points.

        Returns:
            Whether the text was written.
        """
        cells = [(row, column + index) for index in range(len(text))]
        if not (0 <= row < self.height and column >= 0 and column + len(text) <= self.width):
            return False
        if any(cell in self.labels or (self.steps[cell] >= 0 and not over) for cell in cells):
            return False
        self.labels |= {cell: (character, ink) for cell, character in zip(cells, text, strict=True)}
        return True

    def cells(self) -> CellGrid:
        """Return the picture."""
        points = _to_braille(self.dots)
        lines = _to_braille(self.lines)
        codes = np.where(
            points > 0, BLANK + points, np.where(lines > 0, BLANK + lines, _SPACE)
        ).astype(np.int32)
        inks = np.where(
            points > 0, FIRST_STEP + self.steps, np.where(lines > 0, FAINT, PLAIN)
        ).astype(np.int16)
        for cell, (character, ink) in self.labels.items():
            codes[cell] = ord(character)
            inks[cell] = ink
        return CellGrid(codes, inks)

    def _to_dots(
        self, column: NDArray[Any], row: NDArray[Any]
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
        height, width = self.dots.shape
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        return column[inside].astype(np.intp), row[inside].astype(np.intp), inside


def _to_braille(dots: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return each cell's dots as the bits of a braille character, (height, width)."""
    blocks = dots.reshape(
        dots.shape[0] // DOTS_DOWN, DOTS_DOWN, dots.shape[1] // DOTS_ACROSS, DOTS_ACROSS
    )
    return np.asarray(np.einsum("rdca,da->rc", blocks, BITS))
