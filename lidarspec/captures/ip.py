"""Extract UDP payloads from captured frames, and build frames around payloads.

`parse_ip` returns the IP packet in a captured frame. `Reassembly.add` collects the fragments of a
packet. `parse_udp` returns the UDP header of a whole packet. The functions raise `NoDatagramError`
for a packet without a datagram.

Two header fields are ignored, because they can be wrong in valid captures:

* Checksums. If the capturing machine itself sent a packet, the packet is captured before the
  network card computes the checksums.
* The length of an unfragmented IP packet, if it is 0 or longer than the frame. Network cards that
  split packets write 0, and one lidar model writes 1234 in packets of 540 bytes. The length in the
  UDP header is checked instead.

Source: RFC 768 (UDP), RFC 791 (IPv4), RFC 8200 (IPv6), RFC 5722 (overlapping fragments), RFC 6946
(atomic fragments), IEEE 802.1Q (VLAN tags), and the link-layer header types of tcpdump.org.
"""

from __future__ import annotations

import ipaddress
import struct
from bisect import bisect_left
from collections import OrderedDict
from functools import lru_cache
from typing import Literal, NamedTuple

ETHERNET = 1
#: The maximum payload over IPv4. A packet has at most 65,535 bytes, of which 20 are the IPv4 header
#: and 8 are the UDP header.
MAX_PAYLOAD_BYTES = 65_507
_MAX_PACKET_BYTES = 65_535

_LOOPBACK_LINKS = {0, 108}
_RAW_IP_LINKS = {12, 101, 228, 229}
#: The offset of the EtherType and the length of the header, by link type.
_ETHERTYPE_LINKS = {
    ETHERNET: (12, 14),
    113: (14, 16),  # Linux "cooked" capture, SLL
    276: (0, 20),  # SLL2
}
#: The names of link types that are not supported, by number.
_UNSUPPORTED_LINKS = {
    9: "PPP",
    50: "PPP",
    51: "PPPoE",
    105: "802.11",
    127: "802.11 with radiotap",
}
_UNSUPPORTED_ETHERTYPES = {0x8847: "MPLS", 0x8848: "MPLS", 0x8864: "PPPoE"}
_VLAN_ETHERTYPES = {0x8100, 0x88A8, 0x9100}
_VLAN_TAG_BYTES = 4
_IPV4_ETHERTYPE = 0x0800
_IPV6_ETHERTYPE = 0x86DD
#: The smallest EtherType. Smaller values in its field are lengths (802.3).
_MIN_ETHERTYPE = 0x0600
#: The value of AF_INET, which is the same on all systems, and the values of AF_INET6 on Linux,
#: NetBSD, FreeBSD and macOS.
_IP_FAMILIES = {2, 10, 24, 28, 30}
_LOOPBACK_HEADER_BYTES = 4

#: The names of protocols that are not UDP, by EtherType. The next table has such names by IP
#: protocol.
_ETHERTYPE_NAMES = {
    0x0806: "ARP",
    0x8863: "PPPoE discovery",
    0x888E: "802.1X",
    0x88CC: "LLDP",
    0x88F7: "PTP",
}
_PROTOCOL_NAMES = {
    1: "ICMP",
    2: "IGMP",
    6: "TCP",
    47: "GRE",
    50: "ESP",
    58: "ICMPv6",
    132: "SCTP",
}

_UDP_PROTOCOL = 17
_FRAGMENT_PROTOCOL = 44
#: Extension headers of IPv6: hop-by-hop options, routing, destination options.
_EXTENSION_PROTOCOLS = {0, 43, 60}

_ETHERNET_HEADER = struct.Struct(">6s6sH")
_IPV4_HEADER = struct.Struct(">BxHHHBB2s4s4s")
_IPV6_HEADER = struct.Struct(">4xHBx16s16s")
_FRAGMENT_HEADER = struct.Struct(">BxHI")
_UDP_HEADER = struct.Struct(">HHHH")
#: The offsets of the bytes of an IPv4 header that differ between packets: the identification and
#: the header checksum.
_IPV4_VARIABLE_OFFSETS = (4, 5, 10, 11)

