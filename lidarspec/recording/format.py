"""Encode and decode the bytes of an .lsr recording.

A recording is a sequence of independent records. The first is the header, in JSON.

    offset  size  of a record, little-endian
    0       4     mark, the bytes B5 4C 53 1E
    4       1     kind: 0 header, 1 received, 2 sent, 3 event
    5       1     flags: 1 the data is a datagram, 2 the line was interrupted before
                  the record, 4 the line was silent before the record
    6       1     a, the length of the addresses in bytes
    7       2     n, the length of the data in bytes
    9       8     arrival time, ns since 1970, signed; the lowest number if unknown
    17      a     sender, receiver: for each, the length of the address in 1 byte,
                  the address, and the port in 2 bytes (no port if the length is 0)
    17+a    n     data
    17+a+n  4     CRC-32 (zlib) of everything before

An event is a JSON object. Its entry "event" is "disconnect", "reconnect", "dropped" or "clock". For
"dropped", the entry "records" is the number of dropped records. "clock" means that the wall clock
was set during the recording. The arrival times continue without this step, and "ahead_ns" is the
wall clock minus the arrival time. Readers skip unknown kinds of records.

A record is used only if its checksum is valid. The reader stops at the first damaged record, or
continues with the next valid record (`salvage`). If the recording process is killed, the file ends
with at most one incomplete record.
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
from lidarspec.remote_files import open_stored
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.options import Learned
from lidarspec.transports.protocol import ClosingContext

VERSION = 1
_ID = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*")
MAGIC = b"\x89LSR\r\n\x1a\n"
MARK = b"\xb5LS\x1e"
HEADER, RECEIVED, SENT, EVENT = range(4)
DATAGRAM = 1
GAP = 2
QUIET = 4
#: maximum number of data bytes in a record.
MAX_DATA_BYTES = 0xFFFF
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
    """The header of a recording, its first record.

    Attributes:
        sensor: id of the sensor; "" for a recording without a sensor.
        options: the options of the sensor, by name.
        source: the SOURCE that was recorded.
        datagrams: whether the data consists of datagrams.
        baud: baud rate of a serial port; None for other sources.
        versions: name of a distribution -> its version, for lidarspec and the sensor's plugin.
        created: date and time with the time zone, ISO 8601.
        wall_ns: wall clock of the recording computer at the start, ns since 1970.
        monotonic_ns: monotonic clock of the recording computer at the start, ns.
        version: version of the format.
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
        """Return the header as JSON. Options that JSON does not support become text."""
        return json.dumps(
            {item.name: getattr(self, item.name) for item in fields(self)}, default=_to_plain
        ).encode()

    def known_sensor(self, folder: Path) -> Sensor:
        """Return the installed sensor that the header names, with the recorded options.

        Args:
            folder: folder of the recording. Only files in this folder are opened for options.

        Raises:
            UsageError: if the header names no sensor, or if an option cannot be restored and the
                caller must pass it, for example a file in another folder.
            UnknownSensor: if the sensor is not installed.
        """
        if not self.sensor:
            raise UsageError("the recording names no sensor")
        if not _ID.fullmatch(self.sensor):
            raise UsageError(f"the recording has the invalid sensor id {self.sensor[:40]!r}")
        installed = named_sensor(self.sensor)
        if not self.options:
            return installed
        try:
            options = installed.configure.check_untrusted_options(self.options, folder)
            configured: Sensor = installed.configure(**options)
        except UsageError as error:
            raise UsageError(
                f"{error}. Pass the options of the recorded sensor again, as in -s {self.sensor} -O"
                " NAME=VALUE"
            ) from None
        return configured


_BLANK = Header()


def read_header(data: bytes) -> Header:
    """Parse a header. Unknown entries are ignored.

    Raises:
        WireError: for an invalid header.
    """
    try:
        values = json.loads(data)
    except (ValueError, RecursionError):
        values = None
    if not isinstance(values, dict):
        raise WireError("the header of the recording is not a JSON object", data=data[:16])
    entries = {
        item.name: values.get(item.name, getattr(_BLANK, item.name)) for item in fields(Header)
    }
    for name, value in entries.items():
        kind = (int, type(None)) if name == "baud" else type(getattr(_BLANK, name))
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            raise WireError(
                f"the header of the recording is invalid: {name} is {shown(value)}",
                path=name,
                got=value,
            )
    return Header(**entries)


def _to_plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, Learned):
        return value.to_dict()
    return str(value)


