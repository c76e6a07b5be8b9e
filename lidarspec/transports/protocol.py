"""What a plugin can add besides sensors: file formats and sources, as values and a protocol."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from lidarspec.errors import SourceError


@dataclass(frozen=True)
class Format:
    """A file format by suffix.

    Args:
        suffix: with its dot, ".csv".
        description: a few words for lists.
        write: writes scans to a path; `every_point` also those without a return.
    """

    suffix: str
    description: str
    write: Callable[..., None]

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
        quiet: whether the line had fallen silent before it: what waited there for more bytes was given up.
    """

    data: bytes
    at: int | None = None
    sender: tuple[str, int] | None = None
    receiver: tuple[str, int] | None = None
    gap: bool = False
    quiet: bool = False


class Transport(Protocol):
    """Where bytes come from, and go to: the only place for input and output."""

    #: whether each chunk is one datagram.
    datagrams: bool

    def chunks(self) -> Iterator[Chunk]:
        """What arrives, until the input ends.

        Raises:
            SourceError: where it cannot be read.
        """

    def write(self, data: bytes) -> None:
        """Send bytes to the device.

        Raises:
            SourceError: where nothing can be sent.
        """

    def close(self) -> None:
        """Give the port, socket or file back."""


class Disconnected(SourceError):
    """The device behind a live source went away; `LiveTransport.reopen` finds it again when it comes back."""


@dataclass
class Statistics:
    """What a live transport counts.

    Attributes:
        kernel_drops: datagrams that the system threw away since nobody fetched them in time.
        foreign: datagrams from other senders than the one asked for.
    """

    kernel_drops: int = 0
    foreign: int = 0


class LiveTransport(Transport, Protocol):
    """A transport that does not end by itself: a port, a socket, a simulated device."""

    statistics: Statistics
    #: what is to be said about it, such as a receive buffer that is too small.
    warnings: list[str]

    def read(self, timeout: float) -> list[Chunk]:
        """What has arrived; an empty list where nothing did for `timeout` seconds.

        Raises:
            Disconnected: where the device went away.
            SourceError: where nothing can ever be read again.
        """

    def reopen(self) -> None:
        """Open it again after `Disconnected`.

        Raises:
            SourceError: where it is not there yet.
        """

    def lines(self, *, dtr: bool | None = None, rts: bool | None = None) -> None:
        """Set control lines; None leaves one as it is.

        Raises:
            UsageError: where there are none.
        """

    def peer(self) -> str | None:
        """The host of the device, as far as it is known."""
