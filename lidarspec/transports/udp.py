"""UDP: datagrams from a sensor, as many as there are at each wake-up, with what the kernel knows of
each.

A sensor sends to this computer's address or to everybody, so that the sockets have to be bound to
all interfaces ("udp://"), unless one is named ("udp://127.0.0.1:2368"). Nothing is sent, and nobody
is answered, before a command is.

Linux says with each datagram when it arrived, however late we fetch it, and how many the socket has
dropped before it; so a short pause after each reading, in which some gather, costs no accuracy. The
receive buffer is what a stalled program lives on; what the kernel really gives is read back. Many
datagrams are fetched in one system call, recvmmsg, which Python does not have (`Slots`): each call
of Python gives the interpreter away and has to win it back, which takes milliseconds beside a
thread that computes, and with a call for each datagram a fast sensor is lost.
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
from lidarspec.spec.links import Udp, is_datagram
from lidarspec.spec.sensor import Sensor
from lidarspec.transports.addresses import Address, parse_origin, resolve_host, with_option
from lidarspec.transports.base import (
    disconnected_error,
    sensor_option,
    sleep_until,
    source_error,
    system_reason,
)
from lidarspec.transports.host_clock import HostClock
from lidarspec.transports.protocol import Chunk, LiveTransport, Sender

#: datagrams in one call, and the room for each: memory that is not written to costs nothing.
MANY = 256
LARGEST = 1 << 16
NAME = 32
CONTROL = 128
_HEADER = struct.Struct("@Nii")
_TWO = struct.Struct("@Niiqq")
_ALIGN = struct.calcsize("@N")
#: bytes of receive buffer that are asked for.
BUFFER = 8 << 20
#: datagrams of one socket that are fetched before the others have their turn.
TOGETHER = 1024
#: seconds between two readings, where the kernel keeps the times: a wake-up for each datagram would
#: cost more than all the rest.
PAUSE = 0.002
#: ns that a datagram may have waited in the kernel, at most; more is a clock that was set.
LATEST = 60_000_000_000
#: socket options that Python has no names for (Linux, asm-generic/socket.h).
SO_RCVBUFFORCE = 33
SO_TIMESTAMPNS = 35
SO_RXQ_OVFL = 40
TIME = struct.Struct("qq")
OPTIONS = ("port", "group", "src")


class _Vector(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("size", ctypes.c_size_t))


class _Message(ctypes.Structure):
    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_size", ctypes.c_uint32),
        ("vectors", ctypes.POINTER(_Vector)),
        ("vectors_number", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_size", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _Datagram(ctypes.Structure):
    _fields_ = (("message", _Message), ("size", ctypes.c_uint))


#: where the size of the first datagram, and of what is told with it, stand in the headers, and how
#: far on the next ones do, in words.
_SIZE, _SIZE_STEP = (
    part // ctypes.sizeof(ctypes.c_uint)
    for part in (_Datagram.size.offset, ctypes.sizeof(_Datagram))
)
_TOLD, _TOLD_STEP = (
    part // ctypes.sizeof(ctypes.c_size_t)
    for part in (_Message.control_size.offset, ctypes.sizeof(_Datagram))
)


class Slots:
    """Room for many datagrams, used again and again.

    Raises:
        OSError: where the system has no recvmmsg.
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
        self._payload, self._names, self._control = (
            ctypes.create_string_buffer(MANY * size) for size in (LARGEST, NAME, CONTROL)
        )
        self._data, self._senders, self._said = (
            memoryview(part).cast("B") for part in (self._payload, self._names, self._control)
        )
        self._vectors = (_Vector * MANY)()
        self._headers = ctypes.create_string_buffer(MANY * ctypes.sizeof(_Datagram))
        self._datagrams = (_Datagram * MANY).from_buffer(self._headers)
        # An access to a field by its name costs more than a datagram should.
        self._sizes, self._told = (
            memoryview(self._headers).cast("B").cast("I"),
            memoryview(self._headers).cast("B").cast("P"),
        )
        for index in range(MANY):
            self._vectors[index] = _Vector(
                ctypes.addressof(self._payload) + index * LARGEST, LARGEST
            )
            message = self._datagrams[index].message
            message.name = ctypes.addressof(self._names) + index * NAME
            message.name_size = NAME
            message.vectors = ctypes.pointer(self._vectors[index])
            message.vectors_number = 1
            message.control = ctypes.addressof(self._control) + index * CONTROL
            message.control_size = CONTROL
        self._fresh = self._headers.raw
        self._known: dict[bytes, tuple[str, int]] = {}

    def fill(self, descriptor: int) -> int:
        """The number of datagrams fetched from a socket, at most `MANY`; 0 where none waits.

        Raises:
            OSError: what the system says.
        """
        ctypes.memmove(
            self._headers, self._fresh, len(self._fresh)
        )  # the kernel wrote over the sizes
        number: int = self._call(descriptor, self._datagrams, MANY, socket.MSG_DONTWAIT, None)
        if number < 0:
            code = ctypes.get_errno()
            if code in (errno.EAGAIN, errno.EWOULDBLOCK, errno.EINTR):
                return 0
            raise OSError(code, os.strerror(code))
        return number

    def datagram(self, index: int) -> tuple[bytes, tuple[str, int]]:
        """A datagram that was fetched, and its sender."""
        start = index * LARGEST
        data = self._data[start : start + self._sizes[_SIZE + index * _SIZE_STEP]].tobytes()
        name = self._senders[index * NAME : index * NAME + NAME].tobytes()
        sender = self._known.get(name)
        if sender is None:
            if len(self._known) >= MANY:
                self._known.clear()
            sender = self._known[name] = _address(name)
        return data, sender

    def numbers(self, index: int) -> tuple[int, int, int] | None:
        """What the socket layer said with a datagram, if it is one value of two numbers: its type,
        and these; else None.
        """
        if self._told[_TOLD + index * _TOLD_STEP] != _TWO.size:
            return None
        size, level, kind, first, second = _TWO.unpack_from(self._said, index * CONTROL)
        if size == _TWO.size and level == socket.SOL_SOCKET:
            return (kind, first, second)
        return None

    def said(self, index: int) -> list[tuple[int, memoryview]]:
        """What the socket layer said with a datagram: type and value."""
        start = index * CONTROL
        found = []
        end = start + self._told[_TOLD + index * _TOLD_STEP]
        while start + _HEADER.size <= end:
            size, level, kind = _HEADER.unpack_from(self._said, start)
            if size < _HEADER.size:
                break
            if level == socket.SOL_SOCKET:
                found.append((kind, self._said[start + _HEADER.size : start + size]))
            start += -(-size // _ALIGN) * _ALIGN
        return found


def _address(name: bytes) -> tuple[str, int]:
    """Host and port of a socket address as the kernel writes it."""
    family = int.from_bytes(name[:2], sys.byteorder)
    port = int.from_bytes(name[2:4], "big")
    if family == socket.AF_INET6:
        packed = name[8:24]
    else:
        packed = name[4:8]
    return socket.inet_ntop(family, packed), port


class UdpTransport(LiveTransport):
    """Datagrams that arrive on some ports.

    Args:
        label: the SOURCE, for messages.
        ports: where to listen; 0 takes any that is free.
        host: address of the interface, "" for all.
        group: multicast group to join.
        sender: only datagrams from this host, or "HOST:PORT"; others are counted as foreign.
        datagrams: whether each is a whole frame, not a piece of a stream.
        sensor: for the next command in messages.
        remote: where to send to; by default the sender that is asked for with its port, or
            accepted.
        broadcast: whether that may be everybody.

    Attributes:
        ports: those that are open.

    Raises:
        SourceError: where a port cannot be opened, or the group not joined.
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
        self._selector = selectors.DefaultSelector()
        self._sockets: list[_Socket] = []
        self._rested = 0.0
        slots: Slots | None = None
        with contextlib.suppress(OSError):
            slots = Slots() if sys.platform == "linux" else None
        try:
            for port in ports:
                self._sockets.append(_Socket(self._bound(host, port, group), slots))
                self._selector.register(
                    self._sockets[-1].socket, selectors.EVENT_READ, self._sockets[-1]
                )
                if broadcast:
                    self._sockets[-1].socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        except BaseException:
            self.close()
            raise
        self.ports = tuple(one.address[1] for one in self._sockets)
        smallest = min((one.buffer for one in self._sockets), default=BUFFER)
        self.warnings = shortfall(BUFFER, smallest)

    def read(self, timeout: float) -> list[Chunk]:
        sleep_until(self._rested)
        found: list[Chunk] = []
        if self.closed:
            ready = []
        else:
            ready = [key.data for key, _ in self._selector.select(timeout)]
        for one in ready:
            self._fetch(one, found)
        self.kernel_drops = sum(each.drops for each in self._sockets)
        gathers = 0 < len(found) < MANY and all(one.is_timed for one in ready)
        self._rested = time.monotonic() + PAUSE if gathers else 0.0
        return found

    def write(self, data: bytes) -> None:
        if self._remote is None:
            text = (
                f"{self.label}: no frame of the sensor has arrived yet, so nobody knows its address"
            )
            raise source_error(
                text, f"the same with {with_option(self.label, 'src', 'ADDRESS:PORT')}"
            )
        try:
            self._sockets[0].socket.sendto(data, self._remote)
        except OSError as error:
            raise disconnected_error(self.label, error) from None

    @property
    def addressed(self) -> bool:
        """Whether what is written has somewhere to go: to the address that was given, or a sender
        that was accepted.
        """
        return self._remote is not None

    def accept(self, sender: Sender) -> None:
        if self._origin is None or self._origin.port is None:
            self._remote = sender

    def reopen(self) -> None:
        """Sockets stay open, whatever becomes of the sensor."""

    def peer(self) -> str | None:
        if self._origin:
            return self._origin.host
        if self._remote:
            return self._remote[0]
        return None

    def close(self) -> None:
        self.closed = True
        self._selector.close()
        for one in self._sockets:
            one.socket.close()

    def _fetch(self, one: _Socket, found: list[Chunk]) -> None:
        """Everything that waits in a socket, up to a limit that is fair to the others."""
        start = len(found)
        try:
            own = self._origin
            for data, sender, at in one.datagrams(*self.clock.now_and_wall()):
                if own is not None and sender not in own:
                    self.foreign = self.foreign + 1
                    self.stranger = sender
                    continue
                found.append(Chunk(data, at, sender, one.address))
        except ConnectionRefusedError:
            return  # somebody's answer to what was sent, not to be read as the end
        except OSError as error:
            if not self.closed:
                raise SourceError(f"{self.label}: {system_reason(error)}") from None
        _order_times(found, start)

    def _bound(self, host: str, port: int, group: str | None) -> socket.socket:
        if ":" in host or ":" in (group or ""):
            family = socket.AF_INET6
        else:
            family = socket.AF_INET
        found = socket.socket(family, socket.SOCK_DGRAM)
        try:
            if group is not None:
                found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            found.bind(("" if group is not None else host, port))
            if group is not None:
                _join(found, group, host)
        except OSError as error:
            found.close()
            raise self._refused(error, host, port, group) from None
        found.setblocking(False)
        return found

    def _refused(self, error: OSError, host: str, port: int, group: str | None) -> SourceError:
        doctor = f"lidarspec doctor {quote(self.label)}{sensor_option(self._sensor)}"
        if error.errno == errno.EADDRINUSE:
            return source_error(
                f"{self.label}: UDP port {port} is in use by another program", doctor
            )
        if error.errno == errno.EACCES:
            return source_error(
                f"{self.label}: UDP port {port} needs rights that you do not have", doctor
            )
        if error.errno == errno.EADDRNOTAVAIL:
            return source_error(
                f"{self.label}: {host or group} is no address of this computer",
                f"lidarspec doctor udp://:{port}",
            )
        if group is not None and error.errno in (errno.ENODEV, errno.ENETUNREACH):
            return source_error(
                f"{self.label}: no interface has a route to the group {group}; name one, as in"
                f" udp://ADDRESS:{port}",
                doctor,
            )
        return source_error(f"{self.label}: UDP port {port}: {system_reason(error)}", doctor)


class _Socket:
    """One socket, and what the kernel has said about it.

    Args:
        slots: where the kernel writes many datagrams at once; None fetches them one by one.

    Attributes:
        address: of its end here.
        buffer: bytes of payload and overhead that the kernel holds for it.
        is_timed: whether the kernel says when each datagram arrived.
        drops: datagrams that the kernel threw away since nobody fetched them in time.
    """

    def __init__(self, found: socket.socket, slots: Slots | None) -> None:
        self.socket = found
        self._slots = slots
        self.drops = 0
        self.address: tuple[str, int] = found.getsockname()[:2]
        self.buffer = _enlarged(found)
        self.is_timed = False
        for option in (SO_TIMESTAMPNS, SO_RXQ_OVFL) if slots is not None else ():
            with contextlib.suppress(OSError):
                found.setsockopt(socket.SOL_SOCKET, option, 1)
                self.is_timed |= option == SO_TIMESTAMPNS

    def datagrams(self, now: int, wall: int) -> Iterator[tuple[bytes, tuple[str, int], int]]:
        """What waits, with sender and arrival time; counts what the kernel dropped.

        Args:
            now: the time of the clock that arrival times are given in, ns since 1970.
            wall: the time of the wall clock at the same moment, which the kernel's times are of.

        Raises:
            OSError: what the system says.
        """
        if self._slots is None:
            yield from self._one_by_one(now)
            return
        for _ in range(TOGETHER // MANY):
            number = self._slots.fill(self.socket.fileno())
            for index in range(number):
                data, sender = self._slots.datagram(index)
                told = self._slots.numbers(index)
                if told is not None and told[0] == SO_TIMESTAMPNS:
                    yield data, sender, _carried(told[1], told[2], now, wall)
                else:
                    yield data, sender, self._told(self._slots.said(index), now, wall)
            if number < MANY:
                return

    def _one_by_one(self, now: int) -> Iterator[tuple[bytes, tuple[str, int], int]]:
        for _ in range(TOGETHER):
            try:
                data, sender = self.socket.recvfrom(LARGEST)
            except BlockingIOError:
                return
            yield data, sender[:2], now

    def _told(self, said: Iterable[tuple[int, memoryview]], now: int, wall: int) -> int:
        """When the datagram arrived; counts what was dropped before it."""
        at = now
        for kind, data in said:
            if kind == SO_TIMESTAMPNS and len(data) == 16:
                seconds, nanoseconds = TIME.unpack(data)
                at = _carried(seconds, nanoseconds, now, wall)
            elif kind == SO_RXQ_OVFL and len(data) == 4:
                drops = int.from_bytes(data, sys.byteorder)
                self.drops += (drops - self.drops) & 0xFFFFFFFF
        return at


def _order_times(chunks: list[Chunk], start: int) -> None:
    """Give no datagram, from `start` on, a later time than those that were queued behind it.

    For some milliseconds after a socket was opened Linux stamps datagrams when they are fetched
    instead of when they arrive.
    """
    times = [chunk.at or 0 for chunk in chunks[start:]]
    if times == sorted(times):
        return
    earliest = times[-1]
    for index in reversed(range(len(times))):
        earliest = min(earliest, times[index])
        chunks[start + index] = replace(chunks[start + index], at=earliest)


def _carried(seconds: int, nanoseconds: int, now: int, wall: int) -> int:
    """A time of the wall clock, which reads `wall` now, as one of a clock that reads `now`; of the
    last minute, whatever it says.
    """
    return now - min(max(wall - seconds * 1_000_000_000 - nanoseconds, 0), LATEST)


def connect(address: Address, sensor: Sensor | None = None) -> UdpTransport:
    """The open sockets of a UDP SOURCE: "udp://", "udp://:2368",
    "udp://?port=6699,7788&group=239.255.0.1&src=192.168.1.200".

    Args:
        sensor: whose ports are taken where the source names none.

    Raises:
        UsageError: where nobody says the ports, or for an option that UDP does not take.
        SourceError: where one cannot be opened.
    """
    address.check(OPTIONS)
    host, port = address.host_and_port()
    host = host and resolve_host(host, address.text)
    if sensor is not None:
        link = sensor.links.get("data")
    else:
        link = None
    ports = _ports(address) or (
        [port] if port else list(link.ports) if isinstance(link, Udp) else []
    )
    if not ports:
        raise UsageError(f"{address.text}: which port? Name the sensor with -s, or say udp://:2368")
    group = address.options.get("group")
    if group is None and host and _is_multicast(host):
        host, group = "", host
    if group is not None and not _is_multicast(group):
        raise UsageError(
            f"{address.text}: {group} is no multicast group (224.0.0.0 to 239.255.255.255)"
        )
    whole = link is None or is_datagram(link)
    return UdpTransport(
        address.text,
        ports,
        host=host,
        group=group,
        sender=address.options.get("src"),
        datagrams=whole,
        sensor=sensor,
    )


def shortfall(asked: int, granted: int) -> list[str]:
    """A warning where the kernel gave less receive buffer than was asked for, with the command that
    mends it; else nothing.
    """
    if granted >= asked:
        return []
    text = (
        f"the system gave a receive buffer of {granted >> 10} KiB of {asked >> 10}: a busy computer"
        " will lose packets"
    )
    return [f"{text}; next: sudo sysctl -w net.core.rmem_max={asked}"]


def _enlarged(found: socket.socket) -> int:
    """Ask for a larger receive buffer; the bytes that there are in the end. Linux says twice what
    it gives.
    """
    for option in (
        (socket.SO_RCVBUF, SO_RCVBUFFORCE) if sys.platform == "linux" else (socket.SO_RCVBUF,)
    ):
        if _granted(found) < BUFFER:
            with contextlib.suppress(OSError):
                found.setsockopt(socket.SOL_SOCKET, option, BUFFER)
    return _granted(found)


def _granted(found: socket.socket) -> int:
    return found.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // (
        2 if sys.platform == "linux" else 1
    )


def _ports(address: Address) -> list[int]:
    text = address.options.get("port", "")
    ports = [part for part in text.split(",") if part]
    if any(not part.isdecimal() or not 0 < int(part) < 65536 for part in ports):
        raise UsageError(
            f"{address.text}: port is one number from 1 to 65535, or several with commas, not"
            f" {text!r}"
        )
    return [int(part) for part in ports]


def _is_multicast(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_multicast
    except ValueError:
        return False


def _join(found: socket.socket, group: str, interface: str) -> None:
    if found.family == socket.AF_INET6:
        found.setsockopt(
            socket.IPPROTO_IPV6,
            socket.IPV6_JOIN_GROUP,
            socket.inet_pton(socket.AF_INET6, group) + struct.pack("@I", 0),
        )
        return
    found.setsockopt(
        socket.IPPROTO_IP,
        socket.IP_ADD_MEMBERSHIP,
        socket.inet_aton(group) + socket.inet_aton(interface or "0.0.0.0"),
    )
