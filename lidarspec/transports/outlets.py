"""Outlets: where bytes go in the place of a sensor: a pseudo-terminal, datagrams, TCP connections,
a file.

One mechanism for simulated sensors and for replays; `serving` drives both by the clock. As a real
sensor would, an outlet takes what it is sent whether somebody listens or not, and counts what
nobody took. Only where `patient` is asked for it waits for its reader: a replay, which is to arrive
whole, and a simulated sensor without a pace of its own.
"""

from __future__ import annotations

import contextlib
import errno
import os
import queue
import select
import socket
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

from lidarspec.errors import SourceError, UsageError
from lidarspec.recording.appending import Appender
from lidarspec.spec.links import Http, Link, Tcp, Udp
from lidarspec.spec.sensor import Sensor
from lidarspec.transports.base import Address, failure, ready, reason, with_option
from lidarspec.transports.protocol import POLL, Chunk

try:
    import fcntl
    import termios
    import tty
except ImportError:  # no POSIX
    termios = None  # type: ignore[assignment]

#: bytes of commands read at once, and bytes that wait for a slow reader at most: of a connection,
#: and of a pseudo-terminal.
BLOCK, BACKLOG, PTY_BACKLOG = 1 << 16, 1 << 20, 1 << 18
HERE, EVERYBODY_HERE, NOBODY = "127.0.0.1", "127.255.255.255", ("127.0.0.1", 9)
#: seconds between two looks at whether somebody listens; what a listener takes to settle, since
#: many drop what came while they opened.
LOOK, SETTLE = 0.02, 0.25
#: seconds between two looks at a pseudo-terminal that nobody has open.
UNHEARD = 0.005
#: seconds that the last bytes are given to be fetched.
FAREWELL = 5.0


class Outlet:
    """Where bytes go, and commands come from.

    Attributes:
        place: what to open to listen, as a SOURCE.
        heard: whether somebody listens, as far as that can be known.
        unsent: bytes that nobody took in time.
        port: where it listens, 0 where it does not.
        controls: the outlets of the sensor's other links, by name, over which it is asked and
            answers.
    """

    place: str = ""
    heard: bool = True
    unsent: int = 0
    port: int = 0
    controls: Mapping[str, Outlet] = MappingProxyType({})

    @property
    def source(self) -> str:
        """The SOURCE by which a program elsewhere listens."""
        return self._controlled(self.place)

    def _controlled(self, source: str) -> str:
        """A SOURCE with the address that commands go to: with its port where there is one only."""
        ports = {control.port for control in self.controls.values()}
        return (
            with_option(source, "control", f"{HERE}:{ports.pop()}" if len(ports) == 1 else HERE)
            if ports
            else source
        )

    def send(self, chunks: Sequence[Chunk], *, patient: bool) -> None:
        """Send, in order, and where `patient`, wait until there is room.

        Raises:
            SourceError: where that cannot ever work.
            UsageError: for a datagram of which nobody says the port.
        """
        raise NotImplementedError

    def receive(self, wait: float) -> list[bytes]:
        """What arrives within `wait` seconds at most: commands, as they came."""
        time.sleep(wait)
        return []

    def await_listener(self) -> None:
        """Returns when somebody listens who can have everything from its beginning on, where that
        can be known.
        """

    def unplug(self) -> None:
        """The device is gone: nobody can listen."""

    def plug(self) -> None:
        """The device is back."""

    def finish(self) -> None:
        """Returns when the last bytes have been fetched, or nobody fetches them."""

    def close(self) -> None:
        """Give everything back."""
        self.unplug()
        for control in self.controls.values():
            control.close()


