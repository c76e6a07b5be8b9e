"""A terminal taken over for a while: the alternate screen, of which only the cells that changed are
written, and single keys.

rich would draw every cell of every picture anew, 50 times what changes; so pictures go out from
here, and rich serves for what is printed once. Keys come without waiting for a line: termios on
POSIX, msvcrt on Windows, behind one class.
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
from lidarspec.view.canvas import Cells, Depth, sgr

#: what the cursor keys send on POSIX, after escape, and on Windows, after a byte of their own.
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
#: a cursor key, the sequence of another one, or a character.
_KEY = re.compile(r"\x1b([\[O][A-D])|\x1b[\[O][^A-Za-z~]*.?|(.)", re.DOTALL)
_WINDOWS = {"H": "up", "P": "down", "M": "right", "K": "left"}
#: seconds between two looks at the keyboard on Windows, which has nothing to wait on.
_LOOK = 0.02
#: the alternate screen, no cursor, no wrapping at the edge; and all of it back.
ENTER = "\x1b[?1049h\x1b[?25l\x1b[?7l\x1b[2J"
LEAVE = "\x1b[?2026l\x1b[0m\x1b[?7h\x1b[?25h\x1b[?1049l"
#: the terminal holds a picture back until all of it is there, where it knows how to.
BEGIN = "\x1b[?2026h"
END = "\x1b[?2026l"
#: unchanged cells between two changed ones that are written along: moving the cursor costs as much.
BRIDGED = 4


class Keys:
    """A keyboard: a context manager that gives the terminal back as it was. This one has no keys,
    but time passes.
    """

    def read(self, timeout: float) -> list[str]:
        """The keys that came within some seconds: characters, "up" "down" "left" "right", "escape";
        empty where none did.
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
        """Give the terminal back."""


def decode_keys(text: str) -> list[str]:
    """The keys in what a POSIX terminal sent; sequences of other keys are left out."""
    keys = _KEY.finditer(text)
    return [
        _POSIX[key[1]] if key[1] else "escape" if key[2] == "\x1b" else key[2]
        for key in keys
        if key[1] or key[2]
    ]


if sys.platform == "win32":
    import msvcrt

    class Keyboard(Keys):
        """The console's keyboard."""

        def read(self, timeout: float) -> list[str]:
            """The keys that came within some seconds."""
            end = time.monotonic() + timeout
            while not msvcrt.kbhit() and time.monotonic() < end:
                time.sleep(_LOOK)
            found = []
            while msvcrt.kbhit():
                key = msvcrt.getwch()
                found.append(_WINDOWS.get(msvcrt.getwch(), "") if key in ("\x00", "\xe0") else key)
            if "\x03" in found:
                raise KeyboardInterrupt
            return [key for key in found if key]

    def keyboard(*, taken: bool = False) -> Keys:
        """The keyboard of the console; one without keys where there is none."""
        if sys.stdin.isatty() and not taken:
            return Keyboard()
        return Keys()

else:
    import termios
    import tty

    class Keyboard(Keys):
        """A terminal whose keys come one by one and unseen; Ctrl-C and Ctrl-Z stay signals."""

        def __init__(self, descriptor: int) -> None:
            self._descriptor = descriptor
            self._before = termios.tcgetattr(descriptor)

        def read(self, timeout: float) -> list[str]:
            """The keys that came within some seconds."""
            if not wait_readable(self._descriptor, timeout):
                return []
            data = os.read(self._descriptor, 1024)
            if not data:  # the terminal went away
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

    def keyboard(*, taken: bool = False) -> Keys:
        """The keyboard of the terminal; one without keys where there is none.

        Args:
            taken: standard input is the data: keys come from the terminal itself.
        """
        try:
            if sys.stdin.isatty() and not taken:
                return Keyboard(sys.stdin.fileno())
            return Keyboard(os.open("/dev/tty", os.O_RDONLY))
        except (OSError, ValueError, termios.error):
            return Keys()


