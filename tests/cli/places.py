"""Sources without a working sensor: real ports and sockets with a fault.

Each function is a context manager that yields its SOURCE.
"""

from __future__ import annotations

import contextlib
import os
import socket
import threading
from collections.abc import Iterator

import click

from lidarspec.cli.root import VERBS, main
from tests.lines import working


@contextlib.contextmanager
def nothing() -> Iterator[str]:
    """Yield a source that does not exist."""
    yield "/dev/ttyUSB99"


@contextlib.contextmanager
def silent() -> Iterator[str]:
    """Yield a port without data."""
    master, slave = os.openpty()
    try:
        yield os.ttyname(slave)
    finally:
        os.close(master)
        os.close(slave)


@contextlib.contextmanager
def babbling() -> Iterator[str]:
    """Yield a port that sends bytes without valid frames."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as server:
        server.bind(("127.0.0.1", 0))
        server.listen()
        server.settimeout(0.02)
        with working(lambda stop: _babble(server, stop)):
            yield f"tcp://127.0.0.1:{server.getsockname()[1]}"


def _babble(server: socket.socket, stop: threading.Event) -> None:
    """Send bytes to each client, one client after another, until it disconnects."""
    while not stop.is_set():
        with contextlib.suppress(OSError):
            line, _ = server.accept()
            with line:
                while not stop.wait(0.01):
                    line.sendall(b"no lidar was there")


@contextlib.contextmanager
def busy() -> Iterator[str]:
    """Yield a port that another process has open."""
    import serial

    with silent() as path, serial.Serial(path, exclusive=True):
        yield path


@contextlib.contextmanager
def taken() -> Iterator[str]:
    """Yield an address that another socket is bound to."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        yield f"udp://127.0.0.1:{other.getsockname()[1]}"


@contextlib.contextmanager
def find_unused_address() -> Iterator[str]:
    """Return an address without a listener."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as other:
        other.bind(("127.0.0.1", 0))
        yield f"tcp://127.0.0.1:{other.getsockname()[1]}"


@contextlib.contextmanager
def nobody() -> Iterator[None]:
    """Drop root permissions, which allow reading every file.

    The verbs are imported before, because only root may be able to read their folders.
    """
    for verb in VERBS:
        main.get_command(click.Context(main), verb)
    user = os.geteuid()
    if user == 0:
        os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(user)


@contextlib.contextmanager
def forbidden() -> Iterator[str]:
    """Yield a port that this user may not open."""
    with silent() as path:
        os.chmod(path, 0)
        with nobody():
            yield path
