"""Limits on connections to the server, so that it stays reachable.

A connection is pending until one of its requests has the token. A pending connection is closed
after `TOKEN_TIMEOUT_S`. If a connection is opened when there are `MAX_CONNECTIONS` already, the
oldest pending connection is closed. A browser sends its first request immediately, so its
connection is pending only for a moment, and idle connections of other users do not block it.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

#: Maximum number of connections, with and without the token.
MAX_CONNECTIONS = 128
#: Number of connections that the system accepts for the server in advance. Each of them needs a
#: file descriptor.
BACKLOG = 64
#: Time after which a connection without the token is closed.
TOKEN_TIMEOUT_S = 10.0
CHECK_PERIOD_S = 1.0

Client = tuple[str, int]


@dataclass
class PendingConnection:
    """A connection that has not sent the token yet."""

    transport: asyncio.Transport
    since: float = field(default_factory=time.monotonic)


class Connections:
    """The connections of a server. All methods run in its event loop.

    Args:
        report: called once with a line of text, if connections were closed because there were too
            many.
    """

    def __init__(self, report: Callable[[str], None]) -> None:
        self._report = report
        self._has_reported = False
        self._waiting: dict[Client, PendingConnection] = {}  # the oldest first
        self._admitted: dict[Client, asyncio.Transport] = {}

    def protocol_class(self) -> type[asyncio.Protocol]:
        """Return the protocol class with which uvicorn serves a connection."""
        connections = self

        class LimitedProtocol(H11Protocol):
            def connection_made(self, transport: asyncio.BaseTransport) -> None:
                assert isinstance(transport, asyncio.Transport)
                super().connection_made(transport)
                connections._add(self.client, transport)

            def connection_lost(self, exc: Exception | None) -> None:
                super().connection_lost(exc)
                connections._remove(self.client, self.transport)

        return LimitedProtocol

    def admit(self, client: Client | None) -> None:
        """Record that a client's connection has sent the token; None is ignored."""
        if client in self._waiting:
            self._admitted[client] = self._waiting.pop(client).transport

    def drop(self, client: Client | None) -> None:
        """Close the connection of a client that does not read its response."""
        if client in self._admitted:
            self._admitted.pop(client).abort()

    async def close(self) -> None:
        """Close all connections at once, without sending the remaining data."""
        waiting = [connection.transport for connection in self._waiting.values()]
        for transport in [*waiting, *self._admitted.values()]:
            transport.abort()
        await asyncio.sleep(0)  # the loop closes their sockets

    async def watch(self) -> None:
        """Close pending connections after a timeout; run until this task is cancelled."""
        while True:
            await asyncio.sleep(CHECK_PERIOD_S)
            self._close_late()

    def _close_late(self) -> None:
        begin = time.monotonic() - TOKEN_TIMEOUT_S
        while self._waiting:
            client, oldest = next(iter(self._waiting.items()))
            if oldest.since > begin:
                return
            self._close_waiting(client)

    def _add(self, client: Client | None, transport: asyncio.Transport) -> None:
        if client is None:  # closed already
            transport.abort()
            return
        if len(self._waiting) + len(self._admitted) >= MAX_CONNECTIONS:
            self._make_room()
        if len(self._waiting) + len(self._admitted) >= MAX_CONNECTIONS:
            transport.abort()
            return
        self._waiting[client] = PendingConnection(transport)

    def _make_room(self) -> None:
        # Connections that became sockets do not report their end.
        for client, transport in list(self._admitted.items()):
            if transport.is_closing():
                del self._admitted[client]
        if len(self._waiting) + len(self._admitted) < MAX_CONNECTIONS:
            return
        if self._waiting:
            self._close_waiting(next(iter(self._waiting)))
        if not self._has_reported:
            self._has_reported = True
            self._report(
                f"there are more than {MAX_CONNECTIONS} connections; for each new connection, the"
                " oldest connection without the token is closed"
            )

    def _close_waiting(self, client: Client) -> None:
        self._waiting.pop(client).transport.abort()

    def _remove(self, client: Client | None, transport: asyncio.Transport) -> None:
        if client is None:
            return
        waiting = self._waiting.get(client)
        if waiting is not None and waiting.transport is transport:
            del self._waiting[client]
        if self._admitted.get(client) is transport:
            del self._admitted[client]


class ErrorReporter:
    """Reports errors of the event loop: each kind of error once, in one line."""

    def __init__(self, report: Callable[[str], None]) -> None:
        self._report = report
        self._reported: set[str] = set()

    def __call__(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Report an error; the event loop calls this as its exception handler."""
        text = str(context.get("message"))
        if text in self._reported:
            return
        self._reported.add(text)
        error = context.get("exception")
        self._report(f"server: {text}" if error is None else f"server: {text}: {error}")