class UdpOutlet(Outlet):
    """Datagrams to an address; commands are taken from the same host.

    Args:
        host: the name or address of a computer.
        ports: one port takes everything; otherwise each datagram goes to the one that it was sent
            to.
        port: for datagrams that do not say where they went.

    Attributes:
        host: its address.

    Raises:
        SourceError: for a host that is none.
    """

    def __init__(self, host: str = HERE, ports: Sequence[int] = (), *, port: int = 0) -> None:
        self._only, self._port = ports[0] if len(ports) == 1 else 0, port
        listed = (
            f":{ports[0]}"
            if len(ports) == 1
            else f"?port={','.join(map(str, ports))}"
            if ports
            else ""
        )
        try:
            family, kind, _, _, address = socket.getaddrinfo(
                host, self._only or 9, type=socket.SOCK_DGRAM
            )[0]
        except OSError as error:
            raise failure(
                f"udp://{host}{listed}: there is no host {host!r} ({reason(error)})", f"ping {host}"
            ) from None
        self.host = str(address[0])
        self.place = (
            f"udp://[{self.host}]{listed}" if ":" in self.host else f"udp://{self.host}{listed}"
        )
        self._socket = socket.socket(family, kind)
        self._socket.setblocking(False)
        with contextlib.suppress(OSError):
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BACKLOG)

    @property
    def source(self) -> str:
        """The SOURCE by which a program on that computer listens: datagrams from elsewhere come in
        at every interface.
        """
        return self._controlled(
            self.place
            if self.host == HERE
            else "udp://" + self.place.removeprefix(f"udp://{self.host}")
        )

    def receive(self, wait: float) -> list[bytes]:
        if ready([self._socket], [], wait)[0]:
            with contextlib.suppress(
                OSError
            ):  # what a destination that does not listen is told with
                data, sender = self._socket.recvfrom(BLOCK)
                return [data] if sender[0] == self.host else []
        return []

    def send(self, chunks: Sequence[Chunk], *, patient: bool) -> None:
        for chunk in chunks:
            port = self._only or (chunk.receiver[1] if chunk.receiver else 0) or self._port
            if not port:
                text = "the datagrams do not say which port they went to: name one, as in"
                raise UsageError(f"{self.place}: {text} udp://{self.host}:2368")
            while not self._sent(chunk.data, port) and not self._sent(chunk.data, port):
                if not patient:
                    self.unsent += len(chunk.data)
                    break

    def close(self) -> None:
        super().close()
        self._socket.close()

    def _sent(self, data: bytes, port: int) -> bool:
        """Whether a datagram went out; where it did not, it is worth another attempt."""
        try:
            self._socket.sendto(data, (self.host, port))
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EWOULDBLOCK):
                ready([], [self._socket], POLL)
            elif error.errno == errno.ENOBUFS:
                time.sleep(LOOK)
            elif error.errno != errno.ECONNREFUSED:  # which is the answer to an earlier datagram
                raise SourceError(f"{self.place}: nothing can be sent: {reason(error)}") from None
            return False
        return True


class TcpOutlet(Outlet):
    """Connections that are accepted at an address; each gets what comes after it.

    Args:
        host, port: where to listen; port 0 takes any that is free.
        sole: for one listener at a time; the next one is heard when `await_listener` is called.

    Raises:
        SourceError: where the address cannot be had.
    """

    def __init__(self, host: str, port: int, *, sole: bool = False) -> None:
        self._sole, self._clients, self.heard = sole, dict[socket.socket, bytearray](), False
        self._listener = listener(host, port)
        self.port = int(self._listener.getsockname()[1])
        self._address = (host, self.port)
        self.place = f"tcp://{host}:{self.port}"

    def receive(self, wait: float) -> list[bytes]:
        if self._listener.fileno() < 0:
            time.sleep(wait)
            return []
        behind = [client for client, waiting in self._clients.items() if waiting]
        doors = [] if self._sole and self._clients else [self._listener]
        readable, writable = ready([*doors, *self._clients], behind, wait)
        for client in writable:
            self._flush(client)
        commands = [self._read(client) for client in readable if client in self._clients]
        if self._listener in readable:
            self._accept()
        return [data for data in commands if data]

    def send(self, chunks: Sequence[Chunk], *, patient: bool) -> None:
        data = b"".join(chunk.data for chunk in chunks)
        if not self._clients:
            self.unsent += len(data)
        for client, waiting in list(self._clients.items()):
            if len(waiting) + len(data) > BACKLOG and not patient:
                self.unsent += len(data)
                continue
            waiting.extend(data)
            self._flush(client)
            while patient and self._clients.get(client):
                ready([], [client], POLL)
                self._flush(client)

    def await_listener(self) -> None:
        self.finish()
        while not self._clients:
            self.receive(LOOK * 10)

    def unplug(self) -> None:
        for client in list(self._clients):
            self._forget(client)
        self._listener.close()

    def plug(self) -> None:
        self._listener = listener(*self._address)

    def finish(self) -> None:
        """Hang up when the last bytes have been sent: closing with something unread would take back
        what is on its way.

        Whoever goes on sending is not waited for longer than who keeps silent.
        """
        limit = time.monotonic() + FAREWELL
        for client in list(self._clients):
            with contextlib.suppress(OSError):
                client.shutdown(socket.SHUT_WR)
                while (left := limit - time.monotonic()) > 0:
                    client.settimeout(left)
                    if not client.recv(BLOCK):
                        break
            self._forget(client)

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            client, _ = self._listener.accept()
            client.setblocking(False)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._clients[client], self.heard = bytearray(), True

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
        self.heard = bool(self._clients)
        client.close()


