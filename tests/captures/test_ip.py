"""Tests of UDP payloads from captured frames: link layers, IPv4, IPv6 and fragments.

Each test reads a whole capture.
"""

from __future__ import annotations

import io
import random
import struct
import tracemalloc
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import permutations

import pytest

from lidarspec.captures.ip import Reassembly
from lidarspec.captures.pcap import CaptureReader, CaptureStats, Datagram
from tests import made_captures as made

PACKET = made.ipv4(made.udp(b"one"))
PACKET6 = made.ipv6(made.udp(b"one"))
BODY = made.udp(bytes(range(40)))  # 48 bytes: fragments of 16, 8, 16 and 8
CUTS = [(0, 16), (16, 24), (24, 40), (40, 48)]
HOP_BY_HOP, ROUTING, FRAGMENT, DESTINATION_OPTIONS, TCP = 0, 43, 44, 60, 6


def extension(following: int, *, units: int = 0) -> bytes:
    return bytes([following, units]) + bytes(6 + 8 * units)


def fragment4(
    start: int, stop: int, *, more: bool | None = None, ident: int = 7, body: bytes = BODY
) -> bytes:
    more = stop < len(body) if more is None else more
    return made.ipv4(body[start:stop], ident=ident, place=start // 8 | more << 13)


def fragment6(
    start: int,
    stop: int,
    *,
    more: bool | None = None,
    ident: int = 7,
    body: bytes = BODY,
    following: int = 17,
) -> bytes:
    more = stop < len(body) if more is None else more
    return made.ipv6(
        struct.pack(">BBHI", following, 0xAA, start | 6 | more, ident) + body[start:stop],
        following=FRAGMENT,
    )


def read(*packets: bytes, link: int = 101) -> tuple[list[bytes], CaptureStats]:
    return made.payloads(made.pcap(*packets, link=link))


def read_at(records: Sequence[tuple[int, bytes]]) -> tuple[list[bytes], CaptureStats]:
    return made.payloads(
        made.pcap_head(link=101)
        + b"".join(made.record(packet, seconds=seconds) for seconds, packet in records)
    )


LINKS = [
    *((link, packet) for link in (12, 101) for packet in (PACKET, PACKET6)),
    *((228, PACKET), (229, PACKET6)),
    *((1, made.ethernet(PACKET)), (1, made.ethernet(PACKET6, ethertype=0x86DD))),
    (1, made.ethernet(struct.pack(">HH", 5, 0x0800) + PACKET, ethertype=0x8100)),
    (1, made.ethernet(struct.pack(">HHHH", 5, 0x8100, 6, 0x86DD) + PACKET6, ethertype=0x88A8)),
    (
        1,
        made.ethernet(
            struct.pack(">HHHHHH", 5, 0x9100, 6, 0x8100, 7, 0x0800) + PACKET, ethertype=0x8100
        ),
    ),
    (113, struct.pack(">HHH8sH", 0, 1, 6, bytes(range(8)), 0x0800) + PACKET),
    (113, struct.pack(">HHH8sH", 4, 1, 6, bytes(range(8)), 0x86DD) + PACKET6),
    (113, struct.pack(">HHH8sHHH", 0, 1, 6, bytes(range(8)), 0x8100, 5, 0x0800) + PACKET),
    (276, struct.pack(">HHIHBB8s", 0x0800, 0, 2, 1, 0, 6, bytes(range(8))) + PACKET),
    (276, struct.pack(">HHIHBB8s", 0x86DD, 0, 2, 1, 0, 6, bytes(range(8))) + PACKET6),
    *((link, struct.pack(order + "I", 2) + PACKET) for link in (0, 108) for order in "<>"),
    *((0, struct.pack("<I", family) + PACKET6) for family in (10, 24, 28, 30)),
    (1, made.ethernet(made.ipv4(made.udp(b"one"), total=0))),
]


@pytest.mark.parametrize(("link", "frame"), LINKS)
def test_link_layers(link: int, frame: bytes) -> None:
    datagrams, stats = made.read(made.pcap(frame, link=link))
    ends = (
        (made.SOURCE6, made.DESTINATION6) if PACKET6 in frame else (made.SOURCE, made.DESTINATION)
    )
    assert [(datagram.data, datagram.source, datagram.destination) for datagram in datagrams] == [
        (b"one", *ends)
    ]
    assert stats == CaptureStats(packets=1, datagrams=1)


@pytest.mark.parametrize(("link", "frame"), LINKS)
def test_frames_cut_at_every_byte_are_snapped_or_malformed(link: int, frame: bytes) -> None:
    for length in range(len(frame)):
        cut = frame[:length]
        snapped = made.payloads(made.pcap_head(link=link) + made.record(cut, original=len(frame)))
        assert snapped == ([], CaptureStats(packets=1, snapped=1))
        assert made.payloads(made.pcap(cut, link=link)) == (
            [],
            CaptureStats(packets=1, malformed=1),
        )


OTHERS = {
    "ARP": (1, made.ethernet(bytes(28), ethertype=0x0806)),
    "802.3 frames without EtherType": (
        1,
        made.ethernet(b"\xaa\xaa\x03" + PACKET, ethertype=len(PACKET) + 3),
    ),
    "ARP in VLAN": (1, made.ethernet(struct.pack(">HH", 5, 0x0806) + bytes(28), ethertype=0x8100)),
    "EtherType 0x1234": (1, made.ethernet(bytes(28), ethertype=0x1234)),
    "loopback frames without IP": (0, struct.pack("<I", 7) + PACKET),
    "TCP": (101, made.ipv4(bytes(20), protocol=TCP)),
    "TCP in fragments": (101, made.ipv4(bytes(24), protocol=TCP, place=0x2000)),
    "TCP over IPv6": (101, made.ipv6(bytes(20), following=TCP)),
    "TCP after options": (101, made.ipv6(extension(TCP) + bytes(20), following=HOP_BY_HOP)),
    "TCP in fragments of IPv6": (101, fragment6(0, 16, following=TCP)),
    "IP protocol 99": (101, made.ipv4(bytes(20), protocol=99)),
    "PPPoE discovery": (1, made.ethernet(bytes(20), ethertype=0x8863)),
}


@pytest.mark.parametrize("what", OTHERS)
def test_everything_else_is_other_and_named(what: str) -> None:
    link, frame = OTHERS[what]
    stats = read(frame, link=link)[1]
    assert stats.others == {
        what.split(maxsplit=1)[0] if what.startswith(("TCP", "ARP")) else what: 1
    }
    assert read(frame, link=link) == ([], CaptureStats(packets=1, other=1))


UNSUPPORTED = [
    ("PPP", 9, b"\xff\x03\x00\x21" + PACKET),
    ("PPP", 50, b"\xff\x03\x00\x21" + PACKET),
    ("PPPoE", 51, bytes.fromhex("11000001003f0021") + PACKET),
    ("802.11", 105, bytes(32) + PACKET),
    ("802.11 with radiotap", 127, bytes(40) + PACKET),
    ("link type 147", 147, PACKET),
    ("PPPoE", 1, made.ethernet(bytes(8) + PACKET, ethertype=0x8864)),
    ("MPLS", 1, made.ethernet(bytes(4) + PACKET, ethertype=0x8847)),
    ("MPLS", 1, made.ethernet(bytes(4) + PACKET, ethertype=0x8848)),
    ("PPPoE", 1, made.ethernet(struct.pack(">HH", 5, 0x8864) + PACKET, ethertype=0x8100)),
]


@pytest.mark.parametrize(("name", "link", "frame"), UNSUPPORTED)
def test_unsupported_link_layers_are_counted_by_name(name: str, link: int, frame: bytes) -> None:
    assert read(frame, link=link) == ([], CaptureStats(packets=1, unsupported=Counter({name: 1})))


@pytest.mark.parametrize(
    "packet",
    [
        made.ipv4(made.udp(b"one"), options=bytes(range(1, 41))),
        made.ipv4(made.udp(b"one"), options=bytes(4), place=0x4000),
        PACKET + b"padding of the shortest Ethernet frame",
        PACKET6 + b"padding",
        made.ipv4(made.udp(b"one") + b"more than UDP says"),
        made.ipv4(made.udp(b"one"), total=1234),
        made.ipv6(made.udp(b"one"), length=1234),
        made.ipv6(extension(17) + made.udp(b"one"), following=HOP_BY_HOP),
        made.ipv6(
            extension(ROUTING)
            + extension(DESTINATION_OPTIONS, units=3)
            + extension(17, units=1)
            + made.udp(b"one"),
            following=HOP_BY_HOP,
        ),
        made.ipv6(struct.pack(">BBHI", 17, 0, 0, 7) + made.udp(b"one"), following=FRAGMENT),
        made.ipv6(struct.pack(">BBHI", 17, 0, 6, 7) + made.udp(b"one"), following=FRAGMENT),
        made.ipv6(
            struct.pack(">BBHI", 60, 0, 0, 7) + extension(17) + made.udp(b"one"), following=FRAGMENT
        ),
    ],
)
def test_whole_packets(packet: bytes) -> None:
    assert read(packet) == ([b"one"], CaptureStats(packets=1, datagrams=1))


@pytest.mark.parametrize(
    "packet",
    [
        b"\x54" + PACKET[1:],
        b"\x44" + made.ipv4(struct.pack(">HHHH", 9, 0, 0, 0))[1:],
        made.ipv4(b"", total=19),
        made.ipv4(bytes(8), total=12, place=0x2000),
        made.ipv4(made.udp(b"one", length=7)),
        made.ipv4(made.udp(b"one", length=0)),
        made.ipv4(made.udp(b"one", length=12)),
        made.ipv4(made.udp(b"one"), total=30),
        made.ipv6(made.udp(b"one"), length=0),
        made.ipv6(made.udp(b"one", length=12)),
        made.ipv6(bytes([17, 200]) + bytes(6) + made.udp(b"one"), following=HOP_BY_HOP),
        made.ipv4(bytes(12), place=0x2000),
        made.ipv4(b"", place=0x2000),
        made.ipv4(bytes(16), place=0x1FFF),
        made.ipv4(bytes(16), place=0x2000, total=44),
        made.ipv6(struct.pack(">BBHI", 17, 0, 12, 7) + b"", following=FRAGMENT),
        made.ipv6(struct.pack(">BBHI", 17, 0, 1, 7) + bytes(12), following=FRAGMENT),
    ],
    ids=[
        *(
            "version 5",
            "IPv4 header of 16 bytes",
            "IPv4 length below its header",
            "fragment too",
            "UDP length 7",
            "UDP length 0",
            "UDP length too long",
        ),
        *(
            "UDP longer than IPv4",
            "IPv6 length 0",
            "UDP longer than IPv6",
            "extension beyond the packet",
            "fragment not in eights",
        ),
        *(
            "empty fragment",
            "fragment beyond 65535",
            "fragment longer than the frame",
            "empty fragment 6",
            "fragment 6 not in eights",
        ),
    ],
)
def test_malformed_packets(packet: bytes) -> None:
    assert read(packet) == ([], CaptureStats(packets=1, malformed=1))


def test_datagrams_cut_at_the_snap_length() -> None:
    def snapped(packet: bytes, kept: int) -> tuple[list[bytes], CaptureStats]:
        return made.payloads(
            made.pcap_head(link=101) + made.record(packet[:kept], original=len(packet))
        )

    padded = PACKET + bytes(10)
    assert snapped(padded, len(PACKET)) == ([b"one"], CaptureStats(packets=1, datagrams=1))
    assert snapped(padded, len(PACKET) - 1) == ([], CaptureStats(packets=1, snapped=1))
    assert snapped(made.ipv4(bytes(99), protocol=TCP), 60) == ([], CaptureStats(packets=1, other=1))
    assert snapped(b"\x54" + PACKET[1:], 25) == ([], CaptureStats(packets=1, malformed=1))
    assert snapped(fragment4(0, 16), 30) == ([], CaptureStats(packets=1, snapped=1))
    assert snapped(fragment6(0, 16), 60) == ([], CaptureStats(packets=1, snapped=1))


@pytest.mark.parametrize("fragment", [fragment4, fragment6])
def test_fragments_in_any_order(fragment: Callable[..., bytes]) -> None:
    for order in permutations(CUTS):
        assert read(*(fragment(*cut) for cut in order)) == (
            [BODY[8:]],
            CaptureStats(packets=4, datagrams=1, fragments=4),
        )


def test_extension_header_after_the_fragment_header() -> None:
    body = extension(17) + BODY
    packets = (
        fragment6(0, 24, body=body, following=DESTINATION_OPTIONS),
        fragment6(24, 56, body=body, following=17),
    )
    assert read(*packets)[0] == read(*packets[::-1])[0] == [BODY[8:]]


def test_datagram_of_fragments_bears_the_time_of_the_last_to_come() -> None:
    capture = (
        made.pcap_head(link=101)
        + made.record(fragment4(16, 48))
        + made.record(fragment4(0, 16), seconds=made.SECONDS + 2)
    )
    at = (made.SECONDS + 2) * 10**9 + made.FRACTION * 1000
    assert made.read(capture)[0] == [Datagram(BODY[8:], at, made.SOURCE, made.DESTINATION)]


def test_interleaved_fragments_are_reassembled() -> None:
    def from_elsewhere(packet: bytes) -> bytes:
        return packet[:15] + b"\x63" + packet[16:]

    other = made.udp(bytes(40))
    packets = [
        fragment4(0, 24),
        fragment4(0, 24, ident=8, body=other),
        from_elsewhere(fragment4(0, 24)),
        fragment6(0, 24),
    ]
    packets += [
        fragment4(24, 48, ident=8, body=other),
        fragment6(24, 48),
        from_elsewhere(fragment4(24, 48)),
        fragment4(24, 48),
    ]
    assert read(*packets) == (
        [bytes(40), BODY[8:], BODY[8:], BODY[8:]],
        CaptureStats(packets=8, datagrams=4, fragments=8),
    )


OVERLAPS = {  # the last one contradicts the others
    "same start": [fragment4(0, 16), fragment4(0, 24)],
    "same place, other bytes": [fragment4(0, 16), fragment4(0, 16, body=bytes(48))],
    "into the one after": [fragment4(32, 48), fragment4(16, 32), fragment4(0, 24)],
    "into the one before": [fragment4(32, 48), fragment4(0, 24), fragment4(16, 32)],
    "around another": [fragment4(8, 16), fragment4(0, 24)],
    "end before others": [fragment4(24, 32), fragment4(16, 24, more=False)],
    "end after the end": [fragment4(16, 24, more=False), fragment4(40, 48)],
    "more after the end": [fragment4(16, 24, more=False), fragment4(24, 32)],
}


@pytest.mark.parametrize("case", OVERLAPS)
def test_overlapping_or_contradicting_fragments_are_refused(case: str) -> None:
    count = len(OVERLAPS[case])
    assert read(*OVERLAPS[case]) == (
        [],
        CaptureStats(packets=count, fragments=count, incomplete_fragments=count),
    )
    data, stats = read(*OVERLAPS[case], fragment4(0, 24), fragment4(24, 48))
    assert data == [BODY[8:]], "nothing may be left of what was refused"
    assert stats.incomplete_fragments == count


def test_a_fragment_seen_twice_is_ignored() -> None:
    packets = [fragment4(0, 24), fragment4(0, 24), fragment4(24, 48)]
    assert read(*packets) == ([BODY[8:]], CaptureStats(packets=3, datagrams=1, fragments=3))


def test_incomplete_fragments_are_counted_at_the_end() -> None:
    packets = [fragment4(0, 16), fragment4(24, 48), fragment6(0, 16)]
    assert read(*packets) == ([], CaptureStats(packets=3, fragments=3, incomplete_fragments=3))


def test_reassembled_packets_can_be_malformed() -> None:
    long = made.udp(bytes(40), length=49)
    assert read(fragment4(0, 24, body=long), fragment4(24, 48, body=long)) == (
        [],
        CaptureStats(packets=2, fragments=2, malformed=1),
    )


def test_fragment_header_within_a_reassembled_packet_is_malformed() -> None:
    body = extension(FRAGMENT) + struct.pack(">BBHI", 17, 0, 0, 7) + BODY
    packets = [
        fragment6(*cut, body=body, following=DESTINATION_OPTIONS) for cut in ((0, 24), (24, 64))
    ]
    assert read(*packets) == ([], CaptureStats(packets=2, fragments=2, malformed=1))


def test_reassembled_packets_can_be_other_than_udp() -> None:
    body = extension(TCP) + BODY
    packets = [
        fragment6(*cut, body=body, following=DESTINATION_OPTIONS) for cut in ((0, 24), (24, 56))
    ]
    assert read(*packets) == ([], CaptureStats(packets=2, fragments=2, other=1))


def test_a_reused_identification_meets_no_old_fragment() -> None:
    stale, fresh = fragment4(0, 24, body=bytes(48)), [fragment4(0, 24), fragment4(24, 48)]
    assert read_at([(10, stale), *((16, packet) for packet in fresh)])[0] == [BODY[8:]]
    assert read_at([(10, stale), *((12, packet) for packet in fresh)])[0] == []


def test_the_oldest_packet_is_dropped_if_too_many_wait() -> None:
    crowd = [fragment4(0, 24, ident=ident) for ident in range(257)]
    data, stats = read(*crowd, fragment4(24, 48, ident=0), fragment4(24, 48, ident=2))
    assert data == [BODY[8:]]
    assert stats == CaptureStats(packets=259, datagrams=1, fragments=259, incomplete_fragments=257)


@pytest.mark.parametrize("size", [8, 1480, 65_000])
def test_waiting_fragments_take_bounded_memory(size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Reassembly, "MAX_BYTES", Reassembly.MAX_BYTES // 8)
    count = min(4000, (3 << 20) // size)
    places = 65_000 // size // 2 or 1  # every second one, so that nothing touches
    packets = (
        made.ipv4(bytes(size), ident=i // places, place=0x2000 | i % places * size // 4)
        for i in range(count)
    )
    capture = io.BytesIO(made.pcap_head(link=101) + b"".join(map(made.record, packets)))
    reader = CaptureReader(capture)
    tracemalloc.start()
    try:
        assert not list(reader)
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()
    assert reader.stats == CaptureStats(packets=count, fragments=count, incomplete_fragments=count)


@pytest.mark.parametrize("inputs", [1500, pytest.param(20_000, marks=pytest.mark.slow)])
def test_mutations_raise_no_exception(inputs: int) -> None:
    draw = random.Random(14)
    frames = [(link, frame) for link, frame in LINKS] + [
        (101, fragment(*cut)) for fragment in (fragment4, fragment6) for cut in CUTS
    ]
    for _ in range(inputs):
        link = draw.choice([link for link, _ in LINKS])
        chosen = [
            bytearray(frame) for other, frame in draw.choices(frames, k=8) if other == link
        ] or [bytearray(PACKET)]
        for frame in chosen:
            for _ in range(draw.randrange(4)):
                frame[draw.randrange(len(frame))] = draw.choice(
                    [draw.randrange(256), 0, 0xFF, 44, 60]
                )
        datagrams, stats = read(*map(bytes, chosen), link=link)
        assert stats.packets == len(chosen)
        refused = stats.other + stats.snapped + stats.malformed
        assert len(datagrams) + refused <= len(chosen) <= len(datagrams) + refused + stats.fragments
