"""Read a byte stream over TCP, and connect again after a disconnection."""

from __future__ import annotations

import contextlib
import errno
import socket
import threading
from shlex import quote

from lidarspec.errors import SourceError, SourceTimeout, UsageError, suggest
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.links import Tcp
from lidarspec.transports.addresses import SourceAddress
from lidarspec.transports.base import (
    StreamTransport,
    disconnected_error,
    find_data_link,
    sensor_option,
    source_error,
    system_reason,
    wait_readable,
)
from lidarspec.transports.protocol import Disconnected

#: maximum number of bytes per read.
MAX_READ_BYTES = 1 << 18
#: timeout of the first connection attempt, and of writing.
CONNECT_TIMEOUT_S = 5.0
#: timeout of each attempt to connect again.
RECONNECT_TIMEOUT_S = 0.5
#: time without a byte after which an incomplete frame is discarded. It is long because TCP
#: retransmits a lost segment only after 0.2 s, and then after 0.4 s, 0.8 s and so on.
SILENCE_S = 10.0


class TcpTransport(StreamTransport):
    """A TCP connection to a sensor.

    Args:
        port: the port; None if the sensor reports a port, to which `connect_to` connects.

    Raises:
        SourceError: if the connection fails.
    """

    silence = SILENCE_S

    def __init__(
        self, label: str, host: str, port: int | None, *, sensor: Sensor | None = None
    ) -> None:
        super().__init__(label, sensor)
        self._is_reported = port is None
        self._address = (host, port or 0)
        self._socket: socket.socket | None = None
        self._is_connected = threading.Event()
        if port is not None:
            self._open(CONNECT_TIMEOUT_S)

    @property
    def awaits_port(self) -> bool:
        return self._is_reported and self._socket is None

    def connect_to(self, port: int) -> None:
        if self.awaits_port:
            self._address = (self._address[0], port)
            self._open(CONNECT_TIMEOUT_S)

    def _receive(self, timeout: float) -> bytes:
        if self._socket is None:
            self._is_connected.wait(timeout)
            return b""
        if not wait_readable(self._socket.fileno(), timeout):
            return b""
        data = self._socket.recv(MAX_READ_BYTES)
        if not data:
            raise Disconnected(f"{self.label}: the sensor closed the connection")
        return data

    def write(self, data: bytes) -> None:
        if self._socket is None:
            raise SourceError(f"{self.label}: the sensor has not reported the port of its data")
        try:
            self._socket.sendall(data)
        except OSError as error:
            raise disconnected_error(self.label, error) from None

    def reopen(self) -> None:
        """Close the connection; open it again unless the sensor reports the port."""
        self._close_socket()
        if not self._is_reported:
            self._open(RECONNECT_TIMEOUT_S)

    def peer(self) -> str | None:
        return self._address[0]

    def close(self) -> None:
        self.closed = True
        self._close_socket()

    def _open(self, timeout: float) -> None:
        self._socket = self._connect(timeout)
        self._is_connected.set()

    def _close_socket(self) -> None:
        self._is_connected.clear()
        if self._socket is not None:
            self._socket.close()
        self._socket = None

    def _connect(self, timeout: float) -> socket.socket:
        try:
            connection = socket.create_connection(self._address, timeout)
        except OSError as error:
            raise self._make_connection_error(error) from None
        connection.settimeout(CONNECT_TIMEOUT_S)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with contextlib.suppress(OSError):
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        return connection

    def _make_connection_error(self, error: OSError) -> SourceError:
        host, port = self._address
        doctor = f"lidarspec doctor {quote(self.label)}{sensor_option(self._sensor)}"
        if isinstance(error, socket.gaierror):
            return source_error(f"{self.label}: unknown host {host!r}", doctor)
        if error.errno == errno.ECONNREFUSED:
            return source_error(
                f"{self.label}: {host} refuses connections to TCP port {port}", doctor
            )
        if isinstance(error, TimeoutError) or error.errno in (errno.ETIMEDOUT, errno.EHOSTUNREACH):
            return suggest(
                SourceTimeout(f"{self.label}: no reply from {host} on TCP port {port}"),
                f"ping {host}",
            )
        return source_error(
            f"{self.label}: TCP port {port} of {host}: {system_reason(error)}", doctor
        )


def connect(address: SourceAddress, sensor: Sensor | None = None) -> TcpTransport:
    """Open the connection of a TCP SOURCE: "tcp://192.168.1.200:2111".

    Raises:
        UsageError: if host or port is missing, or for any option.
        SourceError: if the connection fails.
    """
    address.check(())
    host, port = address.host_and_port()
    link = find_data_link(sensor, Tcp)
    if port is None and link is not None and link.port:
        port = link.port
    is_reported = link is not None and bool(link.reported)
    if not host or (port is None and not is_reported):
        raise UsageError(f"{address.text}: expected host and port, as in tcp://192.168.1.200:2111")
    return TcpTransport(address.text, host, port, sensor=sensor)