# Locally administered addresses, which are not assigned to any device.
_DESTINATION_MAC = bytes.fromhex("020000000001")
_SOURCE_MAC = bytes.fromhex("020000000002")
_DO_NOT_FRAGMENT = 0x4000
_TIME_TO_LIVE = 64


class NoDatagramError(Exception):
    """No datagram can be read from a packet.

    Attributes:
        reason: "other" (not UDP over IP), "link" (unsupported link layer), "short" (fewer bytes
            than the headers declare) or "malformed" (header fields contradict each other).
        name: for "other", the protocol; for "link", the link layer.
    """

    def __init__(
        self, reason: Literal["other", "link", "short", "malformed"], name: str = ""
    ) -> None:
        super().__init__(reason)
        self.reason = reason
        self.name = name


class IpFragment(NamedTuple):
    """The position of a fragment in the whole packet.

    Attributes:
        ident: the identification, which all fragments of a packet share.
        start: offset of the fragment's first byte in the body of the whole packet.
    """

    ident: int
    start: int
    more: bool


class IpPacket(NamedTuple):
    """An IP packet that contains UDP, or a fragment of such a packet.

    Attributes:
        source: address of the sender, 4 or 16 bytes.
        destination: address of the receiver, 4 or 16 bytes.
        protocol: number of the first header in `body`: UDP, or an IPv6 extension header.
        body_offset: offset of `body` in the frame; 0 for a reassembled packet.
        fragment: the position of the fragment; None for a whole packet.
        variable_offsets: offsets of the bytes of the IP header that differ between packets.
    """

    source: bytes
    destination: bytes
    protocol: int
    body: bytes
    body_offset: int = 0
    fragment: IpFragment | None = None
    variable_offsets: tuple[int, ...] = ()


class UdpPacket(NamedTuple):
    """The header of a UDP packet."""

    source: int
    destination: int
    start: int
    stop: int


class HeaderLayout(NamedTuple):
    """The size of the headers of an unfragmented UDP packet, and the bytes that vary.

    Attributes:
        size: length of all headers together, bytes.
        payload_size: length of the payload after the headers, bytes.
        variable_offsets: offsets of the checksums and of the IPv4 identification. All other header
            bytes are equal in packets of the same sender and size.
    """

    size: int
    payload_size: int
    variable_offsets: tuple[int, ...]


def parse_ip(frame: bytes, link: int) -> IpPacket:
    """Return the IP packet in a captured frame, without padding.

    Args:
        link: the link-layer type, as in a pcap header.

    Raises:
        NoDatagramError: if the frame contains no UDP over IP, or is incomplete.
    """
    try:
        start = _find_ip(frame, link)
        version = frame[start] >> 4
        if version == 4:
            return _parse_ipv4(frame, start)
        if version == 6:
            return _parse_ipv6(frame, start)
    except (struct.error, IndexError):
        raise NoDatagramError("short") from None
    raise NoDatagramError("malformed")


def parse_udp(packet: IpPacket) -> UdpPacket:
    """Return the UDP header of a whole packet.

    Raises:
        NoDatagramError: if no UDP header follows the extension headers, or its length is wrong.
    """
    try:
        protocol, start = _skip_extensions(packet.protocol, packet.body)
        if protocol == _FRAGMENT_PROTOCOL:
            raise NoDatagramError("malformed")
        if protocol != _UDP_PROTOCOL:
            raise _make_protocol_error(protocol)
        source, destination, length, _ = _UDP_HEADER.unpack_from(packet.body, start)
    except struct.error:
        raise NoDatagramError("short") from None
    if length < _UDP_HEADER.size:
        raise NoDatagramError("malformed")
    if start + length > len(packet.body):
        raise NoDatagramError("short")
    return UdpPacket(source, destination, start + _UDP_HEADER.size, start + length)


def measure_headers(packet: IpPacket, udp: UdpPacket) -> HeaderLayout | None:
    """Return the layout of the headers of a UDP packet; None for a reassembled packet."""
    if not packet.body_offset:
        return None
    size = packet.body_offset + udp.start
    udp_checksum = (size - 2, size - 1)
    return HeaderLayout(size, udp.stop - udp.start, (*udp_checksum, *packet.variable_offsets))


