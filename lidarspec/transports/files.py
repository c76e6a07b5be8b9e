"""Transports for files and standard input.

`open_file` detects the format of a file by its content: a recording, a capture, a robotics log,
hexadecimal text or raw bytes. A file is read as fast as the caller requests chunks. Chunks have the
recorded arrival times; raw bytes have no times.
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

from lidarspec.captures.bulk import CaptureBatches, CapturedDatagrams, StreamBatches
from lidarspec.captures.containers import (
    HEAD_BYTES,
    find_damage,
    open_capture,
    peek_head,
    refuse_unsupported_file,
    unpack,
)
from lidarspec.captures.pcap import CaptureStats, is_stream_capture
from lidarspec.captures.records import is_capture
from lidarspec.errors import SourceError, UnknownSensor, UsageError, system_errors
from lidarspec.recording.format import MAGIC, Header, Record, Recording
from lidarspec.remote_files import is_remote, open_stored
from lidarspec.sensor_operations import Sensor
from lidarspec.transports.addresses import parse_origin
from lidarspec.transports.hex_text import is_hexadecimal, iter_hex_chunks
from lidarspec.transports.protocol import Chunk, Transport
from lidarspec.transports.robotics_logs import BagTransport, find_log_kind

#: Events that interrupt the stream. An incomplete frame before such an event is discarded.
INTERRUPTIONS = frozenset({"disconnect", "reconnect", "dropped"})
#: Number of bytes that are read at once.
BLOCK_BYTES = 1 << 18
#: Suffixes of hexadecimal text.
HEX_SUFFIXES = {".hex", ".txt"}
#: Suffixes of files that are read as hexadecimal text only if their content is hexadecimal.
TEXT_SUFFIXES = {".log", ".csv", ".asc"}


class RecordingTransport(Transport):
    """Reads the received data of a recording.

    Sent data is skipped. The first chunk after an interruption has `gap` set.

    Args:
        file: the open file; None to open `path`.
        sender: yield only datagrams from this "ADDRESS" or "ADDRESS:PORT"; None for all senders.
        salvage: whether to continue after damaged parts.
    """

    def __init__(
        self,
        path: str,
        file: BinaryIO | None = None,
        *,
        sender: str | None = None,
        salvage: bool = False,
    ) -> None:
        self._file = file or (sys.stdin.buffer if path == "-" else open_capture(path))
        self._recording = Recording(path, self._file, salvage=salvage)
        self.header: Header = self._recording.header
        self.datagrams = self.header.datagrams
        if sender is None:
            self._origin = None
        else:
            self._origin = parse_origin(sender)
        self.warnings: list[str] = []
        self._invalid_events = 0
        self._has_clock_warning = False
        self._has_skipped = False

    def known_sensor(self) -> Sensor:
        """Return the sensor of the recording, configured with the recorded options.

        Raises:
            UsageError: if the recording names no sensor, or if an option cannot be restored.
        """
        try:
            return self.header.known_sensor(Path(self._recording.path).parent)
        except UnknownSensor:
            raise
        except UsageError as error:
            raise UsageError(f"{self._recording.path}: {error}") from None

    def chunks(self) -> Iterator[Chunk]:
        """Yield the received data in order, with the recorded arrival times."""
        interrupted = False
        damaged = 0
        for record in self._recording:
            interrupted = interrupted or self._has_skipped or self._recording.damaged > damaged
            damaged = self._recording.damaged
            self._has_skipped = False
            if record.direction == "event":
                interrupted = self._count_event(record) or interrupted
            elif record.direction == "in" and self._accepts(record):
                yield Chunk(
                    record.data,
                    record.at,
                    record.sender,
                    record.receiver,
                    interrupted or record.gap,
                    record.quiet,
                )
                interrupted = False
        if _check_end(self, self._file) and self._recording.damaged:
            self.warnings.append(_describe_damage(self._recording))
            if self._recording.is_cut:
                self.unread = 0
            else:
                self.unread = self._recording.leftover
        if self._invalid_events:
            self.warnings.append(
                f"{self._recording.path}: {self._invalid_events} events without a name were ignored"
            )

    def skip_until(self, time_ns: int) -> bool:
        self._has_skipped = self._recording.seek(time_ns)
        return self._has_skipped

    def write(self, data: bytes) -> None:
        raise SourceError(f"{self._recording.path} is a recording, so nothing can be sent to it")

    def close(self) -> None:
        self._recording.close()

    def _accepts(self, record: Record) -> bool:
        """Return whether a record is from the requested sender.

        Records from other senders are counted in `foreign`.
        """
        if self._origin is None or record.sender in self._origin:
            return True
        self.foreign += 1
        return False

    def _count_event(self, record: Record) -> bool:
        """Count the event in a record, and return whether the event interrupts the stream."""
        try:
            event = json.loads(record.data)
            name = event["event"]
            self.disconnects += name == "disconnect"
            is_interruption = name in INTERRUPTIONS
        except (ValueError, RecursionError, TypeError, KeyError):
            self._invalid_events += 1
            return False
        if name == "clock" and not self._has_clock_warning:
            self._has_clock_warning = True
            text = (
                "the clock of the computer was stepped during the recording; arrival times continue"
                " without this step"
            )
            self.warnings.append(f"{self._recording.path}: {text}")
        return is_interruption


def _describe_damage(recording: Recording) -> str:
    """Return a warning with the offset of the damage and the number of unread bytes."""
    lost = f"{recording.leftover} bytes were not read"
    if recording.salvage:
        return _describe_skipped(str(recording.path), recording.damaged, recording.leftover)
    if recording.is_cut:
        return f"{recording.path} is truncated in its last record: {lost}"
    repair = f"lidarspec record {quote(str(recording.path))} --salvage -o repaired.lsr"
    return f"{recording.path} is corrupt at byte {recording.offset}: {lost}; next: {repair}"


def _describe_skipped(path: str, count: int, size: int) -> str:
    """Return a warning with the number of damaged places and of unread bytes."""
    return f"{path} is corrupt in {count} place{'s' * (count > 1)}: {size} bytes were not read"


def _check_end(transport: FileTransport | RecordingTransport, file: BinaryIO) -> bool:
    """Return whether a compressed file was decompressed to its end; warn if not."""
    fault = find_damage(file)
    if fault is not None:
        transport.warnings.append(fault.text)
        transport.unread += fault.unread
    return fault is None


class FileTransport(Transport):
    """Reads the raw bytes of a file or of standard input."""

    def __init__(self, path: str, file: BinaryIO) -> None:
        self._path = path
        self.file = file
        self.warnings: list[str] = []

    @property
    def can_resume(self) -> bool:
        """Whether another transport can continue reading at the current offset."""
        return (
            type(self) in (FileTransport, CaptureTransport, StreamCaptureTransport)
            and self.file.seekable()
        )

    def chunks(self) -> Iterator[Chunk]:
        with system_errors(self._path):
            while block := self.file.read(BLOCK_BYTES):
                yield Chunk(block)
        _check_end(self, self.file)

    def write(self, data: bytes) -> None:
        raise SourceError(f"{self._path} is a file, so nothing can be sent to it")

    def close(self) -> None:
        if self.file is not sys.stdin.buffer:
            self.file.close()

    def _warn(self, stats: CaptureStats) -> None:
        """Add a warning for each kind of unread data in a capture."""
        self.unread = stats.lost
        if stats.damaged:
            self.warnings.append(_describe_skipped(self._path, stats.damaged, stats.lost))
        if _check_end(self, self.file) and stats.truncated_tail:
            self.warnings.append(
                f"{self._path} is truncated in its last record; all earlier records were read"
            )
        if stats.snapped:
            self.warnings.append(
                f"{self._path}: {stats.snapped} packets were truncated by the snap length of"
                " the capture"
            )
        if stats.other > stats.datagrams:
            self.warnings.append(
                f"{self._path}: {stats.other} of {stats.packets} packets are not UDP over IP"
                f" and were not read: {_list_counts(stats.others)}"
            )
        if stats.unsupported:
            self.warnings.append(
                f"{self._path}: {stats.unsupported.total()} of {stats.packets} packets have an"
                " unsupported link layer and were not read:"
                f" {_list_counts(stats.unsupported)}; next: editcap -C BYTES -T rawip IN.pcap"
                " OUT.pcap, which removes the BYTES before the IP header"
            )
        if not stats.packets:
            self.warnings.append(f"{self._path} is a capture without packets")
        if stats.incomplete_fragments:
            self.warnings.append(
                f"{self._path}: {stats.incomplete_fragments} IP fragments were ignored,"
                " because other fragments of their datagrams are missing"
            )
        if contradicting := stats.malformed - stats.damaged:
            self.warnings.append(
                f"{self._path}: {contradicting} packets were ignored, because their headers"
                " are inconsistent"
            )


def _list_counts(counts: Counter[str]) -> str:
    return ", ".join(f"{number} {name}" for name, number in counts.most_common())


class HexTransport(FileTransport):
    """Reads hexadecimal text, which may also contain times."""

    def chunks(self) -> Iterator[Chunk]:
        yield from iter_hex_chunks(self._path, self.file.readline)
        _check_end(self, self.file)


class CaptureTransport(FileTransport):
    """Reads the UDP datagrams of a pcap or pcapng file."""

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
                datagram.data, datagram.at, datagram.source, datagram.destination, self._take_gap()
            )
        self._warn(reader.stats)

    def batches(self) -> Iterator[CapturedDatagrams]:
        """Yield the datagrams of the capture in batches of arrays.

        Raises:
            SourceError: if the file cannot be read.
        """
        reader = self.reader = self.reader or self.in_batches(self.file)
        for batch in reader.batches():
            if self._origin is None:
                mine = batch
            else:
                mine = batch.select_sender(self._origin)
            self.foreign += len(batch) - len(mine)
            if len(mine):
                yield replace(mine, gap=True) if self._take_gap() else mine
        self._warn(reader.stats)

    def skip_until(self, time_ns: int) -> bool:
        with system_errors(self._path):
            self._has_skipped = self.reader is not None and self.reader.skip_until(time_ns)
        return self._has_skipped

    def _take_gap(self) -> bool:
        """Return whether data was skipped since the last call."""
        gap = self._has_skipped
        self._has_skipped = False
        return gap


class StreamCaptureTransport(CaptureTransport):
    """Reads the capture of a byte stream; each packet is a chunk."""

    datagrams = False
    in_batches = StreamBatches

    def chunks(self) -> Iterator[Chunk]:
        reader = self.reader = self.in_batches(self.file)
        yield from (
            Chunk(packet.data, packet.at or None, gap=self._take_gap()) for packet in reader
        )
        self._warn(reader.stats)


def open_file(
    path: str, *, sender: str | None = None, member: str = ""
) -> FileTransport | RecordingTransport | BagTransport:
    """Open a file, and return the transport for its format.

    Args:
        path: a file, "-" for standard input, or the folder of a ROS 2 bag.
        sender: yield only data from this address or topic; None for all data.
        member: name of a file in a zip archive; "" if the archive has only one capture or
            recording.

    Raises:
        SourceError: if the file cannot be opened, or its format is not supported.
        UsageError: if a required library is missing, or an archive contains several captures.
    """
    if (log := find_log_kind(path)) is not None:
        return BagTransport(path, log, sender=sender)
    name = "standard input" if path == "-" else path
    with system_errors(path), contextlib.ExitStack() as undo:
        if path == "-":
            plain = sys.stdin.buffer
        else:
            plain = undo.enter_context(contextlib.closing(open_stored(path)))
        file = unpack(name, plain, member)
        start = peek_head(file)
        log = find_log_kind(path, start)
        if log is not None and (file is not plain or path == "-"):
            raise SourceError(
                f"{name} is {log.description}{' in a compressed file' * (file is not plain)}:"
                " pass the path of an uncompressed file"
            )
        refuse_unsupported_file(name, start)
        if log is not None and is_remote(path):
            raise SourceError(
                f"{path} is {log.description}, which can only be read from a local file: copy"
                " it to this computer"
            )
        if log is not None:
            return BagTransport(path, log, sender=sender)
        undo.pop_all()  # the transport closes the file
    opened_transport = _open_by_content(path, name, file, start, sender)
    opened_transport.stored = plain
    return opened_transport


def _open_by_content(
    path: str, name: str, file: BinaryIO, start: bytes, sender: str | None
) -> FileTransport | RecordingTransport:
    """Return the transport for an open file that begins with the bytes `start`."""
    if start.startswith(MAGIC):
        return RecordingTransport(path, file, sender=sender)
    if is_stream_capture(start):
        return StreamCaptureTransport(name, file)
    if is_capture(start):
        return CaptureTransport(name, file, sender=sender)
    suffixes = set(Path(path.lower()).suffixes[-2:])  # compression adds a second suffix
    is_text = suffixes & HEX_SUFFIXES or (
        suffixes & TEXT_SUFFIXES and is_hexadecimal(start, whole=len(start) < HEAD_BYTES)
    )
    if is_text:
        return HexTransport(name, file)
    return FileTransport(name, file)
