"""Files and standard input as transports: recordings, captures, logs (see `bags`), raw bytes,
hexadecimal text.

A file ends, and is read as fast as it is asked for. Recordings and captures give what was received
at the times of then, and count what they leave out; bytes alone have no times. `open_file` tells
them apart by what they hold.
"""

from __future__ import annotations

import contextlib
import json
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import BinaryIO

from lidarspec.captures.bulk import Batch, CaptureBatches, StreamBatches
from lidarspec.captures.containers import HEAD, damage, head, opened, refuse_container, unpacked
from lidarspec.captures.pcap import CaptureStats, is_stream_capture
from lidarspec.captures.records import is_capture
from lidarspec.errors import SourceError, UnknownSensor, UsageError, system_errors
from lidarspec.recording.format import MAGIC, Header, Record, Recording
from lidarspec.spec.sensor import Sensor
from lidarspec.stores import file_of, is_stored
from lidarspec.transports.addresses import parse_origin
from lidarspec.transports.bags import BagTransport, log_of
from lidarspec.transports.hexadecimal import hex_chunks, is_hexadecimal
from lidarspec.transports.protocol import Chunk, Transport

#: events behind which a frame begun earlier does not go on.
INTERRUPTIONS = frozenset({"disconnect", "reconnect", "dropped"})
#: bytes read at once.
BLOCK = 1 << 18
#: suffixes of text: of hexadecimal digits, and of what may be that or not.
HEX_SUFFIXES = {".hex", ".txt"}
TEXT_SUFFIXES = {".log", ".csv", ".asc"}


class RecordingTransport(Transport):
    """What was received, as it arrived; commands that were sent and events are passed over, and
    leave their gap.

    Args:
        path: the file.
        file: it, where it is open already.
        sender: only datagrams from this address, or "ADDRESS:PORT".
        salvage: go on behind damaged places.

    Attributes:
        header: what the recording says of itself.
    """

    def __init__(
        self,
        path: str,
        file: BinaryIO | None = None,
        *,
        sender: str | None = None,
        salvage: bool = False,
    ) -> None:
        self._file = file or (sys.stdin.buffer if path == "-" else opened(path))
        self._recording = Recording(path, self._file, salvage=salvage)
        self.header: Header = self._recording.header
        self.datagrams = self.header.datagrams
        if sender is None:
            self._origin = None
        else:
            self._origin = parse_origin(sender)
        self.warnings: list[str] = []
        self._no_events = 0
        self._was_set = False
        self._has_skipped = False

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
        interrupted = False
        damaged = 0
        for record in self._recording:
            interrupted = interrupted or self._has_skipped or self._recording.damaged > damaged
            damaged = self._recording.damaged
            self._has_skipped = False
            if record.direction == "event":
                interrupted = self._interrupts(record) or interrupted
            elif record.direction == "in" and self._wanted(record):
                yield Chunk(
                    record.data,
                    record.at,
                    record.sender,
                    record.receiver,
                    interrupted or record.gap,
                    record.quiet,
                )
                interrupted = False
        if _is_whole(self, self._file) and self._recording.damaged:
            self.warnings.append(_damage(self._recording))
            if self._recording.is_cut:
                self.unread = 0
            else:
                self.unread = self._recording.leftover
        if self._no_events:
            self.warnings.append(
                f"{self._recording.path}: {self._no_events} events were passed over, which have no"
                " name"
            )

    def skip(self, at: int) -> bool:
        self._has_skipped = self._recording.seek(at)
        return self._has_skipped

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
        """Whether an event says that the line was interrupted; counts disconnects, and takes down
        that the clock was set.
        """
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
            text = (
                "the clock of the computer was set while it recorded; the arrival times go on"
                " evenly, as it was at first"
            )
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
    return (
        f"{path} is damaged in {places} place{'s' * (places > 1)}: {size} bytes were not read,"
        " everything else was"
    )


def _is_whole(transport: FileTransport | RecordingTransport, file: BinaryIO) -> bool:
    """Whether a file that was unpacked ended as it should; its transport takes down where it did
    not.
    """
    fault = damage(file)
    if fault is not None:
        transport.warnings.append(fault.text)
        transport.unread += fault.unread
    return fault is None


class FileTransport(Transport):
    """The bytes of a file as they are, or standard input for "-".

    Attributes:
        file: the open file.
    """

    def __init__(self, path: str, file: BinaryIO) -> None:
        self._path = path
        self.file = file
        self.warnings: list[str] = []

    @property
    def can_go_on(self) -> bool:
        """Whether another one can begin where this one stands: of bytes as they are, and batches of
        a capture.
        """
        return (
            type(self) in (FileTransport, CaptureTransport, StreamCaptureTransport)
            and self.file.seekable()
        )

    def chunks(self) -> Iterator[Chunk]:
        with system_errors(self._path):
            while block := self.file.read(BLOCK):
                yield Chunk(block)
        _is_whole(self, self.file)

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
        if _is_whole(self, self.file) and stats.truncated_tail:
            self.warnings.append(
                f"{self._path} is cut off in its last record; everything before it was read"
            )
        if stats.snapped:
            self.warnings.append(
                f"{self._path}: {stats.snapped} packets were cut by the capture's snap length"
            )
        if stats.other > stats.datagrams:
            self.warnings.append(
                f"{self._path}: {stats.other} of {stats.packets} packets are no UDP over IP, and"
                f" were not read: {_list_counts(stats.others)}"
            )
        if stats.unsupported:
            self.warnings.append(
                f"{self._path}: {stats.unsupported.total()} of {stats.packets} packets have an"
                f" unsupported link layer, and were not read: {_list_counts(stats.unsupported)};"
                " next: editcap -C BYTES -T rawip IN.pcap OUT.pcap, which removes the BYTES before"
                " the IP header"
            )
        if not stats.packets:
            self.warnings.append(f"{self._path} is a capture without a packet")
        if stats.incomplete_fragments:
            self.warnings.append(
                f"{self._path}: {stats.incomplete_fragments} IP fragments were left out, others of"
                " their datagrams are missing"
            )
        if contradicting := stats.malformed - stats.damaged:
            self.warnings.append(
                f"{self._path}: {contradicting} packets were left out, since their headers"
                " contradict themselves"
            )


