"""Recorders: what arrives over a link, and what is sent, taken at the speed of the capture and
brought into a file.

The suffix of the file says which: .lsr holds everything, .pcap and .pcapng packets for Wireshark,
.bin the bytes alone. All of them grow by whole records, which a thread of their own writes
(`appending`).
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
from lidarspec.captures.pcap import UNKNOWN_ENDPOINT, USER_LINKS, Datagram, datagram_frame
from lidarspec.captures.records import WRITINGS
from lidarspec.errors import UnknownFormat, UsageError
from lidarspec.framing.decoder import Decoder
from lidarspec.framing.results import Found
from lidarspec.plugins import registry, sensor as named_sensor
from lidarspec.recording.appending import Appender, Log
from lidarspec.recording.format import (
    DATAGRAM,
    EVENT,
    GAP,
    HEADER,
    LARGEST,
    MAGIC,
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
#: bytes between frames that make one packet at most.
LARGEST_GAP = 1 << 16


@dataclass(frozen=True)
class MadeFor:
    """What makes a recorder of the open transport and the sensor, as it is read: configured with
    what was learned of it.
    """

    make: Callable[[Transport, Sensor | str | None], Log]


#: a file, a recorder, or what makes one when the source is open.
RecordTo = str | Path | Appender | Callable[[Transport], Log] | MadeFor


class Recorder(Appender):
    """Writes an .lsr recording, from any thread; a context manager.

    Nothing that goes wrong with the file is raised by `write`: the capture goes on. It is kept in
    `error`, and raised once, by the next `sync` or by `close`; the file is then valid to its last
    whole record.

    Args:
        path: the file, new unless `overwrite`.
        sensor: the sensor, or its id; left out for a raw recording.
        source: the SOURCE that is recorded.
        datagrams: whether each chunk is a datagram; by default what the sensor's link says.
        baud: of a serial port.

    Attributes:
        header: what the recording says of itself.
        records, bytes: received and sent so far, and the bytes in them.
        dropped: records and events that came while the disk did not keep up, or after it failed.
        error: what went wrong with the file, None where nothing did.

    Raises:
        UsageError: where the file exists, or the sensor is not installed and nothing else says what
            the link carries.
        SourceError: where it cannot be made.
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
        self.header = _header(sensor, str(source), datagrams=datagrams, baud=baud)
        super().__init__(path, _record_size, overwrite=overwrite)
        self._put(MAGIC + pack_record(HEADER, self.header.to_json(), self.header.wall_ns))
        try:
            self.sync()
        except BaseException:
            self._finish()
            raise

    def write(self, chunk: Chunk, direction: Literal["in", "out"] = "in") -> None:
        """Take what was received or sent, with its arrival time; more than 65,535 bytes of a stream
        become several records.
        """
        kind = RECEIVED if direction == "in" else SENT
        for start in range(0, len(chunk.data) or 1, LARGEST):
            data = chunk.data[start : start + LARGEST]
            flags = DATAGRAM * self.header.datagrams | (GAP * chunk.gap | QUIET * chunk.quiet) * (
                not start
            )
            self._put(
                pack_record(
                    kind, data, chunk.at, flags=flags, sender=chunk.sender, receiver=chunk.receiver
                ),
                len(data),
            )

    def event(self, name: str, at: int | None = None, **details: Any) -> None:
        """Take down what happened to the line, such as "disconnect" or "reconnect"; now, unless
        `at` says when.
        """
        self._put(_event(name, time.time_ns() if at is None else at, details))

    def _make_drop_record(self, dropped: int) -> bytes:
        return _event("dropped", time.time_ns(), {"records": dropped})


class PcapRecorder(Appender):
    """Writes the datagrams that are received as a capture that Wireshark opens.

    Args:
        path: the file, new unless `overwrite`.
        port: that datagrams went to where they do not say it.
    """

    def __init__(self, path: str | Path, *, port: int = 0, overwrite: bool = False) -> None:
        self._writing = WRITINGS[check_suffix(path)]
        super().__init__(path, self._writing.size, overwrite=overwrite)
        self._receiver = (UNKNOWN_ENDPOINT[0], port)
        self._put(self._writing.head(ETHERNET))

    def write(self, chunk: Chunk, direction: Literal["in", "out"] = "in") -> None:
        """Take a datagram that was received; one that was sent is none of the sensor's, and is left
        out.

        Raises:
            UsageError: for addresses that are none.
        """
        if direction == "in":
            datagram = Datagram(
                chunk.data,
                chunk.at or 0,
                chunk.sender or UNKNOWN_ENDPOINT,
                chunk.receiver or self._receiver,
            )
            self._put(self._writing.record(datagram_frame(datagram), datagram.at), len(chunk.data))


