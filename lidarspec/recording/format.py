"""Encode and decode the bytes of an .lsr recording.

A recording is a sequence of records, each complete in itself. The first one describes it in JSON.

    offset  size  of a record, little-endian
    0       4     mark b"\xb5LS\x1e"
    4       1     kind: 0 header, 1 received, 2 sent, 3 event
    5       1     flags: 1 a datagram, 2 the line was interrupted before it, 4 it had fallen silent
    6       1     a, bytes of addresses
    7       2     n, bytes of data
    9       8     arrival time, ns since 1970, signed; the least number: nobody knows
    17      a     sender, receiver: each a length byte, that many bytes of address,
                  and, if there are any, the port in 2 bytes
    17+a    n     data
    17+a+n  4     CRC-32 (zlib) of everything before

An event is a JSON object, with its name as "event": "disconnect", "reconnect", "dropped" (so many
"records"), or "clock": the wall clock was set, and is "ahead_ns" ahead of the arrival times, which
go on evenly. What a reader does not know it passes over.

Theory of operation: a length is at most what its one or two bytes can say, so no record claims more
than 66 kB, and none is believed before its checksum passes. The reader keeps a window of the file
that holds one record and what was read with it. It stops at the first damaged record, or salvages
what lies behind it; what a killed process leaves behind is whole records and at most one that is
not. A time is found by bisection (`Recording.seek`): arrival times do not go back, and from
anywhere in the file the next mark with a good checksum is a record. So no index is kept, which a
crash could lose, and every recording can be sought in.
"""

from __future__ import annotations

import itertools
import json
import os
import re
import struct
import sys
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from functools import lru_cache
from pathlib import Path
from reprlib import repr as shown
from shlex import quote
from typing import Any, BinaryIO, Literal

from lidarspec.errors import SourceError, UsageError, WireError, suggest, system_errors
from lidarspec.plugins import sensor as named_sensor
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.options import Learned
from lidarspec.stores import file_of
from lidarspec.transports.protocol import Closing

VERSION = 1
_ID = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*")
MAGIC = b"\x89LSR\r\n\x1a\n"
MARK = b"\xb5LS\x1e"
HEADER, RECEIVED, SENT, EVENT = range(4)
DATAGRAM = 1
GAP = 2
QUIET = 4
#: most bytes of data in one record.
LARGEST = 0xFFFF
_HEAD = struct.Struct("<4sBBBHq")
_CRC = struct.Struct("<I")
_PORT = struct.Struct("<H")
_UNKNOWN = -(1 << 63)
_BLOCK = 1 << 16
Address = tuple[str, int]
Direction = Literal["in", "out", "event"]
DIRECTIONS: dict[int, Direction] = {RECEIVED: "in", SENT: "out", EVENT: "event"}


@dataclass(frozen=True)
class Header:
    """What a recording says of itself.

    Attributes:
        sensor, options: id and options of the sensor; "" where it was recorded raw.
        source: the SOURCE that it came from.
        datagrams: whether the link carried datagrams.
        baud: of a serial port.
        versions: of lidarspec and of the sensor's distribution.
        created: date and time with the zone, ISO 8601.
        wall_ns, monotonic_ns: the same moment on both clocks of the recording machine.
        version: of the format.
    """

    sensor: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)
    source: str = ""
    datagrams: bool = False
    baud: int | None = None
    versions: Mapping[str, str] = field(default_factory=dict)
    created: str = ""
    wall_ns: int = 0
    monotonic_ns: int = 0
    version: int = VERSION

    def to_json(self) -> bytes:
        """The header as it stands in the file; an option that JSON does not know stands as its
        text.
        """
        return json.dumps(
            {item.name: getattr(self, item.name) for item in fields(self)}, default=_plain
        ).encode()

    def known_sensor(self, folder: Path) -> Sensor:
        """The installed sensor that it names, with the options of then, as far as anybody may give
        them.

        Args:
            folder: where the recording is; of paths in it those alone are opened that lead to a
                file there.

        Raises:
            UsageError: where it names none, or one with an option that only the caller should give,
                such as a file elsewhere.
            UnknownSensor: where that one is not installed.
        """
        if not _ID.fullmatch(self.sensor):
            raise UsageError(
                f"its header gives {self.sensor[:40]!r} for the id of a sensor"
                if self.sensor
                else "it names no sensor"
            )
        found = named_sensor(self.sensor)
        try:
            return (
                found.configure(**found.configure.options_of_file(self.options, folder))
                if self.options
                else found
            )
        except UsageError as error:
            raise UsageError(
                f"it was recorded with an option that has to be given again, as -s {self.sensor} -O"
                f" ...: {error}"
            ) from None


_BLANK = Header()


def read_header(data: bytes) -> Header:
    """The header that bytes stand for; names that this version does not know are passed over.

    Raises:
        WireError: for bytes that are none.
    """
    try:
        values = json.loads(data)
    except (ValueError, RecursionError):
        values = None
    if not isinstance(values, dict):
        raise WireError("the header of the recording is no JSON object", data=data[:16])
    known = {
        item.name: values.get(item.name, getattr(_BLANK, item.name)) for item in fields(Header)
    }
    for name, value in known.items():
        kind = (int, type(None)) if name == "baud" else type(getattr(_BLANK, name))
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            raise WireError(
                f"the header of the recording has {name} = {shown(value)}", path=name, got=value
            )
    return Header(**known)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, Learned):
        return value.to_dict()
    return str(value)


