"""Where a replay goes to: a pseudo terminal, UDP, TCP, or another file; each takes the place of the sensor that was recorded."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import time
from dataclasses import replace

from lidarspec.errors import SourceError, UsageError
from lidarspec.files import Chunk, Disconnected
from lidarspec.recording.recorders import AnyRecorder
from lidarspec.recording.replaying import Player
from lidarspec.transports.live import Address, listener, reason

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
