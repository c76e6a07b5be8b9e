"""A pseudo-terminal as the serial port of a simulated sensor: POSIX only."""

from __future__ import annotations

import contextlib
import os
import select
import termios
import time
import tty
from collections.abc import Sequence
from pathlib import Path

from lidarspec.errors import UsageError
from lidarspec.spec import Sensor
from lidarspec.transports.doors import BLOCK, Sending
from lidarspec.transports.live import POLL, failure, reason

#: bytes that wait for a slow reader; a real adapter holds no more.
BACKLOG = 1 << 18
#: seconds between two looks at whether somebody has opened the port.
UNHEARD = 0.005


class PtyDoor:
    """A serial port that programs open by its path; bytes sent while nobody has it open are lost, as on a wire.

    Args:
        link: a symbolic link that leads to it, and comes and goes with it.

    Attributes:
        path: of the port itself, which is another one after each `plug`.
        heard: whether somebody has it open.
        unsent: bytes that nobody took in time.

    Raises:
        SourceError: where there is none to be had, or the link cannot be made.
    """

    def __init__(self, sensor: Sensor, link: str | Path | None = None) -> None:
        if sensor.datagrams:
            raise UsageError(f"{sensor.id} sends datagrams, which a serial port cannot carry: simulate it to udp://127.0.0.1")
        self._link = Path(link) if link is not None else None
        self._master, self.path, self.unsent = -1, "", 0
        self.heard = False
        self._waiting = bytearray()
        self.plug()

    @property
    def where(self) -> str:
        """The path to open."""
        return str(self._link or self.path)

    def plug(self) -> None:
        """Make the port, in raw mode, with nobody on it."""
        try:
            self._master, slave = os.openpty()
        except OSError as error:
            raise failure(f"no pseudo-terminal can be had: {reason(error)}", "lidarspec sim SENSOR --to tcp://127.0.0.1:2111") from None
        self.path = os.ttyname(slave)
        tty.setraw(slave)
        os.close(slave)
        os.set_blocking(self._master, False)
        self.heard = False
        if self._link is not None:
            self._make_link(self._link)

    def unplug(self) -> None:
        """Hang up, and take the link away."""
        if self._link is not None and self._link.is_symlink() and os.readlink(self._link) == self.path:
            self._link.unlink()
        if self._master >= 0:
            os.close(self._master)
        self._master = -1
        self._waiting.clear()

    def close(self) -> None:
        self.unplug()

    def receive(self, wait: float) -> list[tuple[str, bytes]]:
        if self._master < 0:
            time.sleep(wait)
            return []
        if not self.heard:
            time.sleep(min(wait, UNHEARD))
        elif not any(select.select([self._master], [self._master] if self._waiting else [], [], wait)):
            return []
        self._flush()
        try:
            data = os.read(self._master, BLOCK)
        except BlockingIOError:
            self.heard = True
            return []
        except OSError:
            data = b""
        if not data:
            self._left()
            return []
        self.heard = True
        return [("data", data)]

    def send(self, sendings: Sequence[Sending], *, patient: bool) -> None:
        data = b"".join(data for _, _, data in sendings)
        if not self.heard or (len(self._waiting) + len(data) > BACKLOG and not patient):
            self.unsent += len(data)
            return
        self._waiting += data
        self._flush()
        while patient and self._waiting and self.heard:
            select.select([], [self._master], [], POLL)
            self._flush()

    def _flush(self) -> None:
        """Write what the reader has room for; where nobody is there any more, what waits is lost."""
        while self._waiting:
            try:
                del self._waiting[: os.write(self._master, self._waiting)]
            except BlockingIOError:
                return
            except OSError:
                self._left()

    def _left(self) -> None:
        """Whoever had it open has gone: what was meant for him is not for the next one."""
        self.unsent += len(self._waiting)
        self._waiting.clear()
        if self.heard:
            self.heard = False
            with contextlib.suppress(OSError, termios.error):
                descriptor = os.open(self.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
                termios.tcflush(descriptor, termios.TCIFLUSH)
                os.close(descriptor)

    def _make_link(self, link: Path) -> None:
        try:
            if link.is_symlink() and not link.exists():
                link.unlink()
            link.symlink_to(self.path)
        except OSError as error:
            self._link = None
            self.unplug()
            raise failure(f"{link}: the link cannot be made: {reason(error)}", f"ls -l {link}") from None
