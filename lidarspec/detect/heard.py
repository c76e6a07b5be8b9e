"""Bytes that were read from one source to find out which sensor sent them, and how the beginning of
a file is read.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

from lidarspec.errors import SourceError
from lidarspec.transports.protocol import Chunk, Transport

#: bytes of a file that are looked at.
LOOKED_AT = 1 << 17
#: bytes that are looked at to tell text, and the least that are enough for it.
TEXT_BYTES = 1 << 12
MIN_TEXT_BYTES = 16


@dataclass(frozen=True)
class Heard:
    """Bytes that one sender of a source sent.

    Attributes:
        source: how to open it again.
        chunks: datagrams, or pieces of a stream.
        datagrams: whether they are datagrams.
        baud: at which a serial port was read; None for another source, and for a port that has no
            baud rate.
        sender: address of the sender, where there are several.
        failure: why it could not be opened.
        warnings: what is to be said of the source, once it was read to its end.
        ports: the UDP ports that datagrams of a capture were sent to.
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
        """Whether the bytes begin as lines of printable text, which only some sensors send."""
        head = self.data[:TEXT_BYTES].removesuffix(b"\r")
        return (
            len(head) >= MIN_TEXT_BYTES
            and head.isascii()
            and re.sub(rb"[\t\r\n]", b"", head).decode().isprintable()
        )


def beginning(opened: Transport, most: int, *, number: int | None = None) -> list[Chunk]:
    """The beginning of a file: what holds `most` bytes, or `number` chunks if these are fewer."""
    return [
        replace(chunk, data=chunk.data[:most])
        for chunk in leading(itertools.islice(opened.chunks(), number), most)
    ]


def leading(chunks: Iterable[Chunk], most: int) -> list[Chunk]:
    """The first chunks, up to the one with which there are so many bytes."""
    found = list[Chunk]()
    size = 0
    for chunk in chunks:
        found.append(chunk)
        size += len(chunk.data)
        if size >= most:
            break
    return found
