"""What a source is recorded in, by the suffix of the file: .lsr holds everything, .pcap packets for Wireshark, .bin the bytes alone."""

from __future__ import annotations

import io
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from lidarspec.captures.pcap import NOBODY, USER_LINKS, Datagram, PcapWriter, is_capture
from lidarspec.errors import UnknownFormat, UsageError
from lidarspec.framing.results import Found
from lidarspec.plugins import sensor as named_sensor
from lidarspec.recording.appending import Appender
from lidarspec.recording.recordings import Recorder
from lidarspec.spec.sensor import Sensor
from lidarspec.transports.protocol import Chunk, Transport

SUFFIXES = (".lsr", ".pcap", ".bin")
#: bytes between frames that make one packet at most.
LARGEST_GAP = 1 << 16
_HEAD, _RECORD = 24, 16


class PcapRecorder(Appender):
    """Writes the datagrams that are received as a capture that Wireshark opens; otherwise as a `Recorder`.

    Args:
        path: the file, new unless `overwrite`.
        port: that datagrams went to where they do not say it.
    """

    def __init__(self, path: str | Path, *, port: int = 0, overwrite: bool = False) -> None:
        self._made, self._receiver = io.BytesIO(), (NOBODY[0], port)
        self._writer = PcapWriter(self._made)
        super().__init__(path, _whole_packets, overwrite=overwrite)
        self._put(_taken_out(self._made))

    def write(self, chunk: Chunk, direction: Literal["in", "out"] = "in") -> None:
        """Take a datagram that was received; one that was sent is none of the sensor's, and is left out.

        Raises:
            UsageError: for addresses that are not IPv4.
        """
        if direction == "in":
            self._writer.write(Datagram(chunk.data, chunk.at or 0, chunk.sender or NOBODY, chunk.receiver or self._receiver))
            self._put(_taken_out(self._made), len(chunk.data))

    def event(self, name: str, at: int | None = None, **details: Any) -> None:
        """A capture has no place for events."""


class FrameRecorder(Appender):
    """Writes a byte stream as a capture with one packet for each frame, link type USER0; otherwise as a `Recorder`.

    What is no frame becomes packets too, so that they hold every byte that was received, in order.

    Args:
        path: the file, new unless `overwrite`.
        sensor: whose frames they are.
    """

    def __init__(self, path: str | Path, sensor: Sensor, *, overwrite: bool = False) -> None:
        self._made, self._decoder = io.BytesIO(), sensor.decoder(stream=True)
        self._held, self._base, self._at = bytearray(), 0, 0
        self._writer = PcapWriter(self._made, USER_LINKS[0])
        super().__init__(path, _whole_packets, overwrite=overwrite)
        self._put(_taken_out(self._made))

    def write(self, chunk: Chunk, direction: Literal["in", "out"] = "in") -> None:
        """Take bytes that were received; those that were sent are left out."""
        if direction == "in":
            self._at = chunk.at or self._at
            if chunk.gap:
                self._cut(self._decoder.idle())
            self._held += chunk.data
            self._cut(self._decoder.feed(chunk.data, self._at))

    def event(self, name: str, at: int | None = None, **details: Any) -> None:
        """A capture has no place for events."""

    def _cut(self, found: list[Found]) -> None:
        """Write the frames found, and what lies before them and is none; keep what waits for more."""
        for item in found:
            self._skip(item.offset - self._base)
            self._packet(len(item.data), item.at or self._at)
        self._skip(len(self._held) - self._decoder.stats.pending)

    def _skip(self, size: int) -> None:
        while size > 0:
            part = min(size, LARGEST_GAP)
            self._packet(part, self._at)
            size -= part

    def _packet(self, size: int, at: int) -> None:
        self._writer.packet(bytes(self._held[:size]), at)
        del self._held[:size]
        self._base += size
        self._put(_taken_out(self._made), size)

    def _finish(self) -> None:
        if not self._closing:
            self._cut(self._decoder.finish())
        super()._finish()


class RawRecorder(Appender):
    """Writes the bytes that are received, and nothing else; otherwise as a `Recorder`."""

    def __init__(self, path: str | Path, *, overwrite: bool = False) -> None:
        super().__init__(path, lambda data, limit: limit, overwrite=overwrite)

    def write(self, chunk: Chunk, direction: Literal["in", "out"] = "in") -> None:
        """Take bytes that were received."""
        if direction == "in":
            self._put(chunk.data, len(chunk.data))

    def event(self, name: str, at: int | None = None, **details: Any) -> None:
        """Bytes alone have no place for events."""


AnyRecorder = Recorder | PcapRecorder | FrameRecorder | RawRecorder
#: a file, a recorder, or what makes one when the source is open.
RecordTo = str | Path | AnyRecorder | Callable[[Transport], AnyRecorder]


def check_suffix(path: str | Path) -> str:
    """The suffix of a file to record in.

    Raises:
        UnknownFormat: where it is none that can be recorded in.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise UnknownFormat(suffix or str(path), SUFFIXES, place=str(path))
    return suffix


def recorder(
    path: str | Path,
    sensor: Sensor | str | None = None,
    source: str | Path = "",
    *,
    datagrams: bool,
    baud: int | None = None,
    port: int = 0,
    overwrite: bool = False,
) -> AnyRecorder:
    """The recorder for a file, by its suffix; arguments as of `Recorder`, `PcapRecorder` and `FrameRecorder`.

    Raises:
        UnknownFormat: for a suffix that is none of them.
        UsageError: where the file exists, or cannot hold what the source gives.
        SourceError: where it cannot be made.
    """
    suffix = check_suffix(path)
    if suffix == ".pcap" and not datagrams:
        if not sensor:
            raise UsageError(f"{path}: a capture of a byte stream has a packet for each frame: name the sensor with -s, or record an .lsr")
        return FrameRecorder(path, sensor if isinstance(sensor, Sensor) else named_sensor(sensor), overwrite=overwrite)
    if suffix == ".bin" and datagrams:
        raise UsageError(f"{path}: bytes alone do not say where a datagram ends: record datagrams in an .lsr or .pcap file")
    if suffix == ".lsr":
        return Recorder(path, sensor, source, datagrams=datagrams, baud=baud, overwrite=overwrite)
    return PcapRecorder(path, port=port, overwrite=overwrite) if suffix == ".pcap" else RawRecorder(path, overwrite=overwrite)


def recorder_for(target: RecordTo, sensor: Sensor | str | None, source: str | Path, opened: Transport) -> tuple[AnyRecorder, bool]:
    """The recorder that a caller asks for, and whether it was made here, and has to be closed here."""
    if isinstance(target, str | Path):
        return recorder(target, sensor, source, datagrams=opened.datagrams, baud=getattr(opened, "baud", None)), True
    return (target, False) if isinstance(target, AnyRecorder) else (target(opened), True)


def _taken_out(made: io.BytesIO) -> bytes:
    """What a writer has made since it was last asked."""
    data = made.getvalue()
    made.seek(0)
    made.truncate()
    return data


def _whole_packets(data: bytes | bytearray, limit: int) -> int:
    """The bytes of those packets of a piece of a capture that end within the limit; the first piece begins with the file's header."""
    end = _HEAD if is_capture(bytes(data[:4])) else 0
    if end > limit:
        return 0
    while end + _RECORD <= limit:
        size = _RECORD + int(struct.unpack_from("<I", data, end + 8)[0])
        if size > limit - end:
            break
        end += size
    return end
