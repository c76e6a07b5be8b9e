"""Send bytes like a sensor, over pseudo-terminals, UDP, TCP and HTTP.

An `OutletLine` is the sensor's end of one link. It sends bytes and returns commands without
waiting. An `Outlet` contains all lines of a sensor. Simulated sensors and replays use outlets.

Like a real sensor, an outlet also sends if no program listens. With `patient=True`, it waits for a
slow reader instead of dropping bytes.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import math
import os
import select
import socket
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path

from lidarspec.errors import SourceError, UsageError
from lidarspec.transports.addresses import with_option
from lidarspec.transports.base import source_error, system_reason, wait_ready
from lidarspec.transports.protocol import POLL_S, Chunk, Disconnected, Sender

try:
    import fcntl
    import termios
    import tty
except ImportError:  # not a POSIX system; `has_terminals` then returns False
    termios = None  # type: ignore[assignment]

LOCALHOST = "127.0.0.1"
_LOOPBACK_BROADCAST = "127.255.255.255"
_READ_BYTES = 1 << 16
#: The event that the program at the other end of a port has closed it, as text.
READER_LEFT = "the reader has disconnected"
#: Maximum number of bytes that wait for a slow reader of a TCP connection; further bytes are
#: dropped. The next constant is the maximum for a reader of a pseudo-terminal.
_MAX_CONNECTION_BACKLOG_BYTES = 1 << 20
_MAX_PTY_BACKLOG_BYTES = 1 << 18
_SEND_BUFFER_BYTES = 1 << 20
#: Number of attempts to send a datagram if the buffer is full or an ICMP error has arrived.
_SEND_ATTEMPTS = 2
#: A replay begins when a reader has kept the port open for this time, because many readers drop
#: bytes that arrive while they open a port.
_READER_SETTLE_S = 0.25
_LISTENER_POLL_S = 0.02
#: Time between two checks of whether a program has opened a pseudo-terminal.
_ABSENT_READER_POLL_S = 0.005
#: Maximum time to wait until readers have read the last bytes.
FETCH_TIMEOUT_S = 5.0
#: Number of consecutive checks without unread bytes after which all bytes of a pseudo-terminal are
#: considered read.
_EMPTY_CHECKS = 3
#: Port that is used to look up the address of a host; nothing is sent to it.
_DISCARD_PORT = 9


class OutletLine:
    """The sensor's end of one link.

    Attributes:
        local_source: the SOURCE with which a program on this computer opens the link.
        port: the port that the line listens on; 0 if it does not listen.
        has_listener: whether a program receives the bytes; True if unknown.
        unsent_bytes: number of bytes that were not read in time.
    """

    local_source: str = ""
    port: int = 0
    has_listener: bool = True
    unsent_bytes: int = 0

    @property
    def source(self) -> str:
        """The SOURCE with which a program on the receiving computer opens the link."""
        return self.local_source

    @property
    def max_wait_s(self) -> float:
        """The maximum time between two calls of `receive`, in seconds."""
        return math.inf

    def readable(self) -> Collection[int | socket.socket]:
        """Return the descriptors on which input can arrive."""
        return ()

    def writable(self) -> Collection[int | socket.socket]:
        """Return the descriptors that have bytes waiting to be written."""
        return ()

    def receive(self) -> list[bytes]:
        """Return the commands that have arrived, and write waiting bytes."""
        return []

    def send(self, chunks: Sequence[Chunk], *, patient: bool) -> None:
        """Send chunks in order.

        Args:
            patient: whether to wait for a slow reader, instead of dropping bytes.

        Raises:
            SourceError: if nothing can be sent.
            UsageError: if the destination port of a datagram is unknown.
        """
        raise NotImplementedError

    def redirect(self, host: str, port: int) -> None:
        """Change the address to which datagrams are sent; other lines ignore this.

        Args:
            host: the address; "" for the same address as before.
        """

    def await_listener(self) -> bool:
        """Wait until a program listens, so that this program receives all bytes.

        For links without connections, such as UDP, this returns at once.

        Returns:
            True if the previous listener has left: the line had a listener when the method was
            called, but this listener has closed the port. The user is then informed of this.
        """
        return False

    def unplug(self) -> None:
        """Disconnect every listener until `plug` is called."""

    def plug(self) -> None:
        """Let listeners connect again."""

    def finish(self) -> None:
        """Wait up to `FETCH_TIMEOUT_S` until the listeners have read the last bytes."""

    def close(self) -> None:
        """Close the line."""
        self.unplug()


class _SendBuffer:
    """Bytes that wait for a slow reader.

    Args:
        write: writes without waiting, and returns the number of written bytes.
        max_bytes: maximum number of waiting bytes.
    """

    def __init__(self, write: Callable[[bytearray], int], max_bytes: int) -> None:
        self._write = write
        self._max_bytes = max_bytes
        self._waiting = bytearray()

    def __len__(self) -> int:
        return len(self._waiting)

    def has_room(self, data: bytes) -> bool:
        return len(self._waiting) + len(data) <= self._max_bytes

    def add(self, data: bytes) -> None:
        self._waiting += data

    def clear(self) -> None:
        self._waiting.clear()

    def flush(self) -> None:
        """Write as many bytes as possible without waiting.

        Raises:
            OSError: if the reader has disconnected.
        """
        with contextlib.suppress(BlockingIOError):
            while self._waiting:
                del self._waiting[: self._write(self._waiting)]


class UdpLine(OutletLine):
    """Sends UDP datagrams to a host, or to the sender of the last command.

    Attributes:
        waits_for_address: whether the destination is unknown at first. Datagrams are dropped until
            a command arrives that contains the port, or whose source port is used.
    """

    takes_commands = False
    waits_for_address = False

    def __init__(
        self,
        local_source: str,
        sockets: Sequence[socket.socket],
        *,
        host: str = "",
        ports: Sequence[int] = (),
        default_port: int = 0,
    ) -> None:
        self.local_source = local_source
        self._sockets = sockets
        self._host = host
        self._ports = ports
        self._default_port = default_port
        self._last_sender: Sender | None = None
        self._is_redirected = False
        for opened in sockets:
            opened.setblocking(False)

    @classmethod
    def to(
        cls,
        host: str = LOCALHOST,
        ports: Sequence[int] = (),
        *,
        default_port: int = 0,
        takes_commands: bool = False,
    ) -> UdpLine:
        """Return a line that sends to a host, and accepts commands only from that host.

        Args:
            ports: the destination ports. With several ports, each datagram is sent to the port of
                its `receiver`.
            default_port: the destination port of datagrams without a receiver; 0 for none.

        Raises:
            SourceError: for an unknown host.
        """
        port_list = _format_ports(ports)
        try:
            family, kind, _, _, address = socket.getaddrinfo(
                host, _DISCARD_PORT, type=socket.SOCK_DGRAM
            )[0]
        except OSError as error:
            raise source_error(
                f"udp://{host}{port_list}: unknown host {host!r} ({system_reason(error)})",
                f"ping {host}",
            ) from None
        numeric_host = str(address[0])
        if ":" in numeric_host:
            bracketed = f"[{numeric_host}]"
        else:
            bracketed = numeric_host
        sender = socket.socket(family, kind)
        with contextlib.suppress(OSError):
            sender.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
        local_source = f"udp://{bracketed}{port_list}"
        line = cls(
            local_source, [sender], host=numeric_host, ports=ports, default_port=default_port
        )
        if takes_commands:
            line._listen_for_commands()
        return line

    @classmethod
    def make_reply_line(cls, host: str, port: int) -> UdpLine:
        """Return a line that replies to the sender of the last command.

        The line also receives commands that programs on this computer broadcast.

        Args:
            port: the port to listen on; 0 selects any free port.

        Raises:
            OSError: if the address is not available.
        """
        first = _bind_udp(host, port)
        port = int(first.getsockname()[1])
        sockets = [first]
        with contextlib.suppress(OSError):
            sockets.append(_bind_udp(_LOOPBACK_BROADCAST, port))
        line = cls(f"udp://{host}:{port}", sockets)
        line.port = port
        return line

    @property
    def source(self) -> str:
        """The SOURCE for the receiving computer, without a host."""
        if not self._host or self._host == LOCALHOST:
            return self.local_source
        return "udp://" + _format_ports(self._ports)

    def readable(self) -> Collection[int | socket.socket]:
        return self._sockets

    def receive(self) -> list[bytes]:
        commands = []
        for opened in self._sockets:
            # An error can be the reply to an earlier datagram that was sent to a closed port.
            with contextlib.suppress(OSError):
                data, sender = opened.recvfrom(_READ_BYTES)
                if not self._host:
                    self._last_sender = sender
                    commands.append(data)
                elif sender[0] == self._host:
                    commands.append(data)
                    if self.takes_commands:
                        self._ports = [sender[1]]
        return commands

    def send(self, chunks: Sequence[Chunk], *, patient: bool) -> None:
        for chunk in chunks:
            receiver = self._find_receiver(chunk)
            if receiver is None or not self._send(chunk.data, receiver, patient=patient):
                self.unsent_bytes += len(chunk.data)

    def redirect(self, host: str, port: int) -> None:
        self._host = host or self._host
        self._ports = [port]
        self._is_redirected = True

    def close(self) -> None:
        for opened in self._sockets:
            opened.close()

    def _listen_for_commands(self) -> None:
        """Receive commands from now on."""
        self.takes_commands = True
        if self._host == LOCALHOST:
            self._sockets[0].bind((LOCALHOST, 0))
            own_port = self._sockets[0].getsockname()[1]
            self.local_source = with_option(self.local_source, "src", f"{LOCALHOST}:{own_port}")

    def _find_receiver(self, chunk: Chunk) -> Sender | None:
        if not self._host:
            return self._last_sender
        if len(self._ports) == 1:
            return self._host, self._ports[0]
        port = chunk.receiver[1] if chunk.receiver else 0
        port = port or self._default_port
        if not port and self.waits_for_address:
            return None
        if not port:
            text = "the recording does not contain the destination port: specify one, as in"
            raise UsageError(f"{self.local_source}: {text} udp://{self._host}:2368")
        return self._host, port

    def _send(self, data: bytes, receiver: Sender, *, patient: bool) -> bool:
        """Send a datagram, and return whether it was sent."""
        attempts = itertools.count() if patient else range(_SEND_ATTEMPTS)
        for _ in attempts:
            try:
                self._sockets[0].sendto(data, receiver)
            except OSError as error:
                if not self._handle_send_error(error):
                    return False
            else:
                return True
        return False

    def _handle_send_error(self, error: OSError) -> bool:
        """Return whether to send a datagram again after an error.

        If a buffer is full, the method waits before it returns.

        Raises:
            SourceError: if sending again is useless, and the user has named the receiver.
        """
        if error.errno in (errno.EAGAIN, errno.EWOULDBLOCK):
            wait_ready([], [self._sockets[0]], POLL_S)
            return True
        if error.errno == errno.ENOBUFS:
            time.sleep(_LISTENER_POLL_S)
            return True
        if error.errno == errno.ECONNREFUSED:
            return True  # an ICMP reply to an earlier datagram
        if self._host and not self._is_redirected:
            reason = system_reason(error)
            raise SourceError(f"{self.local_source}: cannot send: {reason}") from None
        return False


class TcpLine(OutletLine):
    """Sends to all TCP connections at an address.

    A new connection receives only the bytes that are sent after it was opened.

    Args:
        port: the port to listen on; 0 selects any free port.
        sole: whether only one connection at a time is accepted.
        is_reported: whether the sensor reports `port` to the host, so that the SOURCE contains no
            port.

    Raises:
        SourceError: if the address is not available.
    """

    def __init__(
        self, host: str, port: int, *, sole: bool = False, is_reported: bool = False
    ) -> None:
        self._sole = sole
        self._clients: dict[socket.socket, _SendBuffer] = {}
        self._listener: socket.socket | None = listen(host, port)
        self.has_listener = False
        self.port = int(self._listener.getsockname()[1])
        self._host = host
        if is_reported:
            self.local_source = f"tcp://{host}"
        else:
            self.local_source = f"tcp://{host}:{self.port}"

    def readable(self) -> Collection[int | socket.socket]:
        if self._listener is None or not self._accepts():
            return list(self._clients)
        return [self._listener, *self._clients]

    def writable(self) -> Collection[int | socket.socket]:
        return [client for client, backlog in self._clients.items() if backlog]

    def receive(self) -> list[bytes]:
        commands = []
        for client in list(self._clients):
            self._flush(client)
            if data := self._read(client):
                commands.append(data)
        if self._listener is not None and self._accepts():
            self._accept(self._listener)
        return commands

    def send(self, chunks: Sequence[Chunk], *, patient: bool) -> None:
        data = b"".join(chunk.data for chunk in chunks)
        if not self._clients:
            self.unsent_bytes += len(data)
        for client, backlog in list(self._clients.items()):
            if not patient and not backlog.has_room(data):
                self.unsent_bytes += len(data)
                continue
            backlog.add(data)
            self._flush(client)
            while patient and self._clients.get(client):
                wait_ready([], [client], POLL_S)
                self._flush(client)

    def await_listener(self) -> bool:
        self.finish()
        while not self._clients:
            wait_for([self], 1.0)
            self.receive()
        return False

    def unplug(self) -> None:
        for client in list(self._clients):
            self._disconnect(client)
        if self._listener is not None:
            self._listener.close()
        self._listener = None

    def plug(self) -> None:
        self._listener = listen(self._host, self.port)

    def finish(self) -> None:
        """Disconnect all clients after they have received the last bytes."""
        limit = time.monotonic() + FETCH_TIMEOUT_S
        for client in list(self._clients):
            with contextlib.suppress(OSError):
                client.shutdown(socket.SHUT_WR)
                # closing a socket with unread input discards bytes that were not yet received
                while (remaining := limit - time.monotonic()) > 0:
                    client.settimeout(remaining)
                    if not client.recv(_READ_BYTES):
                        break
            self._disconnect(client)

    def _accepts(self) -> bool:
        return not (self._sole and self._clients)

    def _accept(self, listener: socket.socket) -> None:
        with contextlib.suppress(OSError):
            client, _ = listener.accept()
            client.setblocking(False)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._clients[client] = _SendBuffer(client.send, _MAX_CONNECTION_BACKLOG_BYTES)
            self.has_listener = True

    def _read(self, client: socket.socket) -> bytes:
        if client not in self._clients:
            return b""
        try:
            data = client.recv(_READ_BYTES)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._disconnect(client)
        return data

    def _flush(self, client: socket.socket) -> None:
        try:
            self._clients[client].flush()
        except OSError:
            self._disconnect(client)

    def _disconnect(self, client: socket.socket) -> None:
        self._clients.pop(client, None)
        self.has_listener = bool(self._clients)
        client.close()


class PtyLine(OutletLine):
    """A pseudo-terminal (POSIX only), which programs open by its path.

    Bytes that are sent before a program opens the terminal are lost.

    Args:
        link: path of a symbolic link to the terminal. The link is created and removed together with
            the terminal.

    Attributes:
        path: the path of the terminal; it changes with each `plug`.

    Raises:
        SourceError: if no terminal is available, or the link cannot be created.
    """

    def __init__(self, link: str | Path | None = None) -> None:
        self._link = None if link is None else Path(link)
        self._master = -1
        self._backlog = _SendBuffer(self._write, _MAX_PTY_BACKLOG_BYTES)
        self.path = ""
        self.plug()

    @property
    def max_wait_s(self) -> float:
        """The maximum time between two checks for a reader, in seconds."""
        if self._master >= 0 and not self.has_listener:
            # opening the terminal causes no event
            return _ABSENT_READER_POLL_S
        return math.inf

    def readable(self) -> Collection[int | socket.socket]:
        if self.has_listener:
            return [self._master]
        return []

    def writable(self) -> Collection[int | socket.socket]:
        if self._backlog:
            return [self._master]
        return []

    def plug(self) -> None:
        """Create the pseudo-terminal, in raw mode."""
        if not has_terminals():
            raise _make_missing_terminal_error("this system has no pseudo-terminals")
        try:
            self._master, slave = os.openpty()
        except OSError as error:
            raise _make_missing_terminal_error(
                f"no pseudo-terminal is available: {system_reason(error)}"
            ) from None
        self.path = os.ttyname(slave)
        self.local_source = str(self._link or self.path)
        tty.setraw(slave)
        os.close(slave)
        os.set_blocking(self._master, False)
        self.has_listener = False
        if self._link is not None:
            self._make_link(self._link)

    def unplug(self) -> None:
        """Close the terminal, and remove the link."""
        link = self._link
        if link is not None and link.is_symlink() and os.readlink(link) == self.path:
            link.unlink()
        if self._master >= 0:
            os.close(self._master)
        self._master = -1
        self.has_listener = False
        self._backlog.clear()

    def receive(self) -> list[bytes]:
        if self._master < 0:
            return []
        self._flush()
        try:
            data = os.read(self._master, _READ_BYTES)
        except BlockingIOError:
            self.has_listener = True
            return []
        except OSError:
            data = b""
        if not data:
            self._handle_hangup()
            return []
        self.has_listener = True
        return [data]

    def send(self, chunks: Sequence[Chunk], *, patient: bool) -> None:
        data = b"".join(chunk.data for chunk in chunks)
        has_room = patient or self._backlog.has_room(data)
        if not self.has_listener or not has_room:
            self.unsent_bytes += len(data)
            return
        self._backlog.add(data)
        self._flush()
        while patient and self._backlog:
            wait_ready([], [self._master], POLL_S)
            if self._is_alone():
                self._handle_hangup()
            self._flush()

    def await_listener(self) -> bool:
        """Wait until a reader has kept the terminal open for `_READER_SETTLE_S`."""
        had_listener = self.has_listener
        has_left = False
        since = time.monotonic()
        while time.monotonic() - since < _READER_SETTLE_S:
            wait_for([self], _LISTENER_POLL_S)
            self.receive()
            if not self.has_listener:
                has_left = had_listener
                since = time.monotonic()
        return has_left

    def finish(self) -> None:
        """Wait until all bytes are read, because closing discards unread bytes."""
        limit = time.monotonic() + FETCH_TIMEOUT_S
        empty_checks = 0
        while empty_checks < _EMPTY_CHECKS and time.monotonic() < limit and not self._is_alone():
            with self._open_slave() as slave:
                waiting = fcntl.ioctl(slave, termios.FIONREAD, bytes(4))
            empty_checks = empty_checks + 1 if waiting == bytes(4) else 0
            time.sleep(_LISTENER_POLL_S)

    def _is_alone(self) -> bool:
        """Return whether no other program has opened the terminal."""
        poller = select.poll()
        poller.register(self._master, select.POLLIN)
        return any(event & select.POLLHUP for _, event in poller.poll(0))

    def _write(self, data: bytearray) -> int:
        return os.write(self._master, data)

    def _flush(self) -> None:
        try:
            self._backlog.flush()
        except OSError:
            self._handle_hangup()

    def _handle_hangup(self) -> None:
        """Discard the waiting bytes, so that the next reader does not receive them."""
        self.unsent_bytes += len(self._backlog)
        self._backlog.clear()
        if not self.has_listener:
            return
        self.has_listener = False
        # The last written bytes may not be in the terminal's buffer yet.
        time.sleep(_LISTENER_POLL_S)
        with contextlib.suppress(OSError, termios.error), self._open_slave() as slave:
            termios.tcflush(slave, termios.TCIFLUSH)

    @contextlib.contextmanager
    def _open_slave(self) -> Iterator[int]:
        """Open the end of the terminal that readers open."""
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
            raise source_error(
                f"{link}: cannot create the link: {system_reason(error)}", f"ls -l {link}"
            ) from None


class Outlet:
    """The lines of one sensor.

    Args:
        data: the line of the data link.
        controls: name of each link except the data link -> its line.
    """

    def __init__(self, data: OutletLine, controls: Mapping[str, OutletLine] | None = None) -> None:
        self.data = data
        self.controls = dict(controls or {})
        self._lines = {"data": data, **self.controls}

    @property
    def local_source(self) -> str:
        """The SOURCE with which a program on this computer opens the data link."""
        return self.data.local_source

    @property
    def source(self) -> str:
        """The SOURCE for the receiving computer, with a `control=` option if required."""
        ports = {line.port for line in self.controls.values()}
        if not ports:
            return self.data.source
        if len(ports) > 1:
            return with_option(self.data.source, "control", LOCALHOST)
        return with_option(self.data.source, "control", f"{LOCALHOST}:{ports.pop()}")

    @property
    def has_listener(self) -> bool:
        """Whether a program listens to the data; True if this is unknown."""
        return self.data.has_listener

    @property
    def unsent_bytes(self) -> int:
        """The number of data bytes that were not read in time."""
        return self.data.unsent_bytes

    def receive(self, wait: float) -> list[tuple[str, bytes]]:
        """Wait at most `wait` seconds for commands, and return (link, bytes) of each."""
        wait_for(self._lines.values(), wait)
        return [(name, data) for name, line in self._lines.items() for data in line.receive()]

    def send(self, link: str, chunks: Sequence[Chunk], *, patient: bool = False) -> None:
        """Send chunks over a link; see `OutletLine.send`."""
        self._lines[link].send(chunks, patient=patient)

    def deliver(self, chunk: Chunk) -> None:
        """Send a chunk over the data link; wait for a slow listener.

        Commands from the listener are ignored.

        Raises:
            Disconnected: if the listener has disconnected.
            SourceError, UsageError: the errors of `OutletLine.send`.
        """
        self.data.receive()
        if self.data.has_listener:
            self.data.send([chunk], patient=True)
        if not self.data.has_listener:
            raise Disconnected(f"{self.local_source}: {READER_LEFT}")

    def await_listener(self) -> bool:
        """Wait until a program reads the data; see `OutletLine.await_listener`."""
        return self.data.await_listener()

    def unplug(self) -> None:
        """Disconnect every listener until `plug` is called."""
        for line in self._lines.values():
            line.unplug()

    def plug(self) -> None:
        """Let listeners connect again."""
        for line in self._lines.values():
            line.plug()

    def finish(self) -> None:
        """Wait until the last bytes of the data were read; see `OutletLine.finish`."""
        self.data.finish()

    def close(self) -> None:
        """Close all lines."""
        for line in self._lines.values():
            line.close()


def wait_for(lines: Collection[OutletLine], timeout: float) -> None:
    """Wait until a line has input or can send its waiting bytes, at most `timeout` seconds."""
    timeout = min([timeout, *(line.max_wait_s for line in lines)])
    reading = [descriptor for line in lines for descriptor in line.readable()]
    writing = [descriptor for line in lines for descriptor in line.writable()]
    if reading or writing:
        wait_ready(reading, writing, timeout)
    else:
        time.sleep(timeout)


def listen(host: str, port: int) -> socket.socket:
    """Return a non-blocking TCP socket that listens; port 0 selects any free port.

    Raises:
        SourceError: if the address is not available.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        server = socket.create_server((host, port), family=family)
    except OSError as error:
        next_step = f"repeat with tcp://{LOCALHOST}:{port}"
        if error.errno == errno.EADDRINUSE:
            next_step = f"ss -ltnp 'sport = :{port}'"
        raise source_error(
            f"tcp://{host}:{port}: cannot listen: {system_reason(error)}", next_step
        ) from None
    server.setblocking(False)
    return server


def has_terminals() -> bool:
    """Return whether the system has pseudo-terminals."""
    return termios is not None


def _make_missing_terminal_error(text: str) -> SourceError:
    return source_error(text, f"repeat with --to tcp://{LOCALHOST}:2111")


def _bind_udp(host: str, port: int) -> socket.socket:
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        bound.bind((host, port))
    except BaseException:
        bound.close()
        raise
    return bound


def _format_ports(ports: Sequence[int]) -> str:
    """Return ports as the text that follows the host in a SOURCE."""
    if not ports:
        return ""
    if len(ports) == 1:
        return f":{ports[0]}"
    return f"?port={','.join(map(str, ports))}"
