"""Files and standard input as transports: recordings, captures, logs (see `bags`), raw bytes, hexadecimal text.

A file ends, and is read as fast as it is asked for. Recordings and captures give what was received at the times of then, and count
what they leave out; bytes alone have no times. `open_file` tells them apart by what they hold.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from shlex import quote
from typing import BinaryIO

from lidarspec.captures.bulk import Batch, CaptureBatches
from lidarspec.captures.pcap import CaptureReader, CaptureStats, StreamReader, is_stream_capture
from lidarspec.captures.records import is_capture
from lidarspec.errors import SourceError, UnknownSensor, UsageError, WireError, suggest, system_errors
from lidarspec.recording.format import MAGIC, Header, Record, Recording
from lidarspec.spec.sensor import Sensor
from lidarspec.stores import is_stored, opened
from lidarspec.transports.bags import BagTransport, log_of
from lidarspec.transports.base import origin
from lidarspec.transports.protocol import Chunk, Transport

#: events behind which a frame begun earlier does not go on.
INTERRUPTIONS = frozenset({"disconnect", "reconnect", "dropped"})
#: in hexadecimal text: offsets and comments, what may stand between bytes, and what may not stand anywhere else.
_BESIDE = re.compile(r"^\s*(?:0[xX])?[0-9a-fA-F]{3,}:(?=\s)|(?:#|//).*", re.MULTILINE)
_COMMENT = re.compile("#|//")
_BETWEEN, _NO_DIGIT = re.compile(r"[\s,;:{}]+"), re.compile(r"[^0-9a-fA-F]")
#: bytes read at once, and bytes that say what a file is.
BLOCK, HEAD = 1 << 18, 512
#: digits of a word that a message shows.
QUOTED = 64
#: how files begin that hold no bytes as a sensor sent them, or these in a shape of their own; what they are, and what takes the bytes out.
CONTAINERS = {
    rb"\x1f\x8b\x08[\x00-\x1f]": ("compressed by gzip", "gunzip -k {}"),
    rb"BZh[1-9]1AY&SY": ("compressed by bzip2", "bunzip2 -k {}"),
    rb"\xfd7zXZ\x00": ("compressed by xz", "unxz -k {}"),
    rb"\x28\xb5\x2f\xfd": ("compressed by zstd", "unzstd {}"),
    rb"\x04\x22\x4d\x18": ("compressed by lz4", "unlz4 {}"),
    rb"PK\x03\x04": ("a zip archive, as .npz files are too", "unzip -l {}"),
    rb"7z\xbc\xaf\x27\x1c": ("a 7z archive", "7z l {}"),
    rb".{257}ustar": ("a tar archive", "tar -tf {}"),
    rb"\x89HDF\r\n": ("an HDF5 file", ""),
    rb"PAR1": ("a Parquet file", ""),
    rb"\x93NUMPY": ("a NumPy array", ""),
    rb"# \.PCD v|ply\r?\n|LASF": ("a file of points", ""),
    rb"snoop\x00{3}|btsnoop\x00|\x34\xcd\xb2\xa1|\xa1\xb2\xcd\x34": ("a capture of another format", "editcap {} capture.pcapng"),
}


class RecordingTransport(Transport):
    """What was received, as it arrived; commands that were sent and events are passed over, and leave their gap.

    Args:
        path: the file.
        sender: only datagrams from this address, or "ADDRESS:PORT".
        salvage: go on behind damaged places.

    Attributes:
        header: what the recording says of itself.
    """

    def __init__(self, path: str | Path, *, sender: str | None = None, salvage: bool = False) -> None:
        self._recording = Recording(path, salvage=salvage)
        self.header: Header = self._recording.header
        self.datagrams, self._origin = self.header.datagrams, None if sender is None else origin(sender)
        self.warnings: list[str] = []
        self._no_events, self._was_set = 0, False

    def known_sensor(self) -> Sensor:
        """The installed sensor that the recording names, with the options of then.

        Raises:
            UsageError: where it names none, or an option that has to be given again.
            UnknownSensor: where that one is not installed.
        """
        try:
            return self.header.known_sensor(Path(self._recording.path).parent)
        except UnknownSensor:
            raise
        except UsageError as error:
            raise UsageError(f"{self._recording.path}: {error}") from None

    def chunks(self) -> Iterator[Chunk]:
        """What was received, in order, with the arrival times of then."""
        interrupted, damaged = False, 0
        for record in self._recording:
            interrupted, damaged = interrupted or self._recording.damaged > damaged, self._recording.damaged
            if record.direction == "event":
                interrupted = self._interrupts(record) or interrupted
            elif record.direction == "in" and self._wanted(record):
                yield Chunk(record.data, record.at, record.sender, record.receiver, interrupted or record.gap, record.quiet)
                interrupted = False
        if self._recording.damaged:
            self.warnings.append(_damage(self._recording))
            self.unread = 0 if self._recording.is_cut else self._recording.leftover
        if self._no_events:
            self.warnings.append(f"{self._recording.path}: {self._no_events} events were passed over, which have no name")

    def write(self, data: bytes) -> None:
        raise SourceError(f"{self._recording.path} is a recording: nothing can be sent to it")

    def close(self) -> None:
        self._recording.close()

    def _wanted(self, record: Record) -> bool:
        if self._origin is None or record.sender in self._origin:
            return True
        self.foreign += 1
        return False

    def _interrupts(self, record: Record) -> bool:
        """Whether an event says that the line was interrupted; counts disconnects, and takes down that the clock was set."""
        try:
            event = json.loads(record.data)
            name = event["event"]
            self.disconnects += name == "disconnect"
            is_interruption = name in INTERRUPTIONS
        except (ValueError, RecursionError, TypeError, KeyError):
            self._no_events += 1
            return False
        if name == "clock" and not self._was_set:
            self._was_set = True
            text = "the clock of the computer was set while it recorded; the arrival times go on evenly, as it was at first"
            self.warnings.append(f"{self._recording.path}: {text}")
        return is_interruption


def _damage(recording: Recording) -> str:
    """Where a recording is damaged, and how much of it was not read."""
    lost = f"{recording.leftover} bytes were not read"
    if recording.salvage:
        return _passed_over(str(recording.path), recording.damaged, recording.leftover)
    if recording.is_cut:
        return f"{recording.path} is cut off in its last record: {lost}, everything before them was"
    mending = f"lidarspec record {quote(str(recording.path))} --salvage -o mended.lsr"
    return f"{recording.path} is damaged at byte {recording.offset}: {lost}; next: {mending}"


def _passed_over(path: str, places: int, size: int) -> str:
    """How much of a file was not read between what was."""
    return f"{path} is damaged in {places} place{'s' * (places > 1)}: {size} bytes were not read, everything else was"


class FileTransport(Transport):
    """The bytes of a file as they are, or standard input for "-".

    Attributes:
        file: the open file.
    """

    def __init__(self, path: str, file: BinaryIO) -> None:
        self._path, self.file = path, file
        self.warnings: list[str] = []

    @property
    def can_go_on(self) -> bool:
        """Whether another one can begin where this one stands: of bytes as they are, and batches of a capture."""
        return type(self) in (FileTransport, CaptureTransport) and self.file.seekable()

    def chunks(self) -> Iterator[Chunk]:
        with system_errors(self._path):
            while block := self.file.read(BLOCK):
                yield Chunk(block)

    def write(self, data: bytes) -> None:
        raise SourceError(f"{self._path} is a file: nothing can be sent to it")

    def close(self) -> None:
        if self.file is not sys.stdin.buffer:
            self.file.close()

    def _warn(self, stats: CaptureStats) -> None:
        """Take down what a capture does not hold whole."""
        self.unread = stats.lost
        if stats.damaged:
            self.warnings.append(_passed_over(self._path, stats.damaged, stats.lost))
        if stats.truncated_tail:
            self.warnings.append(f"{self._path} is cut off in its last record; everything before it was read")
        if stats.snapped:
            self.warnings.append(f"{self._path}: {stats.snapped} packets were cut by the capture's snap length")
        if stats.other > stats.datagrams:
            kinds = ", ".join(f"{number} {what}" for what, number in stats.others.most_common())
            self.warnings.append(f"{self._path}: {stats.other} of {stats.packets} packets are no UDP over IP, and were not read: {kinds}")
        if not stats.packets:
            self.warnings.append(f"{self._path} is a capture without a packet")
        if stats.incomplete_fragments:
            self.warnings.append(
                f"{self._path}: {stats.incomplete_fragments} IP fragments were left out, others of their datagrams are missing"
            )
        if contradicting := stats.malformed - stats.damaged:
            self.warnings.append(f"{self._path}: {contradicting} packets were left out, since their headers contradict themselves")


class HexTransport(FileTransport):
    """Bytes written as hexadecimal text, in any way that `unhexed` reads; lines without digits are passed over."""

    def chunks(self) -> Iterator[Chunk]:
        return hex_chunks(self._path, self.file.readline)


def hex_chunks(name: str, readline: Callable[[int], bytes]) -> Iterator[Chunk]:
    """The bytes of hexadecimal text, a chunk for each line; one that is longer than a block comes in several.

    Args:
        name: of the file, for messages.
        readline: the next line, or so many bytes of it.

    Raises:
        WireError: where something else is in it.
    """
    text, goes_on, number = "", "", 1
    while (block := readline(BLOCK)) or text:
        text += block.decode("ascii", "replace")
        end = len(text) if len(block) < BLOCK or block.endswith(b"\n") else between(text)
        try:
            yield Chunk(unhexed(goes_on + text[:end]))
        except ValueError as error:
            raise WireError(f"{name}, line {number}: not hexadecimal: {error}") from None
        if block.endswith(b"\n"):
            goes_on, number = "", number + 1
        else:  # so does a comment in the line; an offset is at its beginning alone
            goes_on = "#" if _COMMENT.search(goes_on + text[:end]) else ","
        text = text[end:]


def between(text: str) -> int:
    """Where hexadecimal text can be cut: behind or before its last mark, else between two bytes."""
    return max(*(text.rfind(mark) + 1 for mark in " \t\n,;:{}"), *(text.rfind(mark) for mark in "\\/#")) or len(text) // 2 * 2


def unhexed(text: str) -> bytes:
    """The bytes that hexadecimal text stands for, as people print it: "54 2c", "542c", "54:2c", "0x54, 0x2C", "{0x54,0x2c};", "\\x54".

    "#" and "//" begin a comment, which goes to the end of the line; a first column of three digits or more and ":" is an offset.

    Raises:
        ValueError: where something else is in it, or a word makes no whole bytes.
    """
    words = _BETWEEN.split(_BESIDE.sub("", text).replace("\\x", " "))
    return b"".join(_whole_bytes(word) for word in words if word)


def _whole_bytes(word: str) -> bytes:
    digits = word.removeprefix("0x").removeprefix("0X")
    if bad := _NO_DIGIT.search(digits):
        raise ValueError(f"{bad[0]!r} is no digit of it")
    if len(digits) == 1 and digits != word:
        digits = f"0{digits}"
    if not digits or len(digits) % 2:
        raise ValueError(f"{word[:QUOTED]!r}{' ...' * (len(word) > QUOTED)} makes no whole bytes")
    return bytes.fromhex(digits)


class CaptureTransport(FileTransport):
    """The UDP datagrams of a pcap or pcapng file.

    Attributes:
        reader: what `batches` comes from, once it has begun.
    """

    datagrams = True

    def __init__(self, path: str, file: BinaryIO, *, sender: str | None = None) -> None:
        super().__init__(path, file)
        self._origin = None if sender is None else origin(sender)
        self.reader: CaptureBatches | None = None

    def chunks(self) -> Iterator[Chunk]:
        reader = CaptureReader(self.file)
        for datagram in reader:
            if self._origin is not None and datagram.source not in self._origin:
                self.foreign += 1
                continue
            yield Chunk(datagram.data, datagram.at, datagram.source, datagram.destination)
        self._warn(reader.stats)

    def batches(self) -> Iterator[Batch]:
        """The datagrams of the capture, many at a time, as arrays.

        Raises:
            SourceError: where the file cannot be read.
        """
        reader = self.reader = self.reader or CaptureBatches(self.file)
        for batch in reader.batches():
            mine = batch if self._origin is None else batch.of(self._origin)
            self.foreign += len(batch) - len(mine)
            if len(mine):
                yield mine
        self._warn(reader.stats)


class StreamCaptureTransport(FileTransport):
    """The bytes of a capture of a byte stream, packet by packet."""

    def chunks(self) -> Iterator[Chunk]:
        reader = StreamReader(self.file)
        yield from (Chunk(packet.data, packet.at or None) for packet in reader)
        self._warn(reader.stats)


def refuse_container(path: str, head: bytes) -> None:
    """Nothing, for a file that is read as the bytes it holds.

    Args:
        head: its first `HEAD` bytes, or all.

    Raises:
        SourceError: where it begins as a file of another kind, which is named.
    """
    for beginning, (what, command) in CONTAINERS.items():
        if re.match(beginning, head, re.DOTALL):
            error = SourceError(f"{path} is {what}, and is not read: this takes captures, recordings and bytes as a sensor sent them")
            raise suggest(error, command.format(quote(path))) if command and os.path.exists(path) else error


def open_file(path: str, *, sender: str | None = None) -> FileTransport | RecordingTransport | BagTransport:
    """The transport for a file, by what it holds; "-" is standard input, which is told by its beginning too; a folder is a bag's.

    Raises:
        SourceError: where it cannot be opened, or is a file of another kind, such as an archive.
        UsageError: where a library is missing that reads it.
    """
    if (log := log_of(path)) is not None:
        return BagTransport(path, log, sender=sender)
    with system_errors(path), contextlib.ExitStack() as undo:
        file = sys.stdin.buffer if path == "-" else undo.enter_context(contextlib.closing(opened(path)))
        head = _head(file)
        path = "standard input" if path == "-" else path
        log = log_of(path, head)
        if log is not None and file is sys.stdin.buffer:
            raise SourceError(f"{path} is {log.what}, and is not read: give its file")
        refuse_container(path, head)
        if log is not None and is_stored(path):
            raise SourceError(f"{path} is {log.what}, which is read from this computer alone: copy it here")
        if log is not None:
            return BagTransport(path, log, sender=sender)
        undo.pop_all()  # the transport closes it
    if head.startswith(MAGIC):
        if file is not sys.stdin.buffer:
            file.close()
        return RecordingTransport("-" if file is sys.stdin.buffer else path, sender=sender)
    if is_stream_capture(head):
        return StreamCaptureTransport(path, file)
    if is_capture(head):
        return CaptureTransport(path, file, sender=sender)
    return HexTransport(path, file) if Path(path).suffix in (".hex", ".txt") else FileTransport(path, file)


def _head(file: BinaryIO) -> bytes:
    """How a file begins; of a pipe what is there first, which stays there."""
    if isinstance(file, io.BufferedReader):
        return file.peek(HEAD)[:HEAD]
    head = file.read(HEAD)
    file.seek(-len(head), os.SEEK_CUR)
    return head