class Terminated(BaseException):
    """A signal asks the process to end; what is open is closed on the way out.

    Attributes:
        code: the exit code that shells expect, 128 and the signal's number.
    """

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.code = 128 + number


def depth(stream: TextIO) -> Depth:
    """The colours that a terminal shows, by NO_COLOR, COLORTERM and TERM as rich reads them."""
    console = Console(file=stream)
    system = console.color_system
    if system is None or console.no_color:
        return "none"
    if system == "truecolor":
        return "truecolor"
    if system == "256":
        return "256"
    return "standard"


def encodable(stream: TextIO) -> bool:
    """Whether a stream takes braille characters."""
    try:
        "⣿▲│".encode(stream.encoding or "ascii")
    except (UnicodeEncodeError, LookupError):
        return False
    return True


class Screen:
    """A terminal's screen, as a context manager that leaves it as it was, whatever ends it.

    Also when the process is asked to end (SIGTERM, SIGHUP), and while it is suspended (SIGTSTP).
    """

    def __init__(self, stream: TextIO, keys: Keys) -> None:
        self._stream = stream
        self.keys = keys
        self._depth = depth(stream)
        self._plain = not encodable(stream)
        self._shown: Cells | None = None
        # how often the terminal was taken over: what was shown before is gone, also in the middle
        # of `show`
        self._taken = 0
        self._handlers: dict[int, Any] = {}

    def size(self) -> tuple[int, int]:
        """Columns and lines of the window as it is now."""
        found = os.get_terminal_size(self._stream.fileno())
        return max(found.columns, 1), max(found.lines, 1)

    def show(self, cells: Cells) -> None:
        """Put a picture on the screen."""
        if self._plain:
            cells = cells.ascii()
        taken = self._taken
        if self._shown is not None and self._shown.size == cells.size:
            before = self._shown
        else:
            before = None
        text = changes(before, cells, self._depth)
        if text:
            self._write(BEGIN + ("" if before is not None else "\x1b[0m\x1b[2J") + text + END)
        self._shown = cells if taken == self._taken else None

    def __enter__(self) -> Screen:
        self.keys.__enter__()
        if sys.platform == "win32":
            os.system("")  # switches the console over to escape sequences
        self._write(ENTER)
        for name, function in (("SIGTERM", _end), ("SIGHUP", _end), ("SIGTSTP", self._suspend)):
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
            pass  # the terminal is gone, and with it what was to be cleaned
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
        # past the stream's own buffer, which a signal in the middle of a write must not enter again
        data = text.encode(self._stream.encoding or "utf-8", "replace")
        while data:
            data = data[os.write(self._stream.fileno(), data) :]

    def _suspend(self, number: int, frame: FrameType | None) -> None:
        """Give the terminal back, sleep until the shell wakes us, and take it again."""
        self._write(LEAVE)
        self.keys.__exit__(None, None, None)
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
        signal.signal(number, self._suspend)
        self.keys.__enter__()
        self._write(ENTER)
        self._shown = None
        self._taken += 1


def changes(before: Cells | None, after: Cells, depth: Depth) -> str:
    """What to write to a terminal that shows `before` for it to show `after`; None is an empty
    screen.
    """
    if before is not None:
        old = before
    else:
        old = Cells.blank(*after.size)
    changed = (old.codes != after.codes) | (old.inks != after.inks)
    parts: list[str] = []
    ink = -1
    for row in np.flatnonzero(changed.any(axis=1)).tolist():
        columns = np.flatnonzero(changed[row])
        starts = np.flatnonzero(np.diff(columns, prepend=-BRIDGED - 2) > BRIDGED)
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


def _end(number: int, frame: FrameType | None) -> None:
    raise Terminated(number)


def interactive() -> bool:
    """Whether there is a screen to take over."""
    return sys.stdout.isatty() and os.environ.get("TERM") != "dumb"
