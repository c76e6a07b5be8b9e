"""Print results on standard output or into a file, and show progress."""

from __future__ import annotations

import contextlib
import functools
import itertools
import json
import shutil
import sys
import textwrap
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from textwrap import indent
from typing import TYPE_CHECKING, Any, TypeVar

import click

from lidarspec.cli.terminal import note, say, verbosity
from lidarspec.errors import escape_controls, system_errors

if TYPE_CHECKING:
    from rich.progress import Progress as Bar
    from rich.text import Text

Function = TypeVar("Function", bound=Callable[..., Any])

#: Seconds between two updates of the progress line.
UPDATE_PERIOD_S = 0.2
#: Number of spaces between the columns of a table. The next constants are the indentation of text
#: below a row, and the minimum width of a last column with text, in characters.
COLUMN_GAP = 2
PROSE_INDENT = 6
MIN_PROSE_WIDTH = 24


def output_options(function: Function) -> Function:
    """Add ``--json`` and ``-o/--output`` to a verb that prints."""
    return click.option("--json", "as_json", is_flag=True, help="Print JSON.")(
        output_option(function)
    )


def output_option(function: Function) -> Function:
    """Add ``-o/--output`` to a verb."""

    @functools.wraps(function)
    def refuse_and_call(*args: Any, output: str | None, **others: Any) -> Any:
        if output is not None:
            from lidarspec.cli.inputs import refuse_overwriting
            from lidarspec.sensor_operations import Sensor

            words = [
                word
                for value in others.values()
                for word in (value if isinstance(value, tuple) else [value])
            ]
            refuse_overwriting(output, *(word for word in words if isinstance(word, str | Sensor)))
        return function(*args, output=output, **others)

    return click.option(
        "-o", "--output", metavar="FILE", help="Write to a file instead of standard output."
    )(refuse_and_call)  # type: ignore[return-value]


class Progress(contextlib.AbstractContextManager["Progress"]):
    """A progress line on standard error, which is removed when the context ends.

    Args:
        unit: converts an amount of work to text.
        period: minimum seconds between two updates; 0 shows every text.
    """

    def __init__(self, unit: Callable[[float], str] = str, period: float = UPDATE_PERIOD_S) -> None:
        self._is_shown = sys.stderr.isatty() and verbosity.loudness >= 0
        self._due = 0.0
        self._unit = unit
        self._period = period
        self._bar: Bar | None = None

    def __call__(self, text: Callable[[], str], done: tuple[float, float] | None = None) -> None:
        """Show a text if an update is due.

        Args:
            text: returns the text; called only if an update is due.
            done: (completed amount, total amount) of work, to show a bar, the rate and the
                remaining time as well; None shows only the text.
        """
        if not self._is_shown or time.monotonic() < self._due:
            return
        self._due = time.monotonic() + self._period
        if self._bar is None:
            self._bar = _make_bar(is_measured=done is not None)
        (task,) = self._bar.tasks
        rate = f"{self._unit(task.speed)}/s" if task.speed else ""
        completed, total = done or (0, 0)
        self._bar.update(
            task.id,
            description=escape_controls(text()),
            completed=completed,
            total=total,
            rate=rate,
        )
        self._bar.start()
        self._bar.refresh()

    def run_task(self, task: Iterable[str], text: Callable[[], str]) -> None:
        """Run a task, print its remarks, and show progress while it runs.

        Args:
            task: an iterator that does the work step by step. It yields remarks to print; an empty
                remark only updates the progress.
            text: returns the text of the progress line.
        """
        for remark in task:
            self(text)
            if remark:
                self.note(remark)

    def note(self, remark: str) -> None:
        """Print a remark in place of the progress line."""
        self.clear()
        note(remark)

    def clear(self) -> None:
        """Remove the progress line."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None
            self._due = 0.0

    def __exit__(self, *_: object) -> None:
        self.clear()


def _make_bar(*, is_measured: bool) -> Bar:
    """Return a progress line of text, with a bar if the total is known."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress as Bar,
        TaskProgressColumn,
        TextColumn,
        TimeRemainingColumn,
    )
    from rich.table import Column

    text = TextColumn(
        "{task.description}", markup=False, table_column=Column(no_wrap=True, ratio=1)
    )
    rate = TextColumn("{task.fields[rate]}", markup=False)
    columns = (
        (
            (
                text,
                BarColumn(20),
                TaskProgressColumn(),
                rate,
                TimeRemainingColumn(compact=True),
            )
        )
        if is_measured
        else (text,)
    )
    bar = Bar(
        *columns, console=Console(stderr=True), transient=True, auto_refresh=False, expand=True
    )
    bar.add_task("", rate="")
    return bar


