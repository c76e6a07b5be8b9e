"""Read and write the records of pcap and pcapng files.

`PcapRecords` and `PcapngBlocks` read one record at a time. They also return the `RecordLayout` of a
record, with which `bulk` finds similar records. `seek_time` searches a file by capture time.

Captures are untrusted: each read has a limited size, and each iteration of a loop advances or ends
the reading. After a damaged record, `skip_damage` continues at the next bytes that look like a
record. A pcap record must end at another plausible record, or at the end of the file. A pcapng
block must be a section header, or repeat its length at its end.

Source: the IETF drafts "PCAP Capture File Format" (draft-ietf-opsawg-pcap) and "PCAP Now Generic
Capture File Format" (draft-ietf-opsawg-pcapng).
"""

from __future__ import annotations

import copy
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarspec.captures.source import BufferedInput, TruncatedError
from lidarspec.errors import UsageError

MAX_PACKET_BYTES = 1 << 18  # the limit of libpcap and Wireshark for the supported link types
NANOSECOND_MAGIC = b"\x4d\x3c\xb2\xa1"

_PCAP = {  # magic: byte order, nanoseconds per unit of the fraction field
    b"\xd4\xc3\xb2\xa1": ("<", 1000),
    b"\xa1\xb2\xc3\xd4": (">", 1000),
    NANOSECOND_MAGIC: ("<", 1),
    b"\xa1\xb2\x3c\x4d": (">", 1),
}
#: The header of a pcap file to write, little-endian.
_HEAD = struct.Struct("<4sHHiIII")
#: The header of a record of a pcap file to write.
_RECORD = struct.Struct("<IIII")
_SECTION = b"\x0a\x0d\x0d\x0a"  # the same in both byte orders
_SECTION_KIND = int.from_bytes(_SECTION)
_ORDERS = {b"\x4d\x3c\x2b\x1a": "<", b"\x1a\x2b\x3c\x4d": ">"}
_INTERFACE = 1
_OBSOLETE_PACKET = 2
_SIMPLE_PACKET = 3
ENHANCED_PACKET = 6
_PACKETS = {_OBSOLETE_PACKET, _SIMPLE_PACKET, ENHANCED_PACKET}
_LAST_KIND = 10  # the largest block type of the draft, apart from the section header
#: Code of the option of an interface block with the resolution of times.
_TIME_RESOLUTION = 9
#: Code of the option of an interface block with the offset of times.
_TIME_OFFSET = 14

MAX_BLOCK_BYTES = 1 << 20  # a packet with its options; longer blocks are skipped
#: The number of offsets that are checked in one step of the search for the next record.
_STEP_BYTES = 1 << 16
#: The number of bytes that the search has to read after an offset, to check whether a record begins
#: there: a packet, its options and the header of the next packet.
_REACH_BYTES = MAX_PACKET_BYTES + (1 << 12)
#: The position that `seek_time` finds is at most this number of bytes before the packet.
NEAR_BYTES = 1 << 21
#: The maximum plausible difference between the times of two consecutive packets: a day.
_MAX_RECORD_STEP_S = 86_400
#: The maximum plausible difference between the times of any two packets of a file: a year.
_MAX_FILE_SPAN_S = 31_536_000
_MAX_INTERFACES = 1024
_SECOND_NS = 1_000_000_000
#: The latest time that `TimeEncoding.read_ns` converts. Records with later times are read singly,
#: so that no int64 overflows.
_MAX_TIME_S = 4_000_000_000


class DamagedRecordError(Exception):
    """A record is invalid, and the start of the next record is unknown."""


class CapturedPacket(NamedTuple):
    """A captured frame.

    Attributes:
        at: ns since 1970, in the range of int64; 0 if the record has no time.
        original: length of the packet on the network, before truncation at the snap length.
    """

    link: int
    at: int
    data: bytes
    original: int


class NoPacketReason(Enum):
    """The reason why a record contains no packet."""

    NO_PACKET = 0
    MALFORMED = 1


