"""From captured frames to UDP payloads, and back: link layers, IPv4, IPv6, fragments.

Knows nothing of files. A frame goes through `ip_packet`, if it is a fragment then through
`Reassembly.add`, and through `udp`; whichever step finds that no datagram comes of it raises
`Refused` with the reason.

Two fields are not trusted. Checksums: where the capturing machine is the sender, its network card
fills them in only after the capture. The length of an unfragmented packet, where more is claimed
than is there, or 0: a lidar in the field puts the IPv4 length of its data packets, 1234, also into
packets of 540 bytes, and a network card that cuts packets up fills it in after the capture. UDP's
own length decides whether the payload is whole.

Source: RFC 768 (UDP), RFC 791 (IPv4), RFC 8200 (IPv6), RFC 5722 (overlapping fragments), RFC 6946
(atomic fragments), RFC 1661 and 1662 (PPP), RFC 2516 (PPPoE), RFC 3032 (MPLS), IEEE 802.1Q (VLAN
tags), IEEE 802.11 9.2 and 9.3.2 (data frames), radiotap.org (its header), and the link-layer header
types of tcpdump.org.
"""

from __future__ import annotations

import ipaddress
import struct
from bisect import bisect_left
from collections import OrderedDict
from functools import lru_cache
from typing import Literal, NamedTuple

ETHERNET = 1
LARGEST_PAYLOAD = 65_507  # 65,535 bytes of IPv4 packet, less 20 of its header and 8 of UDP's
_LARGEST_PACKET = 65_535

_LOOPBACK = {0, 108}
_RAW = {12, 101, 228, 229}
_ETHERTYPE_LINKS = {
    ETHERNET: (12, 14),
    113: (14, 16),
    276: (0, 20),
}  # offset of the EtherType, length of the header
_VLAN_TAGS = {0x8100, 0x88A8, 0x9100}
_IP_ETHERTYPES = {0x0800, 0x86DD}
_IP_FAMILIES = {
    2,
    10,
    24,
    28,
    30,
}  # AF_INET everywhere; AF_INET6 of Linux, NetBSD, FreeBSD and macOS
_PPP_LINKS = {9: 0, 50: 0, 51: 6}  # what stands before PPP's header: nothing, or that of PPPoE
_PPPOE, _MPLS, _PPP_IP = 0x8864, {0x8847, 0x8848}, {0x0021, 0x0057}
_WIFI, _RADIOTAP = 105, 127
#: what packets are called that are no UDP, by EtherType and by IP protocol.
_ETHERTYPES = {
    0x0806: "ARP",
    0x8863: "PPPoE discovery",
    0x888E: "802.1X",
    0x88CC: "LLDP",
    0x88F7: "PTP",
}
_PROTOCOLS = {1: "ICMP", 2: "IGMP", 6: "TCP", 47: "GRE", 50: "ESP", 58: "ICMPv6", 132: "SCTP"}

_UDP = 17
_FRAGMENT = 44
_EXTENSIONS = {0, 43, 60}  # hop-by-hop options, routing, destination options

_ETHERNET_HEADER = struct.Struct(">6s6sH")
_IPV4_HEADER = struct.Struct(">BxHHHBB2s4s4s")
_IPV6_HEADER = struct.Struct(">4xHBx16s16s")
_UDP_HEADER = struct.Struct(">HHHH")
_SNAP_HEADER, _SNAP = struct.Struct(">6sH"), bytes.fromhex("aaaa03000000")
_TO_MAC, _FROM_MAC = (
    bytes.fromhex("020000000001"),
    bytes.fromhex("020000000002"),
)  # locally administered, nobody's
_DO_NOT_FRAGMENT, _TIME_TO_LIVE = 0x4000, 64


class Refused(Exception):
    """A packet that gives no datagram.

    Attributes:
        reason: "other" (not UDP), "short" (fewer bytes than its headers say) or "malformed"
            (headers that cannot be).
        what: the name of what it is instead of UDP.
    """

    def __init__(self, reason: Literal["other", "short", "malformed"], what: str = "") -> None:
        super().__init__(reason)
        self.reason, self.what = reason, what


class Fragment(NamedTuple):
    """Where the body of a packet belongs in the whole: bytes from `start` on, with `more` to come
    after it.
    """

    ident: int
    start: int
    more: bool


class IpPacket(NamedTuple):
    """An IP packet that carries UDP, or a fragment of one; addresses as on the wire, 4 or 16 bytes;
    `at`: where in the frame `body` is.
    """

    source: bytes
    destination: bytes
    protocol: int
    body: bytes
    at: int = 0
    fragment: Fragment | None = None


class UdpPacket(NamedTuple):
    """Ports, and which part of the IP packet's body the payload is."""

    source: int
    destination: int
    start: int
    stop: int


