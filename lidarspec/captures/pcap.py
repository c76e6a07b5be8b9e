"""Read the UDP datagrams of pcap and pcapng files, and make records of datagrams.

`records` reads the records of a file, and `ip` parses the frames in them. This module combines
both, and counts packets without a datagram in `CaptureStats`. Captures are untrusted input: damage
in a capture is counted and raises no exception.
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

from lidarspec.captures.containers import open_capture
from lidarspec.captures.ip import (
    MAX_PAYLOAD_BYTES,
    HeaderLayout,
    NoDatagramError,
    Reassembly,
    build_udp_frame,
    format_address,
    measure_headers,
    parse_ip,
    parse_udp,
)
from lidarspec.captures.records import (
    CapturedPacket,
    DamagedRecordError,
    Form,
    NoPacketReason,
    is_capture,
    make_packet_record,
    make_record_reader,
    seek_time,
    skip_damage,
)
from lidarspec.captures.source import MIN_BUFFER_BYTES, BufferedInput, TruncatedError
from lidarspec.errors import SourceError, UsageError
from lidarspec.transports.protocol import ClosingContext

#: Link types USER0 to USER15, for private use. Captures of byte streams are written with USER0.
USER_LINKS = range(147, 163)
#: The maximum number of protocols that are counted separately. All others are counted together.
MAX_COUNTED_KINDS = 16
#: The address and port of a datagram with unknown sender or receiver.
UNKNOWN_ENDPOINT = ("0.0.0.0", 0)
#: The first bytes of an IPv6 address that represents an IPv4 address (RFC 4291).
_IPV4_MAPPED_PREFIX = bytes.fromhex("00000000000000000000ffff")
#: A datagram over IPv6 can be longer by this number of bytes, because the length field of IPv6 does
#: not include the IP header.
_EXTRA_PAYLOAD_BYTES_IPV6 = 20


@dataclass(frozen=True, slots=True)
class Datagram:
    """One whole UDP datagram.

    Attributes:
        data: the payload.
        at: capture time in ns since 1970; 0 if the file has no times. For a fragmented datagram,
            the time of the last fragment.
        headers: the layout of the headers; None if the packet was reassembled or truncated.
    """

    data: bytes
    at: int
    source: tuple[str, int]
    destination: tuple[str, int]
    headers: HeaderLayout | None = field(default=None, compare=False)


@dataclass(slots=True)
class CaptureStats:
    """Counts of the packets, and of the damage, that a reader has found in a capture.

    Attributes:
        others: protocol, such as "ARP" -> number of packets that are not UDP over IP.
        unsupported: unsupported link layer, such as "802.11" -> number of packets.
        truncated_tail: whether the file ends within a record.
        snapped: number of UDP packets that were truncated by the snap length and not returned.
        incomplete_fragments: number of fragments of datagrams that stayed incomplete.
        malformed: number of packets and records with contradictory fields.
        lost: number of bytes that were skipped because of damaged records.
        stopped_at: file offset of the record that ended the reading; None if the file was read to
            its end.
    """

    packets: int = 0
    datagrams: int = 0
    other: int = 0
    others: Counter[str] = field(default_factory=Counter, compare=False)
    unsupported: Counter[str] = field(default_factory=Counter)
    truncated_tail: bool = False
    snapped: int = 0
    fragments: int = 0
    incomplete_fragments: int = 0
    malformed: int = 0
    damaged: int = 0
    lost: int = 0
    stopped_at: int | None = None

    def count_other(self, name: str) -> None:
        """Count a packet that is not UDP over IP."""
        self.other += 1
        _count_name(self.others, name)

    def count_unsupported(self, link_layer: str) -> None:
        """Count a packet with an unsupported link layer."""
        _count_name(self.unsupported, link_layer)


def _count_name(counts: Counter[str], name: str) -> None:
    """Count a name, or "more" if there are already `MAX_COUNTED_KINDS` names."""
    if name not in counts and len(counts) >= MAX_COUNTED_KINDS:
        name = "more"
    counts[name] += 1


class CaptureReader(ClosingContext):
    """Iterates over the UDP datagrams of a capture, in the order of the file.

    Each datagram is yielded once: a second iterator continues where the first stopped.

    Args:
        file: an open binary file or pipe, which stays open; or the path of a file, which may be
            compressed.

    Attributes:
        max_buffer_bytes: maximum size of the read buffer. The buffer exceeds this size only if a
            single record does not fit into it.

    Raises:
        SourceError: if the file cannot be read, or is not a capture. Damage is only counted.
    """

    max_buffer_bytes = MIN_BUFFER_BYTES

    def __init__(self, file: BinaryIO | str | os.PathLike[str]) -> None:
        self.stats = CaptureStats()
        self._owned: BinaryIO | None = None
        if isinstance(file, str | os.PathLike):
            self._owned = open_capture(file)
            file = self._owned
        self._source = BufferedInput(file, max_buffer_bytes=self.max_buffer_bytes)
        self._fragments = Reassembly()
        self._form: Form | None = None
        self._datagrams: Iterator[Datagram] | None = None
        try:
            magic = bytes(self._source.peek(4))
            if not is_capture(magic):
                if magic:
                    seen = f"the file begins with {magic.hex(' ')}"
                else:
                    seen = "the file is empty"
                raise SourceError(
                    f"{getattr(file, 'name', 'input')}: neither a pcap nor a pcapng capture: {seen}"
                )
        except SourceError:
            self.close()
            raise

    @property
    def offset(self) -> int:
        """The file offset of the next record."""
        return self._source.offset

    def __iter__(self) -> Iterator[Datagram]:
        # Not in __init__: the generator refers to the reader, and such a cycle keeps an unused
        # reader alive until the garbage collector runs.
        if self._datagrams is None:
            self._datagrams = self._iter_datagrams()
        return self._datagrams

    def skip_until(self, time_ns: int) -> bool:
        """Skip datagrams before a time; return whether datagrams were skipped.

        Args:
            time_ns: ns since 1970.
        """
        return self._form is not None and seek_time(self._source, self._form, time_ns)

    def close(self) -> None:
        """Close the file if it was given as a path."""
        if self._owned is not None:
            self._owned.close()

    def _iter_datagrams(self) -> Iterator[Datagram]:
        with self._close_at_end():
            form = make_record_reader(self._source)
            self._form = form
            while self._source.begin_record():
                try:
                    datagram = self.to_datagram(form.read())
                except DamagedRecordError:
                    self._skip_damage(form)
                    continue
                if datagram is not None:
                    self.stats.datagrams += 1
                    yield datagram

    def _skip_damage(self, form: Form) -> None:
        """Continue at the next readable record or at the end; count the skipped bytes."""
        damage_start = self._source.record
        has_more = skip_damage(self._source, form)
        self.stats.malformed += 1
        self.stats.damaged += 1
        self.stats.lost += self._source.offset - damage_start
        self.stats.stopped_at = None if has_more else damage_start

    @contextmanager
    def _close_at_end(self) -> Iterator[None]:
        """Close the file and complete the statistics when the context ends.

        The context contains the loop over the records. An incomplete last record ends the context
        without an exception.
        """
        try:
            yield
        except TruncatedError:
            self.stats.truncated_tail = True
            self.stats.stopped_at = self._source.record
        finally:
            self.close()
        self._fragments.finish()
        self.stats.incomplete_fragments = self._fragments.dropped

    def to_datagram(self, packet: CapturedPacket | NoPacketReason) -> Datagram | None:
        """Count a packet; return the datagram that it contains or completes, else None."""
        if isinstance(packet, NoPacketReason):
            if packet is NoPacketReason.MALFORMED:
                self.stats.malformed += 1
            return None
        self.stats.packets += 1
        try:
            ip = parse_ip(packet.data, packet.link)
            if ip.fragment is not None:
                self.stats.fragments += 1
                whole = self._fragments.add(ip, ip.fragment, packet.at)
                self.stats.incomplete_fragments = self._fragments.dropped
                if whole is None:
                    return None
                ip = whole
            udp = parse_udp(ip)
        except NoDatagramError as error:
            self._count_unread(packet, error)
            return None
        return Datagram(
            ip.body[udp.start : udp.stop],
            packet.at,
            (format_address(ip.source), udp.source),
            (format_address(ip.destination), udp.destination),
            measure_headers(ip, udp),
        )

    def _count_unread(self, packet: CapturedPacket, error: NoDatagramError) -> None:
        is_cut = len(packet.data) < packet.original
        if error.reason == "other":
            self.stats.count_other(error.name)
        elif error.reason == "link":
            self.stats.count_unsupported(error.name)
        elif error.reason == "short" and is_cut:
            self.stats.snapped += 1
        else:
            self.stats.malformed += 1


class StreamReader(CaptureReader):
    """Iterates over the packets of a captured byte stream, as datagrams."""

    def to_datagram(self, packet: CapturedPacket | NoPacketReason) -> Datagram | None:
        """Count the packet of a record, and return its bytes as a datagram.

        Returns:
            The datagram. None if the link type of the packet is not in `USER_LINKS`, or if the
            record has no packet, so that nothing is counted.
        """
        if isinstance(packet, NoPacketReason):
            return None
        self.stats.packets += 1
        if packet.link not in USER_LINKS:
            self.stats.count_unsupported(f"link type {packet.link}")
            return None
        headers = None
        if len(packet.data) < packet.original:
            self.stats.snapped += 1
        else:
            headers = HeaderLayout(0, len(packet.data), ())
        return Datagram(packet.data, packet.at, UNKNOWN_ENDPOINT, UNKNOWN_ENDPOINT, headers)


def make_datagram_record(datagram: Datagram) -> bytes:
    """Make the pcap record that contains a datagram.

    Raises:
        UsageError: if the payload is too long, or an address, port or time is invalid.
    """
    return make_packet_record(make_datagram_frame(datagram), datagram.at)


def make_datagram_frame(datagram: Datagram) -> bytes:
    """Make an unfragmented Ethernet frame that contains a datagram.

    Raises:
        UsageError: if the payload is too long, or an address or port is invalid.
    """
    source, destination = _pack_endpoints(datagram.source, datagram.destination)
    limit = MAX_PAYLOAD_BYTES
    if len(source[0]) == 16:
        limit += _EXTRA_PAYLOAD_BYTES_IPV6
    if len(datagram.data) > limit:
        raise UsageError(
            f"a datagram has {len(datagram.data)} bytes, but UDP supports at most {limit}"
        )
    return build_udp_frame(datagram.data, source, destination)


def is_stream_capture(head: bytes) -> bool:
    """Return whether a capture contains a byte stream; False for big-endian captures.

    Args:
        head: the first bytes of the file, at least 24 bytes of pcap or 64 bytes of pcapng.
    """
    if head.startswith(b"\x0a\x0d\x0d\x0a"):  # a section of pcapng, with an interface after it
        interface = int.from_bytes(head[4:8], "little")
        if head[interface : interface + 4] != b"\x01\0\0\0":
            return False
        link_offset = interface + 8
    elif head[:1] in (b"\x4d", b"\xd4"):  # little-endian pcap
        link_offset = 20
    else:
        return False
    if not is_capture(head) or len(head) < link_offset + 4:
        return False
    return int.from_bytes(head[link_offset : link_offset + 2], "little") in USER_LINKS


@lru_cache(maxsize=256)
def _pack_endpoints(*endpoints: tuple[str, int]) -> list[tuple[bytes, int]]:
    """Return (address as bytes, port) of each endpoint."""
    addresses = []
    for host, port in endpoints:
        try:
            addresses.append(ipaddress.ip_address(host).packed)
        except ValueError:
            raise UsageError(f"a capture requires an IP address, got {host!r}") from None
        if not 0 <= port < 1 << 16:
            raise UsageError(f"{port} is not a UDP port: expected 0 to 65535")
    if len({len(address) for address in addresses}) > 1:
        addresses = [_to_ipv6(address) for address in addresses]
    return [(address, port) for address, (_, port) in zip(addresses, endpoints, strict=True)]


def _to_ipv6(address: bytes) -> bytes:
    if len(address) == 16:
        return address
    if not any(address):
        return bytes(16)
    return _IPV4_MAPPED_PREFIX + address
