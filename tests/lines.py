"""Pseudo terminals that can be unplugged, and senders at a fixed rate."""

from __future__ import annotations

import contextlib
import os
import socket
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from lidarspec import Device, Sensor

#: seconds after which a test fails if an event has not come: many, since the machine may be slow or
#: busy.
TIMEOUT_S = 60.0
#: how much later than promised something may happen while the machine is busy.
SLACK = 5.0


class Port:
    """A serial port: a pseudo-terminal with a name, which is removed on unplugging."""

    def __init__(self, name: Path) -> None:
        self.name, self._master, self._slave = name, -1, -1
        self.plug()

    def plug(self) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.name.symlink_to(os.ttyname(self._slave))

    def unplug(self) -> None:
        self.name.unlink()
        os.close(self._slave)
        os.close(self._master)
        self._master = -1

    def send(self, data: bytes) -> None:
        os.write(self._master, data)

    def offer(self, data: bytes) -> None:
        """Send as many bytes as fit; the rest is lost, as on a port without a reader."""
        os.set_blocking(self._master, False)
        with contextlib.suppress(BlockingIOError):
            os.write(self._master, data)
        os.set_blocking(self._master, True)

    def discard(self) -> None:
        """Discard the bytes that the program has not read, so that it can send more."""
        termios.tcflush(self._slave, termios.TCIFLUSH)

    def receive(self, size: int) -> bytes:
        """Return the next bytes that the program wrote."""
        found = b""
        while len(found) < size:
            found += os.read(self._master, size - len(found))
        return found

    def close(self) -> None:
        if self._master >= 0:
            self.unplug()


@contextlib.contextmanager
def port(folder: Path) -> Iterator[Port]:
    made = Port(folder / "ttyTEST")
    try:
        yield made
    finally:
        made.close()


@contextlib.contextmanager
def working(function: Callable[[threading.Event], None]) -> Iterator[threading.Event]:
    """Run a function in a thread; the function receives an event that stops it."""
    stop = threading.Event()
    thread = threading.Thread(target=function, args=(stop,))
    thread.start()
    try:
        yield stop
    finally:
        stop.set()
        thread.join()


def send_paced(
    send: Callable[[bytes], object],
    frames: Sequence[bytes],
    rate: float,
    stop: threading.Event,
    tick: float = 0.002,
) -> int:
    """Send frames at a rate, repeatedly, until `stop` is set; return their number.

    The frames are sent in groups every `tick` seconds.
    """
    began, sent = time.monotonic(), 0
    while not stop.is_set():
        due = int((time.monotonic() - began) * rate)
        for index in range(sent, due):
            send(frames[index % len(frames)])
        sent = max(sent, due)
        time.sleep(tick)
    return sent


def until(condition: Callable[[], object], seconds: float = TIMEOUT_S) -> float:
    """Wait for a condition; return the seconds, and fail after the timeout."""
    began = time.monotonic()
    while not condition():
        assert time.monotonic() - began < seconds, "it did not happen in time"
        time.sleep(0.005)
    return time.monotonic() - began


def read_until(device: Device, condition: Callable[[], object]) -> None:
    """Read a live device until a condition holds; fail if it does not become true."""

    def read_and_check() -> object:
        device.newest(0.01)
        return condition()

    until(read_and_check)


@contextlib.contextmanager
def udp(host: str = "127.0.0.1") -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as made:
        made.bind((host, 0))
        yield made


def free_port() -> int:
    """Return an unused UDP port."""
    with udp() as made:
        number: int = made.getsockname()[1]
        return number


def _values(sensor: str, index: int) -> dict[str, Any]:
    """Return the values of the packet with this number."""
    match sensor:
        case "shape-clock":  # 40 packets a scan
            return {
                "seconds": index // 400 % 60,
                "ticks": index % 400 * 25,
                "distances": [1000 + index % 500] * 4,
            }
        case "shape-commands":  # 18 packets a turn
            return {"angle": index * 2000 % 36000, "distances": [1000 + index % 500] * 3}
        case _:
            block = {
                "azimuth": index * 100 % 36000,
                "channels": [{"distance": 400, "intensity": 7}] * 3,
            }
            return {"number": 1 + index % 200, "reserved": bytes(3), "blocks": [block] * 4}


def turning(sensor: Sensor, number: int) -> list[bytes]:
    """Return the first data frames of a shape for live tests, while it rotates.

    The shape is clock, commands or datagrams.
    """
    return [sensor.build("data", **_values(sensor.id, index)) for index in range(number)]
