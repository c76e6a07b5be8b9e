"""Captures: the UDP datagrams of a pcap or pcapng file, and the records of those that are written.

Theory of operation: `records` walks the records of the file, `ip` takes the captured frames apart,
and this module joins the two and counts in `CaptureStats` whatever gives no datagram. Captures are
hostile input: past the first four bytes nothing in them raises, and memory follows the bytes that
are there, never a length that they claim.
"""

from __future__ import annotations

import ipaddress
import os
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from typing import BinaryIO

from lidarspec.captures.containers import opened
from lidarspec.captures.ip import (
    LARGEST_PAYLOAD,
    Headers,
    Reassembly,
    Refused,
    address,
    headers,
    ip_packet,
    udp,
    udp_frame,
)
from lidarspec.captures.records import (
    CapturedPacket,
    Damaged,
    Form,
    Passed,
    is_capture,
    packet_record,
    records,
    resume,
    sought,
)
from lidarspec.captures.source import SMALLEST, Source, Truncated
from lidarspec.errors import SourceError, UsageError
from lidarspec.transports.protocol import Closing

#: the link types kept for private use: captures of byte streams have the first.
USER_LINKS = range(147, 163)
#: kinds of packets that are counted by their names.
MOST_KINDS = 16
#: who sent a datagram, and to whom, where nobody knows.
NOBODY = ("0.0.0.0", 0)
#: what an IPv4 address has before it as an IPv6 one.
_MAPPED = bytes.fromhex("00000000000000000000ffff")


@dataclass(frozen=True, slots=True)
class Datagram:
    """One whole UDP datagram.

    Attributes:
        data: the payload.
        at: capture time in ns since 1970, of its last fragment where it came in several; 0 where
            the file has no times.
        source, destination: address and port.
    """

    data: bytes
    at: int
    source: tuple[str, int]
    destination: tuple[str, int]


@dataclass(slots=True)
class CaptureStats:
    """What a capture held so far.

    Attributes:
        packets: captured packets, of whatever kind.
        datagrams: UDP datagrams handed out.
        other: packets that are not UDP over IP.
        others: how many of them by what they are, "ARP" or "TCP"; of so many kinds at most.
        truncated_tail: whether the file ends in the middle of a record; all before it was read.
        snapped: UDP packets that the capture's snap length cut short; they are not handed out.
        fragments: UDP packets that were IP fragments.
        incomplete_fragments: those whose datagram never became whole.
        malformed: packets and records that contradict themselves.
        damaged: places where a record could not be read, and bytes were passed over to the next one
            that could.
        lost: bytes that were passed over there.
        stopped_at: file offset of the truncated or malformed record that ended the reading, else
            None.
    """

    packets: int = 0
    datagrams: int = 0
    other: int = 0
    others: Counter[str] = field(default_factory=Counter, compare=False)
    truncated_tail: bool = False
    snapped: int = 0
    fragments: int = 0
    incomplete_fragments: int = 0
    malformed: int = 0
    damaged: int = 0
    lost: int = 0
    stopped_at: int | None = None

    def leave(self, what: str) -> None:
        """Count a packet that is no UDP over IP."""
        self.other += 1
        self.others[what if what in self.others or len(self.others) < MOST_KINDS else "more"] += 1


