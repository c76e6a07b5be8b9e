"""Pictures in character cells, with two by four braille dots per cell.

The dots are square if a cell is twice as high as wide. Pictures contain the numbers of inks, so
that two of them can be compared cell by cell. The colour depth of the terminal decides how an ink
is shown: true colour, 256 colours, 16, or none.
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

from lidarspec.errors import printable
from lidarspec.points.appearance import STEPS
from lidarspec.points.colours import Rgb, make_ramp

Depth = Literal["truecolor", "256", "standard", "none"]

#: SGR numbers of the ramp in 16 colours, from dark to light.
_STANDARD = (94, 36, 92, 93)
PLAIN, STRONG, FAINT, LABEL, GOOD, ALARM = range(6)
ACROSS = 2
DOWN = 4
#: the bit of each dot of a braille character, by row and column.
BITS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]], np.int64)
BLANK = 0x2800
_SPACE = ord(" ")
#: replacements in ASCII; a braille character is replaced by its number of dots.
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
    """A colour and weight.

    Attributes:
        rgb: None for the terminal's own colour.
        standard: the SGR number of the nearest of 16 colours.
        bold, faint: the weight.
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
#: the first ink of the ramp, for its lowest values.
FIRST_STEP = len(_FIXED)
_SCALE = tuple(
    TextStyle(rgb, _STANDARD[step * len(_STANDARD) // STEPS])
    for step, rgb in enumerate(make_ramp("dark", STEPS))
)
INKS: tuple[TextStyle, ...] = (*_FIXED, *_SCALE)


@functools.cache
def sgr(ink: int, depth: Depth) -> str:
    """The escape sequence that selects an ink, from whatever was selected before.

    Without colours the weights are kept: only they distinguish faint lines from points.
    """
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
    """Return an ink as a style of rich."""
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
        codes: (height, width) int32, the characters as code points.
        inks: (height, width) int16, their colours, as indices of `INKS`.
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
        """Write text from a cell on; it is cut off at the edge."""
        width, height = self.size
        if not 0 <= row < height or column >= width:
            return
        text = printable(text).replace("\n", " ")
        text = text[max(-column, 0) :][: width - max(column, 0)]
        column = max(column, 0)
        self.codes[row, column : column + len(text)] = [ord(character) for character in text]
        self.inks[row, column : column + len(text)] = ink

    def paste(self, row: int, column: int, other: CellGrid) -> None:
        """Copy a picture, with its upper left corner in a cell; it is cut off at the edge."""
        width = min(other.size[0], self.size[0] - column)
        height = min(other.size[1], self.size[1] - row)
        if width > 0 and height > 0:
            self.codes[row : row + height, column : column + width] = other.codes[:height, :width]
            self.inks[row : row + height, column : column + width] = other.inks[:height, :width]

    def lines(self) -> list[str]:
        """Return the characters without colours, line by line."""
        return ["".join(map(chr, row)) for row in self.codes.tolist()]

    def text(self) -> Text:
        """Return the picture as coloured text for rich."""
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
        width, height: in cells.
        ramp: the column that colours show: "range", or one with weak and strong values.
        dots: (4 * height, 2 * width) bool, points.
        lines: the same for rings and axes, shown where a cell has no point.
        steps: (height, width) int16, the colour of a cell's points on the ramp; -1 without.
        labels: text in cells, (row, column) -> character and ink.
    """

    def __init__(self, width: int, height: int, ramp: str = "range") -> None:
        self.width = width
        self.height = height
        self.ramp = ramp
        self.dots, self.lines = np.zeros((2, DOWN * height, ACROSS * width), np.bool_)
        self.steps = np.full((height, width), -1, np.int16)
        self.labels: dict[tuple[int, int], tuple[str, int]] = {}

    def plot(self, column: NDArray[Any], row: NDArray[Any], shade: NDArray[Any]) -> None:
        """Set dots of points at fractional dot coordinates; dots outside are left out.

        Args:
            column, row: (n,) coordinates in dots.
            shade: (n,) positions on the ramp, from 0 to 1. A cell takes the colour of its nearest
                or strongest point.
        """
        across, down, inside = self._places(column, row)
        self.dots[down, across] = True
        steps = np.clip(shade[inside] * STEPS, 0, STEPS - 1).astype(np.uint8)
        order = np.argsort(STEPS - steps if self.ramp == "range" else steps, kind="stable")
        self.steps[down[order] // DOWN, across[order] // ACROSS] = steps[order]

    def line(self, column: NDArray[Any], row: NDArray[Any]) -> None:
        """Set dots of rings and axes."""
        across, down, _ = self._places(column, row)
        self.lines[down, across] = True

    def label(
        self, row: int, column: int, text: str, ink: int = LABEL, *, over: bool = False
    ) -> bool:
        """Write text from a cell on, unless it would leave the canvas or hide something.

        Args:
            over: whether it may hide points.

        Returns:
            Whether it was written.
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
        points = _braille(self.dots)
        lines = _braille(self.lines)
        codes = np.where(
            points > 0, BLANK + points, np.where(lines > 0, BLANK + lines, _SPACE)
        ).astype(np.int32)
        inks = np.where(
            points > 0, FIRST_STEP + self.steps, np.where(lines > 0, FAINT, PLAIN)
        ).astype(np.int16)
        for cell, (character, ink) in self.labels.items():
            codes[cell], inks[cell] = ord(character), ink
        return CellGrid(codes, inks)

    def _places(
        self, column: NDArray[Any], row: NDArray[Any]
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
        height, width = self.dots.shape
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        return column[inside].astype(np.intp), row[inside].astype(np.intp), inside


def _braille(dots: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the braille bits of each cell, (height, width)."""
    blocks = dots.reshape(dots.shape[0] // DOWN, DOWN, dots.shape[1] // ACROSS, ACROSS)
    return np.asarray(np.einsum("rdca,da->rc", blocks, BITS))