class Headers(NamedTuple):
    """What stands before the payload of an unfragmented UDP packet.

    Attributes:
        size: of all headers together, which is where the payload starts.
        payload: its length.
        free: the places of bytes that may differ between packets of one stream and tell nothing
            about it: the identification of an unfragmented IPv4 packet, and checksums.
    """

    size: int
    payload: int
    free: tuple[int, ...]


def ip_packet(frame: bytes, link: int) -> IpPacket:
    """The IP packet in a captured frame, padding cut off.

    Args:
        frame: the bytes from the link layer's first on, as many as were captured.
        link: the link-layer type, as in a pcap header.

    Raises:
        Refused: the frame carries no UDP over IP, or not all of it.
    """
    try:
        start = _ip_start(frame, link)
        version = frame[start] >> 4
        if version == 4:
            return _ipv4(frame, start)
        if version == 6:
            return _ipv6(frame, start)
    except (struct.error, IndexError):
        raise Refused("short") from None
    raise Refused("malformed")


def udp(packet: IpPacket) -> UdpPacket:
    """The UDP header of a whole packet.

    Raises:
        Refused: no UDP follows the extension headers, or its length does not fit.
    """
    try:
        protocol, at = _past_extensions(packet.protocol, packet.body)
        if protocol != _UDP:
            raise Refused("malformed") if protocol == _FRAGMENT else _not_udp(protocol)
        source, destination, length, _ = _UDP_HEADER.unpack_from(packet.body, at)
    except struct.error:
        raise Refused("short") from None
    if length < _UDP_HEADER.size:
        raise Refused("malformed")
    if at + length > len(packet.body):
        raise Refused("short")
    return UdpPacket(source, destination, at + _UDP_HEADER.size, at + length)


def headers(frame: bytes, link: int) -> Headers | None:
    """Where the payload stands in a frame, and which bytes before it decide that; None for
    fragments.

    Frames of the same link type and length, whose headers are equal but for the free bytes, have
    their payload in the same place and come from the same sender: nothing else is looked at by
    `ip_packet` and `udp`.

    Raises:
        Refused: as `ip_packet` and `udp`.
    """
    packet = ip_packet(frame, link)
    if packet.fragment is not None:
        return None
    part = udp(packet)
    size = packet.at + part.start
    start = _ip_start(frame, link)
    free = [size - 2, size - 1]
    if frame[start] >> 4 == 4:
        free += [start + at for at in (4, 5, 10, 11)]
    return Headers(size, part.stop - part.start, tuple(free))


@lru_cache(maxsize=256)
def address(packed: bytes) -> str:
    """The usual text of an address of 4 or 16 bytes."""
    return str(ipaddress.ip_address(packed))


def udp_frame(payload: bytes, source: tuple[bytes, int], destination: tuple[bytes, int]) -> bytes:
    """An Ethernet frame with an IP and a UDP header before `payload`; over IPv4 the UDP checksum is
    0 (not computed).

    Args:
        payload: at most `LARGEST_PAYLOAD` bytes, over IPv6 20 more.
        source, destination: address, of 4 bytes both or of 16, and port.
    """
    ends, length = source[0] + destination[0], _UDP_HEADER.size + len(payload)
    if len(ends) == 32:
        kind, ip_header = 0x86DD, struct.pack(">IHBB", 6 << 28, length, _UDP, _TIME_TO_LIVE) + ends
        parts = (
            ends,
            struct.pack(">II", length, _UDP),
            _UDP_HEADER.pack(source[1], destination[1], length, 0),
            payload,
        )
        checksum = _checksum(b"".join(parts) + bytes(len(payload) % 2)) or 0xFFFF
    else:
        kind, checksum = 0x0800, 0
        fields = (0x45, _IPV4_HEADER.size + length, 0, _DO_NOT_FRAGMENT, _TIME_TO_LIVE, _UDP)
        blank = _IPV4_HEADER.pack(*fields, b"\0\0", source[0], destination[0])
        ip_header = _IPV4_HEADER.pack(
            *fields, _checksum(blank).to_bytes(2), source[0], destination[0]
        )
    udp_header = _UDP_HEADER.pack(source[1], destination[1], length, checksum)
    return _ETHERNET_HEADER.pack(_TO_MAC, _FROM_MAC, kind) + ip_header + udp_header + payload


def _checksum(words: bytes) -> int:
    """The ones' complement of the ones' complement sum of 16-bit words: all of it as one number
    modulo 0xFFFF, which stands for 0.
    """
    return 0xFFFF - (int.from_bytes(words) % 0xFFFF or 0xFFFF)


