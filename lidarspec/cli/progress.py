"""One line on a terminal that says how far a verb is; elsewhere nothing."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable

#: seconds between two lines.
PERIOD = 0.2


class Progress:
    """The line, on standard error; a context manager that takes it away at the end."""

    def __init__(self) -> None:
        self._is_shown = sys.stderr.isatty()
        self._due, self._width = 0.0, 0

    def __call__(self, text: Callable[[], str]) -> None:
        """Show a text, made only where it is time for one."""
        if not self._is_shown or time.monotonic() < self._due:
            return
        self._due = time.monotonic() + PERIOD
        line = text()[: shutil.get_terminal_size().columns - 1]
        self._write(f"\r{line.ljust(self._width)}")
        self._width = len(line)

    def clear(self) -> None:
        """Take the line away, so that something else can be said."""
        if self._width:
            self._write(f"\r{' ' * self._width}\r")
            self._width, self._due = 0, 0.0

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self.clear()

    def _write(self, text: str) -> None:
        sys.stderr.write(text)
        sys.stderr.flush()


def size(number: float) -> str:
    """Bytes in words: "1.5 MB"."""
    power = 0 if number < 1000 else 1 if number < 1e6 else 2 if number < 1e9 else 3
    return f"{number:.0f} bytes" if not power else f"{number / 1000**power:.1f} {'?kMG'[power]}B"
