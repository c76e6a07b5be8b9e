"""Serve HTTP requests to a simulated sensor.

The server passes each request to the simulated sensor as a frame of `HttpRequest`, and waits for a
frame of `HttpReply`. If no reply arrives in time, the status is 504.
"""

from __future__ import annotations

import contextlib
import queue
import threading
from collections import deque
from collections.abc import Sequence
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from lidarspec.spec.fields import HttpReply, HttpRequest
from lidarspec.transports.outlets import OutletLine
from lidarspec.transports.protocol import Chunk

_MAX_BODY_BYTES = 1 << 20
_REPLY_TIMEOUT_S = 2.0
#: Maximum time until a request that a thread has received is passed to the simulated sensor.
_REQUEST_POLL_S = 0.01
_SHUTDOWN_POLL_S = 0.05

_ReplyQueue = queue.SimpleQueue[bytes]


class HttpLine(OutletLine):
    """The web server of a simulated sensor.

    Args:
        port: the port to listen on; 0 selects any free port.

    Raises:
        OSError: if the address is not available.
    """

    def __init__(self, host: str, port: int) -> None:
        self._lock = threading.Lock()
        self._requests: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        # One queue for each request without a reply, in order. Requests that timed out are removed.
        self._reply_queues: deque[_ReplyQueue] = deque()
        self._server = ThreadingHTTPServer((host, port), partial(_Handler, self))
        self._server.daemon_threads = True
        self.port = int(self._server.server_address[1])
        self.local_source = f"http://{host}:{self.port}"
        threading.Thread(
            target=self._server.serve_forever,
            kwargs={"poll_interval": _SHUTDOWN_POLL_S},
            name=self.local_source,
            daemon=True,
        ).start()

    @property
    def max_wait_s(self) -> float:
        return _REQUEST_POLL_S

    def receive(self) -> list[bytes]:
        requests = []
        with contextlib.suppress(queue.Empty):
            while True:
                requests.append(self._requests.get_nowait())
        return requests

    def send(self, chunks: Sequence[Chunk], *, patient: bool) -> None:
        for chunk in chunks:
            with contextlib.suppress(IndexError):  # the request has timed out
                self._reply_queues.popleft().put(chunk.data)

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()

    def handle_request(self, request: bytes) -> bytes | None:
        """Return the simulated sensor's reply to a request; None if there is none in time."""
        reply = _ReplyQueue()
        with self._lock:
            self._reply_queues.append(reply)
            self._requests.put(request)
        try:
            return reply.get(timeout=_REPLY_TIMEOUT_S)
        except queue.Empty:
            with contextlib.suppress(ValueError):
                self._reply_queues.remove(reply)
            return None


class _Handler(BaseHTTPRequestHandler):
    timeout = _REPLY_TIMEOUT_S

    def __init__(self, line: HttpLine, *arguments: Any) -> None:
        self._line = line
        super().__init__(*arguments)  # handles the request

    def _handle_request(self) -> None:
        path = self.path.encode("latin-1")
        body = self._read_body()
        request = HttpRequest.build(
            {
                "method": self.command,
                "path_size": len(path),
                "path": path,
                "size": len(body),
                "body": body,
            }
        )
        reply_data = self._line.handle_request(request)
        if reply_data is None:
            self.send_error(504, "the simulated sensor has no reply to this request")
            return
        reply = HttpReply.parse(reply_data)
        self.send_response(reply.status)
        self.send_header("Content-Length", str(reply.size))
        self.end_headers()
        self.wfile.write(reply.body)

    do_GET = do_PUT = do_POST = do_DELETE = _handle_request

    def _read_body(self) -> bytes:
        size = self.headers.get("Content-Length", "0")
        if not size.isdecimal() or int(size) > _MAX_BODY_BYTES:
            return b""
        return self.rfile.read(int(size))

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing, because the simulator prints the commands that it recognizes."""
