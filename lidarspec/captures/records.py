"""The records of pcap and pcapng files: from bytes of a file to captured frames.

Hostile input: `Source` reads in bounded steps, so that a length in the file never becomes an allocation, and each turn of
the walkers either advances or ends the reading.

Source: the IETF drafts "PCAP Capture File Format" (draft-ietf-opsawg-pcap) and "PCAP Now Generic Capture File Format"
(draft-ietf-opsawg-pcapng).
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from enum import Enum
from typing import BinaryIO, NamedTuple

from lidarspec.errors import SourceError

LARGEST_PACKET = 1 << 18  # what libpcap and Wireshark allow on the link types read here
NANOSECOND_MAGIC = b"\x4d\x3c\xb2\xa1"

_PCAP = {  # magic: byte order, nanoseconds in a unit of time
    b"\xd4\xc3\xb2\xa1": ("<", 1000),
    b"\xa1\xb2\xc3\xd4": (">", 1000),
    NANOSECOND_MAGIC: ("<", 1),
    b"\xa1\xb2\x3c\x4d": (">", 1),
}
_SECTION = b"\x0a\x0d\x0d\x0a"  # the same in both byte orders
_ORDERS = {b"\x4d\x3c\x2b\x1a": "<", b"\x1a\x2b\x3c\x4d": ">"}
_INTERFACE, _OBSOLETE_PACKET, _SIMPLE_PACKET, ENHANCED_PACKET = 1, 2, 3, 6
_PACKETS = {_OBSOLETE_PACKET, _SIMPLE_PACKET, ENHANCED_PACKET}
_TIME_RESOLUTION, _TIME_OFFSET = 9, 14  # options of an interface

_STEP = 1 << 16
LARGEST_BLOCK = 1 << 20  # a packet with its options; longer blocks are passed over unread
_MOST_INTERFACES = 1024
_SECOND = 1_000_000_000


class Truncated(Exception):
    """The input ended within a record."""


class Damaged(Exception):
    """A record that leaves no way to find the next one, or to understand it."""


class CapturedPacket(NamedTuple):
    """A captured frame.

    Attributes:
        link: link-layer type.
        at: capture time in ns since 1970, which fits an int64; 0 where the record has none.
        data: the bytes that were kept.
        original: how many bytes there were before the snap length cut them.
    """

    link: int
    at: int
    data: bytes
    original: int


class Passed(Enum):
    """A record that gives no packet."""

    NO_PACKET = 0
    MALFORMED = 1


class Source:
    """Bytes of a file or pipe, read in steps: what is held follows what is there, never a length that the file claims.

    Attributes:
        record: offset of the record that was begun last.
    """

    def __init__(self, file: BinaryIO) -> None:
        # A pipe's read1 returns what has arrived; its read would wait for the whole step.
        self._read: Callable[[int], bytes] = getattr(file, "read1", file.read)
        self._data: bytes | memoryview = b""
        self._at = 0
        self._passed = 0  # bytes of the file before `_data`
        self.record = 0

    def magic(self) -> bytes:
        """The next four bytes, which stay there; fewer at the end."""
        self._has(4)
        return bytes(self._data[self._at : self._at + 4])

    def begin_record(self) -> bool:
        """Whether a record begins here, rather than the end of the input."""
        self.record = self._passed + self._at
        return self._has(1)

    def take(self, size: int) -> bytes:
        """The next `size` bytes; the caller sees to it that `size` is bounded.

        Raises:
            Truncated: fewer are left.
        """
        if not self._has(size):
            raise Truncated
        self._at += size
        return bytes(self._data[self._at - size : self._at])

    def skip(self, size: int) -> None:
        """Passes over `size` bytes, however many.

        Raises:
            Truncated: fewer are left.
        """
        while size:
            step = min(size, _STEP)
            self.take(step)
            size -= step

    def _has(self, size: int) -> bool:
        have = len(self._data) - self._at
        if have >= size:
            return True
        pieces = [self._data[self._at :]]
        try:
            while have < size and (piece := self._read(_STEP)):
                pieces.append(piece)
                have += len(piece)
        except OSError as error:
            raise SourceError(f"cannot read the capture: {error}") from error
        self._passed += self._at
        self._data, self._at = b"".join(pieces), 0
        return have >= size


def is_capture(head: bytes) -> bool:
    """Whether the first four bytes of a file are those of a pcap or pcapng capture."""
    return head[:4] in _PCAP or head[:4] == _SECTION


class PcapRecords:
    """The records of a pcap file.

    Attributes:
        order: the byte order of the file, as in `struct`.
        unit: nanoseconds in the unit of the second half of its times.
        link: its link-layer type.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self.order, self.unit = _PCAP[source.take(4)]
        *_, link = struct.unpack(self.order + "HHiIII", source.take(20))
        self.link = link & 0xFFFF  # the upper half tells the length of the frame check sequence
        self._head = struct.Struct(self.order + "IIII")

    def read(self) -> CapturedPacket:
        """The packet of the record that begins here.

        Raises:
            Truncated, Damaged: nothing can be read from `source.record` on.
        """
        seconds, fraction, captured, original = self._head.unpack(self._source.take(self._head.size))
        if captured > LARGEST_PACKET:
            raise Damaged
        return CapturedPacket(self.link, seconds * _SECOND + fraction * self.unit, self._source.take(captured), original)


