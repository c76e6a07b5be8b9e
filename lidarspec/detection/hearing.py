"""Bytes out of any source, to find out whose they are: the beginning of a file, or a second of what comes over a live one."""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from lidarspec.errors import SourceError, UsageError
from lidarspec.files import Chunk, Disconnected, LiveTransport, Transport
from lidarspec.links import Serial, Udp
from lidarspec.plugins import sensors
from lidarspec.sources import live_address, transport

#: bytes and datagrams that are looked at; of a live source, bytes that are enough.
LOOKED_AT, DATAGRAMS, PLENTY = 1 << 17, 400, 1 << 14
#: seconds to listen for, and between two looks.
LISTEN, LOOK = 1.2, 0.1


@dataclass(frozen=True)
class Heard:
    """What came from one source, of one sender.

    Attributes:
        source: how to open it again.
        chunks: datagrams, or pieces of a stream.
        datagrams: whether they are datagrams.
        baud: at which a serial port was read; None for another source, and for a port that has no baud rate.
        sender: address of the sender, where there are several.
        failure: why it could not be opened.
    """

    source: str
    chunks: tuple[bytes, ...] = ()
    datagrams: bool = False
    baud: int | None = None
    sender: str = ""
    failure: SourceError | None = field(default=None, compare=False)

    @property
    def size(self) -> int:
        """The number of bytes."""
        return sum(map(len, self.chunks))


def bauds() -> list[int]:
    """The baud rates that installed sensors declare, those of the most sensors first."""
    declared = [baud for sensor in sensors().values() for link in sensor.links.values() if isinstance(link, Serial) for baud in link.bauds]
    return sorted(set(declared), key=lambda baud: (-declared.count(baud), baud))


def udp_ports() -> list[int]:
    """The UDP ports that data of installed sensors come to."""
    links = (sensor.links.get("data") for sensor in sensors().values())
    return sorted({port for link in links if isinstance(link, Udp) for port in link.ports})


def hear(source: str | Path, *, seconds: float = LISTEN) -> Iterator[Heard]:
    """What comes from a source; a serial port whose baud rate is not given, once for each that installed sensors declare.

    Args:
        seconds: to listen for, each time.

    Raises:
        SourceError: where it cannot be opened.
    """
    text, address = str(source), live_address(source)
    if address is not None and address.scheme == "serial" and "baud" not in address.options:
        mark = "&" if "?" in text else "?"
        for baud in bauds()[: 1 if has_no_baud(address.place) else None]:
            yield from _heard(f"{text}{mark}baud={baud}", seconds, None if has_no_baud(address.place) else baud, text)
    elif address is not None and address.scheme == "udp" and not address.host_and_port()[1] and "port" not in address.options:
        mark = "&" if "?" in text else "?"
        yield from _heard(f"{text}{mark}port={','.join(map(str, udp_ports()))}", seconds, None, text)
    else:
        yield from _heard(text, seconds, int(address.options["baud"]) if address is not None and "baud" in address.options else None, text)


def has_no_baud(port: str) -> bool:
    """Whether a port is a pseudo-terminal, at which every baud rate is the same."""
    return os.path.realpath(port).startswith("/dev/pts/")


def _heard(source: str, seconds: float, baud: int | None, name: str) -> Iterator[Heard]:
    opened = transport(source)
    try:
        live = hasattr(opened, "read")
        chunks = _listened(opened, seconds) if live else _begun(opened)  # type: ignore[arg-type]
    finally:
        opened.close()
    by_sender: dict[str, list[bytes]] = {}
    for chunk in chunks:
        by_sender.setdefault(chunk.sender[0] if chunk.sender else "", []).append(chunk.data)
    for sender, data in (by_sender or {"": []}).items():
        yield Heard(name, tuple(data), opened.datagrams, baud, sender if len(by_sender) > 1 else "")


def _begun(opened: Transport) -> list[Chunk]:
    """The beginning of a file."""
    found: list[Chunk] = []
    size = 0
    for chunk in itertools.islice(opened.chunks(), DATAGRAMS if opened.datagrams else None):
        found.append(Chunk(chunk.data[:LOOKED_AT], chunk.at, chunk.sender))
        size += len(found[-1].data)
        if size >= LOOKED_AT:
            break
    return found


def _listened(opened: LiveTransport, seconds: float) -> list[Chunk]:
    """What comes within some seconds, or as soon as it is plenty."""
    found: list[Chunk] = []
    end, size = time.monotonic() + seconds, 0
    while (left := end - time.monotonic()) > 0 and size < PLENTY:
        try:
            chunks = opened.read(min(left, LOOK))
        except Disconnected:
            break
        found += chunks
        size += sum(len(chunk.data) for chunk in chunks)
    return found


def everywhere(ports: list[str], *, seconds: float = LISTEN) -> Iterator[Heard]:
    """What comes over every serial port given and every UDP port that installed sensors declare; failures are told, not raised."""
    for source in (*ports, *(f"udp://:{port}" for port in udp_ports())):
        try:
            yield from hear(source, seconds=seconds)
        except (SourceError, UsageError) as error:
            yield Heard(source, failure=error if isinstance(error, SourceError) else SourceError(str(error)))