@dataclass(frozen=True, slots=True)
class Record:
    """One record of a recording.

    Attributes:
        direction: "in" for received data, "out" for sent data, "event" for an event of the
            connection.
        data: the bytes; JSON for an event.
        at: arrival time, ns since 1970; None if unknown.
        sender: address and port of the sender of a datagram; None if unknown.
        receiver: address and port of the receiver of a datagram; None if unknown.
        datagram: whether `data` is a whole datagram.
        gap: whether the line was interrupted before this record.
        quiet: whether the line was silent before this record.
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
    """Return the bytes of a record.

    Raises:
        UsageError: if the data or an address is too long, or a port or time is invalid.
    """
    if sender or receiver:
        addresses = _pack_endpoint(sender) + _pack_endpoint(receiver)
    else:
        addresses = b""
    try:
        head = _HEAD.pack(
            MARK, kind, flags, len(addresses), len(data), _UNKNOWN if at is None else at
        )
    except struct.error:
        raise UsageError(
            f"the recording cannot store {len(data)} bytes from {sender} to {receiver} with the"
            f" time {at} ns: a value exceeds the limits of the format"
        ) from None
    body = b"".join((head, addresses, data))
    return body + _CRC.pack(zlib.crc32(body))


def size_at(buffer: bytes | bytearray | memoryview, start: int = 0) -> int:
    """Return the length of the record at an offset, from its first bytes.

    Returns:
        0 if the buffer ends before the length is known; -1 if no record begins at the offset.
    """
    mark = bytes(buffer[start : start + len(MARK)])
    if mark != MARK[: len(mark)]:
        return -1
    if len(buffer) - start < _HEAD.size:
        return 0
    _, _, _, addresses, size, _ = _HEAD.unpack_from(buffer, start)
    return int(_HEAD.size + addresses + size + _CRC.size)


class Recording(ClosingContext):
    """Reads the records of a recording in order; a context manager.

    Iterating yields `Record`s. A second iteration continues after the last record that was read.
    Only one block and one record of the file are in memory.

    Args:
        path: the file; "-" is standard input.
        file: the open or decompressed file; it is closed with the recording.
        salvage: whether to continue with the next valid record after damage, even if the header is
            damaged. Otherwise, reading ends at the damage.

    Attributes:
        header: the header.
        records: number of valid records so far, including the header and events.
        damaged: number of damaged parts so far, including an incomplete record at the end.
        leftover: number of bytes in damaged parts; without `salvage`, the number of all bytes after
            the last valid record.
        is_cut: whether the last damaged part is an incomplete record at the end of the file.
        offset: file offset of the next record, or of the damage that ended the reading.

    Raises:
        SourceError: if the file cannot be opened, is not a recording, or has a later format.
        WireError: if its header is damaged and `salvage` is false.
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
            self._file = file or (sys.stdin.buffer if self.path == "-" else open_stored(self.path))
        try:
            self._records = self._read_until_records()
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
        """Skip records that were received before a time.

        The last few blocks of earlier records are not skipped. Damage in skipped data is not
        counted.

        Args:
            at: ns since 1970.

        Returns:
            Whether records were skipped; always False for a pipe or without arrival times.
        """
        # Bisection needs no index, which a crash could destroy. Arrival times never decrease, and a
        # record can be found from any offset: it begins at the next mark with a valid checksum.
        here = low = self.offset
        if not self._file.seekable():
            return False
        with system_errors(self.path):
            high = self._file.seek(0, os.SEEK_END)
            while high - low > 2 * (MAX_DATA_BYTES + _BLOCK):
                middle = (low + high) // 2
                record = self._find_received(middle, high)
                if record is None or record[0] >= at:
                    high = middle
                else:
                    low = record[1]
            self._move_to(low)
        return low > here

    def _find_received(self, start: int, stop: int) -> tuple[int, int] | None:
        """Return the time and offset of the first received record between two offsets."""
        self._move_to(start)
        while self.offset < stop and self._fill_window(1):
            size = self._find_valid_length()
            place = self._place
            if size > 0:
                kind, record = _unpack_record(self._window[place : place + size])
                if kind == RECEIVED and record.at is not None:
                    return record.at, self.offset
                self._skip(size)
            else:
                self._skip_to_mark()
        return None

    def _move_to(self, offset: int) -> None:
        self._file.seek(offset)
        self._window = b""
        self._place = 0
        self.offset = offset

    def _read_until_records(self) -> Iterator[Record]:
        """Read the header and return the records after it."""
        with system_errors(self.path):
            magic = self._file.read(len(MAGIC))
            if magic != MAGIC:
                if magic:
                    seen = f"the file begins with {magic.hex(' ')}"
                else:
                    seen = "the file is empty"
                raise SourceError(f"{self.path}: not an .lsr recording: {seen}")
            pairs = self._iter_valid_records()
            first = next(pairs, None)
        if first is not None and first[0] == HEADER:
            self.header = read_header(first[1].data)
            if self.header.version > VERSION:
                raise SourceError(
                    f"{self.path}: the recording has format {self.header.version}, but this version"
                    f" of lidarspec reads formats up to {VERSION}: update lidarspec"
                )
            return self._keep_known(pairs)
        if not self.salvage:
            damage = WireError(f"{self.path}: the header of the recording is corrupt or truncated")
            raise suggest(
                damage, f"lidarspec record {quote(str(self.path))} --salvage -o repaired.lsr"
            )
        self.header = Header()
        return self._keep_known(itertools.chain([] if first is None else [first], pairs))

    def _keep_known(self, pairs: Iterator[tuple[int, Record]]) -> Iterator[Record]:
        with system_errors(self.path):
            yield from (record for kind, record in pairs if kind in DIRECTIONS)

    def _iter_valid_records(self) -> Iterator[tuple[int, Record]]:
        """Yield (kind, record) of every valid record."""
        while self._fill_window(1):
            if (size := self._find_valid_length()) > 0:
                kind, record = _unpack_record(self._window[self._place : self._place + size])
                self._skip(size)
                self.records += 1
                yield kind, record
                continue
            self.damaged += 1
            if not self.salvage:
                self.leftover += self._count_remaining_bytes()
                return
            self.leftover += self._skip_to_mark()

    def _find_valid_length(self) -> int:
        """Return the length of the current record; 0 if it is damaged or incomplete."""
        self._fill_window(_HEAD.size)
        size = size_at(self._window, self._place)
        self.is_cut = size == 0 or (size > 0 and not self._fill_window(size))
        if size < 0 or self.is_cut:
            return 0
        end = self._place + size - _CRC.size
        passes = (
            zlib.crc32(self._window[self._place : end]) == _CRC.unpack_from(self._window, end)[0]
        )
        start = self._place + _HEAD.size
        if passes and _read_endpoints(self._window[start : start + self._window[self._place + 6]]):
            return size
        return 0

    def _fill_window(self, number: int) -> bool:
        """Read until `number` bytes are in memory; return False if the file is too short."""
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

    def _skip_to_mark(self) -> int:
        """Skip to the next record mark, or the end; return the number of skipped bytes."""
        before = self.offset
        self._skip(1)
        while (position := self._window.find(MARK, self._place)) < 0:
            left = len(self._window) - self._place
            keep = min(len(MARK) - 1, left)  # possible beginning of a mark
            self._skip(left - keep)
            if not self._fill_window(keep + 1):
                self._skip(keep)
                return self.offset - before
        self._skip(position - self._place)
        return self.offset - before

    def _count_remaining_bytes(self) -> int:
        """Return the number of bytes from the current offset to the end of the file."""
        if self._file.seekable():
            return self._file.seek(0, os.SEEK_END) - self.offset
        left = len(self._window) - self._place
        while block := self._file.read(_BLOCK):
            left += len(block)
        return left


