"""The parts of the terminal window around the picture: statistics, colours, keys."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import NamedTuple

from lidarspec.points.appearance import RAMP_STEPS, CloudAppearance
from lidarspec.view.canvas import ALARM, FAINT, FIRST_STEP, LABEL, PLAIN, STRONG, CellGrid

#: (key, its effect) for the list of keys.
KEYS = (
    ("space", "pause and continue"),
    ("c", "switch colours"),
    ("+ -", "zoom in and out"),
    ("arrows", "move the view"),
    ("0", "show all points"),
    ("r", "start and stop recording to a file; live sources only"),
    ("q", "quit"),
    ("?", "this list"),
)
HINTS = (("space pause", "c colour"), ("+ - zoom", "0 all"), ("? help", "q quit"))
HINT_COLUMNS = 13
#: width of the margin and of the column with the keys, in the list of keys.
KEY_COLUMNS = 14
#: minimum width of the source in the title; in less space, it is omitted.
MIN_SOURCE_COLUMNS = 8


class WindowFigure(NamedTuple):
    """One of the statistics in the window: its name, its value, and the value's ink."""

    name: str
    value: str
    ink: int = PLAIN


def write_title(window: CellGrid, sensor: str, source: str, state: str, ink: int) -> None:
    """Write the sensor, the source and the state into the first line."""
    columns = window.size[0]
    room = columns - len(sensor) - len(state) - 6
    window.write(0, 1, sensor, STRONG)
    window.write(0, len(sensor) + 3, shorten_source(source, room), LABEL)
    window.write(0, columns - len(state) - 1, state, ink)


def shorten_source(source: str, room: int) -> str:
    """Return the source, shortened to fit.

    A source that is too long is replaced by "..." and its end; if `room` is at most
    `MIN_SOURCE_COLUMNS`, it is replaced by "".

    Args:
        room: number of characters that are available.
    """
    if len(source) <= room:
        return source
    if room <= MIN_SOURCE_COLUMNS:
        return ""
    return "..." + source[len(source) - room + 3 :]


def write_side(
    window: CellGrid, first_column: int, figures: Sequence[WindowFigure], look: CloudAppearance
) -> None:
    """Write statistics, colours and keys at the right of the picture.

    Args:
        first_column: index of the first column to write, directly to the right of the picture.
        figures: the statistics, one per line.
    """
    columns, lines = window.size
    for row in range(1, lines):
        window.write(row, first_column, "│", FAINT)
    for row, figure in enumerate(figures[: lines - 1], start=1):
        window.write(row, first_column + 2, figure.name, LABEL)
        window.write(row, columns - 1 - len(figure.value), figure.value, figure.ink)
    ramp_row = len(figures) + 2
    hints_row = lines - len(HINTS)
    if ramp_row + 2 <= hints_row:
        _write_ramp(window, ramp_row, first_column + 2, look)
    if ramp_row + 2 < hints_row:
        for row, (first, second) in enumerate(HINTS, start=hints_row):
            window.write(row, first_column + 2, f"{first:<{HINT_COLUMNS}}{second}", FAINT)


def write_last_line(window: CellGrid, figures: Sequence[WindowFigure]) -> None:
    """Write the known statistics into the last line, as far as they fit."""
    columns, lines = window.size
    row = lines - 1
    column = 1
    for figure in figures:
        if figure.value == "-":
            continue
        width = len(figure.name) + 1 + len(figure.value)
        if column + width >= columns:
            break
        window.write(row, column, figure.name, LABEL)
        window.write(row, column + len(figure.name) + 1, figure.value, figure.ink)
        column += width + 2


def _write_ramp(window: CellGrid, row: int, column: int, look: CloudAppearance) -> None:
    """Write the colour ramp, and below it the name of the column and its limits."""
    for step in range(RAMP_STEPS):
        window.write(row, column + step, "━", FIRST_STEP + step)
    low, high = look.ends
    window.write(row + 1, column, low, LABEL)
    window.write(row + 1, column + (RAMP_STEPS - len(look.ramp)) // 2, look.ramp, LABEL)
    window.write(row + 1, column + RAMP_STEPS - len(high), high, LABEL)


def draw_keys(columns: int, lines: int) -> CellGrid:
    """Draw the list of keys, for a window with `columns` and `lines`."""
    width = min(max(len(text) for _, text in KEYS) + KEY_COLUMNS, columns)
    page = CellGrid.blank(width, min(len(KEYS) + 4, lines))
    page.write(0, 0, "─" * width, FAINT)
    page.write(0, 2, " keys ", LABEL)
    for row, (key, text) in enumerate(KEYS, start=2):
        page.write(row, 3, key, STRONG)
        page.write(row, 11, text)
    page.write(page.size[1] - 1, 0, "─" * width, FAINT)
    return page


def draw_message(columns: int, text: str) -> CellGrid:
    """Draw a box with a message, for a picture with a width of `columns`."""
    lines = textwrap.wrap(text, max(columns - 4, 1))
    width = min(max(map(len, lines)) + 4, columns)
    box = CellGrid.blank(width, len(lines) + 2)
    for row, line in enumerate(lines, start=1):
        box.write(row, 2, line, ALARM)
    return box
