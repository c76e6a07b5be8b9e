"""Doors: where a simulated sensor's bytes go, and commands come from. Here datagrams and TCP connections.

As a real sensor would, the device sends whether somebody listens or not; only one without a pace of its own waits for its reader.

A pseudo-terminal as the serial port of a simulated sensor: POSIX only.

Where a replay goes to: a pseudo terminal, UDP, TCP, or another file; each takes the place of the sensor that was recorded.
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import termios
import time
import tty
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from lidarspec.errors import SourceError, UsageError
from lidarspec.recording.recorders import AnyRecorder
from lidarspec.recording.replaying import Player
from lidarspec.spec.links import Tcp, Udp
from lidarspec.spec.sensor import Sensor
from lidarspec.transports.live_transport import POLL, Address, failure, listener, reason
from lidarspec.transports.protocol import Chunk, Disconnected

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


#: bytes that wait for a slow reader; a real adapter holds no more.
PTY_BACKLOG = 1 << 18
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
        if not self.heard or (len(self._waiting) + len(data) > PTY_BACKLOG and not patient):
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


#: seconds between two looks at whether somebody listens, and what a listener takes to settle: many drop what came while they opened.
LOOK, SETTLE = 0.02, 0.25
#: seconds that the last bytes are given to be fetched.
FAREWELL = 5.0
_BLOCK = 1 << 16


class PtyPlayer:
    """A new pseudo terminal; whoever opens it reads a serial port. What is written to it is passed over.

    Raises:
        UsageError: on systems without any.
        SourceError: where none can be had.
    """

    def __init__(self) -> None:
        if not hasattr(os, "openpty"):
            raise UsageError("this system has no pseudo terminals: play to tcp://127.0.0.1:PORT, or to a file")
        import tty

        try:
            self._master, slave = os.openpty()
            tty.setraw(slave)
            self.place = os.ttyname(slave)
            os.close(slave)
        except OSError as error:
            raise SourceError(f"no pseudo terminal: {reason(error)}") from None
        os.set_blocking(self._master, False)
        self._poller = select.poll()
        self._poller.register(self._master, select.POLLIN | select.POLLOUT)

    def wait(self) -> None:
        """Returns when somebody has opened it, and kept it open for a moment."""
        since = time.monotonic()
        while time.monotonic() - since < SETTLE:
            time.sleep(LOOK)
            if self._is_alone():
                since = time.monotonic()
        self._pass_over()

    def send(self, chunk: Chunk) -> None:
        left = memoryview(chunk.data)
        while left:
            events = self._poller.poll(1000)
            happened = events[0][1] if events else 0
            if happened & select.POLLHUP:
                self._forget()
                raise Disconnected(f"{self.place}: nobody reads any more")
            if happened & select.POLLIN:
                self._pass_over()
            if happened & select.POLLOUT:
                with contextlib.suppress(BlockingIOError):
                    left = left[os.write(self._master, left) :]

    def close(self) -> None:
        """Give it back when the last bytes have been read, or nobody reads."""
        if self._master < 0:
            return
        self._drain()
        os.close(self._master)
        self._master = -1

    def _is_alone(self) -> bool:
        return any(happened & select.POLLHUP for _, happened in self._poller.poll(0))

    def _pass_over(self) -> None:
        with contextlib.suppress(OSError):
            while os.read(self._master, _BLOCK):
                pass

    def _forget(self) -> None:
        """What the reader that left has not read is not for the next one."""
        import termios

        time.sleep(LOOK)
        with contextlib.suppress(OSError, termios.error):
            other = os.open(self.place, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            try:
                termios.tcflush(other, termios.TCIFLUSH)
            finally:
                os.close(other)

    def _drain(self) -> None:
        """Wait until nothing is left to be read: what is, is lost when the terminal goes away."""
        import fcntl
        import termios

        empty, limit = 0, time.monotonic() + FAREWELL
        while empty < 3 and time.monotonic() < limit and not self._is_alone():
            try:
                other = os.open(self.place, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            except OSError:
                return
            try:
                waiting = fcntl.ioctl(other, termios.FIONREAD, bytes(4))
            finally:
                os.close(other)
            empty = empty + 1 if waiting == bytes(4) else 0
            time.sleep(LOOK)


class UdpPlayer:
    """Datagrams to an address; without a port, each to the one that it was sent to then.

    Args:
        place: "udp://127.0.0.1:2368", or without the port.
        port: for datagrams that do not say where they went.

    Raises:
        SourceError: where the address cannot be used.
    """

    def __init__(self, place: str, *, port: int = 0) -> None:
        address = Address.parse(place)
        address.check(())
        host, self._port = address.host_and_port()
        self.place, self._default, self._host = place, port, host or "127.0.0.1"
        try:
            family, kind, _, _, found = socket.getaddrinfo(self._host, self._port or 9, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(family, kind)
        except OSError as error:
            raise SourceError(f"{place}: {reason(error)}") from None
        self._host = str(found[0])

    def wait(self) -> None:
        """Whether somebody listens to datagrams, nobody knows."""

    def send(self, chunk: Chunk) -> None:
        port = self._port or (chunk.receiver[1] if chunk.receiver else 0) or self._default
        if not port:
            raise UsageError(f"{self.place}: the datagrams do not say which port they went to: name one, as in udp://{self._host}:2368")
        while True:
            try:
                self._socket.sendto(chunk.data, (self._host, port))
                return
            except OSError as error:
                if error.errno not in (errno.ENOBUFS, errno.EAGAIN, errno.ECONNREFUSED):
                    raise SourceError(f"{self.place}: {reason(error)}") from None
                if error.errno == errno.ECONNREFUSED:
                    continue  # the answer to an earlier datagram; this one has not been sent
                time.sleep(LOOK)

    def close(self) -> None:
        self._socket.close()


class TcpPlayer:
    """A server, as the sensor is one, for one listener at a time; what it sends is passed over.

    Args:
        place: "tcp://127.0.0.1:2111"; port 0 takes any.

    Raises:
        SourceError: where the address cannot be listened on.
    """

    def __init__(self, place: str) -> None:
        address = Address.parse(place)
        address.check(())
        is_free = address.place.endswith(":0")
        host, port = replace(address, place=address.place[:-2]).host_and_port() if is_free else address.host_and_port()
        if port is None and not is_free:
            raise UsageError(f"{place}: name the port to listen on, as in tcp://127.0.0.1:2111")
        self._server = listener(host or "127.0.0.1", port or 0)
        self.place = f"tcp://{self._server.getsockname()[0]}:{self._server.getsockname()[1]}"
        self._listener: socket.socket | None = None

    def wait(self) -> None:
        """Returns when somebody has connected."""
        self._hang_up()
        self._server.settimeout(LOOK * 10)
        while self._listener is None:
            with contextlib.suppress(TimeoutError):
                self._listener, _ = self._server.accept()
                self._listener.settimeout(None)

    def send(self, chunk: Chunk) -> None:
        if self._listener is None:
            self.wait()
        assert self._listener is not None
        try:
            if select.select([self._listener], [], [], 0)[0] and not self._listener.recv(_BLOCK):
                raise ConnectionResetError(errno.ECONNRESET, "closed")
            self._listener.sendall(chunk.data)
        except OSError:
            self._listener.close()
            self._listener = None
            raise Disconnected(f"{self.place}: nobody reads any more") from None

    def close(self) -> None:
        """Hang up when the last bytes have been sent."""
        self._server.close()
        self._hang_up()

    def _hang_up(self) -> None:
        if self._listener is None:
            return
        with contextlib.suppress(OSError), self._listener:
            self._listener.shutdown(socket.SHUT_WR)
            self._listener.settimeout(FAREWELL)
            while self._listener.recv(_BLOCK):  # closing with something unread would take back what is on its way
                pass
        self._listener = None


class FilePlayer:
    """A new recording, capture or raw file, with the times of then."""

    def __init__(self, recorder: AnyRecorder) -> None:
        self.place, self._recorder = recorder.path, recorder

    def wait(self) -> None:
        """A file is always there."""

    def send(self, chunk: Chunk) -> None:
        self._recorder.keep_up()
        self._recorder.write(chunk)

    def close(self) -> None:
        self._recorder.close()


def player(place: str, *, datagrams: bool, port: int = 0) -> Player:
    """The player for "pty", "udp://..." or "tcp://...".

    Raises:
        UsageError: for anything else, and where it cannot take the place of what was recorded.
    """
    if place == "pty" or place.startswith("tcp:"):
        if datagrams:
            raise UsageError(f"datagrams were recorded, and {place} is a byte stream: play them to udp://127.0.0.1")
        return PtyPlayer() if place == "pty" else TcpPlayer(place)
    if not place.startswith("udp:"):
        raise UsageError(f"a replay goes to pty, udp://host:port, tcp://host:port or a new file, not to {place!r}")
    if not datagrams:
        raise UsageError(f"a byte stream was recorded, and {place} takes datagrams: play it to pty or tcp://127.0.0.1:PORT")
    return UdpPlayer(place, port=port)
