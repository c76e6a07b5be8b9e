"""Show pictures on the alternate screen of a terminal, and read single keys.

Only changed cells are written. The library rich, which writes all cells, is not used.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import sys
import time
from types import FrameType, TracebackType
from typing import Any, Self, TextIO

import numpy as np
from rich.console import Console

from lidarspec.transports.base import wait_readable
from lidarspec.view.canvas import CellGrid, Depth, sgr

#: code of a cursor key after escape, on POSIX -> its name.
_POSIX = {
    "[A": "up",
    "[B": "down",
    "[C": "right",
    "[D": "left",
    "OA": "up",
    "OB": "down",
    "OC": "right",
    "OD": "left",
}
#: matches a cursor key, the sequence of an unknown key, or a character.
_KEY = re.compile(r"\x1b([\[O][A-D])|\x1b[\[O][^A-Za-z~]*.?|(.)", re.DOTALL)
#: code of a cursor key after a prefix byte, on Windows -> its name.
_WINDOWS = {"H": "up", "P": "down", "M": "right", "K": "left"}
#: time between two checks of the keyboard on Windows, which has no function to wait for a key with
#: a timeout.
_POLL_S = 0.02
#: escape sequences that switch to the alternate screen, without cursor and line wrapping, and
#: escape sequences that restore the terminal.
ENTER = "\x1b[?1049h\x1b[?25l\x1b[?7l\x1b[2J"
LEAVE = "\x1b[?2026l\x1b[0m\x1b[?7h\x1b[?25h\x1b[?1049l"
#: escape sequences before and after a picture. Between them, terminals do not update the screen.
BEGIN = "\x1b[?2026h"
END = "\x1b[?2026l"
#: up to this number of unchanged cells between two changed cells are written as well, because
#: moving the cursor over them would need as many bytes.
MAX_BRIDGED_CELLS = 4


class KeyReader:
    """Reads keys; a context manager that restores the settings of the terminal on exit.

    This base class is used if there is no keyboard: `read` only waits and returns no key.
    """

    def read(self, timeout: float) -> list[str]:
        """Wait for a key for at most `timeout` seconds, and return the pressed keys.

        Returns:
            Characters, "up", "down", "left", "right" and "escape"; empty if no key was pressed.
        """
        time.sleep(timeout)
        return []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Restore the terminal."""


def decode_keys(text: str) -> list[str]:
    """Return the keys in the input from a POSIX terminal; unknown keys are omitted."""
    keys = _KEY.finditer(text)
    return [
        _POSIX[key[1]] if key[1] else "escape" if key[2] == "\x1b" else key[2]
        for key in keys
        if key[1] or key[2]
    ]


if sys.platform == "win32":
    import msvcrt

    class Keyboard(KeyReader):
        """The console's keyboard."""

        def read(self, timeout: float) -> list[str]:
            """Return the keys pressed within some seconds."""
            end = time.monotonic() + timeout
            while not msvcrt.kbhit() and time.monotonic() < end:
                time.sleep(_POLL_S)
            keys = []
            while msvcrt.kbhit():
                key = msvcrt.getwch()
                keys.append(_WINDOWS.get(msvcrt.getwch(), "") if key in ("\x00", "\xe0") else key)
            if "\x03" in keys:
                raise KeyboardInterrupt
            return [key for key in keys if key]

    def keyboard(*, stdin_is_data: bool = False) -> KeyReader:
        """Return the keyboard of the console, or `KeyReader()` if there is none."""
        if sys.stdin.isatty() and not stdin_is_data:
            return Keyboard()
        return KeyReader()

else:
    import termios
    import tty

    class Keyboard(KeyReader):
        """Reads single keys of a terminal; Ctrl-C and Ctrl-Z still send signals."""

        def __init__(self, descriptor: int) -> None:
            self._descriptor = descriptor
            self._before = termios.tcgetattr(descriptor)

        def read(self, timeout: float) -> list[str]:
            """Return the keys pressed within some seconds."""
            if not wait_readable(self._descriptor, timeout):
                return []
            data = os.read(self._descriptor, 1024)
            if not data:  # the terminal was closed
                raise EOFError("the terminal was closed")
            return decode_keys(data.decode("utf-8", "replace"))

        def __enter__(self) -> Self:
            tty.setcbreak(self._descriptor, termios.TCSANOW)
            return self

        def __exit__(
            self,
            kind: type[BaseException] | None,
            error: BaseException | None,
            traceback: TracebackType | None,
        ) -> None:
            with contextlib.suppress(termios.error):
                termios.tcsetattr(self._descriptor, termios.TCSANOW, self._before)

    def keyboard(*, stdin_is_data: bool = False) -> KeyReader:
        """Return the keyboard of the terminal, or `KeyReader()` if there is none.

        Args:
            stdin_is_data: whether standard input is the data, so that keys are read from /dev/tty.
        """
        try:
            if sys.stdin.isatty() and not stdin_is_data:
                return Keyboard(sys.stdin.fileno())
            return Keyboard(os.open("/dev/tty", os.O_RDONLY))
        except (OSError, ValueError, termios.error):
            return KeyReader()


