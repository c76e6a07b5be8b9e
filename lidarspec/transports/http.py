"""HTTP: the web server of a sensor as a link, and that of a simulated one.

A message is what `HttpRequest` and `HttpReply` describe: method, path and body; status and body. A
request is bounded in time, and its reply in size, whatever the other side sends. Requests wait for
one another.
"""

from __future__ import annotations

import contextlib
import http.client
import queue
import socket
import threading
from collections import deque
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from lidarspec.errors import UsageError
from lidarspec.spec.fields import HttpReply, HttpRequest
from lidarspec.spec.links import Http
from lidarspec.transports.base import HostClock, reason
from lidarspec.transports.protocol import Chunk, LiveTransport

#: bytes of a request's body that a simulated sensor takes, and seconds that it has for its answer.
BODY, PATIENCE = 1 << 20, 2.0


class HttpTransport(LiveTransport):
    """Requests to a host, each in the thread that reads; what goes wrong with one is said in
    `warnings`, and it stays unanswered.

    Args:
        host: name or address of the sensor.
        link: its port, and the bounds.
    """

    datagrams = True

    def __init__(self, host: str, link: Http) -> None:
        self._host, self._link, self._clock = host, link, HostClock()
        self.label, self.warnings = (
            f"http://{f'[{host}]' if ':' in host else host}:{link.port}",
            list[str](),
        )
        self._requests = queue.SimpleQueue[bytes]()

    def read(self, timeout: float) -> list[Chunk]:
        try:
            request = HttpRequest.parse(self._requests.get(timeout=timeout))
        except queue.Empty:
            return []
        path = request.path.decode("latin-1")
        try:
            status, body, location = self._request(str(request.method), path, request.body)
        except (OSError, http.client.HTTPException, ValueError) as error:
            why = reason(error) or f"no answer within {self._link.timeout:g} s"
            self.warnings = [f"{self.label}{path}: {why}"]
            return []
        self.warnings = []
        if location:
            self.warnings = [
                f"{self.label}{path}: status {status}, moved to {location}, which is not followed"
            ]
        reply = HttpReply.build({"status": status, "size": len(body), "body": body})
        return [Chunk(reply, self._clock.now(), (self._host, self._link.port))]

    def write(self, data: bytes) -> None:
        try:
            HttpRequest.parse(data)
        except Exception:
            raise UsageError(
                f"{self.label}: over HTTP go messages as HttpRequest describes them, not"
                f" {data[:16].hex(' ')}"
            ) from None
        self._requests.put(data)

    def reopen(self) -> None:
        """Each request has a connection of its own."""

    def peer(self) -> str | None:
        return self._host

    def close(self) -> None:
        self.closed = True

    def _request(self, method: str, path: str, body: bytes) -> tuple[int, bytes, str]:
        """Return the status and the body of a reply, and where a redirection leads."""
        connection = http.client.HTTPConnection(
            self._host, self._link.port, timeout=self._link.timeout
        )
        with contextlib.closing(connection):
            connection.connect()
            limit = threading.Timer(self._link.timeout, _hang_up, [connection.sock])
            limit.daemon = True
            limit.start()
            try:
                connection.request(method, path, body or None)
                reply = connection.getresponse()
                found = reply.read(self._link.largest + 1)
            finally:
                limit.cancel()
            if len(found) > self._link.largest:
                raise ValueError(f"the reply is longer than {self._link.largest} bytes")
            if reply.length:
                raise ValueError(
                    f"the reply ends {reply.length} bytes too early, or took longer than"
                    f" {self._link.timeout:g} s"
                )
            location = reply.getheader("Location", "") if 300 <= reply.status < 400 else ""
            return reply.status, found, location


def _hang_up(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


class Server(ThreadingHTTPServer):
    """The web server of a simulated sensor, in threads of its own: what is not answered in time has
    the status 504.

    Args:
        host, port: where to listen; port 0 takes any that is free.

    Attributes:
        asked: the requests, as messages.
        waiting: where each of them waits for its reply, in the same order.

    Raises:
        OSError: where the address cannot be had.
    """

    daemon_threads = True

    def __init__(self, host: str, port: int) -> None:
        self.asked, self.waiting = queue.SimpleQueue[bytes](), deque[queue.SimpleQueue[bytes]]()
        self.order = threading.Lock()
        super().__init__((host, port), _Handler)
        threading.Thread(
            target=self.serve_forever,
            kwargs={"poll_interval": 0.05},
            name=f"http://{host}:{port}",
            daemon=True,
        ).start()

    def server_close(self) -> None:
        """End it."""
        self.shutdown()
        super().server_close()


class _Handler(BaseHTTPRequestHandler):
    """One request: to the sensor, and its reply back."""

    timeout = PATIENCE

    def _ask(self) -> None:
        assert isinstance(self.server, Server)
        size = self.headers.get("Content-Length", "0")
        body = self.rfile.read(int(size)) if size.isdecimal() and int(size) <= BODY else b""
        path, answer = self.path.encode("latin-1"), queue.SimpleQueue[bytes]()
        request = {
            "method": self.command,
            "path_size": len(path),
            "path": path,
            "size": len(body),
            "body": body,
        }
        with self.server.order:
            self.server.waiting.append(answer)
            self.server.asked.put(HttpRequest.build(request))
        try:
            reply = HttpReply.parse(answer.get(timeout=PATIENCE))
        except queue.Empty:
            with contextlib.suppress(ValueError):
                self.server.waiting.remove(answer)
            self.send_error(504, "the simulated sensor has no answer to that")
            return
        self.send_response(reply.status)
        self.send_header("Content-Length", str(reply.size))
        self.end_headers()
        self.wfile.write(reply.body)

    do_GET = do_PUT = do_POST = do_DELETE = _ask

    def log_message(self, format: str, *args: object) -> None:
        """Nothing is said of requests: the simulator says which commands it heard."""
