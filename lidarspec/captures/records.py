"""The records of pcap and pcapng files: all that is known of the two formats, for one record and for many alike.

Hostile input: `Source` reads in bounded steps, so that a length in the file never becomes an allocation, and each turn of
the walkers either advances or ends the reading. Damaged input: a doubtful length is believed unless other records begin within
what it claims, and behind a record that cannot be read `resume` goes to the next place where records follow each other.

`Source` reads into buffers that can be lent out: one is not written to again while an
array that was `lent`, or anything made from it without a copy, is alive. So whoever needs the bytes for longer just keeps them.

Source: the IETF drafts "PCAP Capture File Format" (draft-ietf-opsawg-pcap) and "PCAP Now Generic Capture File Format"
(draft-ietf-opsawg-pcapng).
"""

from __future__ import annotations

import copy
import functools
import io
import os
import re
import stat
import struct
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import SourceError, UsageError

LARGEST_PACKET = 1 << 18  # what libpcap and Wireshark allow on the link types read here
NANOSECOND_MAGIC = b"\x4d\x3c\xb2\xa1"

_PCAP = {  # magic: byte order, nanoseconds in a unit of time
    b"\xd4\xc3\xb2\xa1": ("<", 1000),
    b"\xa1\xb2\xc3\xd4": (">", 1000),
    NANOSECOND_MAGIC: ("<", 1),
    b"\xa1\xb2\x3c\x4d": (">", 1),
}
#: the head of a file that is written, little-endian, and that of a record in it.
_HEAD, _RECORD = struct.Struct("<4sHHiIII"), struct.Struct("<IIII")
_SECTION = b"\x0a\x0d\x0d\x0a"  # the same in both byte orders
_SECTION_KIND = int.from_bytes(_SECTION)
_ORDERS = {b"\x4d\x3c\x2b\x1a": "<", b"\x1a\x2b\x3c\x4d": ">"}
_INTERFACE, _OBSOLETE_PACKET, _SIMPLE_PACKET, ENHANCED_PACKET = 1, 2, 3, 6
_PACKETS = {_OBSOLETE_PACKET, _SIMPLE_PACKET, ENHANCED_PACKET}
_LAST_KIND = 10  # that the draft gives a number, but for the section's
_TIME_RESOLUTION, _TIME_OFFSET = 9, 14  # options of an interface