class FrameRecorder(Appender):
    """Writes a byte stream as a capture with one packet for each frame, link type USER0.

    What is no frame becomes packets too, so that they hold every byte that was received, in order.

    Args:
        path: the file, new unless `overwrite`.
        sensor: whose frames they are.
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
        """Take bytes that were received; those that were sent are left out."""
        if direction == "in":
            self._at = chunk.at or self._at
            if chunk.gap:
                self._cut(self._decoder.idle())
            self._held += chunk.data
            self._cut(self._decoder.feed(chunk.data, self._at))

    def _cut(self, found: list[Found]) -> None:
        """Write the frames found and the skipped bytes before them.

        Bytes that may still become a frame are kept.
        """
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
        self._put(self._writing.record(bytes(self._held[:size]), at), size)
        del self._held[:size]
        self._base += size

    def _finish(self) -> None:
        if not self._closing:
            self._cut(self._decoder.finish())
        super()._finish()


class RawRecorder(Appender):
    """Writes the bytes that are received, and nothing else."""

    def __init__(self, path: str | Path, *, overwrite: bool = False) -> None:
        super().__init__(path, None, overwrite=overwrite)

    def write(self, chunk: Chunk, direction: Literal["in", "out"] = "in") -> None:
        """Take bytes that were received."""
        if direction == "in":
            self._put(chunk.data, len(chunk.data))


def declared_port(sensor: Sensor | None) -> int:
    """The first port that the datagrams of a sensor go to; 0 where nobody knows one."""
    links = sensor.links.values() if sensor is not None else ()
    return next((port for link in links if isinstance(link, Udp) for port in link.ports), 0)


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
    overwrite: bool = False,
) -> Appender:
    """The open recorder for a file, by its suffix: .lsr, .pcap, .pcapng or .bin.

    Args:
        path: the new file.
        sensor: whose bytes these are, as far as it is known; a capture of a byte stream needs it.
        source: where they come from, for the header of an .lsr.
        datagrams: whether chunks are datagrams, or pieces of a stream.
        baud: of a serial line, for the header of an .lsr.
        overwrite: take the place of a file that exists.

    Raises:
        UnknownFormat: for another suffix.
        UsageError: where the file exists, or cannot hold what the source gives.
        SourceError: where it cannot be made.
    """
    suffix = check_suffix(path)
    if suffix in WRITINGS and not datagrams:
        if not sensor:
            raise UsageError(
                f"{path}: a capture of a byte stream has a packet for each frame: name the sensor"
                " with -s, or record an .lsr"
            )
        return FrameRecorder(
            path,
            sensor if isinstance(sensor, Sensor) else named_sensor(sensor),
            overwrite=overwrite,
        )
    if suffix == ".bin" and datagrams:
        raise UsageError(
            f"{path}: bytes alone do not say where a datagram ends: record datagrams in an .lsr or"
            " .pcap file"
        )
    if suffix == ".lsr":
        return Recorder(path, sensor, source, datagrams=datagrams, baud=baud, overwrite=overwrite)
    port = declared_port(sensor if isinstance(sensor, Sensor) else None)
    if suffix in WRITINGS:
        return PcapRecorder(path, port=port, overwrite=overwrite)
    return RawRecorder(path, overwrite=overwrite)


def recorder_for(
    target: RecordTo, sensor: Sensor | str | None, source: str | Path, opened: Transport
) -> tuple[Log, bool]:
    """Return the recorder for a target, and whether it was made here.

    A recorder that was made here has to be closed by the caller of this function.
    """
    if isinstance(target, str | Path):
        return recorder(target, sensor, source, datagrams=opened.datagrams, baud=opened.baud), True
    if isinstance(target, Appender):
        return target, False
    return target.make(opened, sensor) if isinstance(target, MadeFor) else target(opened), True


def _header(
    sensor: Sensor | str | None, source: str, *, datagrams: bool | None, baud: int | None
) -> Header:
    known = (
        named_sensor(sensor) if isinstance(sensor, str) and sensor and datagrams is None else sensor
    )
    if isinstance(known, Sensor):
        name = known.id
        options = dict(known.options)
        link = known.datagrams
    else:
        name = known or ""
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


def _event(name: str, at: int, details: dict[str, Any]) -> bytes:
    return pack_record(EVENT, json.dumps({"event": name, **details}, default=str).encode(), at)


def _record_size(data: bytes | bytearray, at: int) -> int:
    """The length of the record that begins there in a piece of a recording, or of the magic bytes,
    which the first piece begins with.
    """
    if data.startswith(MAGIC, at):
        return len(MAGIC)
    return size_at(data, at)
