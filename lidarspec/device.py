"""A sensor on a source: packets and scans as they come."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

import numpy as np

from lidarspec.decoder import Counters, Decoder, Spans
from lidarspec.detect import detected
from lidarspec.errors import UsageError
from lidarspec.files import Chunk, Transport
from lidarspec.packets import Packets
from lidarspec.plugins import sensor as named_sensor
from lidarspec.scans import Scan, ScanStream
from lidarspec.sources import transport
from lidarspec.spec import Sensor
from lidarspec.streams import PacketStream, data_frame

#: bytes or datagrams decoded together when a file is read.
BATCH_BYTES, BATCH_CHUNKS = 1 << 18, 1024


class Device:
    """A sensor read from a source; a context manager.

    Attributes:
        sensor: the sensor, given or detected.
        stats: the counters of everything read so far.
        warnings: what is to be said about the source, such as a file that is cut off.
    """

    def __init__(self, source: str | Path, sensor: Sensor, *, backend: str = "auto") -> None:
        self.sensor, self._source = sensor, source
        self._transport: Transport = transport(source)
        self._decoder: Decoder = sensor.decoder(stream=not self._transport.datagrams, backend=backend)
        self._senders: dict[str, str] = {}

    @property
    def stats(self) -> Counters:
        """The counters."""
        self._decoder.stats.foreign = getattr(self._transport, "foreign", 0)
        return self._decoder.stats

    @property
    def warnings(self) -> list[str]:
        """What is to be said about the source."""
        return list(getattr(self._transport, "warnings", []))

    def spans(self) -> Iterator[list[Spans]]:
        """Every incoming frame, in batches."""
        chunks = self._transport.chunks()
        while batch := _batch(chunks):
            if self._decoder.stream:
                found = [spans for chunk in batch for spans in self._decoder.spans(chunk.data, chunk.at)]
            else:
                found = [self._decoder.datagrams([chunk.data for chunk in batch], [chunk.at for chunk in batch])]
                self._check_senders(batch, found[0])
            yield found
        yield self._decoder.rest()

    def packets(self, frame: str | None = None) -> Iterator[Packets]:
        """The packets of the data frame, or of another type, in batches."""
        stream: PacketStream | None = None
        waiting: list[Spans] = []
        for found in self.spans():
            waiting += found
            name = frame or data_frame(self.sensor, waiting)
            if stream is None and name is not None:
                stats, interpreted = self._decoder.stats, self._decoder.interpreted
                stream = PacketStream(self.sensor, name, stats, interpreted=interpreted, state=self._first_state())
            if stream is None:
                continue
            packets, waiting = stream.add(waiting), []
            if len(packets):
                yield packets

    def scans(self) -> Iterator[Scan]:
        """Every scan; the first and last piece are marked ``complete=False``."""
        stream = ScanStream(self.sensor)
        for packets in self.packets():
            yield from stream.add(packets)
        yield from stream.finish()

    def close(self) -> None:
        """Give the source back."""
        self._transport.close()

    def __enter__(self) -> Device:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Device({self.sensor.id} on {self._source}: {self.stats})"

    def _check_senders(self, batch: list[Chunk], found: Spans) -> None:
        """Frames of several senders must not be mixed into one cloud."""
        ends = np.cumsum([len(chunk.data) for chunk in batch])
        for kind, place in zip(found.kinds.tolist(), np.searchsorted(ends, found.starts, side="right").tolist(), strict=True):
            sender = batch[place].sender
            first = self._senders.setdefault(found.names[kind], sender[0]) if sender else None
            if sender and first != sender[0]:
                raise UsageError(
                    f"{self._source}: {first} and {sender[0]} both send {found.names[kind]} frames; choose one with ?src={first}"
                )

    def _first_state(self) -> dict[str, bytes]:
        """The first frame of each type that `points` takes its state from: a file is read as if it stood at the start."""
        wanted = set(self.sensor.state)
        if not wanted or not Path(str(self._source).partition("?")[0]).is_file():
            return {}
        first: dict[str, bytes] = {}
        source = transport(self._source)
        decoder = self.sensor.decoder(stream=not source.datagrams)
        try:
            for chunk in source.chunks():
                for item in decoder.feed(chunk.data, chunk.at):
                    if item.frame in wanted:
                        first.setdefault(item.frame, item.data)
                if len(first) == len(wanted):
                    break
        finally:
            source.close()
        return first


def _batch(chunks: Iterator[Chunk]) -> list[Chunk]:
    """The next chunks, as many as are worth decoding together."""
    found: list[Chunk] = []
    size = 0
    for chunk in chunks:
        found.append(chunk)
        size += len(chunk.data)
        if size >= BATCH_BYTES or len(found) >= BATCH_CHUNKS:
            break
    return found


def open(source: str | Path, sensor: str | Sensor | None = None, *, backend: str = "auto") -> Device:
    """A sensor on any SOURCE.

    Args:
        source: see DESIGN 3.2; a file, or "-" for standard input.
        sensor: an id, a path to a sensor's module, or a Sensor; found out from a file where left out.

    Raises:
        SourceError: where the source cannot be opened.
        UsageError, WireError: where several sensors fit, or none, and `sensor` was left out.
    """
    if sensor is None:
        sensor = detected(source)
    return Device(source, sensor if isinstance(sensor, Sensor) else named_sensor(sensor), backend=backend)