def _ip_start(frame: bytes, link: int) -> int:
    if link in _RAW:
        return 0
    if link in _LOOPBACK:
        # The family stands in the byte order of the capturing machine; families are small, so the
        # smaller reading is right.
        if (
            min(*struct.unpack_from("<I", frame), *struct.unpack_from(">I", frame))
            not in _IP_FAMILIES
        ):
            raise Refused("other", "loopback without IP")
        return 4
    if link in _PPP_LINKS:
        return _past_ppp(frame, _PPP_LINKS[link])
    if link in (_WIFI, _RADIOTAP):
        return _past_ethertype(frame, *_past_wifi(frame, link))
    if link not in _ETHERTYPE_LINKS:
        raise Refused("other", f"link type {link}")
    at, start = _ETHERTYPE_LINKS[link]
    return _past_ethertype(frame, frame[at] << 8 | frame[at + 1], start)


def _past_ethertype(frame: bytes, ethertype: int, start: int) -> int:
    """Where IP begins behind an EtherType, with whatever tags and labels."""
    while ethertype in _VLAN_TAGS:
        ethertype = frame[start + 2] << 8 | frame[start + 3]
        start += 4
    if ethertype == _PPPOE:
        return _past_ppp(frame, start + 6)
    if ethertype in _MPLS:
        while not frame[start + 2] & 1:  # the bottom of the stack of labels
            start += 4
        if frame[start + 4] >> 4 not in (4, 6):
            raise Refused("other", "MPLS without IP")
        return start + 4
    if ethertype not in _IP_ETHERTYPES:
        what = _ETHERTYPES.get(ethertype, f"EtherType 0x{ethertype:04x}")
        raise Refused("other", what if ethertype >= 0x0600 else "802.3 without EtherType")
    return start


def _past_ppp(frame: bytes, at: int) -> int:
    """Where IP begins behind PPP's header, of which address and control, and the upper byte of the
    protocol, may be left out.
    """
    at += 2 * (frame[at] == 0xFF)
    short = frame[at] & 1
    protocol = frame[at] if short else frame[at] << 8 | frame[at + 1]
    if protocol not in _PPP_IP:
        raise Refused("other", f"PPP protocol 0x{protocol:04x}")
    return at + 2 - short


def _past_wifi(frame: bytes, link: int) -> tuple[int, int]:
    """The EtherType in a data frame of 802.11, and where what it names begins."""
    at, is_padded = _past_radiotap(frame) if link == _RADIOTAP else (0, False)
    control, flags = frame[at], frame[at + 1]
    if control & 0x4C != 0x08:
        raise Refused("other", "802.11 without data")
    if flags & 0x40:
        raise Refused("other", "encrypted 802.11")
    size = 30 if flags & 3 == 3 else 24
    is_whole = not flags & 0x04 and not frame[at + 22] & 0x0F
    if control & 0x80:  # QoS
        is_whole = is_whole and not frame[at + size] & 0x80
        size += 6 if flags & 0x80 else 2
    if not is_whole:
        raise Refused("other", "802.11 in fragments or aggregates")
    start = at + size + (-size % 4 if is_padded else 0)
    snap, ethertype = _SNAP_HEADER.unpack_from(frame, start)
    if snap != _SNAP:
        raise Refused("other", "802.11 without EtherType")
    return ethertype, start + _SNAP_HEADER.size


def _past_radiotap(frame: bytes) -> tuple[int, bool]:
    """The length of a radiotap header, and whether the header behind it is padded to words of 4
    bytes, which its flags say.
    """
    length, present = struct.unpack_from("<HI", frame, 2)
    at, more = 8, present
    while more & 1 << 31:
        (more,) = struct.unpack_from("<I", frame, at)
        at += 4
    at = at + -at % 8 + 8 if present & 1 else at
    return length, bool(present & 2 and frame[at] & 0x20)


def _not_udp(protocol: int) -> Refused:
    return Refused("other", _PROTOCOLS.get(protocol, f"IP protocol {protocol}"))


def _ipv4(frame: bytes, start: int) -> IpPacket:
    first, total, ident, place, _, protocol, _, source, destination = _IPV4_HEADER.unpack_from(
        frame, start
    )
    header, total = (first & 0x0F) * 4, total or len(frame) - start
    if header < _IPV4_HEADER.size or total < header:
        raise Refused("malformed")
    if protocol != _UDP:
        raise _not_udp(protocol)
    body = frame[start + header : start + total]
    fragment = _fragment(ident, (place & 0x1FFF) * 8, total - header, more=bool(place & 0x2000))
    if fragment is not None and len(body) < total - header:
        raise Refused("short")
    return IpPacket(source, destination, protocol, body, start + header, fragment)