class CaptureReader(Closing):
    """The UDP datagrams of a capture, in file order, each once: an iterator goes on where the last
    one stopped.

    Args:
        file: an open binary file, also a pipe, which stays open; or a path, whose file is closed
            after the last datagram, and which may be compressed.

    Attributes:
        stats: what was met so far.
        largest: bytes that are read at once, at most.

    Raises:
        SourceError: the file cannot be read, or is no capture at all. Damage further on is counted,
            never raised.
    """

    largest = SMALLEST

    def __init__(self, file: BinaryIO | str | os.PathLike[str]) -> None:
        self.stats = CaptureStats()
        self._owned: BinaryIO | None = None
        if isinstance(file, str | os.PathLike):
            file = self._owned = opened(file)  # closed by `close`
        self._source = Source(file, largest=self.largest)
        self._fragments = Reassembly()
        self._form: Form | None = None
        self._datagrams: Iterator[Datagram] | None = None
        try:
            magic = bytes(self._source.ahead(4))
            if not is_capture(magic):
                seen = f"it begins with {magic.hex(' ')}" if magic else "it is empty"
                raise SourceError(
                    f"{getattr(file, 'name', 'input')}: neither a pcap nor a pcapng capture: {seen}"
                )
        except SourceError:
            self.close()
            raise

    @property
    def place(self) -> int:
        """Where in the file the next record begins."""
        return self._source.place

    def __iter__(self) -> Iterator[Datagram]:
        if (
            self._datagrams is None
            # and not before: it holds the reader, which would live on until the garbage is collected
        ):
            self._datagrams = self._walk()
        return self._datagrams

    def skip(self, at: int) -> bool:
        """Go on close before the first datagram that came at a time, ns since 1970, or later, where
        a file can be sought: whether it did.

        What is passed over is not counted, and datagrams whose fragments stand on both sides are
        left out.
        """
        return self._form is not None and sought(self._source, self._form, at)

    def close(self) -> None:
        """Closes the file, if it was given as a path."""
        if self._owned is not None:
            self._owned.close()

    def _walk(self) -> Iterator[Datagram]:
        with self._to_the_end():
            form = self._form = records(self._source)
            while self._source.begin_record():
                try:
                    datagram = self.datagram(form.read())
                except Damaged:
                    self._pass_over(form)
                    continue
                if datagram is not None:
                    self.stats.datagrams += 1
                    yield datagram

    def _pass_over(self, form: Form) -> None:
        """Goes behind a damaged record, to the next one or the end; counts what is lost."""
        begun = self._source.record
        found = resume(self._source, form)
        self.stats.malformed += 1
        self.stats.damaged += 1
        self.stats.lost += self._source.place - begun
        self.stats.stopped_at = None if found else begun

    @contextmanager
    def _to_the_end(self) -> Iterator[None]:
        """Around the reading of all records: counts what ends it."""
        try:
            yield
        except Truncated:
            self.stats.truncated_tail = True
            self.stats.stopped_at = self._source.record
        finally:
            self.close()
        self._fragments.finish()
        self.stats.incomplete_fragments = self._fragments.dropped

    def datagram(self, packet: CapturedPacket | Passed) -> Datagram | None:
        """The datagram that this packet is, or makes whole; counts what it is otherwise."""
        stats = self.stats
        if isinstance(packet, Passed):
            stats.malformed += packet is Passed.MALFORMED
            return None
        stats.packets += 1
        try:
            ip = ip_packet(packet.data, packet.link)
            if ip.fragment is not None:
                stats.fragments += 1
                whole = self._fragments.add(ip, ip.fragment, packet.at)
                stats.incomplete_fragments = self._fragments.dropped
                if whole is None:
                    return None
                ip = whole
            part = udp(ip)
        except Refused as refused:
            if refused.reason == "other":
                stats.leave(refused.what)
            elif refused.reason == "short" and len(packet.data) < packet.original:
                stats.snapped += 1
            else:
                stats.malformed += 1
            return None
        ends = (address(ip.source), part.source), (address(ip.destination), part.destination)
        return Datagram(ip.body[part.start : part.stop], packet.at, *ends)

    def headers(self, packet: CapturedPacket) -> Headers | None:
        """Where the payload of a packet that gave a datagram stands, and so that of packets like
        it; None where others may differ.
        """
        return headers(packet.data, packet.link)


class StreamReader(CaptureReader):
    """The packets of a capture of a byte stream, link type USER0 to USER15, as datagrams that
    nobody sent.
    """

    def datagram(self, packet: CapturedPacket | Passed) -> Datagram | None:
        """What the packet holds; counts it where it is of another link type."""
        if isinstance(packet, Passed):
            return None
        self.stats.packets += 1
        if packet.link not in USER_LINKS:
            self.stats.leave(f"link type {packet.link}")
            return None
        self.stats.snapped += len(packet.data) < packet.original
        return Datagram(packet.data, packet.at, NOBODY, NOBODY)

    def headers(self, packet: CapturedPacket) -> Headers | None:
        """None for a packet that was cut, which is counted."""
        return Headers(0, len(packet.data), ()) if len(packet.data) == packet.original else None


def datagram_record(datagram: Datagram) -> bytes:
    """The record of one datagram in a pcap file.

    Raises:
        UsageError: as `datagram_frame`, and for a time that no record can hold.
    """
    return packet_record(datagram_frame(datagram), datagram.at)


def datagram_frame(datagram: Datagram) -> bytes:
    """One datagram, unfragmented, as Ethernet, IP and UDP.

    Raises:
        UsageError: more bytes than UDP carries, an address that is none, or a port that there is
            not.
    """
    source, destination = _endpoints(datagram.source, datagram.destination)
    most = LARGEST_PAYLOAD + 20 * (len(source[0]) == 16)
    if len(datagram.data) > most:
        raise UsageError(f"a datagram of {len(datagram.data)} bytes: UDP carries at most {most}")
    return udp_frame(datagram.data, source, destination)


def is_stream_capture(head: bytes) -> bool:
    """Whether a file that begins so is a capture of a byte stream, little-endian; 24 bytes of pcap
    tell, 64 of pcapng as written here.
    """
    link = 20
    if head.startswith(b"\x0a\x0d\x0d\x0a"):
        link = 8 + int.from_bytes(head[4:8], "little")
        if head[link - 8 : link - 4] != b"\x01\0\0\0":  # no interface
            return False
    elif head[:1] not in (b"\x4d", b"\xd4"):
        return False
    return (
        is_capture(head)
        and len(head) >= link + 4
        and int.from_bytes(head[link : link + 2], "little") in USER_LINKS
    )


@lru_cache(maxsize=256)
def _endpoints(*ends: tuple[str, int]) -> list[tuple[bytes, int]]:
    """Addresses, of 4 bytes or 16 as the longest of them is, and ports."""
    packed = []
    for host, port in ends:
        try:
            packed.append(ipaddress.ip_address(host).packed)
        except ValueError:
            raise UsageError(f"{host!r} is no address, which is what a capture holds") from None
        if not 0 <= port < 1 << 16:
            raise UsageError(f"{port} is not a UDP port")
    if len({len(address) for address in packed}) > 1:
        packed = [
            address if len(address) == 16 else _MAPPED + address if any(address) else bytes(16)
            for address in packed
        ]
    return [(address, port) for address, (_, port) in zip(packed, ends, strict=True)]
