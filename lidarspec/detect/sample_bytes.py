"""Sample bytes of one sender, from which its sensor is identified."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

from lidarspec.errors import SourceError
from lidarspec.transports.protocol import Chunk, Transport

#: The number of bytes of a file to examine. The last chunk may exceed this number.
MAX_SAMPLE_BYTES = 1 << 17
#: The maximum number of bytes to examine to recognise text.
MAX_TEXT_BYTES = 1 << 12
#: The minimum number of bytes that can be recognised as text.
MIN_TEXT_BYTES = 16


@dataclass(frozen=True)
class SampleBytes:
    """The bytes of one sender, and how they were received.

    Attributes:
        chunks: datagrams, or pieces of a stream.
        baud: the baud rate of a serial port; None if there is none.
        sender: the address of the sender; "" if the source has only one sender.
        failure: the error if the source could not be opened; else None.
        ports: the destination ports of the datagrams in a capture.
    """

    source: str
    chunks: tuple[bytes, ...] = ()
    datagrams: bool = False
    baud: int | None = None
    sender: str = ""
    failure: SourceError | None = field(default=None, compare=False)
    warnings: tuple[str, ...] = ()
    ports: frozenset[int] = frozenset()

    @property
    def size(self) -> int:
        """The number of bytes."""
        return sum(map(len, self.chunks))

    @property
    def data(self) -> bytes:
        """All bytes in order."""
        return b"".join(self.chunks)

    @property
    def is_text(self) -> bool:
        """Whether the first bytes are printable ASCII text."""
        head = self.data[:MAX_TEXT_BYTES]
        return (
            len(head) >= MIN_TEXT_BYTES
            and head.isascii()
            and re.sub(rb"[\t\r\n]", b"", head).decode().isprintable()
        )


def read_beginning(opened: Transport, enough: int, *, max_chunks: int | None = None) -> list[Chunk]:
    """Return the first chunks of a file.

    Args:
        enough: the number of bytes after which reading ends.
    """
    return [
        replace(chunk, data=chunk.data[:enough])
        for chunk in take_leading(itertools.islice(opened.chunks(), max_chunks), enough)
    ]


def take_leading(chunks: Iterable[Chunk], enough: int) -> list[Chunk]:
    """Return the first chunks: as many as contain `enough` bytes together, or all."""
    taken = list[Chunk]()
    size = 0
    for chunk in chunks:
        taken.append(chunk)
        size += len(chunk.data)
        if size >= enough:
            break
    return taken