class AnsweringOutlet(Outlet):
    """Datagrams that are answered: what is sent goes to whoever asked last.

    Args:
        host, port: where to listen; port 0 takes any that is free. What is broadcast within this
            computer is heard too.

    Raises:
        OSError: where the address cannot be had.
    """

    def __init__(self, host: str, port: int) -> None:
        self._socket, self._asker = _bound(host, port), NOBODY
        self.port = int(self._socket.getsockname()[1])
        self.place, self._sockets = f"udp://{host}:{self.port}", [self._socket]
        with contextlib.suppress(OSError):
            self._sockets.append(_bound(EVERYBODY_HERE, self.port))

    def receive(self, wait: float) -> list[bytes]:
        found = []
        for one in ready(self._sockets, [], wait)[0]:
            with contextlib.suppress(OSError):
                data, self._asker = one.recvfrom(BLOCK)
                found.append(data)
        return found

    def send(self, chunks: Sequence[Chunk], *, patient: bool) -> None:
        for chunk in chunks:
            with contextlib.suppress(OSError):  # who asked has gone
                self._socket.sendto(chunk.data, self._asker)

    def close(self) -> None:
        for one in self._sockets:
            one.close()


class HttpOutlet(Outlet):
    """The web server of a simulated sensor.

    Args:
        host, port: where to listen; port 0 takes any that is free.

    Raises:
        OSError: where the address cannot be had.
    """

    def __init__(self, host: str, port: int) -> None:
        from lidarspec.transports.http import Server

        self._server = Server(host, port)
        self.port = int(self._server.server_address[1])
        self.place = f"http://{host}:{self.port}"

    def receive(self, wait: float) -> list[bytes]:
        with contextlib.suppress(queue.Empty):
            return [
                self._server.asked.get(timeout=wait) if wait else self._server.asked.get_nowait()
            ]
        return []

    def send(self, chunks: Sequence[Chunk], *, patient: bool) -> None:
        for chunk in chunks:
            with contextlib.suppress(
                IndexError
            ):  # who asked has been told already that there is no answer
                self._server.waiting.popleft().put(chunk.data)

    def close(self) -> None:
        self._server.server_close()


def _bound(host: str, port: int) -> socket.socket:
    found = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        found.setblocking(False)
        found.bind((host, port))
    except BaseException:
        found.close()
        raise
    return found


