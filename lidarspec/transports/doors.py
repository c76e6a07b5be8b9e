"""Doors: where a simulated sensor's bytes go, and commands come from. Here datagrams and TCP connections.

As a real sensor would, the device sends whether somebody listens or not; only one without a pace of its own waits for its reader.
"""

from __future__ import annotations

import contextlib
import errno
import select
import socket
import time
from collections.abc import Sequence
from typing import Protocol

from lidarspec.errors import UsageError
from lidarspec.links import Tcp, Udp
from lidarspec.spec import Sensor
from lidarspec.transports.live import POLL, failure, listener, reason

#: bytes of commands read at once, and bytes that wait for a slow reader of a connection at most.
BLOCK, BACKLOG = 1 << 16, 1 << 20
HERE = "127.0.0.1"

#: what leaves a device: link, type of frame, bytes.
Sending = tuple[str, str, bytes]


class Door(Protocol):
    """Where a device's bytes go, and commands come from.

    Attributes:
        where: what to tell whoever wants to listen.
        heard: whether somebody listens, as far as that can be known.
        unsent: bytes that nobody took in time.
    """

    @property
    def where(self) -> str: ...
    @property
    def heard(self) -> bool: ...
    @property
    def unsent(self) -> int: ...

    def receive(self, wait: float) -> list[tuple[str, bytes]]:
        """The commands that arrive within `wait` seconds at most, each with its link."""

    def send(self, sendings: Sequence[Sending], *, patient: bool) -> None:
        """Send, and where `patient`, wait until there is room.

        Raises:
            SourceError: where that cannot ever work.
        """

    def unplug(self) -> None:
        """The device is gone."""

    def plug(self) -> None:
        """The device is back."""

    def close(self) -> None:
        """Give everything back."""


class UdpDoor:
    """Datagrams to an address; commands are taken from the same host.

    Args:
        port: where everything goes; left out, data goes to the sensor's first declared port and the rest to its second.

    Raises:
        SourceError: for a host that is none.
        UsageError: for a sensor that sends no datagrams.
    """

    def __init__(self, sensor: Sensor, host: str = HERE, port: int | None = None) -> None:
        link = sensor.links.get("data")
        if not isinstance(link, Udp) or not sensor.datagrams:
            raise UsageError(f"{sensor.id} sends a stream of bytes, no datagrams: simulate it to pty or tcp://")
        ports = (port,) if port else link.ports
        if not ports:
            raise UsageError(f"{sensor.id} declares no port: name one, as in udp://{host}:2368")
        try:
            family, _, _, _, address = socket.getaddrinfo(host, ports[0], type=socket.SOCK_DGRAM)[0]
        except OSError as error:
            raise failure(f"udp://{host}:{ports[0]}: there is no host {host!r} ({reason(error)})", "ping " + host) from None
        self.host, self._sensor, self.heard, self.unsent = str(address[0]), sensor, True, 0
        self._ports = (ports[0], ports[1] if len(ports) > 1 else ports[0])
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        with contextlib.suppress(OSError):
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BACKLOG)
        at = f"[{self.host}]" if ":" in self.host else self.host
        several = self._ports[0] != self._ports[1]
        self.where = f"udp://{at}?port={self._ports[0]},{self._ports[1]}" if several else f"udp://{at}:{self._ports[0]}"

    def receive(self, wait: float) -> list[tuple[str, bytes]]:
        found = []
        if select.select([self._socket], [], [], wait)[0]:
            with contextlib.suppress(OSError):  # what a destination that does not listen is told with
                data, sender = self._socket.recvfrom(BLOCK)
                found = [("data", data)] if sender[0] == self.host else []
        return found

    def send(self, sendings: Sequence[Sending], *, patient: bool) -> None:
        for _, frame, data in sendings:
            address = (self.host, self._ports[0 if self._sensor.frames[frame].data else 1])
            try:
                self._socket.sendto(data, address)
            except BlockingIOError:
                select.select([], [self._socket], [], POLL)
                self._again(data, address)
            except OSError as error:
                if error.errno != errno.ECONNREFUSED:
                    raise failure(f"{self.where}: nothing can be sent: {reason(error)}", "lidarspec sim --help") from None
                self._again(data, address)

    def unplug(self) -> None:
        """Nothing to do: a device that is gone sends nothing."""

    plug = unplug

    def close(self) -> None:
        self._socket.close()

    def _again(self, data: bytes, address: tuple[str, int]) -> None:
        try:
            self._socket.sendto(data, address)
        except OSError:
            self.unsent += len(data)


class TcpDoor:
    """Connections that are accepted at an address; each gets everything from its beginning on.

    Raises:
        SourceError: where the address cannot be had.
    """

    def __init__(self, sensor: Sensor, host: str = HERE, port: int | None = None) -> None:
        link = sensor.links.get("data")
        port = link.port if port is None and isinstance(link, Tcp) else port
        if port is None:
            raise UsageError(f"{sensor.id} declares no TCP port: name one, as in tcp://{host}:2111")
        self._address, self.unsent = (host, port), 0
        self._clients: dict[socket.socket, bytearray] = {}
        self._listener = self._listening()
        self.where = f"tcp://{host}:{self._listener.getsockname()[1]}"
        self._address = (host, self._listener.getsockname()[1])

    @property
    def heard(self) -> bool:
        """Whether somebody is connected."""
        return bool(self._clients)

    def receive(self, wait: float) -> list[tuple[str, bytes]]:
        behind = [client for client, waiting in self._clients.items() if waiting]
        if self._listener.fileno() < 0:
            time.sleep(wait)
            return []
        readable, writable, _ = select.select([self._listener, *self._clients], behind, [], wait)
        for client in writable:
            self._flush(client)
        found = []
        for source in readable:
            if source is self._listener:
                self._accept()
            elif source in self._clients and (data := self._read(source)):
                found.append(("data", data))
        return found

    def send(self, sendings: Sequence[Sending], *, patient: bool) -> None:
        data = b"".join(data for _, _, data in sendings)
        if not self._clients:
            self.unsent += len(data)
        for client, waiting in list(self._clients.items()):
            if len(waiting) + len(data) > BACKLOG and not patient:
                self.unsent += len(data)
                continue
            waiting.extend(data)
            self._flush(client)
            while patient and self._clients.get(client):
                select.select([], [client], [], POLL)
                self._flush(client)

    def unplug(self) -> None:
        for client in list(self._clients):
            self._forget(client)
        self._listener.close()

    def plug(self) -> None:
        self._listener = self._listening()

    def close(self) -> None:
        self.unplug()

    def _listening(self) -> socket.socket:
        made = listener(*self._address)
        made.setblocking(False)
        return made

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            client, _ = self._listener.accept()
            client.setblocking(False)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._clients[client] = bytearray()

    def _read(self, client: socket.socket) -> bytes:
        try:
            data = client.recv(BLOCK)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._forget(client)
        return data

    def _flush(self, client: socket.socket) -> None:
        waiting = self._clients.get(client)
        if not waiting:
            return
        try:
            del waiting[: client.send(waiting)]
        except BlockingIOError:
            pass
        except OSError:
            self._forget(client)

    def _forget(self, client: socket.socket) -> None:
        self._clients.pop(client, None)
        client.close()
