"""Make captures for the tests with `struct`: frames, pcap files and pcapng blocks.

The module also finds the real captures.
"""

from __future__ import annotations

import io
import ipaddress
import os
import struct
from pathlib import Path

from lidarspec.captures.pcap import CaptureReader, CaptureStats, Datagram

CAPTURES = Path(
    os.environ.get("LIDARSPEC_CAPTURES", Path(__file__).parents[2] / "shared" / "captures")
)

SOURCE, DESTINATION = ("192.168.1.201", 2368), ("192.168.1.10", 6699)
SOURCE6, DESTINATION6 = ("fe80::1", 2368), ("ff02::1:2", 6699)
SECONDS, FRACTION = 0x65432101, 123_456
ENHANCED, SIMPLE, OBSOLETE, INTERFACE = 6, 3, 2, 1


def udp(data: bytes, *, length: int | None = None) -> bytes:
    return (
        struct.pack(
            ">HHHH", SOURCE[1], DESTINATION[1], 8 + len(data) if length is None else length, 0x1234
        )
        + data
    )


def ipv4(
    body: bytes,
    *,
    protocol: int = 17,
    options: bytes = b"",
    total: int | None = None,
    ident: int = 7,
    place: int = 0,
) -> bytes:
    header = 20 + len(options)
    first, whole = 0x40 | header // 4, header + len(body) if total is None else total
    ends = ipaddress.ip_address(SOURCE[0]).packed + ipaddress.ip_address(DESTINATION[0]).packed
    return (
        struct.pack(">BBHHHBBH", first, 0, whole, ident, place, 64, protocol, 0xBEEF)
        + ends
        + options
        + body
    )


def ipv6(body: bytes, *, following: int = 17, length: int | None = None) -> bytes:
    ends = ipaddress.ip_address(SOURCE6[0]).packed + ipaddress.ip_address(DESTINATION6[0]).packed
    return (
        struct.pack(">IHBB", 0x6000_0000, len(body) if length is None else length, following, 64)
        + ends
        + body
    )


def ethernet(packet: bytes, *, ethertype: int = 0x0800) -> bytes:
    return bytes(range(12)) + struct.pack(">H", ethertype) + packet


def frame(data: bytes) -> bytes:
    return ethernet(ipv4(udp(data)))


def pcap_head(
    order: str = "<", *, magic: int = 0xA1B2C3D4, link: int = 1, snap_length: int = 65535
) -> bytes:
    return struct.pack(order + "IHHiIII", magic, 2, 4, 0, 0, snap_length, link)


def record(
    data: bytes, order: str = "<", *, original: int | None = None, seconds: int = SECONDS
) -> bytes:
    return (
        struct.pack(
            order + "IIII",
            seconds,
            FRACTION,
            len(data),
            len(data) if original is None else original,
        )
        + data
    )


def pcap(*frames: bytes, link: int = 1) -> bytes:
    return pcap_head(link=link) + b"".join(map(record, frames))


def block(
    kind: int,
    body: bytes,
    order: str = "<",
    *,
    length: int | None = None,
    trailer: int | None = None,
) -> bytes:
    length = 12 + len(body) if length is None else length
    return (
        struct.pack(order + "II", kind, length)
        + body
        + struct.pack(order + "I", length if trailer is None else trailer)
    )


def section(order: str = "<") -> bytes:
    return block(0x0A0D0D0A, struct.pack(order + "IHHq", 0x1A2B3C4D, 1, 0, -1), order)


def option(code: int, value: bytes, order: str = "<") -> bytes:
    return struct.pack(order + "HH", code, len(value)) + value + bytes(-len(value) % 4)


def interface(
    order: str = "<", *, link: int = 1, snap_length: int = 0, options: bytes = b""
) -> bytes:
    return block(INTERFACE, struct.pack(order + "HHI", link, 0, snap_length) + options, order)


def packet(
    data: bytes,
    order: str = "<",
    *,
    kind: int = ENHANCED,
    number: int = 0,
    ticks: int = 0,
    captured: int | None = None,
) -> bytes:
    """Return a packet block of any of the three kinds."""
    times = struct.pack(order + "II", ticks >> 32, ticks & 0xFFFFFFFF)
    lengths = struct.pack(order + "II", len(data) if captured is None else captured, len(data))
    heads = {
        ENHANCED: struct.pack(order + "I", number) + times + lengths,
        OBSOLETE: struct.pack(order + "HH", number, 0xFFFF) + times + lengths,
        SIMPLE: lengths[4:],
    }
    return block(kind, heads[kind] + data + bytes(-len(data) % 4), order)


def read(capture: bytes) -> tuple[list[Datagram], CaptureStats]:
    reader = CaptureReader(io.BytesIO(capture))
    return list(reader), reader.stats


def payloads(capture: bytes) -> tuple[list[bytes], CaptureStats]:
    datagrams, stats = read(capture)
    return [datagram.data for datagram in datagrams], stats