def _ipv6(frame: bytes, start: int) -> IpPacket:
    length, protocol, source, destination = _IPV6_HEADER.unpack_from(frame, start)
    body_start = start + _IPV6_HEADER.size
    body = frame[body_start : body_start + length]
    missing = length - len(body)
    fragment = None
    protocol, at = _past_extensions(protocol, body)
    if protocol == _FRAGMENT:
        protocol, place, ident = struct.unpack_from(">BxHI", body, at)
        at += 8
        fragment = _fragment(ident, place & 0xFFF8, len(body) - at + missing, more=bool(place & 1))
    if protocol != _UDP and protocol not in _EXTENSIONS:
        raise _not_udp(protocol)
    if fragment is not None and missing:
        raise Refused("short")
    return IpPacket(source, destination, protocol, body[at:], body_start + at, fragment)


def _past_extensions(protocol: int, body: bytes) -> tuple[int, int]:
    """The protocol after the extension headers, and where it starts in the body."""
    at = 0
    while protocol in _EXTENSIONS:
        protocol, units = struct.unpack_from(">BB", body, at)
        at += (units + 1) * 8
    return protocol, at


def _fragment(ident: int, start: int, size: int, *, more: bool) -> Fragment | None:
    if not more and not start:
        return None
    if not size or (more and size % 8) or start + size > _LARGEST_PACKET:
        raise Refused("malformed")
    return Fragment(ident, start, more)


class _Partial:
    """The fragments of one packet, none overlapping another."""

    __slots__ = ("at", "parts", "protocol", "size", "starts", "total")

    def __init__(self, at: int) -> None:
        self.at = at
        self.parts: dict[int, bytes] = {}
        self.starts: list[int] = []  # the keys of `parts`, sorted
        self.size = 0
        self.total: int | None = None
        self.protocol = _UDP

    def add(self, start: int, body: bytes, *, more: bool) -> bool:
        """Whether the body was taken in: it overlaps nothing and agrees with the others about the
        end.
        """
        stop = start + len(body)
        index = bisect_left(self.starts, start)
        before, after = self.starts[index - 1 : index], self.starts[index : index + 1]
        if any(earlier + len(self.parts[earlier]) > start for earlier in before) or any(
            later < stop for later in after
        ):
            return False
        if more and self.total is not None and stop > self.total:
            return False
        if not more and (after or self.total is not None):
            return False
        if not more:
            self.total = stop
        self.starts.insert(index, start)
        self.parts[start] = body
        self.size += len(body)
        return True


class Reassembly:
    """Puts fragments together, in whatever order they come, in bounded memory.

    A packet whose fragments overlap is given up (RFC 5722), except that a fragment seen twice is
    ignored. The oldest packets are given up where more than `MOST_PACKETS` or `MOST_BYTES` wait,
    and those older than `PATIENCE_NS`.

    Attributes:
        dropped: fragments of packets that were given up.
    """

    MOST_PACKETS = 256
    MOST_BYTES = 4 << 20
    # at 10,000 datagrams/s the 16-bit identification of IPv4 comes round after 6.5 s
    PATIENCE_NS = 5_000_000_000
    _OVERHEAD = (
        160  # bytes of objects around each fragment, so that tiny ones count for what they take
    )

    def __init__(self) -> None:
        self.dropped = 0
        self._partials: OrderedDict[tuple[bytes, bytes, int], _Partial] = OrderedDict()
        self._held = 0

    def add(self, packet: IpPacket, fragment: Fragment, at: int) -> IpPacket | None:
        """The whole packet, if this fragment was the last one missing.

        Args:
            packet: what `ip_packet` returned, with its `fragment`.
            at: capture time in ns.
        """
        while self._partials and next(iter(self._partials.values())).at < at - self.PATIENCE_NS:
            self._drop()
        key = packet.source, packet.destination, fragment.ident
        partial = self._partials.setdefault(key, _Partial(at))
        if partial.parts.get(fragment.start) == packet.body:
            return None
        if not partial.add(fragment.start, packet.body, more=fragment.more):
            self.dropped += 1
            self._drop(key)
            return None
        self._held += len(packet.body) + self._OVERHEAD
        if fragment.start == 0:
            partial.protocol = packet.protocol
        if partial.size == partial.total:
            self._remove(key)
            body = b"".join(partial.parts[start] for start in partial.starts)
            return IpPacket(packet.source, packet.destination, partial.protocol, body)
        while len(self._partials) > self.MOST_PACKETS or self._held > self.MOST_BYTES:
            self._drop()
        return None

    def finish(self) -> None:
        """Gives up all that is still incomplete."""
        while self._partials:
            self._drop()

    def _drop(self, key: tuple[bytes, bytes, int] | None = None) -> None:
        self.dropped += len(self._remove(key or next(iter(self._partials))).parts)

    def _remove(self, key: tuple[bytes, bytes, int]) -> _Partial:
        partial = self._partials.pop(key)
        self._held -= partial.size + self._OVERHEAD * len(partial.parts)
        return partial
