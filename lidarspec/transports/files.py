"""Files and standard input as transports: raw bytes, hex text, captures."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from lidarspec.captures.bulk import Batch, CaptureBatches
from lidarspec.captures.pcap import CaptureReader, CaptureStats, StreamReader, is_capture, is_stream_capture
from lidarspec.errors import SourceError, WireError
from lidarspec.files import Chunk
from lidarspec.transports.recordings import RecordingTransport, is_recording

#: bytes read at once.
BLOCK = 1 << 18


class FileTransport:
    """The bytes of a file as they are, or standard input for "-"."""

    datagrams = False

    def __init__(self, path: str, file: BinaryIO) -> None:
        self._path, self._file = path, file
        self.warnings: list[str] = []

    def chunks(self) -> Iterator[Chunk]:
        try:
            while block := self._file.read(BLOCK):
                yield Chunk(block)
        except OSError as error:
            raise SourceError(f"{self._path}: {error.strerror or error}") from None

    def write(self, data: bytes) -> None:
        raise SourceError(f"{self._path} is a file: nothing can be sent to it")

    def close(self) -> None:
        if self._file is not sys.stdin.buffer:
            self._file.close()


class HexTransport(FileTransport):
    """Bytes written as hexadecimal text; white space is free, "#" begins a comment, an offset column ends in ":"."""

    def chunks(self) -> Iterator[Chunk]:
        for number, line in enumerate(self._file, start=1):
            text = line.decode("ascii", "replace").partition("#")[0]
            text = text.rpartition(":")[2]
            try:
                yield Chunk(bytes.fromhex(text))
            except ValueError:
                raise WireError(f"{self._path}, line {number}: not hexadecimal: {text.strip()[:40]!r}") from None


class CaptureTransport(FileTransport):
    """The UDP datagrams of a pcap or pcapng file."""

    datagrams = True

    def __init__(self, path: str, file: BinaryIO, *, sender: str | None = None) -> None:
        super().__init__(path, file)
        self._sender = sender
        self.foreign = 0

    def chunks(self) -> Iterator[Chunk]:
        reader = CaptureReader(self._file)
        for datagram in reader:
            if self._sender is not None and datagram.source[0] != self._sender:
                self.foreign += 1
                continue
            yield Chunk(datagram.data, datagram.at, datagram.source, datagram.destination)
        self._warn(reader.stats)

    def batches(self) -> Iterator[Batch]:
        """The same datagrams as those of `chunks`, many at a time.

        Raises:
            SourceError: where the file cannot be read.
        """
        reader = CaptureBatches(self._file)
        for batch in reader.batches():
            mine = batch if self._sender is None else batch.of(self._sender)
            self.foreign += len(batch) - len(mine)
            if len(mine):
                yield mine
        self._warn(reader.stats)

    def _warn(self, stats: CaptureStats) -> None:
        if stats.truncated_tail:
            self.warnings.append(f"{self._path} is cut off in its last record; everything before it was read")
        if stats.snapped:
            self.warnings.append(f"{self._path}: {stats.snapped} packets were cut by the capture's snap length")


class StreamCaptureTransport(FileTransport):
    """The bytes of a capture of a byte stream, packet by packet."""

    def chunks(self) -> Iterator[Chunk]:
        reader = StreamReader(self._file)
        for packet in reader:
            yield Chunk(packet.data, packet.at or None)
        if reader.stats.truncated_tail:
            self.warnings.append(f"{self._path} is cut off in its last record; everything before it was read")


def open_file(path: str, *, sender: str | None = None) -> FileTransport | RecordingTransport:
    """The transport for a file, by what it holds; "-" is standard input.

    Raises:
        SourceError: where it cannot be opened.
    """
    if path == "-":
        return FileTransport("standard input", sys.stdin.buffer)
    with contextlib.ExitStack() as undo:
        try:
            file = open(path, "rb")  # noqa: SIM115  the transport closes it
            undo.callback(file.close)
            head = file.peek(24)[:24]
        except OSError as error:
            raise SourceError(f"{path}: {error.strerror or error}") from None
        undo.pop_all()
    if is_recording(head):
        file.close()
        return RecordingTransport(path, sender=sender)
    if is_stream_capture(head):
        return StreamCaptureTransport(path, file)
    if is_capture(head):
        return CaptureTransport(path, file, sender=sender)
    return HexTransport(path, file) if Path(path).suffix in (".hex", ".txt") else FileTransport(path, file)
