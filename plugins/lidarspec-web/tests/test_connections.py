"""Tests of connections without the token: idle, slow, and too many of them."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from lidarspec_web import connections
from lidarspec_web.connections import ErrorReporter

from .pages import DEADLINE, FLAT, Station

FEW = 8
MANY = 5 * FEW


@pytest.fixture
def station(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Station]:
    """Yield a server with a low limit of connections."""
    monkeypatch.setattr(connections, "MAX_CONNECTIONS", FEW)
    with Station(f"sim:{FLAT}", tmp_path) as station:
        yield station


def connect(station: Station) -> socket.socket:
    return socket.create_connection(("127.0.0.1", station.port), DEADLINE)


def is_closed(connection: socket.socket) -> bool:
    """Return whether the server has closed a connection without a request."""
    connection.setblocking(False)
    try:
        return connection.recv(1) == b""
    except BlockingIOError:
        return False
    except ConnectionError:
        return True


def wait_until_closed(opened: list[socket.socket], count: int) -> None:
    end = time.monotonic() + DEADLINE
    while sum(map(is_closed, opened)) < count:
        assert time.monotonic() < end, "connections are not closed"
        time.sleep(0.01)


def test_idle_connections_make_way_for_a_page(station: Station) -> None:
    with contextlib.ExitStack() as stack, station.page() as before:
        opened = [stack.enter_context(connect(station)) for _ in range(MANY)]
        wait_until_closed(opened, MANY - FEW + 1)
        assert not all(map(is_closed, opened))
        assert station.request("/")[0] == 200
        with station.page() as after:
            for page in (before, after):
                assert page.scan()[1]["x"].size
    told = [text for text in station.said if not text.startswith("page ")]
    assert told == [
        "there are more than 8 connections; for each new connection, the oldest connection without"
        " the token is closed"
    ]


def test_pages_do_not_make_way(station: Station) -> None:
    """If all connections are pages, a further one is closed at once."""
    with contextlib.ExitStack() as stack:
        pages = [stack.enter_context(station.page()) for _ in range(FEW)]
        for page in pages:
            page.scan()
        wait_until_closed([stack.enter_context(connect(station))], 1)
        for page in pages:
            assert page.scan()[1]["x"].size
    with station.page() as page:  # there is room again
        assert page.scan()[1]["x"].size


@pytest.mark.parametrize("sent", [b"", b"G", b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-A: "])
def test_a_connection_without_the_token_ends(
    station: Station, monkeypatch: pytest.MonkeyPatch, sent: bytes
) -> None:
    """Both if it sends nothing, and if it sends a header without an end, byte by byte."""
    with station.page() as page, connect(station) as slow:
        page.scan()
        monkeypatch.setattr(connections, "TOKEN_TIMEOUT_S", 0.0)
        monkeypatch.setattr(connections, "CHECK_PERIOD_S", 0.01)
        end = time.monotonic() + DEADLINE
        with contextlib.suppress(ConnectionError):
            while not is_closed(slow):
                assert time.monotonic() < end, "it is not closed"
                slow.send(sent[:1] or b"")
                time.sleep(0.01)
        assert page.scan()[1]["x"].size


def test_errors_of_the_event_loop_are_one_line_each() -> None:
    told = list[str]()
    loop = asyncio.new_event_loop()
    try:
        loop.set_exception_handler(ErrorReporter(told.append))
        for _ in range(3):
            context = {
                "message": "socket.accept() failed",
                "exception": OSError(24, "Too many open files"),
            }
            loop.call_exception_handler(context)
        loop.call_exception_handler({"message": "a task was destroyed"})
    finally:
        loop.close()
    assert told == [
        "server: socket.accept() failed: [Errno 24] Too many open files",
        "server: a task was destroyed",
    ]
