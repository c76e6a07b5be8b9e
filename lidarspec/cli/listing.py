"""Print the lines of an explanation, in colours on a terminal."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable

from lidarspec.cli.output import emit_parts, render
from lidarspec.errors import escape_controls
from lidarspec.explaining.listing import Line, fold, join_text as plain_text

#: Role of a part of a line -> its style on a terminal.
STYLES = {
    "title": "bold",
    "offset": "dim",
    "hex": "cyan",
    "bits": "yellow",
    "docs": "dim",
    "good": "green",
    "bad": "bold red",
    "point": "magenta",
    "note": "bold yellow",
}


def emit_lines(lines: Iterable[Line], output: str | None) -> None:
    """Print each line when it is made, with colours only on a terminal."""
    may_be_coloured = sys.stdout.isatty() or "FORCE_COLOR" in os.environ
    if output is not None or not may_be_coloured:
        emit_parts(map(plain_text, lines), output)
        return
    # Only colours need rich. Importing it takes a third of the time of this verb.
    from rich.console import Console

    console = Console()
    if not console.is_terminal:
        emit_parts(map(plain_text, lines), output)
        return
    width = console.width if sys.stdout.isatty() else None
    emit_parts((_format_line(line, width) for line in lines), output, colour=True)


def _format_line(line: Line, width: int | None) -> str:
    from rich.text import Text

    drawing = Text()
    for span in line if width is None else fold(line, width):
        drawing.append(escape_controls(span.text), STYLES.get(span.role))
    return render(drawing)
