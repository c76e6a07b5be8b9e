"""What a plugin can add besides sensors: file formats and sources.

A `Transport` is the only place for input and output: it gives `Chunk`s and takes bytes. What it can
do is said by its class (a `LiveTransport` does not end by itself) and by its attributes, all of
which have a default here.
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

#: seconds between two looks at whether somebody wants to stop.
POLL = 0.05
#: who sends datagrams: address and port.
Sender = tuple[str, int]


@dataclass(frozen=True)
class Origin:
    """Whose datagrams are wanted: those of an address, or of one of its ports; a sender is `in` it,
    or not.
    """

    host: str
    port: int | None = None

    @classmethod
    def parse(cls, text: str) -> Origin:
        """What "192.168.1.201", "192.168.1.201:2368", "fe80::1" and "[fe80::1]:2368" stand for.

        Raises:
            UsageError: for a port that is none.
        """
        found = re.fullmatch(r"\[(.*)\](?::(.*))?|([^:]*):([^:]*)", text)
        if found is None:
            return cls(text)
        host = found[1] or found[3] or ""
        if found[1] is None:
            port = found[4]
        else:
            port = found[2]
        if port is not None and not (port.isdecimal() and 0 < int(port) < 65536):
            raise UsageError(f"src={text}: a sender is ADDRESS or ADDRESS:PORT")
        return cls(host, None if port is None else int(port))

    def __contains__(self, sender: Sender | None) -> bool:
        return sender is not None and sender[0] == self.host and self.port in (None, sender[1])


def endpoint(sender: Sender) -> str:
    """A sender as it is written, and as `src=` takes it: "192.168.1.201:2368", "[fe80::1]:2368"."""
    if ":" in sender[0]:
        return f"[{sender[0]}]:{sender[1]}"
    return f"{sender[0]}:{sender[1]}"


def sender_names(ends: Iterable[tuple[Sender | None, Sender | None]]) -> dict[Sender | None, str]:
    """What to call each sender: by its address, and its port where several of one address send to
    one port; "" where nobody knows it.

    Args:
        ends: sender and receiver of datagrams; a sensor may send from several ports, but not the
            same.
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
    """A file format by suffix.

    Args:
        suffix: with its dot, ".csv".
        description: a few words for lists.
        write: writes scans to a path; `every_point` also those without a return.
        holds: what it has a place for that not every format has: "organized" points, as rows and
            columns, where `write` is given `organized=True` with a single scan; "scans" each by
            itself, organised ones always; "beams" and "frame-id" of ROS's messages; "packets" as
            they came, which `write` is given as `packets=`.
    """

    suffix: str
    description: str
    write: Callable[..., None]
    holds: tuple[str, ...] = ()

    def __call__(self, path: Path, scans: Iterable[Any], *, every_point: bool = False) -> None:
        """Write the scans."""
        self.write(path, scans, every_point=every_point)


@dataclass(frozen=True, slots=True)
class Chunk:
    """What a transport read at once: a datagram, or a piece of a byte stream.

    Attributes:
        data: the bytes.
        at: arrival time, ns since 1970; None where nobody knows it.
        sender: (address, port) of a datagram, else None.
        receiver: (address, port) that a datagram was sent to, where it is known.
        gap: whether the line was interrupted before it: a frame begun earlier does not go on here.
        quiet: whether the line had fallen silent before it: what waited there for more bytes was
            given up.
    """

    data: bytes
    at: int | None = None
    sender: Sender | None = None
    receiver: Sender | None = None
    gap: bool = False
    quiet: bool = False


class Closing:
    """A context manager that is closed at the end."""

    def close(self) -> None:
        """Give everything back."""
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
    """Where bytes come from, and go to. A source of one's own derives from it.

    Attributes:
        datagrams: whether each chunk is one datagram.
        baud: of a serial line; None for anything else.
        warnings: what is to be said of it so far, such as where a file is damaged, or that a
            receive buffer is too small.
        foreign: datagrams from other senders than the one asked for, so far.
        kernel_drops: datagrams that the system threw away, so far, since nobody fetched them in
            time.
        disconnects: interruptions of the line that a recording tells of, so far.
        unread: bytes of a damaged file that could not be read, so far.
        stored: the file that is read, as it is stored: one that unpacks it stands before it.
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
        """What arrives, until the input ends.

        Raises:
            SourceError: where it cannot be read.
        """

    @property
    def place(self) -> tuple[int, int] | None:
        """How many bytes of the stored file were read, and how many there are; None where nobody
        knows.
        """
        stored: Any = self.stored
        if stored is None or not stored.seekable():
            return None
        size: int = (
            stored.size if hasattr(stored, "size") else os.fstat(stored.fileno()).st_size
        )  # in a store, or here
        return stored.tell(), size

    def skip(self, at: int) -> bool:
        """Pass over what arrived before a time, ns since 1970, where that can be done without
        reading it: whether it was.
        """
        return False

    @abstractmethod
    def write(self, data: bytes) -> None:
        """Send bytes to the device.

        Raises:
            SourceError: where nothing can be sent.
        """

    @abstractmethod
    def close(self) -> None:
        """Give the port, socket or file back."""


def no_bytes(source: str | Path, warnings: Sequence[str]) -> str:
    """Why there are no bytes in a file: what its transport says of it, or that there are none."""
    return "; ".join(warnings) or f"{source} holds no bytes"


class Disconnected(SourceError):
    """The device behind a live source went away; `LiveTransport.reopen` finds it again when it
    comes back.
    """


class LiveTransport(Transport):
    """A transport that does not end by itself: a port, a socket, a simulated device.

    Attributes:
        label: how the user called it, for messages.
        closed: whether it was closed, which ends `chunks`.
        overflow: what a reader's queue should do when it is full: "drop_oldest", or "block" for a
            source without a pace of its own.
        silence: seconds without a byte after which nothing of a frame can be under way: what waits
            for more is given up then.
        addressed: whether what is written has somewhere to go.
        stranger: who sent the last of the datagrams that are `foreign`.
    """

    label: str = ""
    closed: bool = False
    silence: float = 0.1
    stranger: Sender | None = None
    overflow: str = "drop_oldest"

    @property
    def addressed(self) -> bool:
        """Whether what is written has somewhere to go: always, but for datagrams while nobody knows
        where the sensor is.
        """
        return True

    def accept(self, sender: Sender) -> None:
        """Take a sender for the sensor: what is written goes there. Lines that know their other end
        have nothing to learn.
        """

    @abstractmethod
    def read(self, timeout: float) -> list[Chunk]:
        """What has arrived; an empty list where nothing did for `timeout` seconds, or it was
        closed.

        Raises:
            Disconnected: where the device went away.
            SourceError: where nothing can ever be read again.
        """

    @abstractmethod
    def reopen(self) -> None:
        """Open it again after `Disconnected`.

        Raises:
            SourceError: where it is not there yet.
        """

    def chunks(self) -> Iterator[Chunk]:
        """What arrives, until the transport is closed or its device goes away."""
        while not self.closed:
            yield from self.read(POLL)

    def lines(self, *, dtr: bool | None = None, rts: bool | None = None) -> None:
        """Set control lines, which only a serial port has; None leaves one as it is.

        Raises:
            UsageError: where there are none.
        """
        raise UsageError(f"{self.label}: only a serial port has control lines")

    def link(self, name: str) -> LiveTransport | None:
        """The open transport of another link of the same device; None where it has an address of
        its own.
        """
        return None

    def peer(self) -> str | None:
        """The host of the device, as far as it is known."""
        return None
