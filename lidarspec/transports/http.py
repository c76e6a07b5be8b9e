"""Send requests to the web server of a sensor.

A request is a frame of `HttpRequest`, and a reply is a frame of `HttpReply`. A request is sent only
after the reply to the previous request has arrived.
"""

from __future__ import annotations

import contextlib
import http.client
import queue
import socket
import threading

from lidarspec.errors import UsageError
from lidarspec.spec.fields import HttpReply, HttpRequest
from lidarspec.spec.links import Http
from lidarspec.transports.base import system_reason
from lidarspec.transports.host_clock import HostClock
from lidarspec.transports.protocol import Chunk, LiveTransport


class HttpTransport(LiveTransport):
    """Sends HTTP requests to a host, in the thread that calls `read`.

    If a request fails, `warnings` contains the reason.

    Args:
        link: the declared link, with port, timeout and maximum size of a reply.
    """

    datagrams = True

    def __init__(self, host: str, link: Http) -> None:
        self._host = host
        self._link = link
        self._clock = HostClock()
        bracketed = f"[{host}]" if ":" in host else host
        self.label = f"http://{bracketed}:{link.port}"
        self.warnings: list[str] = []
        self._requests: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def read(self, timeout: float) -> list[Chunk]:
        try:
            request = HttpRequest.parse(self._requests.get(timeout=timeout))
        except queue.Empty:
            return []
        path = request.path.decode("latin-1")
        self.warnings = []
        try:
            status, body, location = self._send_request(str(request.method), path, request.body)
        except (OSError, http.client.HTTPException, ValueError) as error:
            cause = system_reason(error) or f"no reply within {self._link.timeout:g} s"
            self.warnings = [f"{self.label}{path}: {cause}"]
            return []
        if location:
            self.warnings = [
                f"{self.label}{path}: status {status}; the redirection to {location} was ignored"
            ]
        reply = HttpReply.build({"status": status, "size": len(body), "body": body})
        return [Chunk(reply, self._clock.now(), (self._host, self._link.port))]

    def write(self, data: bytes) -> None:
        try:
            HttpRequest.parse(data)
        except Exception:
            raise UsageError(
                f"{self.label}: expected an HTTP message as declared by HttpRequest, got"
                f" {data[:16].hex(' ')}"
            ) from None
        self._requests.put(data)

    def reopen(self) -> None:
        """Do nothing, because each request opens its own connection."""

    def peer(self) -> str | None:
        return self._host

    def close(self) -> None:
        self.closed = True

    def _send_request(self, method: str, path: str, body: bytes) -> tuple[int, bytes, str]:
        """Send a request; return the status, body and redirection target of the reply."""
        connection = http.client.HTTPConnection(
            self._host, self._link.port, timeout=self._link.timeout
        )
        with contextlib.closing(connection):
            connection.connect()
            # The timeout of the connection applies to each read, so it does not limit the duration
            # of the whole request.
            limit = threading.Timer(self._link.timeout, _hang_up, [connection.sock])
            limit.daemon = True
            limit.start()
            try:
                connection.request(method, path, body or None)
                reply = connection.getresponse()
                content = reply.read(self._link.largest + 1)
            finally:
                limit.cancel()
            if len(content) > self._link.largest:
                raise ValueError(f"the reply is longer than {self._link.largest} bytes")
            if reply.length:
                raise ValueError(
                    f"the reply lacks {reply.length} bytes, or took longer than"
                    f" {self._link.timeout:g} s"
                )
            is_redirection = 300 <= reply.status < 400
            if is_redirection:
                location = reply.getheader("Location", "")
            else:
                location = ""
            return reply.status, content, location


def _hang_up(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)