#: bytes of a buffer at first, and most of those that are passed over at once.
SMALLEST = 1 << 16
#: bytes behind what was read that may be looked at, whatever they are, so that records can be compared in words.
SLACK = 256
#: buffers kept for use again.
MOST_KEPT = 2
LARGEST_BLOCK = 1 << 20  # a packet with its options; longer blocks are passed over unread
#: places that are looked at together for the next record, and bytes behind each that may be needed: a packet, its options, a head.
_STEP, _REACH = 1 << 16, LARGEST_PACKET + (1 << 12)
#: bytes before a time that is sought which are read all the same.
NEAR = 1 << 21
#: seconds between two packets in a row, and between two of a file, at most, where a record may begin.
_DAY, _YEAR = 86_400, 31_536_000
_MOST_INTERFACES = 1024
_SECOND = 1_000_000_000
_FURTHEST = 4_000_000_000  # seconds; times further on are read one by one, so that none overflows


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
    """Bytes of a file or pipe, in buffers that can be lent out: what is held follows what is there, never a length that it claims.

    Args:
        largest: bytes that a buffer grows to where the file has so many; a record that does not fit makes it longer.

    Attributes:
        storage: the buffer in use, `SLACK` bytes longer than it is ever filled.
        at: where in `storage` the next byte stands.
        record: file offset of the record that was begun last.
        place: file offset of the next byte.
    """

    def __init__(self, file: BinaryIO, *, largest: int = SMALLEST) -> None:
        self._file, self._into, self._largest = file, _into(file), largest
        self._kept: list[tuple[NDArray[np.uint8], weakref.ref[Any]]] = []
        self._lent: weakref.ref[Any] | None = None
        self._data = memoryview(b"")
        self._passed = 0  # bytes of the file before `storage`
        self.record = self.at = 0
        self._adopt(np.empty(_first_size(file, largest) + SLACK, np.uint8), 0)

    def __reduce__(self) -> tuple[Any, ...]:
        """What is pickled goes on at the same place of the file."""
        return _source_at, (self._file, self._largest, self.place)

    @property
    def stop(self) -> int:
        """How much of `storage` is filled."""
        return len(self._data)

    @property
    def place(self) -> int:
        return self._passed + self.at

    def from_place(self, place: int) -> Source:
        """The same file's bytes from a place on, in a small buffer. Its position is then not this one's any more: see `go`."""
        return _source_at(self._file, SMALLEST, place)

    def go(self, place: int) -> None:
        """Go on from a place of a file that can be sought."""
        self._file.seek(place)
        self._lent = None  # what is held elsewhere is not written to: the buffer is another
        self._adopt(np.empty_like(self.storage), 0)
        self.record = self._passed = place

    @property
    def size(self) -> int | None:
        """Bytes of the file; None where it cannot be sought. The position is then not this one's any more: see `go`."""
        return self._file.seek(0, os.SEEK_END) if self._file.seekable() else None

    def ahead(self, size: int) -> memoryview:
        """The next `size` bytes, which stay there; fewer at the end."""
        self._has(size)
        return self._data[self.at : self.at + size]

    def begin_record(self) -> bool:
        """Whether a record begins here, rather than the end of the input."""
        self.record = self.place
        return self._has(1)

    def take(self, size: int) -> bytes:
        """The next `size` bytes; the caller sees to it that `size` is bounded.

        Raises:
            Truncated: fewer are left.
        """
        if not self._has(size):
            raise Truncated
        self.at += size
        return bytes(self._data[self.at - size : self.at])

    def skip(self, size: int) -> None:
        """Passes over `size` bytes, however many.

        Raises:
            Truncated: fewer are left.
        """
        while size:
            step = min(size, SMALLEST)
            if not self._has(step):
                raise Truncated
            self.at += step
            size -= step

    def more(self) -> bool:
        """Whether bytes came after those that are there; they may all move."""
        return self._has(len(self._data) - self.at + 1)

    def lent(self) -> NDArray[np.uint8]:
        """The bytes in the buffer, (n,), read-only: not written to again while this array or a view of it is alive."""
        array = np.frombuffer(self._view[: len(self._data)], np.uint8)
        array.flags.writeable = False
        self._lent = weakref.ref(array)
        return array

    def _has(self, size: int) -> bool:
        have = len(self._data) - self.at
        if have >= size:
            return True
        self._turn(have)
        while have < size:
            if have == len(self.storage) - SLACK:
                self._turn(have)
            try:
                count = self._into(self._view[have : len(self.storage) - SLACK])
            except OSError as error:
                raise SourceError(f"cannot read the capture: {error}") from error
            if not count:
                break
            have += count
            self._data = self._view[:have]
        return have >= size

    def _turn(self, have: int) -> None:
        """Puts what is not read yet to the front of a buffer that nobody holds."""
        size = len(self.storage) - SLACK
        tail, at = self.storage[self.at : self.at + have], self.at
        if len(self._data) == size:
            size = 2 * size if have == size else max(size, min(2 * size, self._largest))
        if self._lent is not None:
            self._kept = [*self._kept[1 - MOST_KEPT :], (self.storage, self._lent)]
        spare = self._spare(size)
        spare[:have] = tail
        self._passed += at
        self._adopt(spare, have)

    def _spare(self, size: int) -> NDArray[np.uint8]:
        if self._lent is None and len(self.storage) - SLACK == size:
            return self.storage
        self._lent = None
        for index, (storage, lent) in enumerate(self._kept):
            if lent() is None and len(storage) - SLACK == size:
                del self._kept[index]
                return storage
        return np.empty(size + SLACK, np.uint8)

    def _adopt(self, storage: NDArray[np.uint8], have: int) -> None:
        self.storage = storage
        self._view = storage.data
        self._data, self.at = self._view[:have], 0


def _source_at(file: BinaryIO, largest: int, place: int) -> Source:
    """The bytes of a file that can be sought, from a place on."""
    file.seek(place)
    source = Source(file, largest=largest)
    source.record = source._passed = place
    return source