def _unpack_record(record: bytes) -> tuple[int, Record]:
    _, kind, flags, addresses, size, at = _HEAD.unpack_from(record)
    start = _HEAD.size + addresses
    sender, receiver = _read_endpoints(record[_HEAD.size : start]) or (None, None)
    arrival_ns = None if at == _UNKNOWN else at
    direction = DIRECTIONS.get(kind, "event")
    marks = (bool(flags & mark) for mark in (DATAGRAM, GAP, QUIET))
    return kind, Record(
        direction, record[start : start + size], arrival_ns, sender, receiver, *marks
    )


@lru_cache(maxsize=256)
def _pack_endpoint(address: Address | None) -> bytes:
    if address is None or not address[0]:
        return b"\0"
    host = address[0].encode()
    try:
        return bytes([len(host)]) + host + _PORT.pack(address[1])
    except (ValueError, struct.error):
        raise UsageError(f"{address}: not an address and port") from None


@lru_cache(maxsize=256)
def _read_endpoints(data: bytes) -> list[Address | None] | None:
    """Return [sender, receiver] of a record; an unknown address in the list is None.

    Returns None instead of the list if the bytes are invalid.
    """
    addresses: list[Address | None] = []
    offset = 0
    while len(addresses) < 2 and offset < len(data):
        length = data[offset]
        offset += 1
        if not length:
            addresses.append(None)
            continue
        host = data[offset : offset + length].decode("utf-8", "replace")
        offset += length
        port = data[offset : offset + _PORT.size]
        addresses.append((host, int.from_bytes(port, "little")))
        offset += _PORT.size
    if offset == len(data) and len(addresses) != 1:
        return addresses or [None, None]
    return None