@dataclass(frozen=True, slots=True)
class Record:
    """One entry of a recording.

    Attributes:
        direction: "in" received, "out" sent, "event" something that happened to the line.
        data: the bytes; of an event its JSON.
        at: arrival time, ns since 1970; None where nobody knows it.
        sender, receiver: addresses and ports of a datagram, where known.
        datagram: whether `data` is a whole datagram.
        gap: whether the line was interrupted before it.
        quiet: whether it had fallen silent before it.
    """

    direction: Direction
    data: bytes
    at: int | None = None
    sender: Address | None = None
    receiver: Address | None = None
    datagram: bool = False
    gap: bool = False
    quiet: bool = False


def pack_record(
    kind: int,
    data: bytes,
    at: int | None = None,
    *,
    flags: int = 0,
    sender: Address | None = None,
    receiver: Address | None = None,
) -> bytes:
    """The bytes of a record.

    Raises:
        UsageError: for more data, a longer address or another port or time than a record can hold.
    """
    if sender or receiver:
        addresses = _endpoint(sender) + _endpoint(receiver)
    else:
        addresses = b""
    try:
        head = _HEAD.pack(
            MARK, kind, flags, len(addresses), len(data), _UNKNOWN if at is None else at
        )
    except struct.error:
        raise UsageError(
            f"a record of {len(data)} bytes at {at} ns from {sender} to {receiver}: no record can"
            " hold that"
        ) from None
    body = b"".join((head, addresses, data))
    return body + _CRC.pack(zlib.crc32(body))


def size_at(buffer: bytes | bytearray | memoryview, start: int = 0) -> int:
    """The length that a record claims; 0 where its first bytes are not all there, -1 where it is
    none.
    """
    mark = bytes(buffer[start : start + len(MARK)])
    if mark != MARK[: len(mark)]:
        return -1
    if len(buffer) - start < _HEAD.size:
        return 0
    _, _, _, addresses, size, _ = _HEAD.unpack_from(buffer, start)
    return int(_HEAD.size + addresses + size + _CRC.size)


