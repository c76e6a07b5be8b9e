"""Receive the UDP datagrams of a sensor, with exact arrival times.

Sensors send to the address of this computer or to the broadcast address. Sockets are therefore
bound to all interfaces ("udp://"), unless the SOURCE contains the address of an interface
("udp://127.0.0.1:2368"). Nothing is sent until `write` is called.

Linux stores the arrival time of each datagram, and the number of datagrams that the socket has
dropped. Arrival times are therefore exact, although the thread pauses after each read. The kernel
may grant a smaller receive buffer than requested.

`ReceiveSlots` fetches many datagrams with one system call, recvmmsg. One call for each datagram
would be too slow for a fast sensor, because each call releases the interpreter lock.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import ipaddress
import os
import selectors
import socket
import struct
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from shlex import quote

from lidarspec.errors import SourceError, UsageError
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.links import Udp, is_datagram
from lidarspec.transports.addresses import SourceAddress, parse_origin, resolve_host, with_option
from lidarspec.transports.base import (
    disconnected_error,
    sensor_option,
    sleep_until,
    source_error,
    system_reason,
)
from lidarspec.transports.host_clock import HostClock
from lidarspec.transports.protocol import Chunk, LiveTransport, Origin, Sender

#: Maximum number of datagrams that one system call fetches.
SLOT_COUNT = 256
#: Size of the buffer for the payload of a datagram; unused pages of it need no memory. The next
#: constants are the sizes of the buffers for the datagram's address and its control messages.
PAYLOAD_SLOT_BYTES = 1 << 16
ADDRESS_SLOT_BYTES = 32
CONTROL_SLOT_BYTES = 128
#: Layout of the header of a control message: size, level, type.
_CONTROL_HEADER = struct.Struct("@Nii")
#: Layout of a control message with two 64-bit integers.
_CONTROL_WITH_TWO_INTEGERS = struct.Struct("@Niiqq")
_CONTROL_ALIGNMENT = struct.calcsize("@N")
#: Requested size of the receive buffer.
REQUESTED_BUFFER_BYTES = 8 << 20
#: Maximum number of datagrams to fetch from a socket before the other sockets are read.
MAX_DATAGRAMS_PER_READ = 1024
#: Pause between two reads if the kernel records arrival times. Waking up for each datagram would
#: take more time than all other work.
READ_PAUSE_S = 0.002
#: Maximum time that a datagram may have waited in the kernel. A longer time means that the clock
#: was set.
MAX_KERNEL_DELAY_NS = 60_000_000_000
#: Numbers of Linux socket options that have no name in Python (asm-generic/socket.h).
SO_RCVBUFFORCE = 33
SO_TIMESTAMPNS = 35
SO_RXQ_OVFL = 40
#: Layout of the value of SO_TIMESTAMPNS: seconds and nanoseconds.
TIMESTAMP = struct.Struct("qq")
#: The destination of commands as long as the address of the sensor is unknown.
BROADCAST_ADDRESS = "255.255.255.255"
#: Options of a UDP SOURCE.
OPTIONS = ("port", "group", "src")


class _Vector(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("size", ctypes.c_size_t))


class _MessageHeader(ctypes.Structure):
    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_size", ctypes.c_uint32),
        ("vectors", ctypes.POINTER(_Vector)),
        ("vector_count", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_size", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _ReceivedDatagram(ctypes.Structure):
    _fields_ = (("message", _MessageHeader), ("size", ctypes.c_uint))


#: Index of the size of the first datagram in the array of headers, in units of c_uint. The next
#: constant is the step to the next datagram.
_SIZE_INDEX = _ReceivedDatagram.size.offset // ctypes.sizeof(ctypes.c_uint)
_SIZE_STEP = ctypes.sizeof(_ReceivedDatagram) // ctypes.sizeof(ctypes.c_uint)
#: Index of the size of the first datagram's control messages, in units of c_size_t. The next
#: constant is the step to the next datagram.
_CONTROL_SIZE_INDEX = _MessageHeader.control_size.offset // ctypes.sizeof(ctypes.c_size_t)
_CONTROL_SIZE_STEP = ctypes.sizeof(_ReceivedDatagram) // ctypes.sizeof(ctypes.c_size_t)


class ReceiveSlots:
    """Buffers for many datagrams, which each call of `fill` overwrites.

    Raises:
        OSError: if the system has no recvmmsg.
    """

    def __init__(self) -> None:
        try:
            self._call = ctypes.CDLL(None, use_errno=True).recvmmsg
        except (AttributeError, TypeError):
            raise OSError("this system has no recvmmsg") from None
        self._call.argtypes = (
            ctypes.c_int,
            ctypes.c_void_p,
            ctypes.c_uint,
            ctypes.c_int,
            ctypes.c_void_p,
        )
        self._payload = ctypes.create_string_buffer(SLOT_COUNT * PAYLOAD_SLOT_BYTES)
        self._names = ctypes.create_string_buffer(SLOT_COUNT * ADDRESS_SLOT_BYTES)
        self._control = ctypes.create_string_buffer(SLOT_COUNT * CONTROL_SLOT_BYTES)
        self._payload_bytes = memoryview(self._payload).cast("B")
        self._name_bytes = memoryview(self._names).cast("B")
        self._control_bytes = memoryview(self._control).cast("B")
        self._vectors = (_Vector * SLOT_COUNT)()
        self._headers = ctypes.create_string_buffer(SLOT_COUNT * ctypes.sizeof(_ReceivedDatagram))
        self._datagrams = (_ReceivedDatagram * SLOT_COUNT).from_buffer(self._headers)
        # Reading ctypes fields by name would be too slow for each datagram.
        self._sizes = memoryview(self._headers).cast("B").cast("I")
        self._control_sizes = memoryview(self._headers).cast("B").cast("P")
        for index in range(SLOT_COUNT):
            self._vectors[index] = _Vector(
                ctypes.addressof(self._payload) + index * PAYLOAD_SLOT_BYTES, PAYLOAD_SLOT_BYTES
            )
            message = self._datagrams[index].message
            message.name = ctypes.addressof(self._names) + index * ADDRESS_SLOT_BYTES
            message.name_size = ADDRESS_SLOT_BYTES
            message.vectors = ctypes.pointer(self._vectors[index])
            message.vector_count = 1
            message.control = ctypes.addressof(self._control) + index * CONTROL_SLOT_BYTES
            message.control_size = CONTROL_SLOT_BYTES
        self._initial_headers = self._headers.raw
        self._senders: dict[bytes, tuple[str, int]] = {}  # cache of `_parse_address`

    def fill(self, descriptor: int) -> int:
        """Fetch the waiting datagrams of a socket, and return their number.

        Returns:
            At most `SLOT_COUNT`; 0 if no datagram waits.

        Raises:
            OSError: if the system call fails.
        """
        # The previous system call has overwritten the sizes.
        ctypes.memmove(self._headers, self._initial_headers, len(self._initial_headers))
        count: int = self._call(descriptor, self._datagrams, SLOT_COUNT, socket.MSG_DONTWAIT, None)
        if count < 0:
            code = ctypes.get_errno()
            if code in (errno.EAGAIN, errno.EWOULDBLOCK, errno.EINTR):
                return 0
            raise OSError(code, os.strerror(code))
        return count

    def datagram(self, index: int) -> tuple[bytes, tuple[str, int]]:
        """Return a fetched datagram and its sender."""
        start = index * PAYLOAD_SLOT_BYTES
        size = self._sizes[_SIZE_INDEX + index * _SIZE_STEP]
        data = self._payload_bytes[start : start + size].tobytes()
        name = self._name_bytes[
            index * ADDRESS_SLOT_BYTES : index * ADDRESS_SLOT_BYTES + ADDRESS_SLOT_BYTES
        ].tobytes()
        sender = self._senders.get(name)
        if sender is None:
            if len(self._senders) >= SLOT_COUNT:
                self._senders.clear()
            sender = self._senders[name] = _parse_address(name)
        return data, sender

    def single_control_message(self, index: int) -> tuple[int, int, int] | None:
        """Return the control message of a datagram that has exactly one, with two integers.

        This method is faster than `control_messages`, and sufficient if the kernel reports only the
        arrival time of the datagram.

        Returns:
            (type, first integer, second integer); None if the datagram has no control message,
            several control messages, or a control message of another size.
        """
        control_size = self._control_sizes[_CONTROL_SIZE_INDEX + index * _CONTROL_SIZE_STEP]
        if control_size != _CONTROL_WITH_TWO_INTEGERS.size:
            return None
        size, level, kind, first, second = _CONTROL_WITH_TWO_INTEGERS.unpack_from(
            self._control_bytes, index * CONTROL_SLOT_BYTES
        )
        if size == _CONTROL_WITH_TWO_INTEGERS.size and level == socket.SOL_SOCKET:
            return (kind, first, second)
        return None

    def control_messages(self, index: int) -> list[tuple[int, memoryview]]:
        """Return (type, value) of each socket-level control message of a datagram."""
        start = index * CONTROL_SLOT_BYTES
        messages = []
        end = start + self._control_sizes[_CONTROL_SIZE_INDEX + index * _CONTROL_SIZE_STEP]
        while start + _CONTROL_HEADER.size <= end:
            size, level, kind = _CONTROL_HEADER.unpack_from(self._control_bytes, start)
            if size < _CONTROL_HEADER.size:
                break
            if level == socket.SOL_SOCKET:
                messages.append(
                    (kind, self._control_bytes[start + _CONTROL_HEADER.size : start + size])
                )
            start += -(-size // _CONTROL_ALIGNMENT) * _CONTROL_ALIGNMENT
        return messages


def _parse_address(name: bytes) -> tuple[str, int]:
    """Return (host, port) of a socket address in the format of the kernel."""
    family = int.from_bytes(name[:2], sys.byteorder)
    port = int.from_bytes(name[2:4], "big")
    if family == socket.AF_INET6:
        packed = name[8:24]
    else:
        packed = name[4:8]
    return socket.inet_ntop(family, packed), port


class UdpTransport(LiveTransport):
    """Receives the datagrams that arrive on one or more ports.

    Args:
        ports: the ports to listen on; 0 for any free port.
        host: address of the interface; "" for all interfaces.
        group: multicast group to join; None to join no group.
        sender: accept only datagrams from this "HOST" or "HOST:PORT"; others are counted in
            `foreign`. None to accept all.
        datagrams: whether each datagram is a whole frame, not a portion of a byte stream.
        remote: the destination of `write`; by default `sender` with its port, or the sender that
            `accept` sets.
        broadcast: whether `remote` is a broadcast address, which `accept` replaces by the address
            of the sensor.

    Attributes:
        ports: the open ports.

    Raises:
        SourceError: if a port cannot be opened, or the group cannot be joined.
    """

    def __init__(
        self,
        label: str,
        ports: Sequence[int],
        *,
        host: str = "",
        group: str | None = None,
        sender: str | None = None,
        datagrams: bool = True,
        sensor: Sensor | None = None,
        remote: tuple[str, int] | None = None,
        broadcast: bool = False,
    ) -> None:
        self.clock = HostClock()
        self.label = label
        self.datagrams = datagrams
        if sender is None:
            self._origin = None
        else:
            self._origin = parse_origin(sender)
        self._remote = remote
        self._sensor = sensor
        if self._origin is not None and self._origin.port is not None:
            self._remote = (self._origin.host, self._origin.port)
        self._is_addressed_by_user = self._remote is not None and not broadcast
        self._selector = selectors.DefaultSelector()
        self._sockets: list[_Socket] = []
        self._next_read = 0.0
        slots: ReceiveSlots | None = None
        with contextlib.suppress(OSError):
            slots = ReceiveSlots() if sys.platform == "linux" else None
        try:
            for port in ports:
                self._sockets.append(_Socket(self._open_socket(host, port, group), slots))
                self._selector.register(
                    self._sockets[-1].socket, selectors.EVENT_READ, self._sockets[-1]
                )
                if broadcast:
                    self._sockets[-1].socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        except BaseException:
            self.close()
            raise
        self.ports = tuple(opened.address[1] for opened in self._sockets)
        smallest = min(
            (opened.buffer_bytes for opened in self._sockets), default=REQUESTED_BUFFER_BYTES
        )
        self.warnings = list_buffer_warnings(REQUESTED_BUFFER_BYTES, smallest)

    def read(self, timeout: float) -> list[Chunk]:
        sleep_until(self._next_read)
        chunks: list[Chunk] = []
        if self.closed:
            ready = []
        else:
            ready = [key.data for key, _ in self._selector.select(timeout)]
        for opened in ready:
            self._fetch(opened, chunks)
        self.kernel_drops = sum(opened.drops for opened in self._sockets)
        has_pause = 0 < len(chunks) < SLOT_COUNT and all(opened.is_timed for opened in ready)
        self._next_read = time.monotonic() + READ_PAUSE_S if has_pause else 0.0
        return chunks

    def write(self, data: bytes) -> None:
        if self._remote is None:
            text = (
                f"{self.label}: the address of the sensor is unknown, because no frame has"
                " arrived yet"
            )
            raise source_error(
                text, f"repeat with {with_option(self.label, 'src', 'ADDRESS:PORT')}"
            )
        try:
            self._sockets[0].socket.sendto(data, self._remote)
        except OSError as error:
            raise disconnected_error(self.label, error) from None

    @property
    def own_port(self) -> int | None:
        return self.ports[0]

    @property
    def addressed(self) -> bool:
        """Whether `write` has a destination: `remote` or an accepted sender."""
        return self._remote is not None

    def accept(self, sender: Sender) -> None:
        if not self._is_addressed_by_user:
            self._remote = sender

    def reopen(self) -> None:
        """Do nothing, because a socket stays open when the sensor disappears."""

    def peer(self) -> str | None:
        if self._origin:
            return self._origin.host
        if self._remote:
            return self._remote[0]
        return None

    def close(self) -> None:
        self.closed = True
        self._selector.close()
        for opened in self._sockets:
            opened.socket.close()

    def _fetch(self, opened: _Socket, chunks: list[Chunk]) -> None:
        """Append the waiting datagrams of a socket, up to a limit, to `chunks`."""
        start = len(chunks)
        try:
            origin = self._origin
            for data, sender, at in opened.iter_datagrams(*self.clock.now_and_wall()):
                if origin is not None and sender not in origin:
                    self.foreign += 1
                    self.other_sender = sender
                    continue
                chunks.append(Chunk(data, at, sender, opened.address))
        except ConnectionRefusedError:
            return  # an ICMP reply to a sent datagram; the socket still receives
        except OSError as error:
            if not self.closed:
                raise SourceError(f"{self.label}: {system_reason(error)}") from None
        _order_times(chunks, start)

    def _open_socket(self, host: str, port: int, group: str | None) -> socket.socket:
        if ":" in host or ":" in (group or ""):
            family = socket.AF_INET6
        else:
            family = socket.AF_INET
        opened = socket.socket(family, socket.SOCK_DGRAM)
        try:
            if group is not None:
                opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            opened.bind(("" if group is not None else host, port))
            if group is not None:
                _join_group(opened, group, host)
        except OSError as error:
            opened.close()
            raise self._make_open_error(error, host, port, group) from None
        opened.setblocking(False)
        return opened

    def _make_open_error(
        self, error: OSError, host: str, port: int, group: str | None
    ) -> SourceError:
        doctor = f"lidarspec doctor {quote(self.label)}{sensor_option(self._sensor)}"
        if error.errno == errno.EADDRINUSE:
            return source_error(
                f"{self.label}: UDP port {port} is in use by another program", doctor
            )
        if error.errno == errno.EACCES:
            return source_error(
                f"{self.label}: UDP port {port} can only be opened by the administrator", doctor
            )
        if error.errno == errno.EADDRNOTAVAIL:
            return source_error(
                f"{self.label}: {host or group} is not an address of this computer",
                f"lidarspec doctor udp://:{port}",
            )
        if group is not None and error.errno in (errno.ENODEV, errno.ENETUNREACH):
            return source_error(
                f"{self.label}: no network interface has a route to the multicast group {group};"
                f" give the address of an interface, as in udp://ADDRESS:{port}",
                doctor,
            )
        return source_error(f"{self.label}: UDP port {port}: {system_reason(error)}", doctor)


class _Socket:
    """A socket and the statistics that the kernel reports for it.

    The kernel reports arrival times by the wall clock. They are converted to the transport's clock
    (`HostClock`), which starts at the time of the wall clock, but does not change if somebody sets
    the wall clock.

    Attributes:
        buffer_bytes: size of the receive buffer, including the kernel's overhead.
        is_timed: whether the kernel records the arrival time of each datagram.
        drops: number of datagrams that the kernel dropped.
    """

    def __init__(self, opened: socket.socket, slots: ReceiveSlots | None) -> None:
        self.socket = opened
        self._slots = slots
        self.drops = 0
        self.address: tuple[str, int] = opened.getsockname()[:2]
        self.buffer_bytes = _enlarge_buffer(opened)
        self.is_timed = False
        for option in (SO_TIMESTAMPNS, SO_RXQ_OVFL) if slots is not None else ():
            with contextlib.suppress(OSError):
                opened.setsockopt(socket.SOL_SOCKET, option, 1)
                self.is_timed |= option == SO_TIMESTAMPNS

    def iter_datagrams(self, now: int, wall: int) -> Iterator[tuple[bytes, tuple[str, int], int]]:
        """Yield (data, sender, arrival time) of the waiting datagrams; update `drops`.

        Args:
            now: the current time of the transport's clock, ns since 1970.
            wall: the time of the wall clock at the same moment, ns since 1970.

        Raises:
            OSError: if the system call fails.
        """
        if self._slots is None:
            yield from self._fetch_singly(now)
            return
        for _ in range(MAX_DATAGRAMS_PER_READ // SLOT_COUNT):
            count = self._slots.fill(self.socket.fileno())
            for index in range(count):
                data, sender = self._slots.datagram(index)
                message = self._slots.single_control_message(index)
                if message is not None and message[0] == SO_TIMESTAMPNS:
                    yield data, sender, _convert_time(message[1], message[2], now, wall)
                else:
                    messages = self._slots.control_messages(index)
                    yield data, sender, self._read_control(messages, now, wall)
            if count < SLOT_COUNT:
                return

    def _fetch_singly(self, now: int) -> Iterator[tuple[bytes, tuple[str, int], int]]:
        for _ in range(MAX_DATAGRAMS_PER_READ):
            try:
                data, sender = self.socket.recvfrom(PAYLOAD_SLOT_BYTES)
            except BlockingIOError:
                return
            yield data, sender[:2], now

    def _read_control(self, messages: Iterable[tuple[int, memoryview]], now: int, wall: int) -> int:
        """Return the arrival time from the control messages, and update `drops`."""
        at = now
        for kind, data in messages:
            if kind == SO_TIMESTAMPNS and len(data) == 16:
                seconds, nanoseconds = TIMESTAMP.unpack(data)
                at = _convert_time(seconds, nanoseconds, now, wall)
            elif kind == SO_RXQ_OVFL and len(data) == 4:
                drops = int.from_bytes(data, sys.byteorder)
                self.drops += (drops - self.drops) & 0xFFFFFFFF
        return at


def _order_times(chunks: list[Chunk], start: int) -> None:
    """Correct arrival times that are later than the times of following chunks.

    Args:
        start: index of the first chunk to correct.
    """
    # just after a socket was opened, Linux reports the time at which a datagram is fetched
    times = [chunk.at or 0 for chunk in chunks[start:]]
    if times == sorted(times):
        return
    earliest = times[-1]
    for index in reversed(range(len(times))):
        earliest = min(earliest, times[index])
        chunks[start + index] = replace(chunks[start + index], at=earliest)


def _convert_time(seconds: int, nanoseconds: int, now: int, wall: int) -> int:
    """Convert a time of the wall clock to a time of the transport's clock.

    The result is at most `now`, and at least `now - MAX_KERNEL_DELAY_NS`.
    """
    return now - min(max(wall - seconds * 1_000_000_000 - nanoseconds, 0), MAX_KERNEL_DELAY_NS)


def connect(address: SourceAddress, sensor: Sensor | None = None) -> UdpTransport:
    """Open the sockets of a UDP SOURCE.

    Examples are "udp://", "udp://:2368" and
    "udp://?port=6699,7788&group=239.255.0.1&src=192.168.1.200".

    Raises:
        UsageError: if neither the SOURCE nor the sensor specifies a port, or for an unknown option.
        SourceError: if a socket cannot be opened.
    """
    address.check(OPTIONS)
    host, port = address.host_and_port()
    host = host and resolve_host(host, address.text)
    if sensor is not None:
        link = sensor.links.get("data")
    else:
        link = None
    ports = _parse_ports(address) or (
        [port] if port else list(link.ports) if isinstance(link, Udp) else []
    )
    if not ports and sensor is not None and sensor.announces_port:
        ports = [0]  # any free port
    if not ports:
        raise UsageError(
            f"{address.text}: the port is unknown: name the sensor with -s, or use udp://:2368"
        )
    group = address.options.get("group")
    if group is None and host and _is_multicast(host):
        host, group = "", host
    if group is not None and not _is_multicast(group):
        raise UsageError(
            f"{address.text}: {group} is not a multicast group (224.0.0.0 to 239.255.255.255)"
        )
    whole = link is None or is_datagram(link)
    remote = None
    is_broadcast = False
    if isinstance(link, Udp) and sensor is not None and sensor.commands_over_data:
        remote, is_broadcast = _find_command_address(address, link)
    return UdpTransport(
        address.text,
        ports,
        host=host,
        group=group,
        sender=address.options.get("src"),
        datagrams=whole,
        sensor=sensor,
        remote=remote,
        broadcast=is_broadcast,
    )


def _find_command_address(address: SourceAddress, link: Udp) -> tuple[Sender | None, bool]:
    """Return the address for commands on the data link, and whether to broadcast them.

    The address is None if it is unknown before the sensor has sent data.
    """
    control = address.options.get("control", "")
    host, port = SourceAddress(control, "", control).host_and_port()
    if not host and "src" in address.options:
        host = Origin.parse(address.options["src"]).host
    port = port or (link.ports[0] if link.ports else link.broadcast)
    if host and port:
        return (resolve_host(host, address.text), port), False
    if link.broadcast:
        everyone = address.options.get("broadcast", BROADCAST_ADDRESS)
        return (resolve_host(everyone, address.text), link.broadcast), True
    return None, False


def list_buffer_warnings(requested: int, granted: int) -> list[str]:
    """Return a list with a warning if a receive buffer is smaller than requested, else []."""
    if granted >= requested:
        return []
    text = describe_small_buffer(requested, granted)
    return [f"{text}; next: {make_sysctl_command(requested)}"]


def describe_small_buffer(requested: int, granted: int) -> str:
    """Return a message about a receive buffer that is smaller than requested."""
    return (
        f"the system granted a receive buffer of {granted >> 10} KiB instead of"
        f" {requested >> 10}: packets may be lost under load"
    )


def make_sysctl_command(requested: int) -> str:
    """Return the command that allows programs to request a buffer of `requested` bytes."""
    return f"sudo sysctl -w net.core.rmem_max={requested}"


def _enlarge_buffer(opened: socket.socket) -> int:
    """Request a larger receive buffer, and return the size that the kernel granted."""
    for option in (
        (socket.SO_RCVBUF, SO_RCVBUFFORCE) if sys.platform == "linux" else (socket.SO_RCVBUF,)
    ):
        if _read_buffer_size(opened) < REQUESTED_BUFFER_BYTES:
            with contextlib.suppress(OSError):
                opened.setsockopt(socket.SOL_SOCKET, option, REQUESTED_BUFFER_BYTES)
    return _read_buffer_size(opened)


def _read_buffer_size(opened: socket.socket) -> int:
    # Linux reports twice the size that was set.
    return opened.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // (
        2 if sys.platform == "linux" else 1
    )


def _parse_ports(address: SourceAddress) -> list[int]:
    text = address.options.get("port", "")
    ports = [part for part in text.split(",") if part]
    if any(not part.isdecimal() or not 0 < int(part) < 65536 for part in ports):
        raise UsageError(
            f"{address.text}: port must be one number from 1 to 65535, or several with commas,"
            f" not {text!r}"
        )
    return [int(part) for part in ports]


def _is_multicast(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_multicast
    except ValueError:
        return False


def _join_group(opened: socket.socket, group: str, interface: str) -> None:
    if opened.family == socket.AF_INET6:
        opened.setsockopt(
            socket.IPPROTO_IPV6,
            socket.IPV6_JOIN_GROUP,
            socket.inet_pton(socket.AF_INET6, group) + struct.pack("@I", 0),
        )
        return
    opened.setsockopt(
        socket.IPPROTO_IP,
        socket.IP_ADD_MEMBERSHIP,
        socket.inet_aton(group) + socket.inet_aton(interface or "0.0.0.0"),
    )
