"""Base classes for transports and file formats, which plugins can add.

A `Transport` does all input and output: it yields `Chunk`s and sends bytes. Its class and its
attributes describe its abilities: a `LiveTransport` does not end by itself, and all attributes have
defaults here.
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

#: seconds between two checks for a request to stop.
POLL = 0.05
#: address and port of a sender of datagrams.
Sender = tuple[str, int]


@dataclass(frozen=True)
class Origin:
    """The requested sender: an address, or one of its ports.

    ``sender in origin`` is true for datagrams of this sender.
    """

    host: str
    port: int | None = None

    @classmethod
    def parse(cls, text: str) -> Origin:
        """Return the origin for ADDRESS or ADDRESS:PORT.

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
            raise UsageError(f"src={text}: a sender is ADDRESS or ADDRESS:PORT")
        return cls(host, None if port is None else int(port))

    def __contains__(self, sender: Sender | None) -> bool:
        return sender is not None and sender[0] == self.host and self.port in (None, sender[1])


def endpoint(sender: Sender) -> str:
    """Return a sender as `src=` accepts it: "192.168.1.201:2368", "[fe80::1]:2368"."""
    if ":" in sender[0]:
        return f"[{sender[0]}]:{sender[1]}"
    return f"{sender[0]}:{sender[1]}"


def sender_names(ends: Iterable[tuple[Sender | None, Sender | None]]) -> dict[Sender | None, str]:
    """Return a name for each sender: its address, with the port if that is ambiguous.

    The port is added if several senders of one address send to the same port. The name of an
    unknown sender is "".

    Args:
        ends: sender and receiver of datagrams.
    """
    known = dict.fromkeys(ends)
    ports = defaultdict[tuple[str, int | None], set[int]](set)
    for sender, receiver in known:
        if sender is not None:
            ports[sender[0], receiver and receiver[1]].add(sender[1])
    shared = {host for (host, _), sending in ports.items() if len(sending) > 1}
    return {
        sender: "" if sender is None else endpoint(sender) if sender[0] in shared else sender[0]
        for sender, _ in known
    }


@dataclass(frozen=True)
class Format:
    """A file format, identified by suffix.

    Args:
        suffix: including the dot, ".csv".
        description: a few words for lists.
        write: writes scans to a path; with `every_point`, also points without a return.
        holds: the optional features of the format. "organized": points in rows and columns; `write`
            is called with `organized=True` and a single scan. "scans": scans are stored separately,
            and always organized. "beams" and "frame-id": those of ROS messages. "packets": raw
            packets, which `write` gets as `packets=`.
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
    """The bytes of one read: a datagram, or a piece of a byte stream.

    Attributes:
        data: the bytes.
        at: arrival time, ns since 1970; None if unknown.
        sender: (address, port) of a datagram, else None.
        receiver: (address, port) that a datagram was sent to, None if unknown.
        gap: whether the line was interrupted before it: an incomplete frame does not continue here.
        quiet: whether the line was silent before it: an incomplete frame was discarded then.
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
    """An input and output of bytes; other sources derive from it.

    Attributes:
        datagrams: whether each chunk is one datagram.
        baud: the baud rate of a serial line; None for all others.
        warnings: the warnings so far, such as a damaged file or a small receive buffer.
        foreign: number of datagrams so far from other senders than the requested one.
        kernel_drops: number of datagrams so far that the system dropped because they were not read
            in time.
        disconnects: number of interruptions so far that a recording reports.
        unread: number of bytes of a damaged file so far that could not be read.
        stored: the file as it is stored, below a decompressing one.
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
            SourceError: if it cannot be read.
        """

    @property
    def progress(self) -> tuple[int, int] | None:
        """The read bytes and the size of the stored file; None if unknown."""
        stored: Any = self.stored
        if stored is None or not stored.seekable():
            return None
        size: int = (
            stored.size if hasattr(stored, "size") else os.fstat(stored.fileno()).st_size
        )  # in a store, or on this computer
        return stored.tell(), size

    def skip_until(self, time_ns: int) -> bool:
        """Skip everything that arrived before a time, if that needs no reading.

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


def no_bytes(source: str | Path, warnings: Sequence[str]) -> str:
    """Return the reason why a file has no bytes: the warnings of its transport."""
    return "; ".join(warnings) or f"{source} holds no bytes"


class Disconnected(SourceError):
    """Raised if the device of a live source disappears.

    `LiveTransport.reopen` opens it again when it is back.
    """


class LiveTransport(Transport):
    """A transport that does not end by itself: a port, a socket, a simulated device.

    Attributes:
        label: the user's name for it, for messages.
        closed: whether it was closed, which ends `chunks`.
        overflow: the policy of a reader's full queue: "drop_oldest", or "block" for a source that
            waits for its reader.
        silence: seconds without a byte after which an incomplete frame is discarded.
        addressed: whether `write` has a destination.
        other_sender: the sender of the last `foreign` datagram.
    """

    label: str = ""
    closed: bool = False
    silence: float = 0.1
    other_sender: Sender | None = None
    overflow: str = "drop_oldest"

    @property
    def addressed(self) -> bool:
        """Whether `write` has a destination.

        It is False only for datagrams while the address of the sensor is unknown.
        """
        return True

    def accept(self, sender: Sender) -> None:
        """Use a sender as the sensor's address, which `write` sends to.

        Lines with a fixed other end do nothing.
        """

    @abstractmethod
    def read(self, timeout: float) -> list[Chunk]:
        """Return the chunks that have arrived.

        Args:
            timeout: seconds to wait for the first one.

        Returns:
            An empty list if nothing arrived in time, or the transport was closed.

        Raises:
            Disconnected: if the device disappeared.
            SourceError: if nothing can be read any more.
        """

    @abstractmethod
    def reopen(self) -> None:
        """Open it again after `Disconnected`.

        Raises:
            SourceError: if the device is not back yet.
        """

    def chunks(self) -> Iterator[Chunk]:
        """Yield chunks until the transport is closed or its device disappears."""
        while not self.closed:
            yield from self.read(POLL)

    def lines(self, *, dtr: bool | None = None, rts: bool | None = None) -> None:
        """Set the control lines of a serial port; None leaves a line unchanged.

        Raises:
            UsageError: if there are no control lines.
        """
        raise UsageError(f"{self.label}: only a serial port has control lines")

    def link(self, name: str) -> LiveTransport | None:
        """Return the open transport of another link of the same device.

        None if that link has an address of its own.
        """
        return None

    def peer(self) -> str | None:
        """Return the host of the device, None if unknown."""
        return None
