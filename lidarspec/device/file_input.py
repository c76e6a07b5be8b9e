"""Frames out of a file or standard input, read as fast as they are asked for."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from lidarspec.captures.bulk import first_frames
from lidarspec.device.arrivals import Arrival, Senders, fed
from lidarspec.device.session import Reply
from lidarspec.errors import CommandError
from lidarspec.framing.decoder import Decoder
from lidarspec.framing.results import Counters
from lidarspec.spec.sensor import Sensor
from lidarspec.transports.files import CaptureTransport
from lidarspec.transports.open_url import transport
from lidarspec.transports.protocol import Chunk, Transport

#: bytes or datagrams decoded together.
BATCH_BYTES, BATCH_CHUNKS = 1 << 18, 1024


class FileInput:
    """What a transport that ends holds; the consumer's own pace is the policy, so that nothing is ever dropped.

    Attributes:
        decoder: what finds the frames.
        ended: whether everything was read.
        state: "streaming", "ended" or "closed".
    """

    is_live = False
    queued = None
    stays_on = True

    def __init__(self, source: str | Path, sensor: Sensor, opened: Transport, *, backend: str) -> None:
        self._source, self._sensor, self._transport = source, sensor, opened
        self.decoder: Decoder = sensor.decoder(stream=not opened.datagrams, backend=backend)
        self._senders = Senders(source, sensor)
        self._arrivals = self._read()
        self.state = "streaming"

    @property
    def ended(self) -> bool:
        return self.state != "streaming"

    @property
    def warnings(self) -> list[str]:
        """What is to be said about the source, such as a file that is cut off."""
        return list(self._transport.warnings)

    @property
    def stats(self) -> Counters:
        """The counters."""
        stats = self.decoder.stats
        stats.foreign, stats.disconnects = self._transport.foreign, self._transport.disconnects
        return stats

    def next(self, wait: float) -> Arrival | None:
        """The next frames; None at the end."""
        found = next(self._arrivals, None)
        if found is None:
            self.state = "ended"
        return found

    def begin(self) -> None:
        """A file has no sensor to be started."""

    def caught_up(self, mark: int) -> bool:
        """A file has no newest scan: each is looked at in its turn."""
        return True

    def mark(self) -> int:
        """Nothing is produced but what is asked for."""
        return 0

    def send(self, name: str, *, timeout: float | None = None, **arguments: object) -> Reply:
        """Never a reply, since there is no device behind a file.

        Raises:
            CommandError: always.
        """
        raise CommandError(f"{self._sensor.id} {name}: {self._source} is a file, there is no device to send it to")

    def close(self) -> None:
        """Give the file back."""
        self.state = "closed"
        self._transport.close()

    def first_state(self) -> dict[str, bytes]:
        """The first frame of each type that `points` takes its state from: a file is read as if it stood at the start."""
        wanted = set(self._sensor.state)
        if not wanted or not Path(str(self._source).partition("?")[0]).is_file():
            return {}
        first: dict[str, bytes] = {}
        source = transport(self._source)
        decoder = self._sensor.decoder(stream=not source.datagrams)
        try:
            if isinstance(source, CaptureTransport):
                return first_frames(decoder, source.batches(), wanted)
            for chunk in source.chunks():
                for item in decoder.feed(chunk.data, chunk.at):
                    if item.frame in wanted:
                        first.setdefault(item.frame, item.data)
                if len(first) == len(wanted):
                    break
        finally:
            source.close()
        return first

    def _read(self) -> Iterator[Arrival]:
        """Every incoming frame, in batches."""
        if isinstance(self._transport, CaptureTransport) and not self.decoder.stream:
            for datagrams in self._transport.batches():
                spans = self.decoder.placed(datagrams.buffer, datagrams.starts, datagrams.sizes, datagrams.at)
                self._senders.see(datagrams.hosts(spans))
                yield Arrival([spans])
            return
        for batch in _batches(self._transport.chunks()):
            if batch[0].gap or batch[0].quiet:
                yield Arrival(self.decoder.rest(), interrupted=batch[0].gap)
            found = fed(self.decoder, batch)
            if not self.decoder.stream:
                self._senders.check(batch, found[0])
            yield Arrival(found)
        yield Arrival(self.decoder.rest())


def _batches(chunks: Iterator[Chunk]) -> Iterator[list[Chunk]]:
    """The chunks, as many at once as are worth decoding together, up to where the line was interrupted or fell silent."""
    found: list[Chunk] = []
    size = 0
    for chunk in chunks:
        if found and (chunk.gap or chunk.quiet or size >= BATCH_BYTES or len(found) >= BATCH_CHUNKS):
            yield found
            found, size = [], 0
        found.append(chunk)
        size += len(chunk.data)
    if found:
        yield found
