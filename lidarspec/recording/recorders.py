"""Recorders: write received and sent data to a file while it is captured.

The suffix of the file selects the format. A recording of lidarspec (.lsr) contains all received and
sent data with arrival times and events. A capture (.pcap, .pcapng) contains the received data as
packets that Wireshark can open. A .bin file contains only the received bytes.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

from lidarspec._version import __version__
from lidarspec.captures.ip import ETHERNET
from lidarspec.captures.pcap import UNKNOWN_ENDPOINT, USER_LINKS, Datagram, make_datagram_frame
from lidarspec.captures.records import WRITINGS
from lidarspec.errors import UnknownFormat, UsageError
from lidarspec.framing.decoder import Decoder
from lidarspec.framing.results import Found
from lidarspec.plugins import registry, sensor as named_sensor
from lidarspec.recording.background_writer import BackgroundWriter, TrafficLog
from lidarspec.recording.format import (
    DATAGRAM,
    EVENT,
    GAP,
    HEADER,
    MAGIC,
    MAX_DATA_BYTES,
    QUIET,
    RECEIVED,
    SENT,
    Header,
    pack_record,
    size_at,
)
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.links import Udp
from lidarspec.transports.protocol import Chunk, Transport

SUFFIXES = (".lsr", *WRITINGS, ".bin")
#: maximum size of a packet with bytes that are not in a frame.
MAX_GAP_BYTES = 1 << 16


@dataclass(frozen=True)
class RecorderFactory:
    """Makes a recorder as soon as the sensor of a source is known.

    Attributes:
        make: a function that takes the open transport and the configured sensor, and returns the
            recorder.
    """

    make: Callable[[Transport, Sensor | str | None], TrafficLog]


#: the target of a recording: a file, a recorder, or a function that makes the recorder when the
#: source is open.
RecordTo = str | Path | BackgroundWriter | Callable[[Transport], TrafficLog] | RecorderFactory


class Recorder(BackgroundWriter):
    """Writes an .lsr file, the recording format of lidarspec; a context manager.

    Any thread may call `write`. `open_recorder` makes the recorders for other formats.

    If the file cannot be written, the capture continues: `write` raises no error. The error is
    stored in `error`, and raised once, by the next `sync` or by `close`. The file is then valid up
    to its last complete record.

    Args:
        path: the file.
        sensor: the sensor, or its id; None to record without a sensor.
        source: the SOURCE that is recorded.
        datagrams: whether each chunk is a datagram; by default, the sensor's data link determines
            this.
        baud: baud rate of a serial port.
        overwrite: whether an existing file may be replaced.

    Attributes:
        header: the header of the recording.
        records: number of records so far.
        bytes: number of data bytes in these records.
        dropped: number of records that were dropped because the disk was too slow or failed.
        error: the error of the file; None if there is no error.

    Raises:
        UsageError: if the file exists and `overwrite` is false, or if the sensor is not installed
            and `datagrams` is None.
        SourceError: if the file cannot be created.
    """

    def __init__(
        self,
        path: str | Path,
        sensor: Sensor | str | None = None,
        source: str | Path = "",
        *,
        datagrams: bool | None = None,
        baud: int | None = None,
        overwrite: bool = False,
    ) -> None:
        self.header = _make_header(sensor, str(source), datagrams=datagrams, baud=baud)
        super().__init__(path, _record_size, overwrite=overwrite)
        self._put(MAGIC + pack_record(HEADER, self.header.to_json(), self.header.wall_ns))
        try:
            self.sync()
        except BaseException:
            self._finish()
            raise

    def write(self, chunk: Chunk, direction: Literal["in", "out"] = "in") -> None:
        """Record received or sent data with its time.

        A chunk of a stream with more than 65,535 bytes becomes several records.
        """
        kind = RECEIVED if direction == "in" else SENT
        for start in range(0, len(chunk.data) or 1, MAX_DATA_BYTES):
            data = chunk.data[start : start + MAX_DATA_BYTES]
            flags = 0
            if self.header.datagrams:
                flags |= DATAGRAM
            if chunk.gap and not start:
                flags |= GAP
            if chunk.quiet and not start:
                flags |= QUIET
            record = pack_record(
                kind, data, chunk.at, flags=flags, sender=chunk.sender, receiver=chunk.receiver
            )
            self._put(record, len(data))

    def event(self, name: str, at: int | None = None, **details: Any) -> None:
        """Record an event of the connection, such as "disconnect" or "reconnect".

        Args:
            at: the time, ns since 1970; by default now.
        """
        self._put(_make_event(name, time.time_ns() if at is None else at, details))

    def _make_drop_record(self, dropped: int) -> bytes:
        return _make_event("dropped", time.time_ns(), {"records": dropped})


class PcapRecorder(BackgroundWriter):
    """Writes received datagrams to a capture that Wireshark can open.

    Args:
        path: the file.
        port: the destination port of datagrams with an unknown destination.
        overwrite: whether an existing file may be replaced.
    """

    def __init__(self, path: str | Path, *, port: int = 0, overwrite: bool = False) -> None:
        self._writing = WRITINGS[check_suffix(path)]
        super().__init__(path, self._writing.size, overwrite=overwrite)
        self._receiver = (UNKNOWN_ENDPOINT[0], port)
        self._put(self._writing.head(ETHERNET))

    def write(self, chunk: Chunk, direction: Literal["in", "out"] = "in") -> None:
        """Record a received datagram. Sent datagrams are ignored.

        Raises:
            UsageError: if the sender or the receiver of the chunk is not an IP address with a valid
                port, or if the data is too long for a datagram.
        """
        if direction == "in":
            datagram = Datagram(
                chunk.data,
                chunk.at or 0,
                chunk.sender or UNKNOWN_ENDPOINT,
                chunk.receiver or self._receiver,
            )
            self._put(
                self._writing.record(make_datagram_frame(datagram), datagram.at), len(chunk.data)
            )


class FrameRecorder(BackgroundWriter):
    """Writes a byte stream as a capture of link type USER0, with a packet per frame.

    Bytes outside frames become packets as well, so that the file contains all received bytes in
    order.

    Args:
        sensor: the sensor that declares the frames.
        overwrite: whether an existing file may be replaced.
    """

    def __init__(self, path: str | Path, sensor: Sensor, *, overwrite: bool = False) -> None:
        self._decoder = Decoder(sensor, stream=True)
        self._held = bytearray()
        self._base = 0
        self._at = 0
        self._writing = WRITINGS[check_suffix(path)]
        super().__init__(path, self._writing.size, overwrite=overwrite)
        self._put(self._writing.head(USER_LINKS[0]))

    def write(self, chunk: Chunk, direction: Literal["in", "out"] = "in") -> None:
        """Record received bytes; ignore sent bytes."""
        if direction == "in":
            self._at = chunk.at or self._at
            if chunk.gap:
                self._write_frames(self._decoder.idle())
            self._held += chunk.data
            self._write_frames(self._decoder.feed(chunk.data, self._at))

    def _write_frames(self, frames: list[Found]) -> None:
        """Write frames, and the received bytes outside these frames, in order."""
        for item in frames:
            self._write_gap(item.offset - self._base)
            self._write_packet(len(item.data), item.at or self._at)
        self._write_gap(len(self._held) - self._decoder.stats.pending)

    def _write_gap(self, size: int) -> None:
        while size > 0:
            part = min(size, MAX_GAP_BYTES)
            self._write_packet(part, self._at)
            size -= part

    def _write_packet(self, size: int, at: int) -> None:
        self._put(self._writing.record(bytes(self._held[:size]), at), size)
        del self._held[:size]
        self._base += size

    def _finish(self) -> None:
        if not self._closing:
            self._write_frames(self._decoder.finish())
        super()._finish()


class RawRecorder(BackgroundWriter):
    """Writes only the received bytes."""

    def __init__(self, path: str | Path, *, overwrite: bool = False) -> None:
        super().__init__(path, None, overwrite=overwrite)

    def write(self, chunk: Chunk, direction: Literal["in", "out"] = "in") -> None:
        """Record received bytes; ignore sent bytes."""
        if direction == "in":
            self._put(chunk.data, len(chunk.data))


def declared_port(sensor: Sensor | None) -> int:
    """Return the first UDP port that a sensor declares; 0 if it declares none."""
    links = sensor.links.values() if sensor is not None else ()
    return next((port for link in links if isinstance(link, Udp) for port in link.ports), 0)


def check_suffix(path: str | Path) -> str:
    """Return the suffix of a file to record to.

    Raises:
        UnknownFormat: for a suffix that is not supported.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise UnknownFormat(suffix or str(path), SUFFIXES, place=str(path))
    return suffix


