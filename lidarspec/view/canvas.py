"""A canvas of braille characters: two dots across and four down in each cell, square where a cell is twice as high as wide."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.text import Text

ACROSS, DOWN = 2, 4
#: the bit of each dot of a braille character, by row and column.
BITS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]], np.int64)
BLANK = 0x2800
#: colours from near to far, and of what is no point.
NEAR_TO_FAR = ("bright_red", "yellow", "bright_green", "bright_cyan", "bright_blue", "magenta")
FAINT = "bright_black"


@dataclass(eq=False)
class Canvas:
    """Dots and labels on a grid of cells.

    Attributes:
        width, height: in cells.
        dots: (4 * height, 2 * width) bool, points.
        lines: the same for rings and axes, shown where a cell has no point.
        shade: (height, width) float, 0 near to 1 far, for the colour of a cell's points; nan without.
        labels: text in cells, (row, column) -> character.
    """

    width: int
    height: int
    dots: NDArray[np.bool_] = field(init=False)
    lines: NDArray[np.bool_] = field(init=False)
    shade: NDArray[np.float64] = field(init=False)
    labels: dict[tuple[int, int], str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.dots = np.zeros((DOWN * self.height, ACROSS * self.width), np.bool_)
        self.lines = np.zeros_like(self.dots)
        self.shade = np.full((self.height, self.width), np.nan)

    def plot(self, column: NDArray[Any], row: NDArray[Any], shade: NDArray[Any] | None = None) -> None:
        """Set dots at fractional dot coordinates; without `shade` they belong to lines. What is outside is left out."""
        across, down = np.floor(column).astype(np.intp), np.floor(row).astype(np.intp)
        inside = (across >= 0) & (across < self.dots.shape[1]) & (down >= 0) & (down < self.dots.shape[0])
        across, down = across[inside], down[inside]
        (self.lines if shade is None else self.dots)[down, across] = True
        if shade is not None:
            np.fmin.at(self.shade, (down // DOWN, across // ACROSS), shade[inside])

    def label(self, row: int, column: int, text: str) -> bool:
        """Write text from a cell on, unless it would leave the canvas or hide a point or another label; whether it was written."""
        cells = [(row, column + index) for index in range(len(text))]
        if not (0 <= row < self.height and column >= 0 and column + len(text) <= self.width):
            return False
        if any(cell in self.labels or not np.isnan(self.shade[cell]) for cell in cells):
            return False
        self.labels |= dict(zip(cells, text, strict=True))
        return True

    def text(self) -> Text:
        """The picture, coloured; its ``plain`` has the characters alone."""
        found = Text(no_wrap=True)
        points, lines = _cells(self.dots), _cells(self.lines)
        for row in range(self.height):
            for column in range(self.width):
                found.append(*self._cell(row, column, int(points[row, column]), int(lines[row, column])))
            if row < self.height - 1:
                found.append("\n")
        return found

    def _cell(self, row: int, column: int, points: int, lines: int) -> tuple[str, str]:
        label = self.labels.get((row, column))
        if label is not None:
            return label, FAINT
        if points:
            step = min(int(self.shade[row, column] * len(NEAR_TO_FAR)), len(NEAR_TO_FAR) - 1)
            return chr(BLANK + points), NEAR_TO_FAR[step]
        return (chr(BLANK + lines), FAINT) if lines else (" ", "")


def _cells(dots: NDArray[np.bool_]) -> NDArray[np.int64]:
    """The braille bits of each cell, (height, width)."""
    blocks = dots.reshape(dots.shape[0] // DOWN, DOWN, dots.shape[1] // ACROSS, ACROSS)
    return np.asarray((blocks * BITS[None, :, None, :]).sum(axis=(1, 3)))