@lru_cache(maxsize=256)
def format_address(packed: bytes) -> str:
    """Return an IP address of 4 or 16 bytes as text."""
    return str(ipaddress.ip_address(packed))


def build_udp_frame(
    payload: bytes, source: tuple[bytes, int], destination: tuple[bytes, int]
) -> bytes:
    """Return an Ethernet frame with an IP header, a UDP header and the payload.

    Args:
        payload: the payload, which has at most `MAX_PAYLOAD_BYTES`, or 20 bytes more over IPv6.
        source: address and port of the sender. The address has 4 or 16 bytes.
        destination: address and port of the receiver. Both addresses have the same length.
    """
    length = _UDP_HEADER.size + len(payload)
    if len(source[0]) == 16:
        ethertype = _IPV6_ETHERTYPE
        ip_header = _build_ipv6_header(length, source[0], destination[0])
        checksum = _udp_checksum_over_ipv6(payload, source, destination)
    else:
        ethertype = _IPV4_ETHERTYPE
        ip_header = _build_ipv4_header(length, source[0], destination[0])
        checksum = 0  # not computed, which IPv4 allows
    link_header = _ETHERNET_HEADER.pack(_DESTINATION_MAC, _SOURCE_MAC, ethertype)
    udp_header = _UDP_HEADER.pack(source[1], destination[1], length, checksum)
    return link_header + ip_header + udp_header + payload


def _build_ipv4_header(body_size: int, source: bytes, destination: bytes) -> bytes:
    fields = (
        0x45,  # version 4, a header of 5 words
        _IPV4_HEADER.size + body_size,
        0,
        _DO_NOT_FRAGMENT,
        _TIME_TO_LIVE,
        _UDP_PROTOCOL,
    )
    without_checksum = _IPV4_HEADER.pack(*fields, b"\0\0", source, destination)
    checksum = _internet_checksum(without_checksum).to_bytes(2)
    return _IPV4_HEADER.pack(*fields, checksum, source, destination)


def _build_ipv6_header(body_size: int, source: bytes, destination: bytes) -> bytes:
    head = struct.pack(">IHBB", 6 << 28, body_size, _UDP_PROTOCOL, _TIME_TO_LIVE)
    return head + source + destination


def _udp_checksum_over_ipv6(
    payload: bytes, source: tuple[bytes, int], destination: tuple[bytes, int]
) -> int:
    length = _UDP_HEADER.size + len(payload)
    pseudo_header = source[0] + destination[0] + struct.pack(">II", length, _UDP_PROTOCOL)
    header = _UDP_HEADER.pack(source[1], destination[1], length, 0)
    padding = bytes(len(payload) % 2)
    checksum = _internet_checksum(pseudo_header + header + payload + padding)
    return checksum or 0xFFFF  # 0 would mean "not computed"


def _internet_checksum(words: bytes) -> int:
    """Return the complement of the ones' complement sum of 16-bit words."""
    # the sum is the big-endian number of all bytes modulo 0xFFFF, but 0xFFFF instead of 0
    return 0xFFFF - (int.from_bytes(words) % 0xFFFF or 0xFFFF)


def _find_ip(frame: bytes, link: int) -> int:
    """Return the offset of the IP header."""
    if link in _RAW_IP_LINKS:
        return 0
    if link in _LOOPBACK_LINKS:
        return _skip_loopback_header(frame)
    if link in _ETHERTYPE_LINKS:
        type_offset, header_size = _ETHERTYPE_LINKS[link]
        return _skip_ethertype(frame, _read_ethertype(frame, type_offset), header_size)
    raise NoDatagramError("link", _UNSUPPORTED_LINKS.get(link, f"link type {link}"))


def _skip_loopback_header(frame: bytes) -> int:
    (little,) = struct.unpack_from("<I", frame)
    (big,) = struct.unpack_from(">I", frame)
    # The family has the byte order of the capturing machine. Families are small numbers, so the
    # smaller value is the one in the right byte order.
    if min(little, big) not in _IP_FAMILIES:
        raise NoDatagramError("other", "loopback frames without IP")
    return _LOOPBACK_HEADER_BYTES