class TerminatedError(BaseException):
    """Raised if a signal ends the process, so that resources are closed.

    Attributes:
        code: the exit code for shells: 128 plus the number of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.code = 128 + number


def find_colour_depth(stream: TextIO) -> Depth:
    """Return the colour depth of a terminal."""
    console = Console(file=stream)
    system = console.color_system
    if system is None or console.no_color:
        return "none"
    if system == "truecolor":
        return "truecolor"
    if system == "256":
        return "256"
    return "standard"


def supports_braille(stream: TextIO) -> bool:
    """Return whether a stream supports braille characters."""
    try:
        "⣿▲│".encode(stream.encoding or "ascii")
    except (UnicodeEncodeError, LookupError):
        return False
    return True


class Screen:
    """The screen of a terminal; a context manager that restores the terminal."""

    def __init__(self, stream: TextIO, keys: KeyReader) -> None:
        self._stream = stream
        self.keys = keys
        self._depth = find_colour_depth(stream)
        self._plain = not supports_braille(stream)
        self._shown: CellGrid | None = None
        # Number of times that the alternate screen was entered again, which clears it. A signal
        # handler may do this during `show`.
        self._taken = 0
        self._handlers: dict[int, Any] = {}

    def size(self) -> tuple[int, int]:
        """Return the numbers of columns and lines of the terminal."""
        window = os.get_terminal_size(self._stream.fileno())
        return max(window.columns, 1), max(window.lines, 1)

    def show(self, cells: CellGrid) -> None:
        """Show a picture on the screen."""
        if self._plain:
            cells = cells.ascii()
        taken = self._taken
        if self._shown is not None and self._shown.size == cells.size:
            before = self._shown
        else:
            before = None
        text = encode_changes(before, cells, self._depth)
        if text:
            self._write(BEGIN + ("" if before is not None else "\x1b[0m\x1b[2J") + text + END)
        self._shown = cells if taken == self._taken else None

    def __enter__(self) -> Screen:
        self.keys.__enter__()
        if sys.platform == "win32":
            os.system("")  # enables escape sequences in the console
        self._write(ENTER)
        for name, function in (
            ("SIGTERM", _raise_terminated),
            ("SIGHUP", _raise_terminated),
            ("SIGTSTP", self._suspend),
        ):
            number = getattr(signal, name, None)
            if number is not None:
                self._handlers[number] = signal.signal(number, function)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            self._write(LEAVE)
        except OSError:
            pass  # the terminal is closed, so it need not be restored
        finally:
            self.keys.__exit__(kind, error, traceback)
            for number, handler in self._handlers.items():
                signal.signal(number, handler)
            self._handlers.clear()

    def _write(self, text: str) -> None:
        if sys.platform == "win32":
            self._stream.write(text)
            self._stream.flush()
            return
        # Write without the buffer of the stream, because a signal handler may run during a write
        # and must not use the buffer then.
        data = text.encode(self._stream.encoding or "utf-8", "replace")
        while data:
            data = data[os.write(self._stream.fileno(), data) :]

    def _suspend(self, number: int, frame: FrameType | None) -> None:
        """Restore the terminal and suspend the process; enter the screen again afterwards."""
        self._write(LEAVE)
        self.keys.__exit__(None, None, None)
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
        signal.signal(number, self._suspend)
        self.keys.__enter__()
        self._write(ENTER)
        self._shown = None
        self._taken += 1


def encode_changes(before: CellGrid | None, after: CellGrid, depth: Depth) -> str:
    """Return the escape sequences and text that change the shown picture.

    Args:
        before: the shown picture; None for an empty screen.
        depth: the colour depth of the terminal.
    """
    if before is not None:
        old = before
    else:
        old = CellGrid.blank(*after.size)
    changed = (old.codes != after.codes) | (old.inks != after.inks)
    parts: list[str] = []
    ink = -1
    for row in np.flatnonzero(changed.any(axis=1)).tolist():
        columns = np.flatnonzero(changed[row])
        starts = np.flatnonzero(
            np.diff(columns, prepend=-MAX_BRIDGED_CELLS - 2) > MAX_BRIDGED_CELLS
        )
        for first, last in zip(
            columns[starts].tolist(),
            columns[np.append(starts[1:], len(columns)) - 1].tolist(),
            strict=True,
        ):
            parts.append(f"\x1b[{row + 1};{first + 1}H")
            codes = after.codes[row, first : last + 1].tolist()
            inks = after.inks[row, first : last + 1].tolist()
            for code, chosen in zip(codes, inks, strict=True):
                if chosen != ink:
                    parts.append(sgr(chosen, depth))
                    ink = chosen
                parts.append(chr(code))
    return "".join(parts)


def _raise_terminated(number: int, frame: FrameType | None) -> None:
    raise TerminatedError(number)


def is_interactive() -> bool:
    """Return whether standard output is a terminal that can move its cursor."""
    return sys.stdout.isatty() and os.environ.get("TERM") != "dumb"