def _into(file: BinaryIO) -> Callable[[memoryview], int | None]:
    """What fills a buffer with the bytes that have arrived: of a pipe, others would wait for as many as there is room for."""
    if isinstance(file, io.BufferedIOBase):
        return file.readinto1
    return file.readinto if isinstance(file, io.RawIOBase) else functools.partial(_copied, file)


def _copied(file: BinaryIO, buffer: memoryview) -> int:
    data = file.read(len(buffer))
    buffer[: len(data)] = data
    return len(data)


def _first_size(file: BinaryIO, largest: int) -> int:
    try:
        status = os.fstat(file.fileno())
    except (AttributeError, OSError):
        return SMALLEST
    return min(max(status.st_size, SMALLEST), largest) if stat.S_ISREG(status.st_mode) else SMALLEST


def is_capture(head: bytes) -> bool:
    """Whether the first four bytes of a file are those of a pcap or pcapng capture."""
    return head[:4] in _PCAP or head[:4] == _SECTION


@dataclass(frozen=True)
class Times:
    """How a record's time is read from its two words.

    Attributes:
        word: their type, with its byte order.
        high, low: which words of the record they are.
        ticks: of `low` in a second where `high` counts seconds, else of both together.
        is_split: whether `high` counts seconds.
        offset: ns.
    """

    word: str
    high: int
    low: int
    ticks: int
    is_split: bool
    offset: int = 0

    def fits(self) -> bool:
        """Whether all times up to `_FURTHEST` can be had in 64 bits without overflow."""
        return self.ticks <= 9 * _SECOND and abs(self.offset) < 1 << 62

    def ns(self, heads: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.bool_] | None]:
        """Times of n records, (n,) ns since 1970, and which of them are right, (n,); None where all are."""
        words = heads.view(self.word)
        high, low = words[:, self.high].astype(np.int64), words[:, self.low]
        if self.is_split:
            high *= _SECOND
            high += low * np.int64(_SECOND // self.ticks)
            return high, None
        seconds, fraction = np.divmod(high << 32 | low, self.ticks)
        right = (high < 1 << 31) & (seconds < _FURTHEST)
        return seconds * _SECOND + fraction * _SECOND // self.ticks + self.offset, right


class Pattern(NamedTuple):
    """What the records of a stream of packets have in common, as far as the file's format says.

    Attributes:
        head: bytes of a record before the packet.
        free: places of bytes among them that differ from record to record: the time's.
        uncut: those of the length that the packet had before it was cut.
        times: how the time is read from them.
        trailer: type of the word at the end that repeats the length, with its byte order; None where there is none.
    """

    head: int
    free: tuple[int, ...]
    uncut: tuple[int, ...]
    times: Times
    trailer: str | None


class PcapRecords:
    """The records of a pcap file.

    Attributes:
        sections: 0, since it is one whole.
        order: the byte order of the file, as in `struct`.
        link: its link-layer type.
    """

    sections = 0

    def __init__(self, source: Source) -> None:
        self._source = source
        self.order, self._unit = _PCAP[source.take(4)]
        *_, self._snap_length, link = struct.unpack(self.order + "HHiIII", source.take(20))
        self.link = link & 0xFFFF  # the upper half tells the length of the frame check sequence
        self._head = struct.Struct(self.order + "IIII")
        self._lengths = struct.Struct(self.order + "II")
        self._began: int | None = None

    def over(self, source: Source) -> PcapRecords:
        """The same form of other bytes of the file."""
        other = copy.copy(self)
        other._source = source
        return other

    def length(self, data: memoryview | bytes, at: int) -> int:
        """The length of the record that begins there, of which 16 bytes are there; 0 where it is doubtful, or cannot be."""
        captured, original = self._lengths.unpack_from(data, at + 8)
        return self._head.size + captured if self._is_sure(captured, original) else 0

    def claim(self, length: int) -> tuple[int, str, int]:
        """Where in a whole packet's record of a length that stands, as what type, and the number that stands there: the length, twice."""
        captured: int = length - self._head.size
        return 8, f"{self.order}u8", captured << 32 | captured

    def pattern(self, record: bytes) -> Pattern:
        """What records like this one have in common."""
        times = Times(f"{self.order}u4", 0, 1, _SECOND // self._unit, True)
        return Pattern(self._head.size, tuple(range(8)), tuple(range(12, 16)), times, None)

    def read(self) -> CapturedPacket:
        """The packet of the record that begins here.

        Raises:
            Truncated, Damaged: nothing can be read from `source.record` on.
        """
        head = self._source.ahead(self._head.size)
        if len(head) < self._head.size:
            raise Truncated
        seconds, fraction, captured, original = self._head.unpack(head)
        if captured > LARGEST_PACKET or not any(head):  # a hole in a file is full of zeros
            raise Damaged
        if not self._is_sure(captured, original) and self._is_false(captured, original):
            raise Damaged
        self._began = seconds if self._began is None else self._began
        self._source.skip(self._head.size)
        return CapturedPacket(self.link, seconds * _SECOND + fraction * self._unit, self._source.take(captured), original)

    def first_place(self, data: memoryview, stop: int, *, is_end: bool) -> int | None:
        """The first place below `stop` where a record begins that another one, or the end of the input, follows."""
        count = len(data) - self._head.size + 1
        if count <= 0:
            return None
        seconds, fractions, captured, original = (np.ndarray((count,), f"{self.order}u4", data, at, (1,)) for at in (0, 4, 8, 12))
        likely = (captured[:stop] <= original[:stop]) & (original[:stop] <= LARGEST_PACKET) & (captured[:stop] > 0)
        places = np.flatnonzero(likely & (fractions[:stop] < _SECOND // self._unit))
        if self._began is not None:
            places = places[abs(seconds[places].astype(np.int64) - self._began) <= _YEAR]
        behind = places + self._head.size + captured[places]
        right = (behind == len(data)) & (captured[places] == original[places]) & is_end
        followed = behind < count
        before, after = places[followed], behind[followed]
        right[followed] = (captured[after] <= original[after]) & (original[after] <= LARGEST_PACKET) & (captured[after] > 0)
        right[followed] &= abs(seconds[after].astype(np.int64) - seconds[before]) <= _DAY
        return int(places[right.argmax()]) if right.any() else None

    def _is_sure(self, captured: int, original: int) -> bool:
        """Whether two lengths bear each other out: the packet is whole, or cut where the file says."""
        return 0 < captured <= LARGEST_PACKET and captured in (original, self._snap_length)

    def _is_false(self, captured: int, original: int) -> bool:
        """Whether a record is longer or shorter than it says: none begins where it ends, and others do within it or its whole packet."""
        size, within = self._head.size + captured, max(captured, min(original, LARGEST_PACKET) + 1)
        data = self._source.ahead(self._head.size + within + _REACH)
        is_end = len(data) < self._head.size + within + _REACH
        if len(data) == size or self.first_place(data[size:], 1, is_end=is_end) is not None:
            return False
        return self.first_place(data[self._head.size :], within, is_end=is_end) is not None


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
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self.sections = 0
        self.order = "<"
        self._interfaces: list[Interface] = []
        self._knows_all = True  # interfaces of the section so far

    def over(self, source: Source) -> PcapngBlocks:
        """The same form, with the interfaces that are known, of other bytes of the file."""
        other = copy.copy(self)
        other._source, other._interfaces = source, list(self._interfaces)
        return other

    def length(self, data: memoryview | bytes, at: int) -> int:
        """The length of the block that begins there; 0 where it can only be read by itself, since it says something that cannot be,
        begins a section, or is longer than is ever held."""
        kind, length = struct.unpack_from(self.order + "II", data, at)
        return 0 if kind == _SECTION_KIND or length > LARGEST_BLOCK or not _can_be(length) else length

    def claim(self, length: int) -> tuple[int, str, int]:
        """Where in a block of a length that stands, as what type, and the number that stands there."""
        return 4, f"{self.order}u4", length

    def pattern(self, record: bytes) -> Pattern | None:
        """What blocks like this one have in common; None for kinds that are read one by one."""
        kind, _, number = struct.unpack_from(self.order + "III", record)
        if kind != ENHANCED_PACKET:
            return None
        interface, word = self._interfaces[number], f"{self.order}u4"
        times = Times(word, 3, 4, interface.ticks, False, interface.offset)
        return Pattern(28, tuple(range(12, 20)), tuple(range(24, 28)), times, word)

    def read(self) -> CapturedPacket | Passed:
        """The packet of the block that begins here.

        Raises:
            Truncated, Damaged: nothing can be read from `source.record` on.
        """
        head = bytes(self._source.ahead(12))
        if len(head) < 12:
            raise Truncated
        if head[:4] == _SECTION:
            if head[8:] not in _ORDERS:
                raise Damaged
            self.order, self._interfaces, self._knows_all, self.sections = _ORDERS[head[8:]], [], True, self.sections + 1
        kind, length = struct.unpack_from(self.order + "II", head)
        if self._is_false(kind, length):
            self._knows_all = self._knows_all and kind != _INTERFACE
            raise Damaged
        if length > LARGEST_BLOCK:
            self._source.skip(length)
            return Passed.NO_PACKET
        body = self._source.take(length)[8:-4]
        if kind == _INTERFACE:
            if len(body) < 8 or len(self._interfaces) == _MOST_INTERFACES:
                self._knows_all = False
                raise Damaged
            self._interfaces.append(_interface(self.order, body))
        return _block_packet(self.order, kind, body, self._interfaces) or Passed.MALFORMED if kind in _PACKETS else Passed.NO_PACKET

    def first_place(self, data: memoryview, stop: int, *, is_end: bool) -> int | None:
        """The first place below `stop` where a whole block begins, or a section; the latter alone where an interface was lost.

        Packets name interfaces by number: with one lost, all that follow would be misread.
        """
        sections = (found.start() for found in re.finditer(re.escape(_SECTION), data[: stop + 3]))
        section = next((at for at in sections if bytes(data[at + 8 : at + 12]) in _ORDERS), None)
        count = len(data) - 11
        if not self._knows_all or count <= 0:
            return section
        words = np.ndarray((count + 8,), f"{self.order}u4", data, 0, (1,))
        kinds, lengths = words[:-8][:stop], words[4:-4][:stop]
        places = np.flatnonzero((kinds > 0) & (kinds <= _LAST_KIND) & (lengths >= 12) & (lengths <= _REACH))
        ends = places + lengths[places]
        places, ends = places[ends <= len(data)], ends[ends <= len(data)]
        right = places[words[ends - 4] == lengths[places]].tolist()
        return min([*right[:1], *([section] if section is not None else [])], default=None)

    def _is_false(self, kind: int, length: int) -> bool:
        """Whether a block is of another length than it says: its end does not repeat it, or is not there while others begin within it."""
        if not _can_be(length) or (length > LARGEST_BLOCK and kind in _PACKETS | {_INTERFACE}):
            return True
        size = _REACH if length > LARGEST_BLOCK else length
        data = self._source.ahead(size)
        if len(data) == length:
            return data[-4:] != data[4:8]
        return self.first_place(data[4:], size, is_end=True) is not None


#: the records of either format.
Form = PcapRecords | PcapngBlocks


def records(source: Source) -> Form:
    """The records of a capture whose magic `is_capture` knows.

    Raises:
        Truncated: the head of the file is cut.
    """
    return PcapngBlocks(source) if source.ahead(4) == _SECTION else PcapRecords(source)


def resume(source: Source, form: Form) -> bool:
    """Goes to the next place where records begin, behind one that is damaged; False where there is none, at the end."""
    source.skip(len(source.ahead(1)))
    while data := source.ahead(_STEP + _REACH):
        found = form.first_place(data, _STEP, is_end=len(data) < _STEP + _REACH)
        source.skip(min(_STEP, len(data)) if found is None else found)
        if found is not None:
            return True
    return False


def sought(source: Source, form: Form, at: int) -> bool:
    """Goes on close before the first packet that was captured at a time, ns since 1970, or later: `NEAR` bytes away at most.

    Packets are taken to stand in the order of their times. Further sections of a pcapng file are taken to have the interfaces of this
    one: where a section begins, or times are years away, since they are counted otherwise there, nothing is passed over.

    Returns:
        False where that is behind here, and for a pipe or a packed file: it then goes on where it was.
    """
    here = low = source.place
    high = source.size
    if high is None:
        return False
    first = _captured(source.from_place(here), form, high)
    while first is not None and high - low > NEAR:
        middle = (low + high) // 2
        found = _captured(source.from_place(middle), form, high)
        if found is None or found[0] >= at or abs(found[0] - first[0]) > _YEAR * _SECOND:
            high = middle
        else:
            low = found[1]
    source.go(low)
    return low > here


def _captured(source: Source, form: Form, stop: int) -> tuple[int, int] | None:
    """Time and place of the first packet behind here, of those whose time is known; None where there is none up to a place."""
    form, section = form.over(source), form.sections
    while resume(source, form) and source.begin_record() and source.record < stop:
        try:
            packet = form.read()
        except Damaged:
            continue
        except Truncated:
            break
        if form.sections != section:
            break
        if isinstance(packet, CapturedPacket) and packet.at:
            return packet.at, source.record
    return None


def _can_be(length: int) -> bool:
    """Whether a block can have a length: that of its head and tail at least, in words."""
    return length >= 12 and length % 4 == 0


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


def capture_head(link: int) -> bytes:
    """What a pcap file begins with: little-endian, with nanoseconds.

    Args:
        link: the link type: `ip.ETHERNET` for datagrams; USER0 for bare packets, when no protocol is around the bytes.
    """
    return _HEAD.pack(NANOSECOND_MAGIC, 2, 4, 0, 0, LARGEST_PACKET, link)


def packet_record(data: bytes, at: int) -> bytes:
    """The record of one packet as it is, of the file's link type, with its time in ns since 1970.

    Raises:
        UsageError: for a packet or time that no record can hold.
    """
    seconds, nanoseconds = divmod(at, _SECOND)
    if not 0 <= seconds < 1 << 32:
        raise UsageError(f"a capture time of {at} ns: pcap holds the years 1970 to 2106")
    _refuse_size(data)
    return _RECORD.pack(seconds, nanoseconds, len(data), len(data)) + data


def _refuse_size(data: bytes) -> None:
    if len(data) > LARGEST_PACKET:
        raise UsageError(f"a packet of {len(data)} bytes: a record holds at most {LARGEST_PACKET}")


def record_size(data: bytes | bytearray, at: int) -> int:
    """The length of the record that begins there in a piece of a written file, or of the file's head, which the first piece begins with."""
    if at == 0 and is_capture(bytes(data[:4])):
        return _HEAD.size
    return _RECORD.size + int.from_bytes(data[at + 8 : at + 12], "little")


class Writing(NamedTuple):
    """How captures of a format are written.

    Attributes:
        head: what a file begins with, for a link type.
        record: of a packet, with its time in ns since 1970.
        size: of the record that begins at a place of a piece of the file, or of its head.
    """

    head: Callable[[int], bytes]
    record: Callable[[bytes, int], bytes]
    size: Callable[[bytes | bytearray, int], int]


def _pcapng_head(link: int) -> bytes:
    """A section, and an interface whose times are in nanoseconds; little-endian."""
    section = _block(_SECTION_KIND, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1))
    return section + _block(_INTERFACE, struct.pack("<HHIHHB3xHH", link, 0, LARGEST_PACKET, _TIME_RESOLUTION, 1, 9, 0, 0))


def _pcapng_record(data: bytes, at: int) -> bytes:
    if not 0 <= at < 1 << 63:
        raise UsageError(f"a capture time of {at} ns: times count from 1970")
    _refuse_size(data)
    head = struct.pack("<IIIII", 0, at >> 32, at & 0xFFFFFFFF, len(data), len(data))
    return _block(ENHANCED_PACKET, head + data + bytes(-len(data) % 4))


def _block(kind: int, body: bytes) -> bytes:
    size = struct.pack("<I", len(body) + 12)
    return struct.pack("<I", kind) + size + body + size


#: by the suffix of the file.
WRITINGS = {
    ".pcap": Writing(capture_head, packet_record, record_size),
    ".pcapng": Writing(_pcapng_head, _pcapng_record, lambda data, at: int.from_bytes(data[at + 4 : at + 8], "little")),
}
