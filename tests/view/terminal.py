"""Run a program in a real pseudo terminal, and keep its screen according to ECMA-48."""

from __future__ import annotations

import fcntl
import os
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

#: seconds that anything may take; five times what it does on a slow machine.
DEADLINE = 30.0
_PIECES = re.compile(r"\x1b\[(\d+);(\d+)H|\x1b\[\??([0-9;]*)([A-Za-z])|([\r\n])|([^\x1b\r\n])")


class Terminal:
    """A program, by default ``lidarspec``, in a terminal window; a context manager.

    Attributes:
        modes: private modes that are set: 1049 (alternate screen), 25 (cursor) and others.
    """

    def __init__(
        self,
        *words: object,
        program: Sequence[str] = (),
        columns: int = 80,
        lines: int = 24,
        cwd: Path | None = None,
        **environment: str,
    ) -> None:
        self._master, slave = os.openpty()
        self.resize(columns, lines, notify=False)
        self.before = termios.tcgetattr(slave)
        self._slave = slave
        names = {
            **os.environ,
            "TERM": "xterm-256color",
            "NO_COLOR": "",
            "COLORTERM": "",
            **environment,
        }
        command = [
            sys.executable,
            "-c",
            _MAIN,
            *(program or [sys.executable, "-m", "lidarspec"]),
            *map(str, words),
        ]
        self.process = subprocess.Popen(
            command,
            stdin=slave,
            stdout=slave,
            stderr=slave,
            cwd=cwd,
            env=names,
            start_new_session=True,
        )
        self.raw, self.modes = "", {"25", "7"}
        self._rest = b""

    def resize(self, columns: int, lines: int, *, notify: bool = True) -> None:
        """Change the size of the window and clear its text."""
        fcntl.ioctl(self._master, termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))
        self.grid = [[" "] * columns for _ in range(lines)]
        self._place, self._kept = (0, 0), (0, 0)
        if notify:
            self.process.send_signal(signal.SIGWINCH)

    def type(self, keys: str) -> None:
        """Press keys."""
        os.write(self._master, keys.encode())

    def text(self) -> str:
        """Return the text on the screen."""
        while self._read(0.0):
            pass
        return "\n".join("".join(row).rstrip() for row in self.grid)

    def wait_for(self, text: str) -> str:
        """Wait until the screen shows a text; return the screen."""
        end = time.monotonic() + DEADLINE
        while text not in (shown := self.text()):
            assert time.monotonic() < end, f"{text!r} is not shown:\n{shown}"
            self._read(0.05)
        return shown

    def wait_until_end(self) -> int:
        """Wait until the program exits; return the exit code."""
        end = time.monotonic() + DEADLINE
        while self.process.poll() is None:
            assert time.monotonic() < end, "it does not end"
            self._read(0.02)
        self.text()
        return self.process.returncode

    def wait_until_loaded(self) -> None:
        """Wait until the program has imported its modules and sleeps.

        On systems without this information, wait for a fixed time.
        """
        end, asleep = time.monotonic() + DEADLINE, 0
        while asleep < 5 and self.process.poll() is None and time.monotonic() < end:
            try:
                maps = Path(f"/proc/{self.process.pid}/maps").read_text(encoding="utf-8")
                state = (
                    Path(f"/proc/{self.process.pid}/stat")
                    .read_text(encoding="utf-8")
                    .rpartition(") ")[2]
                )
            except OSError:
                maps = state = ""
                end = min(end, time.monotonic() + 3)
            # A process that is still loading runs, or waits for the disk.
            asleep += "_multiarray_umath" in maps and state.startswith("S")
            self._read(0.02)

    def is_as_before(self) -> bool:
        """Return whether the terminal's modes are as before the program began."""
        self.text()
        return self.modes == {"25", "7"} and termios.tcgetattr(self._slave) == self.before

    def is_clean(self) -> bool:
        """Return whether the terminal is restored.

        Restored are the main screen, cursor, wrapping, colours and the echo of lines.
        """
        self.text()
        now = termios.tcgetattr(self._slave)
        return (
            self.modes == {"25", "7"}
            and now == self.before
            and self.raw.rpartition("\x1b[?1049l")[0].endswith("\x1b[0m\x1b[?7h\x1b[?25h")
        )

    def __enter__(self) -> Terminal:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self._master)
        os.close(self._slave)

    def _read(self, timeout: float) -> bool:
        ready, _, _ = select.select([self._master], [], [], timeout)
        if not ready:
            return False
        data = self._rest + os.read(self._master, 1 << 16)
        whole = len(data)
        begun = data.rfind(b"\x1b")
        # The escape sequence continues in the next piece.
        if begun >= 0 and not data[begun:].rstrip(b"0123456789;?[\x1b")[:1]:
            whole = begun
        while whole and data[whole - 1] >= 0x80 and not _decodes(data[:whole]):
            whole -= 1
        text, self._rest = data[:whole].decode("utf-8", "replace"), data[whole:]
        self.raw += text
        for piece in _PIECES.finditer(text):
            self._take(piece)
        return True

    def _take(self, piece: re.Match[str]) -> None:
        at_row, at_column, numbers, letter, control, character = piece.groups()
        row, column = self._place
        if at_row:
            self._place = int(at_row) - 1, int(at_column) - 1
        elif letter in ("h", "l"):
            (self.modes.add if letter == "h" else self.modes.discard)(numbers)
            # The alternate screen. Only the cursor of the main screen is kept, not its text.
            if numbers == "1049":
                self.grid = [[" "] * len(line) for line in self.grid]
                self._place, self._kept = self._kept, self._place
        elif letter == "A":
            self._place = row - int(numbers), column
        elif letter == "K" and row < len(self.grid):
            self.grid[row] = [" "] * len(self.grid[row])
        elif letter == "J":
            self.grid = [[" "] * len(line) for line in self.grid]
        elif control == "\n" and row == len(self.grid) - 1:
            self.grid = [*self.grid[1:], [" "] * len(self.grid[0])]
        elif control:
            self._place = (row + 1, column) if control == "\n" else (row, 0)
        elif character and row < len(self.grid) and column < len(self.grid[0]):
            self.grid[row][column] = character
            self._place = row, column + 1


def _decodes(data: bytes) -> bool:
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return False
    return True


#: makes the pty the terminal of the session, then runs a program in it; a test run in the
#: background of a shell has interrupts switched off, and its children would inherit that.
_MAIN = """
import fcntl, os, signal, sys, termios
signal.signal(signal.SIGINT, signal.SIG_DFL)
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
os.execvp(sys.argv[1], sys.argv[1:])
"""