class Recording(Closing):
    """A recording, read in order: an iterable of `Record`s that goes on where the last loop
    stopped, and a context manager.

    Memory is bounded by a block and a record.

    Args:
        path: the file; "-" is standard input.
        file: it, where it is open already, or is read in another way than as it stands; closed with
            this one.
        salvage: look for the next good record behind a damaged place, even the header, instead of
            stopping there.

    Attributes:
        header: what it says of itself.
        records: good records so far, the header and events among them.
        damaged: places so far that hold no good record; a record that is not whole at the end is
            one.
        leftover: bytes in damaged places; without `salvage` all that are behind the last good
            record.
        is_cut: whether the last damaged place is a record that the file ends in.
        offset: file offset of the next record, or of the damage that ended the reading.

    Raises:
        SourceError: where the file cannot be opened, is no recording, or one of a later format.
        WireError: where its header is damaged, and `salvage` is not asked for.
    """

    def __init__(
        self, path: str | Path, file: BinaryIO | None = None, *, salvage: bool = False
    ) -> None:
        self.path = str(path)
        self.salvage = salvage
        self._window = b""
        self._place = 0
        self.records = self.damaged = self.leftover = 0
        self.is_cut = False
        self.offset = len(MAGIC)
        with system_errors(path):
            self._file = file or (sys.stdin.buffer if self.path == "-" else file_of(self.path))
        try:
            self._records = self._begin()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        if self.path != "-":
            self._file.close()

    def __iter__(self) -> Iterator[Record]:
        return self._records

    def seek(self, at: int) -> bool:
        """Go on close before the first record that was received at a time, ns since 1970, or later,
        a few blocks away at most.

        Damaged places that are passed over are not counted.

        Returns:
            False where that is behind here, where nobody knows when records arrived, and for a
            pipe: it then goes on where it was.
        """
        here = low = self.offset
        if not self._file.seekable():
            return False
        with system_errors(self.path):
            high = self._file.seek(0, os.SEEK_END)
            while high - low > 2 * (LARGEST + _BLOCK):
                middle = (low + high) // 2
                found = self._find_received(middle, high)
                if found is None or found[0] >= at:
                    high = middle
                else:
                    low = found[1]
            self._go(low)
        return low > here

    def _find_received(self, start: int, stop: int) -> tuple[int, int] | None:
        """Time and offset of the first record between two places that was received, and when is
        known.
        """
        self._go(start)
        while self.offset < stop and self._holds(1):
            size = self._good()
            place = self._place
            if size > 0:
                kind, record = _unpack_record(self._window[place : place + size])
                if kind == RECEIVED and record.at is not None:
                    return record.at, self.offset
                self._skip(size)
            else:
                self._next_mark()
        return None

    def _go(self, offset: int) -> None:
        self._file.seek(offset)
        self._window = b""
        self._place = 0
        self.offset = offset

    def _begin(self) -> Iterator[Record]:
        """Read the header; the records behind it."""
        with system_errors(self.path):
            magic = self._file.read(len(MAGIC))
            if magic != MAGIC:
                if magic:
                    seen = f"it begins with {magic.hex(' ')}"
                else:
                    seen = "it is empty"
                raise SourceError(f"{self.path}: not an .lsr recording: {seen}")
            pairs = self._pairs()
            first = next(pairs, None)
        if first is not None and first[0] == HEADER:
            self.header = read_header(first[1].data)
            if self.header.version > VERSION:
                raise SourceError(
                    f"{self.path}: written in format {self.header.version}, and this lidarspec"
                    f" knows {VERSION}"
                )
            return self._known(pairs)
        if not self.salvage:
            damage = WireError(f"{self.path}: the header of the recording is damaged or cut off")
            raise suggest(
                damage, f"lidarspec record {quote(str(self.path))} --salvage -o mended.lsr"
            )
        self.header = Header()
        return self._known(itertools.chain([] if first is None else [first], pairs))

    def _known(self, pairs: Iterator[tuple[int, Record]]) -> Iterator[Record]:
        with system_errors(self.path):
            yield from (record for kind, record in pairs if kind in DIRECTIONS)

    def _pairs(self) -> Iterator[tuple[int, Record]]:
        """Kind and content of every good record."""
        while self._holds(1):
            if (size := self._good()) > 0:
                kind, record = _unpack_record(self._window[self._place : self._place + size])
                self._skip(size)
                self.records += 1
                yield kind, record
                continue
            self.damaged += 1
            if not self.salvage:
                self.leftover += self._rest()
                return
            self.leftover += self._next_mark()

    def _good(self) -> int:
        """The length of the record in place; 0 where it is damaged or not whole."""
        self._holds(_HEAD.size)
        size = size_at(self._window, self._place)
        self.is_cut = size == 0 or (size > 0 and not self._holds(size))
        if size < 0 or self.is_cut:
            return 0
        end = self._place + size - _CRC.size
        passes = (
            zlib.crc32(self._window[self._place : end]) == _CRC.unpack_from(self._window, end)[0]
        )
        start = self._place + _HEAD.size
        if passes and _endpoints(self._window[start : start + self._window[self._place + 6]]):
            return size
        return 0

    def _holds(self, number: int) -> bool:
        """Whether so many bytes are in the window from the place on, after reading more where it
        takes that.
        """
        while len(self._window) - self._place < number:
            block = self._file.read(_BLOCK)
            if not block:
                return False
            self._window = self._window[self._place :] + block
            self._place = 0
        return True

    def _skip(self, number: int) -> None:
        self._place += number
        self.offset += number

    def _next_mark(self) -> int:
        """Go to the next mark, or to the end; the bytes passed over."""
        before = self.offset
        self._skip(1)
        while (found := self._window.find(MARK, self._place)) < 0:
            left = len(self._window) - self._place
            keep = min(len(MARK) - 1, left)  # which a mark may begin with
            self._skip(left - keep)
            if not self._holds(keep + 1):
                self._skip(keep)
                return self.offset - before
        self._skip(found - self._place)
        return self.offset - before

    def _rest(self) -> int:
        """The bytes from the place to the end of the file."""
        if self._file.seekable():
            return self._file.seek(0, os.SEEK_END) - self.offset
        left = len(self._window) - self._place
        while block := self._file.read(_BLOCK):
            left += len(block)
        return left


def _unpack_record(record: bytes) -> tuple[int, Record]:
    _, kind, flags, addresses, size, at = _HEAD.unpack_from(record)
    start = _HEAD.size + addresses
    sender, receiver = _endpoints(record[_HEAD.size : start]) or (None, None)
    known = None if at == _UNKNOWN else at
    direction = DIRECTIONS.get(kind, "event")
    marks = (bool(flags & mark) for mark in (DATAGRAM, GAP, QUIET))
    return kind, Record(direction, record[start : start + size], known, sender, receiver, *marks)


@lru_cache(maxsize=256)
def _endpoint(address: Address | None) -> bytes:
    if address is None or not address[0]:
        return b"\0"
    host = address[0].encode()
    try:
        return bytes([len(host)]) + host + _PORT.pack(address[1])
    except (ValueError, struct.error):
        raise UsageError(f"{address}: no address and port that a record can hold") from None


@lru_cache(maxsize=256)
def _endpoints(data: bytes) -> list[Address | None] | None:
    """Sender and receiver as they stand in a record; None where they are not two, or do not fill
    their place.
    """
    found: list[Address | None] = []
    place = 0
    while len(found) < 2 and place < len(data):
        length = data[place]
        host = data[place + 1 : place + 1 + length].decode("utf-8", "replace")
        end = place + 1 + length + 2 * bool(length)
        found.append((host, int.from_bytes(data[end - 2 : end], "little")) if length else None)
        place = end
    if place == len(data) and len(found) != 1:
        return found or [None, None]
    return None