class Interface(NamedTuple):
    """Where packets of a pcapng file were captured."""

    link: int
    snap_length: int  # 0: no limit
    ticks: int  # in a second
    offset: int  # ns


class PcapngBlocks:
    """The blocks of a pcapng file.

    Attributes:
        sections: how many have begun.
        order: the byte order of the section, as in `struct`.
        interfaces: those of the section so far.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self.sections = 0
        self.order = ""
        self.interfaces: list[Interface] = []

    def read(self) -> CapturedPacket | Passed:
        """The packet of the block that begins here.

        Raises:
            Truncated, Damaged: nothing can be read from `source.record` on.
        """
        head = self._source.take(12)
        if head[:4] == _SECTION:
            if head[8:] not in _ORDERS:
                raise Damaged
            self.order, self.interfaces, self.sections = _ORDERS[head[8:]], [], self.sections + 1
        kind, length = struct.unpack_from(self.order + "II", head)
        body = _block_body(self._source, head, length)
        if kind == _INTERFACE:
            # Packets name interfaces by number: with one lost, all that follows would be misread.
            if body is None or len(body) < 8 or len(self.interfaces) == _MOST_INTERFACES:
                raise Damaged
            self.interfaces.append(_interface(self.order, body))
        elif kind in _PACKETS:
            packet = None if body is None else _block_packet(self.order, kind, body, self.interfaces)
            return packet or Passed.MALFORMED
        elif body is None and length <= LARGEST_BLOCK:
            return Passed.MALFORMED
        return Passed.NO_PACKET


def records(source: Source) -> PcapRecords | PcapngBlocks:
    """The records of a capture whose magic `is_capture` knows.

    Raises:
        Truncated: the head of the file is cut.
    """
    return PcapngBlocks(source) if source.magic() == _SECTION else PcapRecords(source)


def _block_body(source: Source, head: bytes, length: int) -> bytes | None:
    """What stands between the two lengths of a block, None where they differ or the block is too long to be held."""
    if length < 12 or length % 4:
        raise Damaged
    if length > LARGEST_BLOCK:
        source.skip(length - 12)
        return None
    block = head[8:] + source.take(length - 12)
    return block[:-4] if block[-4:] == head[4:8] else None


def _interface(order: str, body: bytes) -> Interface:
    link, snap_length = struct.unpack_from(order + "HxxI", body)
    ticks, offset, at = 1_000_000, 0, 8
    while at + 4 <= len(body):
        code, size = struct.unpack_from(order + "HH", body, at)
        value = body[at + 4 : at + 4 + size]
        if len(value) < size:
            break
        if code == _TIME_RESOLUTION and size == 1:
            ticks = 2 ** (value[0] & 0x7F) if value[0] & 0x80 else 10 ** value[0]
        elif code == _TIME_OFFSET and size == 8:
            offset = struct.unpack(order + "q", value)[0] * _SECOND
        at += 4 + size + -size % 4
    return Interface(link, snap_length, ticks, offset)


def _block_packet(order: str, kind: int, body: bytes, interfaces: list[Interface]) -> CapturedPacket | None:
    """The packet of a block, None where the block contradicts itself or names an unknown interface."""
    if kind == _SIMPLE_PACKET:
        if len(body) < 4 or not interfaces:
            return None
        (original,) = struct.unpack_from(order + "I", body)
        captured = min(original, interfaces[0].snap_length or original)
        if captured > len(body) - 4:
            return None
        return CapturedPacket(interfaces[0].link, 0, body[4 : 4 + captured], original)
    if len(body) < 20:
        return None
    number, high, low, captured, original = struct.unpack_from(order + ("IIIII" if kind == ENHANCED_PACKET else "HxxIIII"), body)
    if number >= len(interfaces) or captured > len(body) - 20:
        return None
    interface = interfaces[number]
    at = (high << 32 | low) * _SECOND // interface.ticks + interface.offset
    if not -(1 << 63) <= at < 1 << 63:
        return None
    return CapturedPacket(interface.link, at, body[20 : 20 + captured], original)
