"""What a plugin can add besides sensors: file formats and sources, as values and a protocol."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol


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
    """

    data: bytes
    at: int | None = None
    sender: tuple[str, int] | None = None


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
