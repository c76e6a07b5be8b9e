"""A served broadcast and its open pages, over real sockets."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import lidarspec as ls
from lidarspec.errors import LidarSpecError
from lidarspec.scans.selection import EVERYTHING, Selection
from lidarspec.simulation.device import SimulatedDevice
from lidarspec.transports.simulated_files import write_file
from tests.libraries import Library

from .messages import parse_message

client = Library("websockets.sync.client")

#: Timeout of every step in seconds, far above its usual duration.
DEADLINE = 30.0
FLAT, SOLID = "ldrobot-stl27l", "robosense-m1"
#: A page that replaces the built one.
PAGE_TEXT = (
    '<!doctype html><title>page</title><link rel="icon" href="data:,"><script'
    ' src="page.js"></script>'
)


class Station:
    """A source that is read in a thread and served, as by `lidarspec view --web`.

    A context manager.

    Attributes:
        said: reports about pages.
        failure: the exception that ended the thread.
    """

    def __init__(
        self,
        source: object,
        folder: Path,
        sensor: Any = None,
        *,
        select: Selection = EVERYTHING,
        **options: Any,
    ) -> None:
        from lidarspec_web.source_server import SourceServer

        (folder / "page").mkdir(exist_ok=True)
        (folder / "page" / "index.html").write_text(PAGE_TEXT)
        (folder / "page" / "page.js").write_text("1")
        self.source = str(source)
        self.said = list[str]()
        given = {"page": folder / "page", "report": self.said.append, "folder": folder, **options}
        self.server = SourceServer(self.source, sensor, selection=select, **given)
        self.broadcast = self.server.broadcast
        self.switch = self.server.switch
        self.failure: LidarSpecError | None = None
        self._thread = threading.Thread(target=self._read, name="reading")

    def _read(self) -> None:
        try:
            self.broadcast.run(time.monotonic() + 10 * DEADLINE)
        except LidarSpecError as error:
            self.failure = error

    @property
    def link(self) -> str:
        return self.server.link

    @property
    def port(self) -> int:
        return int(self.link.rpartition(":")[2].partition("/")[0])

    @property
    def token(self) -> str:
        return self.link.partition("?token=")[2]

    def request(self, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
        """Return the response to a raw request with the token."""
        return request_raw(self.port, f"{path}?token={self.token}", **headers)

    def handshake(self) -> bytes:
        """Return the request that opens a WebSocket by hand."""
        host = f"127.0.0.1:{self.port}"
        given = {"Host": host, "Origin": f"http://{host}", "Connection": "Upgrade", **UPGRADE}
        lines = [
            f"GET /socket?token={self.token} HTTP/1.1",
            *(f"{name.replace('_', '-')}: {value}" for name, value in given.items()),
        ]
        return "\r\n".join([*lines, "", ""]).encode()

    def page(self, **options: Any) -> Page:
        return Page(self.link, **options)

    def __enter__(self) -> Station:
        self.server.__enter__()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.broadcast.stop()
        self._thread.join()
        self.server.__exit__(None, None, None)


class Page:
    """An open page: the messages that it sends and receives; a context manager."""

    def __init__(self, link: str, **options: Any) -> None:
        address, _, query = link.partition("?")
        given = {
            "origin": address.rstrip("/"),
            "max_size": None,
            "compression": None,
            "open_timeout": DEADLINE,
            **options,
        }
        self._opened = client.connect(
            f"ws{address.removeprefix('http')}socket{'?' * bool(query)}{query}", **given
        )
        self._kept = deque[Any]()

    def say(self, word: str, **facts: Any) -> None:
        self.socket.send(json.dumps({"do": word, **facts}))

    def receive_matching(self, is_it: Callable[[Any], bool], *, within: float = DEADLINE) -> Any:
        """Return the first unread message that matches; the others stay unread."""
        for message in self._kept:
            if is_it(message):
                self._kept.remove(message)
                return message
        end = time.monotonic() + within
        while (left := end - time.monotonic()) > 0:
            message = self.socket.recv(left)
            message = (
                parse_message(message)
                if isinstance(message, bytes)
                else json.loads(message, parse_constant=_no_constant)
            )
            if is_it(message):
                return message
            self._kept.append(message)
        raise TimeoutError([message["is"] for message in self._kept if isinstance(message, dict)])

    def until(self, word: str, holds: Callable[[Any], bool] = lambda message: True) -> Any:
        """Return the next message of a kind that matches."""
        return self.receive_matching(
            lambda message: isinstance(message, dict) and message["is"] == word and holds(message)
        )

    def state(self, holds: Callable[[Any], bool] = lambda state: True) -> Any:
        """Return the next state from now on that matches."""
        self._kept = deque(
            message
            for message in self._kept
            if not (isinstance(message, dict) and message["is"] == "state")
        )
        return self.until("state", holds)

    def scan(self, most: int = 1 << 20) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Return the newest scan that the page has not received."""
        self.say("next", most=most)
        return self.receive_matching(lambda message: isinstance(message, tuple))  # type: ignore[no-any-return]

    def scan_at(self, position: float) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Return the first scan from now on that is near a position.

        A scan that is already being sent may come before it.
        """
        while True:
            header, columns = self.scan()
            if abs(header["position"] - position) < 0.21:
                return header, columns

    def request(self, word: str, **facts: Any) -> Any:
        """Return the reply to a request, neither a scan nor a state."""
        self.say(word, **facts)
        return self.receive_matching(
            lambda message: (
                isinstance(message, dict) and message["is"] not in ("state", "hello", "ended")
            )
        )

    def __enter__(self) -> Page:
        self.socket = self._opened.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.__exit__(None, None, None)


def _no_constant(name: str) -> None:
    raise ValueError(f"{name} is not JSON")


def write_recording(
    folder: Path, sensor: str = FLAT, seconds: float = 5.0, suffix: str = ".lsr", **faults: Any
) -> Path:
    """Return a file of data from a simulated sensor."""
    path = folder / f"sent{suffix}"
    write_file(SimulatedDevice(ls.sensor(sensor), **faults), path, seconds)
    return path


def request_raw(port: int, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    """Return status, headers and body of the response to a raw request.

    Args:
        headers: replace or extend the usual ones, with "_" for "-"; `upgrade` requests a WebSocket.
    """
    given = {
        "Host": f"127.0.0.1:{port}",
        "Connection": "Upgrade" if "upgrade" in headers else "close",
        **headers,
    }
    lines = [
        f"GET {path} HTTP/1.1",
        *(f"{name.replace('_', '-')}: {value}" for name, value in given.items()),
        "",
        "",
    ]
    with socket.create_connection(("127.0.0.1", port), DEADLINE) as raw:
        raw.settimeout(DEADLINE)
        raw.sendall("\r\n".join(lines).encode("latin-1"))
        data = b""
        while b"\r\n\r\n" not in data and (more := raw.recv(1 << 16)):
            data += more
        head, _, body = data.partition(b"\r\n\r\n")
        lines = head.decode("latin-1").split("\r\n")
        told = {
            name.lower(): value.strip()
            for name, _, value in (line.partition(":") for line in lines[1:])
        }
        while len(body) < int(told.get("content-length", 0)) and (more := raw.recv(1 << 16)):
            body += more
    return int(lines[0].split()[1]), told, body


#: The headers with which a browser requests a WebSocket, with the origin of the page.
UPGRADE = {
    "upgrade": "websocket",
    "Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ==",
    "Sec_WebSocket_Version": "13",
}


def mask(message: dict[str, Any]) -> bytes:
    """Return a short message as a WebSocket frame, masked with zeros."""
    text = json.dumps(message).encode()
    return bytes([0x81, 0x80 | len(text), 0, 0, 0, 0]) + text