def format_size(number: float) -> str:
    """Format a number of bytes: "1.5 MB"."""
    if number < 1000:
        power = 0
    elif number < 1e6:
        power = 1
    elif number < 1e9:
        power = 2
    else:
        power = 3
    if not power:
        return f"{number:.0f} bytes"
    return f"{number / 1000**power:.1f} {'?kMG'[power]}B"


def emit(content: str | bytes, output: str | None) -> None:
    """Write text or bytes to standard output or to a file.

    Raises:
        SourceError: if the file cannot be written.
    """
    emit_parts([content], output)


def emit_parts(
    parts: Iterable[str | bytes], output: str | None, *, colour: bool | None = None
) -> None:
    """Write texts or bytes like `emit`, but each as soon as the iterator yields it.

    Args:
        parts: texts of one or more lines, or bytes.
        output: the file; None for standard output.
        colour: passed to `say`.
    """
    if output is None or output == "-":
        for part in parts:
            say(part, nl=isinstance(part, str), colour=colour)
        return
    # This imports the modules of scans, which only verbs that write a file need.
    from lidarspec.formats.common import replace_file

    path = Path(output)
    is_replaced = path.is_file() or not path.exists()  # False for a device or a pipe
    with (
        system_errors(output),
        replace_file(path) if is_replaced else contextlib.nullcontext(path) as written,
        written.open("wb") as file,
    ):
        for part in parts:
            file.write(part if isinstance(part, bytes) else f"{part}\n".encode())


def emit_json(value: Any, output: str | None) -> None:
    """Write a value as JSON, like `emit`."""
    emit(json.dumps(value, indent=2, allow_nan=False), output)


def emit_json_list(
    head: dict[str, Any], name: str, items: Iterable[Any], output: str | None
) -> None:
    """Write a JSON object that ends with a list, without storing the list.

    Args:
        head: the entries of the object before the list.
        name: the key of the list.
        items: yields the items of the list, which are written one after another.
        output: the file; None for standard output.
    """
    beginning = json.dumps({**head, name: []}, indent=2, allow_nan=False).removesuffix("]\n}")
    emit_parts(itertools.chain(_iter_items(beginning, items), ["  ]\n}"]), output)


def _iter_items(beginning: str, items: Iterable[Any]) -> Iterator[str]:
    """Yield each item as text, with a comma if another item follows."""
    held = beginning
    for number, item in enumerate(items):
        yield held + "," * bool(number)
        held = indent(json.dumps(item, indent=2, allow_nan=False), "    ")
    yield held


def table(headers: Sequence[str], rows: Sequence[Sequence[str]], output: str | None = None) -> str:
    """Format rows as aligned columns, fitted to the width of a terminal."""
    lines = [headers, *rows]
    if output is None and sys.stdout.isatty():
        room = shutil.get_terminal_size().columns
    else:
        room = sys.maxsize
    widths = _fit_widths(lines, room)
    full = max(len(line[-1]) for line in lines)
    hangs = (
        widths[-1] < min(full, MIN_PROSE_WIDTH)
        or sum(widths) + COLUMN_GAP * (len(widths) - 1) > room
    )
    if hangs:
        widths = _fit_widths([line[:-1] for line in lines], room)
    return "\n".join(text.rstrip() for line in lines for text in _fold_row(line, widths, room))


def _fit_widths(lines: Sequence[Sequence[str]], room: int) -> list[int]:
    """Return widths of columns that fit into `room` characters, if possible."""
    columns = list(zip(*lines, strict=True))
    widths = [max(map(len, cells)) for cells in columns]
    for index in sorted(range(len(columns)), key=lambda index: -widths[index]):
        excess = max(sum(widths) + COLUMN_GAP * (len(widths) - 1) - room, 0)
        word = max((len(word) for cell in columns[index] for word in cell.split()), default=0)
        widths[index] = max(word, widths[index] - excess)
    return widths


def _fold_row(line: Sequence[str], widths: Sequence[int], room: int) -> Iterator[str]:
    """Yield the lines of one row.

    If the row has more cells than `widths`, the remaining cells are on indented lines after it.
    """

    def wrap(cell: str, width: int) -> list[str]:
        if len(cell) > width:
            return textwrap.wrap(cell, width, break_long_words=False, break_on_hyphens=False)
        return [cell]

    cells = [wrap(cell, width) for cell, width in zip(line, widths, strict=False)]
    for parts in itertools.zip_longest(*cells, fillvalue=""):
        yield (" " * COLUMN_GAP).join(
            part.ljust(width) for part, width in zip(parts, widths, strict=True)
        )
    for cell in line[len(widths) :]:
        yield from (" " * PROSE_INDENT + text for text in wrap(cell, room - PROSE_INDENT) if text)


def render(what: Text) -> str:
    """Convert a text of the library rich to a string with colour codes."""
    from rich.console import Console

    console = Console()
    with console.capture() as captured:
        console.print(what, soft_wrap=True, highlight=False)
    return captured.get().rstrip("\n")