def _skip_ethertype(frame: bytes, ethertype: int, start: int) -> int:
    """Return the offset of the IP header after an EtherType and VLAN tags."""
    while ethertype in _VLAN_ETHERTYPES:
        ethertype = _read_ethertype(frame, start + 2)
        start += _VLAN_TAG_BYTES
    if ethertype in (_IPV4_ETHERTYPE, _IPV6_ETHERTYPE):
        return start
    if ethertype in _UNSUPPORTED_ETHERTYPES:
        raise NoDatagramError("link", _UNSUPPORTED_ETHERTYPES[ethertype])
    if ethertype < _MIN_ETHERTYPE:
        raise NoDatagramError("other", "802.3 frames without EtherType")
    name = _ETHERTYPE_NAMES.get(ethertype, f"EtherType 0x{ethertype:04x}")
    raise NoDatagramError("other", name)


def _read_ethertype(frame: bytes, offset: int) -> int:
    return frame[offset] << 8 | frame[offset + 1]


def _make_protocol_error(protocol: int) -> NoDatagramError:
    return NoDatagramError("other", _PROTOCOL_NAMES.get(protocol, f"IP protocol {protocol}"))


def _parse_ipv4(frame: bytes, start: int) -> IpPacket:
    version_and_words, length, ident, flags_and_offset, _, protocol, _, source, destination = (
        _IPV4_HEADER.unpack_from(frame, start)
    )
    header_size = (version_and_words & 0x0F) * 4
    length = length or len(frame) - start
    if header_size < _IPV4_HEADER.size or length < header_size:
        raise NoDatagramError("malformed")
    if protocol != _UDP_PROTOCOL:
        raise _make_protocol_error(protocol)
    body_start = start + header_size
    body = frame[body_start : start + length]
    fragment = _make_fragment(
        ident,
        start=(flags_and_offset & 0x1FFF) * 8,
        size=length - header_size,
        more=bool(flags_and_offset & 0x2000),
    )
    if fragment is not None and len(body) < length - header_size:
        raise NoDatagramError("short")
    variable_offsets = tuple(start + offset for offset in _IPV4_VARIABLE_OFFSETS)
    return IpPacket(source, destination, protocol, body, body_start, fragment, variable_offsets)


def _parse_ipv6(frame: bytes, start: int) -> IpPacket:
    length, protocol, source, destination = _IPV6_HEADER.unpack_from(frame, start)
    body_start = start + _IPV6_HEADER.size
    body = frame[body_start : body_start + length]
    missing_bytes = length - len(body)
    fragment = None
    protocol, offset = _skip_extensions(protocol, body)
    if protocol == _FRAGMENT_PROTOCOL:
        protocol, offset_and_flags, ident = _FRAGMENT_HEADER.unpack_from(body, offset)
        offset += _FRAGMENT_HEADER.size
        fragment = _make_fragment(
            ident,
            start=offset_and_flags & 0xFFF8,
            size=len(body) - offset + missing_bytes,
            more=bool(offset_and_flags & 1),
        )
    if protocol != _UDP_PROTOCOL and protocol not in _EXTENSION_PROTOCOLS:
        raise _make_protocol_error(protocol)
    if fragment is not None and missing_bytes:
        raise NoDatagramError("short")
    return IpPacket(source, destination, protocol, body[offset:], body_start + offset, fragment)


def _skip_extensions(protocol: int, body: bytes) -> tuple[int, int]:
    """Return the protocol after the IPv6 extension headers, and its offset in `body`."""
    offset = 0
    while protocol in _EXTENSION_PROTOCOLS:
        protocol, extra_units = struct.unpack_from(">BB", body, offset)
        offset += (extra_units + 1) * 8
    return protocol, offset


def _make_fragment(ident: int, *, start: int, size: int, more: bool) -> IpFragment | None:
    """Return the fragment that header fields describe; None for a whole packet."""
    if not more and not start:
        return None
    is_cut_in_eights = not more or size % 8 == 0
    if not size or not is_cut_in_eights or start + size > _MAX_PACKET_BYTES:
        raise NoDatagramError("malformed")
    return IpFragment(ident, start, more)


