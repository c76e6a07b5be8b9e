"""Single keys from a terminal, without waiting for a line: termios on POSIX, msvcrt on Windows, behind one class."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from types import TracebackType
from typing import Protocol

#: what the cursor keys send on POSIX, after escape, and on Windows, after a byte of their own.
_POSIX = {"[A": "up", "[B": "down", "[C": "right", "[D": "left", "OA": "up", "OB": "down", "OC": "right", "OD": "left"}
_WINDOWS = {"H": "up", "P": "down", "M": "right", "K": "left"}
#: seconds between two looks at the keyboard on Windows, which has nothing to wait on.
_LOOK = 0.02


class Keys(Protocol):
    """A keyboard: a context manager that gives the terminal back as it was."""

    def read(self, timeout: float) -> list[str]:
        """The keys that came within some seconds: characters, "up" "down" "left" "right", "escape"; empty where none did."""

    def __enter__(self) -> Keys: ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None: ...


class NoKeys:
    """Where there is no keyboard, time still passes."""

    def read(self, timeout: float) -> list[str]:
        time.sleep(timeout)
        return []

    def __enter__(self) -> NoKeys:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        pass


def decoded(text: str) -> list[str]:
    """The keys in what a POSIX terminal sent; sequences of other keys are left out."""
    found: list[str] = []
    while text:
        if text[0] != "\x1b":
            found.append(text[0])
            text = text[1:]
        elif text[1:3] in _POSIX:
            found.append(_POSIX[text[1:3]])
            text = text[3:]
        elif text[1:2] in ("[", "O"):
            end = next((place for place, character in enumerate(text[2:], 2) if character.isalpha() or character == "~"), len(text))
            text = text[end + 1 :]
        else:
            found.append("escape")
            text = text[1:]
    return found


if sys.platform == "win32":
    import msvcrt

    class Keyboard:
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

        def __enter__(self) -> Keyboard:
            return self

        def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
            pass

    def keyboard(*, taken: bool = False) -> Keys:
        """The keyboard of the console; one without keys where there is none."""
        return Keyboard() if sys.stdin.isatty() and not taken else NoKeys()

else:
    import select
    import termios
    import tty

    class Keyboard:
        """A terminal whose keys come one by one and unseen; Ctrl-C and Ctrl-Z stay signals."""

        def __init__(self, descriptor: int) -> None:
            self._descriptor = descriptor
            self._before = termios.tcgetattr(descriptor)

        def read(self, timeout: float) -> list[str]:
            """The keys that came within some seconds."""
            ready, _, _ = select.select([self._descriptor], [], [], timeout)
            if not ready:
                return []
            data = os.read(self._descriptor, 1024)
            if not data:  # the terminal went away
                raise EOFError("the terminal was closed")
            return decoded(data.decode("utf-8", "replace"))

        def __enter__(self) -> Keyboard:
            tty.setcbreak(self._descriptor, termios.TCSANOW)
            return self

        def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
            with contextlib.suppress(termios.error):
                termios.tcsetattr(self._descriptor, termios.TCSANOW, self._before)

    def keyboard(*, taken: bool = False) -> Keys:
        """The keyboard of the terminal; one without keys where there is none.

        Args:
            taken: standard input is the data: keys come from the terminal itself.
        """
        try:
            return Keyboard(sys.stdin.fileno()) if sys.stdin.isatty() and not taken else Keyboard(os.open("/dev/tty", os.O_RDONLY))
        except (OSError, ValueError, termios.error):
            return NoKeys()
