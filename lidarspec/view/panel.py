"""What stands around a picture: title, figures, the meaning of colours, keys; and the layout of all of it."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

from lidarspec.view.canvas import ALARM, FAINT, GOOD, LABEL, PLAIN, RAMPS, STEPS, STRONG, Cells
from lidarspec.view.feed import NOTHING, Reading
from lidarspec.view.polar import Look

#: cells of the figures beside the picture, and of the narrowest picture that has them there.
BESIDE, NARROWEST = 25, 36
#: from what error or loss rate on a figure is an alarm.
ALARMING = 0.01
KEYS = (
    ("space", "pause and go on"),
    ("c", "colour by range or intensity"),
    ("+ -", "zoom in and out"),
    ("arrows", "move what is in the middle"),
    ("0", "all of it again"),
    ("r", "record to a file, and stop; not of files"),
    ("q", "quit"),
    ("?", "this page"),
)
_HINTS = (("space pause", "c colour"), ("+ - zoom", "0 all"), ("? help", "q quit"))

Figure = tuple[str, str, int]


@dataclass(frozen=True)
class Title:
    """The line above the picture.

    Attributes:
        sensor, source: what is seen.
        state: "live", "paused" and so on.
        ink: of the state.
    """

    sensor: str
    source: str
    state: str
    ink: int = GOOD


@dataclass(frozen=True)
class Layout:
    """Where things are: the picture's size, and whether the figures stand beside or below it."""

    width: int
    height: int
    beside: bool

    @classmethod
    def of(cls, columns: int, lines: int) -> Layout:
        """For a window; a narrow one has one line of figures below."""
        beside = columns >= NARROWEST + BESIDE + 1 and lines >= 14
        return cls(columns - BESIDE - 1 if beside else columns, max(lines - (1 if beside else 2), 1), beside)


def composed(columns: int, lines: int, title: Title, drawn: Cells, figures: Sequence[Figure], look: Look) -> Cells:
    """The whole window; `drawn` has the size that `Layout.of` gives the picture."""
    layout = Layout.of(columns, lines)
    whole = Cells.blank(columns, lines)
    _write_title(whole, title)
    whole.paste(1, 0, drawn)
    if not layout.beside:
        _write_line(whole, figures)
        return whole
    left = layout.width
    for row in range(1, lines):
        whole.write(row, left, "│", FAINT)
    for row, (name, value, ink) in enumerate(figures[: lines - 1], start=1):
        whole.write(row, left + 2, name, LABEL)
        whole.write(row, columns - 1 - len(value), value, ink)
    row = len(figures) + 2
    if row + 2 <= lines - len(_HINTS):
        _write_ramp(whole, row, left + 2, look)
    if row + 2 <= lines - len(_HINTS) - 1:
        for place, (first, second) in enumerate(_HINTS):
            whole.write(lines - len(_HINTS) + place, left + 2, f"{first:<13}{second}", FAINT)
    return whole


def figures_of(reading: Reading | None, *, points: int, valid: int, near: float | None, lost: int, queue: str | None) -> list[Figure]:
    """The figures to show, each with its ink.

    Args:
        reading: of the last moments; None before the first.
        points, valid, near: of the scan that is shown: its points, those with a return, and metres to the nearest.
        lost: packets missing since the beginning.
        queue: how full the queue is, where there is one.
    """
    known = NOTHING if reading is None else reading
    found = [
        ("speed", _told(known.speed_hz, "{:.1f} Hz"), STRONG),
        ("packets", _told(known.packet_rate_hz, "{:.0f} /s"), PLAIN),
        ("input", _told(known.bytes_per_s, "{:.1f} kB/s", 1e-3), PLAIN),
        ("points", str(points), PLAIN),
        ("valid", f"{valid / points:.1%}".replace("%", " %") if points else "-", PLAIN),
        ("nearest", _told(near, "{:.2f} m"), PLAIN),
        _rate("errors", known.error_rate if reading else None),
        _rate("skipped", known.skipped_rate if reading else None),
        ("lost", str(lost) if lost or known.loss_rate is not None else "-", ALARM if lost else PLAIN),
        ("jitter", _told(known.jitter_s, "{:.2f} ms", 1e3), PLAIN),
    ]
    return found if queue is None else [*found, ("queue", queue, PLAIN)]


def help_page(columns: int, lines: int) -> Cells:
    """The keys, in a box, for the middle of a window."""
    width = min(max(len(text) for _, text in KEYS) + 14, columns)
    page = Cells.blank(width, min(len(KEYS) + 4, lines))
    page.write(0, 0, "─" * width, FAINT)
    page.write(0, 2, " keys ", LABEL)
    for row, (key, text) in enumerate(KEYS, start=2):
        page.write(row, 3, key, STRONG)
        page.write(row, 11, text)
    page.write(page.size[1] - 1, 0, "─" * width, FAINT)
    return page


def message(columns: int, text: str) -> Cells:
    """Some lines of text for the middle of a picture."""
    lines = textwrap.wrap(text, max(columns - 4, 1))
    found = Cells.blank(min(max(map(len, lines)) + 4, columns), len(lines) + 2)
    for row, line in enumerate(lines, start=1):
        found.write(row, 2, line, ALARM)
    return found


def _write_title(whole: Cells, title: Title) -> None:
    columns = whole.size[0]
    whole.write(0, 1, title.sensor, STRONG)
    room = columns - len(title.sensor) - len(title.state) - 6
    source = title.source if len(title.source) <= room else "..." + title.source[len(title.source) - room + 3 :] if room > 8 else ""
    whole.write(0, len(title.sensor) + 3, source, LABEL)
    whole.write(0, columns - len(title.state) - 1, title.state, title.ink)


def _write_line(whole: Cells, figures: Sequence[Figure]) -> None:
    columns, lines = whole.size
    column = 1
    for name, value, ink in figures:
        if value == "-":
            continue
        if column + len(name) + len(value) + 1 >= columns:
            break
        whole.write(lines - 1, column, name, LABEL)
        whole.write(lines - 1, column + len(name) + 1, value, ink)
        column += len(name) + len(value) + 3


def _write_ramp(whole: Cells, row: int, column: int, look: Look) -> None:
    """What the colours mean: a bar of the ramp, and the values at its ends."""
    for step in range(STEPS):
        whole.write(row, column + step, "━", RAMPS[look.ramp] + step)
    end = f"{look.full:g} m" if look.ramp == "range" else f"{look.full:g}"
    whole.write(row + 1, column, "0", LABEL)
    whole.write(row + 1, column + (STEPS - len(look.ramp)) // 2, look.ramp, LABEL)
    whole.write(row + 1, column + STEPS - len(end), end, LABEL)


def _rate(name: str, rate: float | None) -> Figure:
    if rate is None:
        return name, "-", PLAIN
    return name, f"{rate:.2%}".replace("%", " %"), ALARM if rate >= ALARMING else PLAIN


def _told(value: float | None, form: str, times: float = 1.0) -> str:
    return "-" if value is None else form.format(value * times)
