"""The bytes that were read from one source to identify the sensor.

Also reads the beginning of a file.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

from lidarspec.errors import SourceError
from lidarspec.transports.protocol import Chunk, Transport

#: bytes of a file that are examined.
LOOKED_AT = 1 << 17
#: bytes that are examined to recognise text, and the minimum for that.
TEXT_BYTES = 1 << 12
MIN_TEXT_BYTES = 16


@dataclass(frozen=True)
class SampleBytes:
    """Bytes that one sender of a source sent.

    Attributes:
        source: the SOURCE, to open it again.
        chunks: datagrams, or pieces of a stream.
        datagrams: whether they are datagrams.
        baud: the baud rate at which a serial port was read; None for other sources, and for a port
            without a baud rate.
        sender: address of the sender, if there are several.
        failure: the reason why it could not be opened.
        warnings: warnings about the source at its end.
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
        """Whether the bytes begin as lines of printable text, as some sensors send."""
        head = self.data[:TEXT_BYTES].removesuffix(b"\r")
        return (
            len(head) >= MIN_TEXT_BYTES
            and head.isascii()
            and re.sub(rb"[\t\r\n]", b"", head).decode().isprintable()
        )


def read_beginning(opened: Transport, most: int, *, number: int | None = None) -> list[Chunk]:
    """Return the start of a file: `most` bytes, or `number` chunks if that is less."""
    return [
        replace(chunk, data=chunk.data[:most])
        for chunk in take_leading(itertools.islice(opened.chunks(), number), most)
    ]


def take_leading(chunks: Iterable[Chunk], most: int) -> list[Chunk]:
    """Return the first chunks, until they have `most` bytes."""
    taken = list[Chunk]()
    size = 0
    for chunk in chunks:
        taken.append(chunk)
        size += len(chunk.data)
        if size >= most:
            break
    return taken