def _list_counts(counts: Counter[str]) -> str:
    return ", ".join(f"{number} {name}" for name, number in counts.most_common())


class HexTransport(FileTransport):
    """Bytes written as hexadecimal text, at the times that it tells; lines without digits are
    passed over.
    """

    def chunks(self) -> Iterator[Chunk]:
        yield from hex_chunks(self._path, self.file.readline)
        _is_whole(self, self.file)


class CaptureTransport(FileTransport):
    """The UDP datagrams of a pcap or pcapng file.

    Attributes:
        reader: what `chunks` or `batches` come from, once one of them has begun.
    """

    datagrams = True
    in_batches: type[CaptureBatches] = CaptureBatches

    def __init__(self, path: str, file: BinaryIO, *, sender: str | None = None) -> None:
        super().__init__(path, file)
        if sender is None:
            self._origin = None
        else:
            self._origin = parse_origin(sender)
        self.reader: CaptureBatches | None = None
        self._has_skipped = False

    def chunks(self) -> Iterator[Chunk]:
        reader = self.reader = self.in_batches(self.file)
        for datagram in reader:
            if self._origin is not None and datagram.source not in self._origin:
                self.foreign += 1
                continue
            yield Chunk(
                datagram.data, datagram.at, datagram.source, datagram.destination, self._gap()
            )
        self._warn(reader.stats)

    def batches(self) -> Iterator[Batch]:
        """The datagrams of the capture, many at a time, as arrays.

        Raises:
            SourceError: where the file cannot be read.
        """
        reader = self.reader = self.reader or self.in_batches(self.file)
        for batch in reader.batches():
            if self._origin is None:
                mine = batch
            else:
                mine = batch.of(self._origin)
            self.foreign += len(batch) - len(mine)
            if len(mine):
                yield replace(mine, gap=True) if self._gap() else mine
        self._warn(reader.stats)

    def skip(self, at: int) -> bool:
        with system_errors(self._path):
            self._has_skipped = self.reader is not None and self.reader.skip(at)
        return self._has_skipped

    def _gap(self) -> bool:
        """Whether something was passed over, once."""
        gap = self._has_skipped
        self._has_skipped = False
        return gap


class StreamCaptureTransport(CaptureTransport):
    """The bytes of a capture of a byte stream, packet by packet."""

    datagrams = False
    in_batches = StreamBatches

    def chunks(self) -> Iterator[Chunk]:
        reader = self.reader = self.in_batches(self.file)
        yield from (Chunk(packet.data, packet.at or None, gap=self._gap()) for packet in reader)
        self._warn(reader.stats)


def open_file(
    path: str, *, sender: str | None = None, member: str = ""
) -> FileTransport | RecordingTransport | BagTransport:
    """The transport for a file, by what it holds; "-" is standard input, which is told by its
    beginning too; a folder is a bag's.

    Args:
        sender: only what comes from this address, or topic.
        member: which file of a zip archive; "" for the one capture or recording in it.

    Raises:
        SourceError: where it cannot be opened, or is a file of another kind.
        UsageError: where a library is missing that reads it, and for an archive of several
            captures.
    """
    if (log := log_of(path)) is not None:
        return BagTransport(path, log, sender=sender)
    name = "standard input" if path == "-" else path
    with system_errors(path), contextlib.ExitStack() as undo:
        if path == "-":
            plain = sys.stdin.buffer
        else:
            plain = undo.enter_context(contextlib.closing(file_of(path)))
        file = unpacked(name, plain, member)
        start = head(file)
        log = log_of(path, start)
        if log is not None and (file is not plain or path == "-"):
            raise SourceError(
                f"{name} is {log.what}{' in a compressed file' * (file is not plain)}, and is not"
                " read: give the file itself"
            )
        refuse_container(name, start)
        if log is not None and is_stored(path):
            raise SourceError(
                f"{path} is {log.what}, which is read from this computer alone: copy it here"
            )
        if log is not None:
            return BagTransport(path, log, sender=sender)
        undo.pop_all()  # the transport closes it
    found = _by_content(path, name, file, start, sender)
    found.stored = plain
    return found


def _by_content(
    path: str, name: str, file: BinaryIO, start: bytes, sender: str | None
) -> FileTransport | RecordingTransport:
    """The transport for what a file begins with."""
    if start.startswith(MAGIC):
        return RecordingTransport(path, file, sender=sender)
    if is_stream_capture(start):
        return StreamCaptureTransport(name, file)
    if is_capture(start):
        return CaptureTransport(name, file, sender=sender)
    suffixes = set(Path(path.lower()).suffixes[-2:])  # that of a compressed file is behind it
    is_text = suffixes & HEX_SUFFIXES or (
        suffixes & TEXT_SUFFIXES and is_hexadecimal(start, whole=len(start) < HEAD)
    )
    if is_text:
        return HexTransport(name, file)
    return FileTransport(name, file)