def is_capture(head: bytes) -> bool:
    """Return whether a file that begins with these bytes is a pcap or pcapng capture."""
    return head[:4] in _PCAP or head[:4] == _SECTION


@dataclass(frozen=True)
class TimeEncoding:
    """The encoding of a capture time in two words of a record.

    Attributes:
        word: NumPy type of the words, with the byte order.
        high: index in the record, in words, of the seconds or of the upper half of a 64-bit number.
        low: index in the record, in words, of the fraction or of the lower half.
        ticks: number of units in a second. The fraction, or the 64-bit number, counts these units.
        is_split: whether the words are seconds and a fraction, instead of a 64-bit number.
        offset: number of ns to add to each time.
    """

    word: str
    high: int
    low: int
    ticks: int
    is_split: bool
    offset: int = 0

    def fits_int64(self) -> bool:
        """Return whether times up to `_MAX_TIME_S` can be calculated with 64 bits."""
        return self.ticks <= 9 * _SECOND_NS and abs(self.offset) < 1 << 62

    def read_ns(
        self, heads: NDArray[np.uint8]
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_] | None]:
        """Return the times of n records, and a mask of the valid times.

        Args:
            heads: the first bytes of each record, (n, size), uint8.

        Returns:
            Times in ns since 1970, (n,); and a mask of the valid times, (n,), or None if all are
            valid.
        """
        words = heads.view(self.word)
        high = words[:, self.high].astype(np.int64)
        low = words[:, self.low]
        if self.is_split:
            high *= _SECOND_NS
            high += low * np.int64(_SECOND_NS // self.ticks)
            return high, None
        seconds, fraction = np.divmod(high << 32 | low, self.ticks)
        right = (high < 1 << 31) & (seconds < _MAX_TIME_S)
        return seconds * _SECOND_NS + fraction * _SECOND_NS // self.ticks + self.offset, right


class RecordLayout(NamedTuple):
    """The layout of a record that contains a packet.

    Attributes:
        head: number of bytes before the packet.
        time_offsets: offsets of the bytes of the capture time.
        original_offsets: offsets of the bytes of the packet's length on the network.
        trailer: NumPy type of the length that is repeated at the end; None if it is not repeated.
    """

    head: int
    time_offsets: tuple[int, ...]
    original_offsets: tuple[int, ...]
    times: TimeEncoding
    trailer: str | None


class PcapRecords:
    """The records of a pcap file.

    Attributes:
        sections: always 0; only pcapng files have sections.
    """

    sections = 0

    def __init__(self, source: BufferedInput) -> None:
        self._source = source
        self.order, self._unit = _PCAP[source.take(4)]
        *_, self._snap_length, link = struct.unpack(self.order + "HHiIII", source.take(20))
        self.link = link & 0xFFFF  # the upper half is the length of the frame check sequence
        self._head = struct.Struct(self.order + "IIII")
        self._lengths = struct.Struct(self.order + "II")
        self._began: int | None = None

    def reopen(self, source: BufferedInput) -> PcapRecords:
        """Return a reader of the same format for another source of the same file."""
        other = copy.copy(self)
        other._source = source
        return other

    def find_length(self, data: memoryview | bytes, offset: int) -> int:
        """Return the length of the record at an offset; 0 if the length is implausible.

        Args:
            data: a buffer with at least 16 bytes after the offset.
        """
        captured, original = self._lengths.unpack_from(data, offset + 8)
        return self._head.size + captured if self._is_plausible(captured, original) else 0

    def length_field(self, length: int) -> tuple[int, str, int]:
        """Return (offset, NumPy type, value) of the two length fields, read as one number.

        Args:
            length: the length of a record whose packet is not truncated, so that both fields have
                the same value.
        """
        captured: int = length - self._head.size
        return 8, f"{self.order}u8", captured << 32 | captured

    def find_layout(self, record: bytes) -> RecordLayout:
        """Return the layout of a record."""
        times = TimeEncoding(f"{self.order}u4", 0, 1, _SECOND_NS // self._unit, True)
        return RecordLayout(self._head.size, tuple(range(8)), tuple(range(12, 16)), times, None)

    def read(self) -> CapturedPacket:
        """Read the next record and return its packet.

        Raises:
            TruncatedError: if the input ends within the record.
            DamagedRecordError: if the record is invalid.
        """
        head = self._source.peek(self._head.size)
        if len(head) < self._head.size:
            raise TruncatedError
        seconds, fraction, captured, original = self._head.unpack(head)
        # The missing parts of a sparse or damaged file are read as zeros.
        if captured > MAX_PACKET_BYTES or not any(head):
            raise DamagedRecordError
        if not self._is_plausible(captured, original) and self._has_wrong_length(
            captured, original
        ):
            raise DamagedRecordError
        self._began = seconds if self._began is None else self._began
        self._source.skip(self._head.size)
        return CapturedPacket(
            self.link,
            seconds * _SECOND_NS + fraction * self._unit,
            self._source.take(captured),
            original,
        )

    def find_next_record(self, data: memoryview, stop: int, *, is_end: bool) -> int | None:
        """Return the first offset below `stop` at which a record may begin, or None.

        Args:
            is_end: whether the input ends with `data`.
        """
        count = len(data) - self._head.size + 1
        if count <= 0:
            return None
        seconds, fractions, captured, original = (
            np.ndarray((count,), f"{self.order}u4", data, at, (1,)) for at in (0, 4, 8, 12)
        )
        likely = (
            (captured[:stop] <= original[:stop])
            & (original[:stop] <= MAX_PACKET_BYTES)
            & (captured[:stop] > 0)
        )
        offsets = np.flatnonzero(likely & (fractions[:stop] < _SECOND_NS // self._unit))
        if self._began is not None:
            offsets = offsets[
                abs(seconds[offsets].astype(np.int64) - self._began) <= _MAX_FILE_SPAN_S
            ]
        behind = offsets + self._head.size + captured[offsets]
        right = (behind == len(data)) & (captured[offsets] == original[offsets]) & is_end
        followed = behind < count
        before = offsets[followed]
        after = behind[followed]
        right[followed] = (
            (captured[after] <= original[after])
            & (original[after] <= MAX_PACKET_BYTES)
            & (captured[after] > 0)
        )
        right[followed] &= (
            abs(seconds[after].astype(np.int64) - seconds[before]) <= _MAX_RECORD_STEP_S
        )
        if right.any():
            return int(offsets[right.argmax()])
        return None

    def _is_plausible(self, captured: int, original: int) -> bool:
        """Return whether a packet is whole, or truncated at the snap length."""
        return 0 < captured <= MAX_PACKET_BYTES and captured in (original, self._snap_length)

    def _has_wrong_length(self, captured: int, original: int) -> bool:
        """Return whether the lengths in the header of a record are wrong.

        They are wrong if no record begins at the end of the packet, but one begins within it.
        """
        size = self._head.size + captured
        within = max(captured, min(original, MAX_PACKET_BYTES) + 1)
        data = self._source.peek(self._head.size + within + _REACH_BYTES)
        is_end = len(data) < self._head.size + within + _REACH_BYTES
        if len(data) == size or self.find_next_record(data[size:], 1, is_end=is_end) is not None:
            return False
        return self.find_next_record(data[self._head.size :], within, is_end=is_end) is not None


class Interface(NamedTuple):
    """A network interface of a pcapng file."""

    link: int
    snap_length: int  # 0: no limit
    ticks: int  # per second
    offset: int  # ns


class PcapngBlocks:
    """The blocks of a pcapng file."""

    def __init__(self, source: BufferedInput) -> None:
        self._source = source
        self.sections = 0
        self.order = "<"
        self._interfaces: list[Interface] = []
        self._knows_all = True  # whether no interface of the section was lost by damage

    def reopen(self, source: BufferedInput) -> PcapngBlocks:
        """Return a reader with the same interfaces for another source of the same file."""
        other = copy.copy(self)
        other._source = source
        other._interfaces = list(self._interfaces)
        return other

    def find_length(self, data: memoryview | bytes, offset: int) -> int:
        """Return the length of the block at an offset; 0 if `read` must read the block."""
        kind: int
        length: int
        kind, length = struct.unpack_from(self.order + "II", data, offset)
        if kind == _SECTION_KIND or length > MAX_BLOCK_BYTES or not _is_possible_length(length):
            return 0
        return length

    def length_field(self, length: int) -> tuple[int, str, int]:
        """Return (offset, NumPy type, value) of the length field in a block of this length."""
        return 4, f"{self.order}u4", length

    def find_layout(self, record: bytes) -> RecordLayout | None:
        """Return the layout of a block; None if its packet must be read with `read`."""
        kind, _, number = struct.unpack_from(self.order + "III", record)
        if kind != ENHANCED_PACKET:
            return None
        interface = self._interfaces[number]
        word = f"{self.order}u4"
        times = TimeEncoding(word, 3, 4, interface.ticks, False, interface.offset)
        return RecordLayout(28, tuple(range(12, 20)), tuple(range(24, 28)), times, word)

    def read(self) -> CapturedPacket | NoPacketReason:
        """Read the next block and return its packet.

        Raises:
            TruncatedError, DamagedRecordError: if the next block cannot be read.
        """
        head = bytes(self._source.peek(12))
        if len(head) < 12:
            raise TruncatedError
        if head[:4] == _SECTION:
            if head[8:] not in _ORDERS:
                raise DamagedRecordError
            self.order = _ORDERS[head[8:]]
            self._interfaces = []
            self._knows_all = True
            self.sections = self.sections + 1
        kind, length = struct.unpack_from(self.order + "II", head)
        if self._has_wrong_length(kind, length):
            self._knows_all = self._knows_all and kind != _INTERFACE
            raise DamagedRecordError
        if length > MAX_BLOCK_BYTES:
            self._source.skip(length)
            return NoPacketReason.NO_PACKET
        body = self._source.take(length)[8:-4]
        if kind == _INTERFACE:
            if len(body) < 8 or len(self._interfaces) == _MAX_INTERFACES:
                self._knows_all = False
                raise DamagedRecordError
            self._interfaces.append(_parse_interface(self.order, body))
        if kind in _PACKETS:
            return (
                _parse_packet_block(self.order, kind, body, self._interfaces)
                or NoPacketReason.MALFORMED
            )
        return NoPacketReason.NO_PACKET

    def find_next_record(self, data: memoryview, stop: int, *, is_end: bool) -> int | None:
        """Return the first offset below `stop` at which a block may begin, or None."""
        sections = (match.start() for match in re.finditer(re.escape(_SECTION), data[: stop + 3]))
        section = next((at for at in sections if bytes(data[at + 8 : at + 12]) in _ORDERS), None)
        count = len(data) - 11
        # without all interfaces, the packets of the section cannot be read
        if not self._knows_all or count <= 0:
            return section
        words = np.ndarray((count + 8,), f"{self.order}u4", data, 0, (1,))
        kinds = words[:-8][:stop]
        lengths = words[4:-4][:stop]
        offsets = np.flatnonzero(
            (kinds > 0) & (kinds <= _LAST_KIND) & (lengths >= 12) & (lengths <= _REACH_BYTES)
        )
        ends = offsets + lengths[offsets]
        offsets = offsets[ends <= len(data)]
        ends = ends[ends <= len(data)]
        right = offsets[words[ends - 4] == lengths[offsets]].tolist()
        return min([*right[:1], *([section] if section is not None else [])], default=None)

    def _has_wrong_length(self, kind: int, length: int) -> bool:
        """Return whether a length is impossible, or contradicts the bytes of the block."""
        if not _is_possible_length(length) or (
            length > MAX_BLOCK_BYTES and kind in _PACKETS | {_INTERFACE}
        ):
            return True
        size = _REACH_BYTES if length > MAX_BLOCK_BYTES else length
        data = self._source.peek(size)
        if len(data) == length:
            return data[-4:] != data[4:8]
        return self.find_next_record(data[4:], size, is_end=True) is not None


#: The reader of the records of either format.
Form = PcapRecords | PcapngBlocks


def make_record_reader(source: BufferedInput) -> Form:
    """Return the reader for a file that `is_capture` accepts.

    Raises:
        TruncatedError: if the file header is incomplete.
    """
    if source.peek(4) == _SECTION:
        return PcapngBlocks(source)
    return PcapRecords(source)


def skip_damage(source: BufferedInput, form: Form) -> bool:
    """Advance to the next readable record after a damaged record.

    Returns:
        False if the input ends without another record.
    """
    source.skip(len(source.peek(1)))
    while data := source.peek(_STEP_BYTES + _REACH_BYTES):
        offset = form.find_next_record(
            data, _STEP_BYTES, is_end=len(data) < _STEP_BYTES + _REACH_BYTES
        )
        source.skip(min(_STEP_BYTES, len(data)) if offset is None else offset)
        if offset is not None:
            return True
    return False


def seek_time(source: BufferedInput, form: Form, at: int) -> bool:
    """Skip packets that were captured before a time.

    The packets must be in the order of their times. The search is not exact: up to about
    `NEAR_BYTES` of earlier packets are not skipped. Skipping ends at the next section of a pcapng
    file.

    Args:
        at: the time, ns since 1970.

    Returns:
        Whether packets were skipped; always False for a pipe or a compressed file.
    """
    # All sections are read with the interfaces of the current one. Another section may encode
    # times differently, so its packets are not used to decide what to skip.
    here = low = source.offset
    high = source.size
    if high is None:
        return False
    first = _find_timed_packet(source.open_at(here), form, high)
    while first is not None and high - low > NEAR_BYTES:
        middle = (low + high) // 2
        packet = _find_timed_packet(source.open_at(middle), form, high)
        if (
            packet is None
            or packet[0] >= at
            or abs(packet[0] - first[0]) > _MAX_FILE_SPAN_S * _SECOND_NS
        ):
            high = middle
        else:
            low = packet[1]
    source.seek(low)
    return low > here


def _find_timed_packet(source: BufferedInput, form: Form, stop: int) -> tuple[int, int] | None:
    """Return (time, offset) of the next timed packet that begins before `stop`, or None."""
    section = form.sections
    form = form.reopen(source)
    while skip_damage(source, form) and source.begin_record() and source.record < stop:
        try:
            packet = form.read()
        except DamagedRecordError:
            continue
        except TruncatedError:
            break
        if form.sections != section:
            break
        if isinstance(packet, CapturedPacket) and packet.at:
            return packet.at, source.record
    return None


def _is_possible_length(length: int) -> bool:
    """Return whether a length is a multiple of 4, and includes header and trailer."""
    return length >= 12 and length % 4 == 0


def _parse_interface(order: str, body: bytes) -> Interface:
    link, snap_length = struct.unpack_from(order + "HxxI", body)
    ticks = 1_000_000
    offset = 0
    at = 8
    while at + 4 <= len(body):
        code, size = struct.unpack_from(order + "HH", body, at)
        value = body[at + 4 : at + 4 + size]
        if len(value) < size:
            break
        if code == _TIME_RESOLUTION and size == 1:
            if value[0] & 0x80:
                ticks = 2 ** (value[0] & 0x7F)
            else:
                ticks = 10 ** value[0]
        elif code == _TIME_OFFSET and size == 8:
            offset = struct.unpack(order + "q", value)[0] * _SECOND_NS
        at += 4 + size + -size % 4
    return Interface(link, snap_length, ticks, offset)


def _parse_packet_block(
    order: str, kind: int, body: bytes, interfaces: list[Interface]
) -> CapturedPacket | None:
    """Return the packet of a packet block; None if the block is invalid."""
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
    number, high, low, captured, original = struct.unpack_from(
        order + ("IIIII" if kind == ENHANCED_PACKET else "HxxIIII"), body
    )
    if number >= len(interfaces) or captured > len(body) - 20:
        return None
    interface = interfaces[number]
    at = (high << 32 | low) * _SECOND_NS // interface.ticks + interface.offset
    if not -(1 << 63) <= at < 1 << 63:
        return None
    return CapturedPacket(interface.link, at, body[20 : 20 + captured], original)


def make_capture_head(link: int) -> bytes:
    """Make the header of a little-endian pcap file with nanoseconds.

    Args:
        link: the link type: `ip.ETHERNET` for datagrams, USER0 for a byte stream.
    """
    return _HEAD.pack(NANOSECOND_MAGIC, 2, 4, 0, 0, MAX_PACKET_BYTES, link)


def make_packet_record(data: bytes, at: int) -> bytes:
    """Make the pcap record that contains a packet.

    Args:
        at: capture time, ns since 1970.

    Raises:
        UsageError: if the packet is too long, or the time is out of range.
    """
    seconds, nanoseconds = divmod(at, _SECOND_NS)
    if not 0 <= seconds < 1 << 32:
        raise UsageError(
            f"capture time {at} ns is out of range: pcap supports the years 1970 to 2106"
        )
    _refuse_size(data)
    return _RECORD.pack(seconds, nanoseconds, len(data), len(data)) + data


def _refuse_size(data: bytes) -> None:
    if len(data) > MAX_PACKET_BYTES:
        raise UsageError(
            f"a packet has {len(data)} bytes, but a record can contain at most {MAX_PACKET_BYTES}"
        )


def record_size(data: bytes | bytearray, offset: int) -> int:
    """Return the length of the record, or of the file header, at an offset."""
    if offset == 0 and is_capture(bytes(data[:4])):
        return _HEAD.size
    return _RECORD.size + int.from_bytes(data[offset + 8 : offset + 12], "little")


class CaptureFormat(NamedTuple):
    """Functions that write captures of one format.

    Attributes:
        head: returns the file header for a link type.
        record: returns the record for a packet and its time in ns since 1970.
        size: returns the length of the record, or of the file header, that begins at an offset. Its
            arguments are a piece of the file, and the offset in this piece.
    """

    head: Callable[[int], bytes]
    record: Callable[[bytes, int], bytes]
    size: Callable[[bytes | bytearray, int], int]


def _make_pcapng_head(link: int) -> bytes:
    """Return a section header and an interface with times in ns, little-endian."""
    section = _make_block(_SECTION_KIND, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1))
    return section + _make_block(
        _INTERFACE,
        struct.pack("<HHIHHB3xHH", link, 0, MAX_PACKET_BYTES, _TIME_RESOLUTION, 1, 9, 0, 0),
    )


def _make_pcapng_record(data: bytes, at: int) -> bytes:
    if not 0 <= at < 1 << 63:
        raise UsageError(f"capture time {at} ns is before 1970")
    _refuse_size(data)
    head = struct.pack("<IIIII", 0, at >> 32, at & 0xFFFFFFFF, len(data), len(data))
    return _make_block(ENHANCED_PACKET, head + data + bytes(-len(data) % 4))


def _make_block(kind: int, body: bytes) -> bytes:
    size = struct.pack("<I", len(body) + 12)
    return struct.pack("<I", kind) + size + body + size


#: The functions that write captures of a format, by the suffix of the file.
WRITINGS = {
    ".pcap": CaptureFormat(make_capture_head, make_packet_record, record_size),
    ".pcapng": CaptureFormat(
        _make_pcapng_head,
        _make_pcapng_record,
        lambda data, offset: int.from_bytes(data[offset + 4 : offset + 8], "little"),
    ),
}