def open_recorder(
    path: str | Path,
    sensor: Sensor | str | None = None,
    source: str | Path = "",
    *,
    datagrams: bool,
    baud: int | None = None,
    overwrite: bool = False,
) -> BackgroundWriter:
    """Open the recorder for a file; its suffix is .lsr, .pcap, .pcapng or .bin.

    Args:
        sensor: the sensor if it is known. A capture of a byte stream requires it.
        source: the source of the data, for the header of an .lsr file.
        datagrams: whether chunks are datagrams, not portions of a byte stream.
        baud: baud rate of a serial line, for the header of an .lsr file.
        overwrite: whether an existing file may be replaced.

    Raises:
        UnknownFormat: for another suffix.
        UsageError: if the file exists and `overwrite` is false, or if the format cannot store the
            data of the source.
        SourceError: if the file cannot be created.
    """
    suffix = check_suffix(path)
    if suffix in WRITINGS and not datagrams:
        if not sensor:
            raise UsageError(
                f"{path}: to record a byte stream as a capture, name the sensor with -s, or record"
                " to an .lsr file"
            )
        return FrameRecorder(
            path,
            sensor if isinstance(sensor, Sensor) else named_sensor(sensor),
            overwrite=overwrite,
        )
    if suffix == ".bin" and datagrams:
        raise UsageError(
            f"{path}: a .bin file cannot separate datagrams: record to an .lsr or .pcap file"
        )
    if suffix == ".lsr":
        return Recorder(path, sensor, source, datagrams=datagrams, baud=baud, overwrite=overwrite)
    port = declared_port(sensor if isinstance(sensor, Sensor) else None)
    if suffix in WRITINGS:
        return PcapRecorder(path, port=port, overwrite=overwrite)
    return RawRecorder(path, overwrite=overwrite)


