"""Base classes for transports and file formats, which plugins can add.

A `Transport` yields `Chunk`s and sends bytes. A `LiveTransport`, such as a port, does not end by
itself.
"""

from __future__ import annotations

import os
import re
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

from lidarspec.errors import SourceError, UsageError

#: maximum time that a loop waits before it checks whether it must stop.
POLL_S = 0.05
#: (address, port) of a sender of datagrams.
Sender = tuple[str, int]


@dataclass(frozen=True)
class Origin:
    """The sender whose datagrams the user wants: an address with or without a port.

    ``sender in origin`` is true if the `Sender` has this address, and this port if a port is given.
    """

    host: str
    port: int | None = None

    @classmethod
    def parse(cls, text: str) -> Origin:
        """Return the wanted sender for a text ADDRESS or ADDRESS:PORT.

        Examples are "192.168.1.201", "192.168.1.201:2368", "fe80::1" and "[fe80::1]:2368".

        Raises:
            UsageError: for an invalid port.
        """
        match = re.fullmatch(r"\[(.*)\](?::(.*))?|([^:]*):([^:]*)", text)
        if match is None:
            return cls(text)
        host = match[1] or match[3] or ""
        if match[1] is None:
            port = match[4]
        else:
            port = match[2]
        if port is not None and not (port.isdecimal() and 0 < int(port) < 65536):
            raise UsageError(f"src={text}: expected ADDRESS or ADDRESS:PORT")
        return cls(host, None if port is None else int(port))

    def __contains__(self, sender: Sender | None) -> bool:
        return sender is not None and sender[0] == self.host and self.port in (None, sender[1])


def format_sender(sender: Sender) -> str:
    """Return a sender as text: "192.168.1.201:2368" or "[fe80::1]:2368"."""
    if ":" in sender[0]:
        return f"[{sender[0]}]:{sender[1]}"
    return f"{sender[0]}:{sender[1]}"


def name_senders(ends: Iterable[tuple[Sender | None, Sender | None]]) -> dict[Sender | None, str]:
    """Return a name for each sender: its address, with the port if necessary.

    The port is necessary if several ports of the address send to the same port. The name of an
    unknown sender is "".

    Args:
        ends: (sender, receiver) of each datagram.
    """
    pairs = dict.fromkeys(ends)
    ports = defaultdict[tuple[str, int | None], set[int]](set)
    for sender, receiver in pairs:
        if sender is not None:
            ports[sender[0], receiver and receiver[1]].add(sender[1])
    shared = {host for (host, _), sending in ports.items() if len(sending) > 1}
    names: dict[Sender | None, str] = {}
    for sender, _ in pairs:
        if sender is None:
            names[sender] = ""
        elif sender[0] in shared:
            names[sender] = format_sender(sender)
        else:
            names[sender] = sender[0]
    return names


@dataclass(frozen=True)
class Format:
    """A file format, identified by suffix.

    Args:
        suffix: the suffix including the dot, ".csv".
        description: a short description for lists.
        write: writes scans to a path. With `every_point`, points without a return are written too.
        holds: the optional features that the format supports:
            "organized": points in rows and columns. `write` then accepts `organized=True` with one
            scan.
            "scans": each scan is stored separately, in rows and columns if it has them.
            "beams": planar scans are also written as LaserScan messages.
            "frame-id": messages contain a frame_id.
            "packets": raw packets, which `write` accepts as `packets=`.
    """

    suffix: str
    description: str
    write: Callable[..., None]
    holds: tuple[str, ...] = ()

    def __call__(self, path: Path, scans: Iterable[Any], *, every_point: bool = False) -> None:
        """Write scans to a file."""
        self.write(path, scans, every_point=every_point)


@dataclass(frozen=True, slots=True)
class Chunk:
    """The bytes of one read: a datagram, or a portion of a byte stream.

    Attributes:
        data: the bytes.
        at: arrival time, ns since 1970; None if unknown.
        sender: (address, port) of the sender of a datagram; None for a stream, or if unknown.
        receiver: (address, port) to which a datagram was sent; None for a stream, or if unknown.
        gap: whether data is missing before this chunk. An incomplete frame before the gap is
            discarded.
        quiet: whether the line was silent before this chunk. An incomplete frame before the silence
            is discarded.
    """

    data: bytes
    at: int | None = None
    sender: Sender | None = None
    receiver: Sender | None = None
    gap: bool = False
    quiet: bool = False