class _PartialPacket:
    """An incomplete packet: the fragments that have arrived, which do not overlap."""

    __slots__ = ("arrival_ns", "parts", "protocol", "size", "starts", "total_size")

    def __init__(self, arrival_ns: int) -> None:
        self.arrival_ns = arrival_ns
        self.parts: dict[int, bytes] = {}
        self.starts: list[int] = []  # the keys of `parts`, sorted
        self.size = 0
        self.total_size: int | None = None
        self.protocol = _UDP_PROTOCOL

    def add(self, start: int, body: bytes, *, more: bool) -> bool:
        """Add a fragment; return False if it contradicts the other fragments."""
        stop = start + len(body)
        index = bisect_left(self.starts, start)
        if self._overlaps(index, start, stop):
            return False
        if more:
            if self.total_size is not None and stop > self.total_size:
                return False
        else:
            has_later_fragments = index < len(self.starts)
            if has_later_fragments or self.total_size is not None:
                return False
            self.total_size = stop
        self.starts.insert(index, start)
        self.parts[start] = body
        self.size += len(body)
        return True

    def _overlaps(self, index: int, start: int, stop: int) -> bool:
        if index > 0:
            previous = self.starts[index - 1]
            if previous + len(self.parts[previous]) > start:
                return True
        return index < len(self.starts) and self.starts[index] < stop


class Reassembly:
    """Reassembles IP fragments that arrive in any order, in bounded memory.

    A packet with overlapping fragments is dropped (RFC 5722). Incomplete packets are dropped after
    `TIMEOUT_NS`, or if they exceed `MAX_PACKETS` or `MAX_BYTES`.
    """

    MAX_PACKETS = 256
    MAX_BYTES = 4 << 20
    #: At 10,000 datagrams per second, the 16-bit identification of IPv4 repeats after 6.5 s. The
    #: timeout is shorter than this.
    TIMEOUT_NS = 5_000_000_000
    #: The size of the Python objects of a fragment. It is part of `MAX_BYTES`, so that many small
    #: fragments do not exceed the memory limit.
    _OVERHEAD_BYTES = 160

    def __init__(self) -> None:
        self.dropped = 0
        self._partials: OrderedDict[tuple[bytes, bytes, int], _PartialPacket] = OrderedDict()
        self._held_bytes = 0

    def add(self, packet: IpPacket, fragment: IpFragment, arrival_ns: int) -> IpPacket | None:
        """Add a fragment; return the whole packet, or None if fragments are missing.

        Args:
            arrival_ns: the capture time, ns since 1970.
        """
        self._drop_older(arrival_ns - self.TIMEOUT_NS)
        key = packet.source, packet.destination, fragment.ident
        partial = self._partials.setdefault(key, _PartialPacket(arrival_ns))
        if partial.parts.get(fragment.start) == packet.body:
            return None
        if not partial.add(fragment.start, packet.body, more=fragment.more):
            self.dropped += 1
            self._drop(key)
            return None
        self._held_bytes += len(packet.body) + self._OVERHEAD_BYTES
        if fragment.start == 0:
            partial.protocol = packet.protocol
        if partial.size == partial.total_size:
            self._remove(key)
            body = b"".join(partial.parts[start] for start in partial.starts)
            return IpPacket(packet.source, packet.destination, partial.protocol, body)
        while len(self._partials) > self.MAX_PACKETS or self._held_bytes > self.MAX_BYTES:
            self._drop(next(iter(self._partials)))
        return None

    def finish(self) -> None:
        """Drop all packets that are still incomplete."""
        while self._partials:
            self._drop(next(iter(self._partials)))

    def _drop_older(self, limit_ns: int) -> None:
        while self._partials:
            key, partial = next(iter(self._partials.items()))
            if partial.arrival_ns >= limit_ns:
                return
            self._drop(key)

    def _drop(self, key: tuple[bytes, bytes, int]) -> None:
        """Remove an incomplete packet, and count its fragments as dropped."""
        self.dropped += len(self._remove(key).parts)

    def _remove(self, key: tuple[bytes, bytes, int]) -> _PartialPacket:
        """Remove a packet from the waiting packets, and return it."""
        partial = self._partials.pop(key)
        self._held_bytes -= partial.size + self._OVERHEAD_BYTES * len(partial.parts)
        return partial