class PtyOutlet(Outlet):
    """A serial port that programs open by its path, POSIX only; bytes sent while nobody has it open
    are lost, as on a wire.

    Args:
        link: a symbolic link that leads to it, and comes and goes with it.

    Attributes:
        path: of the port itself, which is another one after each `plug`.

    Raises:
        SourceError: where there is none to be had, or the link cannot be made.
    """

    def __init__(self, link: str | Path | None = None) -> None:
        self._link = Path(link) if link is not None else None
        self._master, self.path, self.heard, self._waiting = -1, "", False, bytearray()
        self.plug()

    def plug(self) -> None:
        """Make the port, in raw mode, with nobody on it."""
        if not has_terminals():
            raise failure(
                "this system has no pseudo-terminals", f"the same with --to tcp://{HERE}:2111"
            )
        try:
            self._master, slave = os.openpty()
        except OSError as error:
            raise failure(
                f"no pseudo-terminal can be had: {reason(error)}",
                f"the same with --to tcp://{HERE}:2111",
            ) from None
        self.path = os.ttyname(slave)
        self.place = str(self._link or self.path)
        tty.setraw(slave)
        os.close(slave)
        os.set_blocking(self._master, False)
        self.heard = False
        if self._link is not None:
            self._make_link(self._link)

    def unplug(self) -> None:
        """Hang up, and take the link away."""
        if (
            self._link is not None
            and self._link.is_symlink()
            and os.readlink(self._link) == self.path
        ):
            self._link.unlink()
        if self._master >= 0:
            os.close(self._master)
        self._master = -1
        self._waiting.clear()

    def receive(self, wait: float) -> list[bytes]:
        if self._master < 0:
            time.sleep(wait)
            return []
        if not self.heard:
            time.sleep(min(wait, UNHEARD))
        elif not any(ready([self._master], [self._master] if self._waiting else [], wait)):
            return []
        self._flush()
        try:
            data = os.read(self._master, BLOCK)
        except BlockingIOError:
            self.heard = True
            return []
        except OSError:
            data = b""
        self.heard = self.heard or bool(data)
        if not data:
            self._left()
        return [data] if data else []

    def send(self, chunks: Sequence[Chunk], *, patient: bool) -> None:
        data = b"".join(chunk.data for chunk in chunks)
        if not self.heard or (len(self._waiting) + len(data) > PTY_BACKLOG and not patient):
            self.unsent += len(data)
            return
        self._waiting += data
        self._flush()
        while patient and self._waiting and self.heard:
            ready([], [self._master], POLL)
            if self._is_alone():
                self._left()
            self._flush()

    def await_listener(self) -> None:
        """Returns when somebody has opened it, and kept it open for a moment."""
        since = time.monotonic()
        while time.monotonic() - since < SETTLE:
            self.receive(LOOK)
            if not self.heard:
                since = time.monotonic()

    def finish(self) -> None:
        """Returns when nothing is left to be read: what is, is lost when the terminal goes away."""
        empty, limit = 0, time.monotonic() + FAREWELL
        while empty < 3 and time.monotonic() < limit and not self._is_alone():
            with self._other_end() as slave:
                waiting = fcntl.ioctl(slave, termios.FIONREAD, bytes(4))
            empty = empty + 1 if waiting == bytes(4) else 0
            time.sleep(LOOK)

    def _is_alone(self) -> bool:
        """Whether nobody has the port open."""
        poller = select.poll()
        poller.register(self._master, select.POLLIN)
        return any(happened & select.POLLHUP for _, happened in poller.poll(0))

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
            time.sleep(LOOK)  # what was written last is still on its way to where it is thrown away
            with contextlib.suppress(OSError, termios.error), self._other_end() as slave:
                termios.tcflush(slave, termios.TCIFLUSH)

    @contextlib.contextmanager
    def _other_end(self) -> Iterator[int]:
        """The descriptor of the end that readers open."""
        slave = os.open(self.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            yield slave
        finally:
            os.close(slave)

    def _make_link(self, link: Path) -> None:
        try:
            if link.is_symlink() and not link.exists():
                link.unlink()
            link.symlink_to(self.path)
        except OSError as error:
            self._link = None
            self.unplug()
            raise failure(
                f"{link}: the link cannot be made: {reason(error)}", f"ls -l {link}"
            ) from None


class FileOutlet(Outlet):
    """A new recording, capture or raw file, with the times of the chunks."""

    def __init__(self, recorder: Appender) -> None:
        self.place, self._recorder = recorder.path, recorder

    def receive(self, wait: float) -> list[bytes]:
        """A file gives no commands."""
        return []

    def send(self, chunks: Sequence[Chunk], *, patient: bool) -> None:
        for chunk in chunks:
            self._recorder.keep_up()
            self._recorder.write(chunk)

    def close(self) -> None:
        self._recorder.close()


def listener(host: str, port: int) -> socket.socket:
    """A TCP socket that listens at an address, and never waits; port 0 takes any that is free.

    Raises:
        SourceError: where the address cannot be had.
    """
    try:
        server = socket.create_server(
            (host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET
        )
    except OSError as error:
        text = f"tcp://{host}:{port}: cannot listen there: {reason(error)}"
        is_taken = error.errno == errno.EADDRINUSE
        raise failure(
            text,
            f"ss -ltnp 'sport = :{port}'" if is_taken else f"the same with tcp://{HERE}:{port}",
        ) from None
    server.setblocking(False)
    return server


def has_terminals() -> bool:
    """Whether the system has pseudo-terminals."""
    return termios is not None


def _controls(sensor: Sensor) -> dict[str, Outlet]:
    """Where a simulated sensor is asked over its other links: on this computer, at the declared
    ports, or free ones if these are taken.
    """
    found: dict[str, Outlet] = {}
    for name in {command.link for command in sensor.commands.values()} - {"data"}:
        declared = sensor.links[name]
        for port in (declared_port(declared), 0):
            with contextlib.suppress(OSError, SourceError):
                if isinstance(declared, Tcp):
                    found[name] = TcpOutlet(HERE, port)
                elif isinstance(declared, Udp):
                    found[name] = AnsweringOutlet(HERE, port)
                elif isinstance(declared, Http):
                    found[name] = HttpOutlet(HERE, port)
                break
    return found


def declared_port(link: Link) -> int:
    """The port at which a sensor is asked over a link, 0 where it declares none."""
    return (
        link.port
        if isinstance(link, Tcp | Http)
        else (*link.ports, link.broadcast)[0]
        if isinstance(link, Udp)
        else 0
    )


def simulated_outlet(sensor: Sensor, place: str, link: str | Path | None = None) -> Outlet:
    """The outlet of a simulated sensor, with those of its other links as `controls`.

    Args:
        place, link: as of the outlet of its data.

    Raises:
        UsageError: for what is no destination, and one that cannot carry what the sensor sends.
        SourceError: where it cannot be had.
    """
    outlet = _data_outlet(sensor, place, link)
    outlet.controls = _controls(sensor)
    return outlet


def _data_outlet(sensor: Sensor, place: str, link: str | Path | None) -> Outlet:
    """The outlet of a simulated sensor: "pty", "udp://HOST:PORT" or "tcp://HOST:PORT"; TCP port 0
    takes one that is free.

    Without a UDP port, data goes to the first one that the sensor declares and the rest to its
    second.

    Args:
        link: a path that leads to the pseudo-terminal.

    Raises:
        UsageError: for what is no destination, and one that cannot carry what the sensor sends.
        SourceError: where it cannot be had.
    """
    if place == "pty":
        if sensor.datagrams:
            raise UsageError(
                f"{sensor.id} sends datagrams, which a serial port cannot carry: simulate it to"
                f" udp://{HERE}"
            )
        return PtyOutlet(link)
    scheme = place.partition("://")[0] if "://" in place else ""
    if scheme not in ("udp", "tcp"):
        raise UsageError(
            f"{place!r} is no destination: pty, udp://HOST:PORT, tcp://HOST:PORT, or a file (.lsr,"
            " .pcap, .pcapng, .bin)"
        )
    if link is not None:
        raise UsageError("a link leads to a pseudo-terminal: it goes with pty alone")
    host, port = _host_and_port(place)
    declared = sensor.links.get("data")
    if scheme == "tcp":
        port = declared.port if port is None and isinstance(declared, Tcp) else port
        if port is None:
            raise UsageError(f"{sensor.id} declares no TCP port: name one, as in tcp://{host}:2111")
        return TcpOutlet(host, port)
    if not isinstance(declared, Udp) or not sensor.datagrams:
        raise UsageError(
            f"{sensor.id} sends a stream of bytes, no datagrams: simulate it to pty or tcp://"
        )
    ports = (port,) if port else declared.ports[:2]
    if not ports:
        raise UsageError(f"{sensor.id} declares no port: name one, as in udp://{host}:2368")
    return UdpOutlet(host, ports)


def replay_outlet(place: str, *, datagrams: bool, port: int = 0) -> Outlet:
    """The outlet of a replay: "pty", "udp://HOST" or "tcp://HOST:PORT"; TCP port 0 takes one that
    is free.

    Args:
        datagrams: whether datagrams were recorded. Without a UDP port, each goes to the one that it
            was sent to then.
        port: for datagrams that do not say where they went.

    Raises:
        UsageError: for what is no destination, and one that cannot take the place of what was
            recorded.
        SourceError: where it cannot be had.
    """
    if place == "pty" or place.startswith("tcp:"):
        if datagrams:
            raise UsageError(
                f"datagrams were recorded, and {place} is a byte stream: play them to udp://{HERE}"
            )
        if place == "pty":
            return PtyOutlet()
    elif not place.startswith("udp:"):
        raise UsageError(
            "a replay goes to pty, udp://host:port, tcp://host:port or a new file, not to"
            f" {place!r}"
        )
    elif not datagrams:
        raise UsageError(
            f"a byte stream was recorded, and {place} takes datagrams: play it to pty or"
            f" tcp://{HERE}:PORT"
        )
    host, named = _host_and_port(place)
    if place.startswith("udp:"):
        return UdpOutlet(host, (named,) if named else (), port=port)
    if named is None:
        raise UsageError(f"{place}: name the port to listen on, as in tcp://{HERE}:2111")
    return TcpOutlet(host, named, sole=True)


def _host_and_port(place: str) -> tuple[str, int | None]:
    """Host, this computer where it is left out, and port of a destination; 0 where any free one
    will do.
    """
    address = Address.parse(place)
    address.check(())
    if address.scheme == "tcp" and address.place.endswith(":0"):
        return replace(address, place=address.place[:-2]).host_and_port()[0] or HERE, 0
    host, port = address.host_and_port()
    return host or HERE, port