def get_recorder(
    target: RecordTo, sensor: Sensor | str | None, source: str | Path, opened: Transport
) -> tuple[TrafficLog, bool]:
    """Return the recorder for a target, and whether the caller must close it.

    The caller must close every recorder except one that was passed as `target`.

    Args:
        target: the path of a file, a recorder, or an object that makes the recorder.
        sensor: the sensor of the source if it is known.
        source: the source of the data, for the header of an .lsr file.
        opened: the open transport of the source.
    """
    if isinstance(target, BackgroundWriter):
        return target, False
    if isinstance(target, RecorderFactory):
        return target.make(opened, sensor), True
    if not isinstance(target, str | Path):
        return target(opened), True
    recorder = open_recorder(target, sensor, source, datagrams=opened.datagrams, baud=opened.baud)
    return recorder, True


def _make_header(
    sensor: Sensor | str | None, source: str, *, datagrams: bool | None, baud: int | None
) -> Header:
    if isinstance(sensor, str) and sensor and datagrams is None:
        sensor = named_sensor(sensor)
    if isinstance(sensor, Sensor):
        name = sensor.id
        options = dict(sensor.options)
        link = sensor.datagrams
    else:
        name = sensor or ""
        options = {}
        link = False
    homes = {
        plugin.distribution: plugin.version
        for plugin in registry().plugins
        if name in plugin.sensors
    }
    return Header(
        sensor=name,
        options=options,
        source=source,
        datagrams=link if datagrams is None else datagrams,
        baud=baud,
        versions={"lidarspec": __version__, **homes},
        created=datetime.now().astimezone().isoformat(timespec="milliseconds"),
        wall_ns=time.time_ns(),
        monotonic_ns=time.monotonic_ns(),
    )


def _make_event(name: str, at: int, details: dict[str, Any]) -> bytes:
    return pack_record(EVENT, json.dumps({"event": name, **details}, default=str).encode(), at)


def _record_size(data: bytes | bytearray, at: int) -> int:
    """Return the length of the record at an offset."""
    if data.startswith(MAGIC, at):
        return len(MAGIC)
    return size_at(data, at)