class ClosingContext:
    """A context manager with a `close` method."""

    def close(self) -> None:
        """Release all resources."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


class Transport(ABC):
    """The base class of inputs and outputs of bytes.

    Attributes:
        datagrams: whether each chunk is one datagram.
        baud: the baud rate of a serial line; None for all other sources.
        warnings: the warnings so far, for example about a damaged file or a small receive buffer.
        foreign: number of datagrams from senders other than the requested sender.
        kernel_drops: number of datagrams that the system dropped because they were not read in
            time.
        disconnects: how often the device was disconnected during a recording; 0 for other sources.
        unread: number of bytes that could not be read from a damaged file.
        stored: the open file in its stored form, which may be compressed; None if the source is not
            a file.
    """

    datagrams: bool = False
    baud: int | None = None
    warnings: Sequence[str] = ()
    foreign: int = 0
    kernel_drops: int = 0
    disconnects: int = 0
    unread: int = 0
    stored: BinaryIO | None = None

    @abstractmethod
    def chunks(self) -> Iterator[Chunk]:
        """Yield chunks as they arrive, until the input ends.

        Raises:
            SourceError: if the source cannot be read.
        """

    @property
    def progress(self) -> tuple[int, int] | None:
        """(number of bytes read, size) of a file; None if unknown.

        For a compressed file, both are numbers of compressed bytes.
        """
        stored: Any = self.stored
        if stored is None or not stored.seekable():
            return None
        if hasattr(stored, "size"):  # the file is in a store
            size: int = stored.size
        else:
            size = os.fstat(stored.fileno()).st_size
        return stored.tell(), size

    def skip_until(self, time_ns: int) -> bool:
        """Skip data that arrived before a time, if the source can seek.

        Args:
            time_ns: ns since 1970.

        Returns:
            Whether data was skipped.
        """
        return False

    @abstractmethod
    def write(self, data: bytes) -> None:
        """Send bytes to the device.

        Raises:
            SourceError: if nothing can be sent.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the port, socket or file."""


def no_bytes_message(source: str | Path, warnings: Sequence[str]) -> str:
    """Return the error message for a file without bytes.

    Args:
        warnings: the warnings of the file's transport.
    """
    return "; ".join(warnings) or f"{source} contains no bytes"


class Disconnected(SourceError):
    """The device of a live source has disappeared.

    `LiveTransport.reopen` opens the device when it is available again.
    """


class LiveTransport(Transport):
    """A transport that does not end by itself: a port, a socket, a simulated device.

    Attributes:
        label: the SOURCE, for messages.
        closed: whether the transport was closed. `chunks` then ends.
        overflow: the default policy for a full queue of chunks: "drop_oldest", or "block" for a
            source that loses nothing if it is read late, such as a simulated device without a rate.
        silence: number of seconds without a byte after which an incomplete frame is discarded.
        other_sender: the sender of the last datagram that was counted in `foreign`; None if no
            datagram was counted.
    """

    label: str = ""
    closed: bool = False
    silence: float = 0.1
    other_sender: Sender | None = None
    overflow: str = "drop_oldest"

    @property
    def addressed(self) -> bool:
        """Whether the destination of `write` is known.

        False for a source of datagrams while the address of the sensor is unknown.
        """
        return True

    @property
    def own_port(self) -> int | None:
        """The port of this computer at which data arrives; None if there is none."""
        return None

    @property
    def awaits_port(self) -> bool:
        """Whether the source waits for the sensor to report the port to connect to."""
        return False

    def connect_to(self, port: int) -> None:
        """Connect to a port that the sensor has reported.

        A source with a fixed port ignores this.

        Raises:
            SourceError: if the connection fails.
        """

    def accept(self, sender: Sender) -> None:
        """Use a sender of valid frames as the destination of `write` from now on.

        A source with a fixed destination ignores this call.

        Args:
            sender: the address and port of the sensor.
        """

    @abstractmethod
    def read(self, timeout: float) -> list[Chunk]:
        """Return the chunks that have arrived.

        Args:
            timeout: maximum time to wait for the first chunk, in seconds.

        Returns:
            The chunks; an empty list if nothing arrived in time, or if the transport was closed.

        Raises:
            Disconnected: if the device disappeared.
            SourceError: if the source cannot be read any more.
        """

    @abstractmethod
    def reopen(self) -> None:
        """Open the device again after `Disconnected`.

        Raises:
            SourceError: if the device is not available yet.
        """

    def chunks(self) -> Iterator[Chunk]:
        """Yield chunks until the transport is closed or its device disappears."""
        while not self.closed:
            yield from self.read(POLL_S)

    def lines(self, *, dtr: bool | None = None, rts: bool | None = None) -> None:
        """Set the control lines of a serial port.

        Args:
            dtr: the new state of the line DTR; None to leave the line unchanged.
            rts: the new state of the line RTS; None to leave the line unchanged.

        Raises:
            UsageError: if the source has no control lines.
        """
        raise UsageError(f"{self.label}: only a serial port has control lines")

    def link(self, name: str) -> LiveTransport | None:
        """Open another link of the same device, such as the TCP port for commands.

        Args:
            name: the name of the link in `Sensor.links`.

        Returns:
            The transport of the link. None if this transport cannot open the link; the caller then
            opens the link by the address of the device.
        """
        return None

    def peer(self) -> str | None:
        """Return the host name or address of the device; None if unknown."""
        return None
