"""What a device reads from, live or not: an input that gives frames in batches, and who may have sent them.

`FileInput` is that of a file or standard input, which are read as fast as they are asked for; `live_input` has the other.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path
from shlex import quote
from typing import Any, Protocol

import numpy as np

from lidarspec.captures.bulk import first_frames
from lidarspec.device.session import Reply
from lidarspec.errors import CommandError, SourceError, UsageError, suggest
from lidarspec.framing.decoder import Decoder
from lidarspec.framing.results import Counters, Found, Frames
from lidarspec.spec.sensor import Sensor
from lidarspec.transports.base import with_option
from lidarspec.transports.files import CaptureTransport
from lidarspec.transports.open_url import transport
from lidarspec.transports.protocol import Chunk, Sender, Transport, endpoint

#: other senders of a stream that are looked at; datagrams of further ones are foreign unseen.
SENDERS = 16


@dataclass(frozen=True, eq=False)
class Arrival:
    """Frames of a piece of input, in stream order.

    Attributes:
        found: the frames of every incoming type.
        interrupted: whether input is missing behind them: no frame, packet or scan goes on there.
    """

    found: list[Frames] = field(default_factory=list)
    interrupted: bool = False


class Input(Protocol):
    """Where a device has its frames from, live or not; what nothing is said of is as with a file.

    Attributes:
        is_live: whether data come at their own pace, and not from a file.
        decoder: what finds the frames on the data link.
        stays_on: whether the sensor is left as it is at the end.
    """

    is_live: bool = False
    decoder: Decoder
    stays_on: bool = True

    @property
    def state(self) -> str:
        """How it is doing, in one or two words."""

    @property
    def ended(self) -> bool:
        """Whether nothing comes any more."""

    @property
    def warnings(self) -> list[str]:
        """What is to be said about the source now."""

    @property
    def stats(self) -> Counters:
        """The counters of everything read so far, those of the transports included."""

    @property
    def queued(self) -> int | None:
        """Chunks that have arrived and wait to be decoded; None where nothing waits."""
        return None

    def begin(self) -> None:
        """Send the commands that the sensor declares for its start.

        Raises:
            CommandError: where the device does not start, unless it sends data all the same.
        """

    def next(self, wait: float) -> Arrival | None:
        """The next frames; None where none come within `wait` seconds, or at the end.

        Raises:
            SourceError: where nothing can be read any more.
            UsageError: where several senders' frames would be mixed.
        """

    def mark(self) -> int:
        """How much has been produced; for `caught_up`."""
        return 0

    def caught_up(self, mark: int) -> bool:
        """Whether everything that had been produced at a mark has been decoded; of a file each scan is looked at in its turn."""
        return True

    def send(self, name: str, *, timeout: float | None = None, **arguments: Any) -> Reply:
        """The reply to a command, which other threads may wait for at the same time.

        Raises:
            UnknownCommand, UnknownField, MissingField, OutOfRange: for what the sensor does not take; nothing is sent.
            CommandError: where the device refuses, the connection is lost or there is no device; ReplyTimeout where it keeps silent.
        """

    def write(self, data: bytes, link: str = "data") -> None:
        """Send bytes as they are; what answers them is read as everything else.

        Raises:
            UsageError: for a text, and for a link that the sensor does not have.
            SourceError: where the connection is lost, or there is no device.
        """

    def first_state(self) -> dict[str, bytes]:
        """Frames of other types, by name, that count as seen before the first packet: of a live sensor none, before it says it."""
        return {}

    def close(self) -> None:
        """Stop the sensor where it was started, and give everything back; a second call does nothing."""


class Senders:
    """Frames of several senders must not be mixed into one cloud.

    Args:
        source: for messages.
    """

    def __init__(self, source: str | Path, sensor: Sensor) -> None:
        self._source, self._sensor = source, sensor
        self._now: dict[str, Sender] = {}  # who sends the frames of a type, and who did before
        self._before: dict[str, set[Sender]] = {}
        self._others: dict[Sender, Decoder] = {}  # of streams: what senders send, and who has sent frames
        self._framed: set[Sender] = set()

    def check(self, chunks: Sequence[Chunk], found: Frames) -> None:
        """Look who sent the frames of these datagrams.

        Raises:
            UsageError: where two senders send frames of one type.
        """
        senders = {chunk.sender for chunk in chunks}
        if len(senders) == 1:
            self.see((found.names[kind], sender) for sender in senders if sender for kind in np.unique(found.kinds).tolist())
            return
        sizes = np.array([len(chunk.data) for chunk in chunks])
        places = np.searchsorted(np.cumsum(sizes) - sizes, found.starts, side="right") - 1
        sent = zip(found.kinds.tolist(), (chunks[place].sender for place in places.tolist()), strict=True)
        self.see((found.names[kind], sender) for kind, sender in sent if sender is not None)

    def see(self, sent: Iterable[tuple[str, Sender]]) -> None:
        """Look who sent frames: the type of each, and the sender.

        A sensor that was started anew may send from another port of its address than before; two sensors there take turns.

        Raises:
            UsageError: where two senders send frames of one type.
        """
        for name, sender in sent:
            known = self._now.setdefault(name, sender)
            if sender == known:
                continue
            before = self._before.setdefault(name, set())
            if sender[0] != known[0] or sender in before or len(before) == SENDERS:
                raise self._several(known, sender, f"{name} frames" if name else f"frames of {self._sensor.id}")
            before.add(known)
            self._now[name] = sender

    def ours(self, chunks: Sequence[Chunk], main: Decoder) -> list[Chunk]:
        """Those pieces of a stream in datagrams that come from the sender which is listened to, the first that sends frames.

        Raises:
            UsageError: where another one sends frames as well.
        """
        mine: list[Chunk] = []
        for chunk in chunks:
            known = self._now.setdefault("", chunk.sender) if chunk.sender else None
            has_begun = bool(main.stats.frames)
            if chunk.sender and (chunk.sender != known or not has_begun) and self._sends_frames(chunk.sender, chunk):
                if has_begun or known in self._framed:
                    self.see([("", chunk.sender)])
                self._now[""] = chunk.sender
                self._framed.add(chunk.sender)
            mine += [chunk] if not chunk.sender or chunk.sender == self._now[""] else []
        return mine

    def _sends_frames(self, sender: Sender, chunk: Chunk) -> bool:
        if sender not in self._others and len(self._others) >= SENDERS:
            return False
        decoder = self._others.setdefault(sender, self._sensor.decoder(stream=True))
        return bool(decoder.feed(chunk.data))

    def _several(self, first: Sender, other: Sender, what: str) -> UsageError:
        one, two = (endpoint(sender) if first[0] == other[0] else sender[0] for sender in (first, other))
        mark = "&" if "?" in str(self._source) else "?"
        error = UsageError(f"{self._source}: {one} and {two} both send {what}; choose one with {mark}src={one}")
        return suggest(error, f"the same with '{with_option(self._source, 'src', one)}'")


def fed(decoder: Decoder, chunks: Sequence[Chunk]) -> list[Frames]:
    """The frames that consecutive chunks complete, each with the arrival time of the chunk that holds its last byte."""
    if not decoder.stream:
        return [decoder.datagrams([chunk.data for chunk in chunks], [chunk.at for chunk in chunks])]
    if len(chunks) == 1:
        return decoder.frames(chunks[0].data, chunks[0].at)
    data = [chunk.data for chunk in chunks]
    ends = np.array([*accumulate(map(len, data), initial=decoder.stats.bytes_in)])[1:]
    found = decoder.frames(b"".join(data), chunks[-1].at)
    times = np.array([-1 if chunk.at is None else chunk.at for chunk in chunks], np.int64)
    return [frames.arrived(times[ends.searchsorted(frames.offsets + frames.sizes)]) for frames in found]


def answers(found: Sequence[Frames], awaited: frozenset[str]) -> list[Found]:
    """The frames of some types, one by one."""
    picked = []
    for frames in found:
        kinds = [index for index, name in enumerate(frames.names) if name in awaited]
        picked += frames.only(np.isin(frames.kinds, kinds)).found()
    return picked


#: bytes or datagrams decoded together.
BATCH_BYTES, BATCH_CHUNKS = 1 << 18, 1024


class FileInput(Input):
    """What a transport that ends holds; the consumer's own pace is the policy, so that nothing is ever dropped.

    Attributes:
        state: "streaming", "ended" or "closed".
    """

    state = "streaming"

    def __init__(self, source: str | Path, sensor: Sensor, opened: Transport, *, backend: str) -> None:
        self._source, self._sensor, self._transport = source, sensor, opened
        self.decoder: Decoder = sensor.decoder(stream=not opened.datagrams, backend=backend)
        self._senders = Senders(source, sensor)
        self._arrivals = self._read()

    @property
    def ended(self) -> bool:
        return self.state != "streaming"

    @property
    def warnings(self) -> list[str]:
        said, stats = list(self._transport.warnings), self.decoder.stats
        if self.state == "ended" and stats.bytes_in and not any(name in stats.frames for name in self._sensor.data_frames):
            text = f"{self._source}: {stats.bytes_in} bytes, and no data frame of {self._sensor.id} among them"
            said.append(f"{text}; next: lidarspec detect {quote(str(self._source))}")
        return said

    @property
    def stats(self) -> Counters:
        stats = self.decoder.stats
        stats.foreign, stats.disconnects, stats.unread = self._transport.foreign, self._transport.disconnects, self._transport.unread
        return stats

    def next(self, wait: float) -> Arrival | None:
        found = next(self._arrivals, None)
        if found is None:
            self.state = "ended"
        return found

    def begin(self) -> None:
        """A file has no sensor to be started."""

    def send(self, name: str, *, timeout: float | None = None, **arguments: Any) -> Reply:
        raise CommandError(f"{self._sensor.id} {name}: {self._source} is a file, there is no device to send it to")

    def write(self, data: bytes, link: str = "data") -> None:
        raise SourceError(f"{self._source} is a file, there is no device to send bytes to")

    def close(self) -> None:
        self.state = "closed"
        self._transport.close()

    def first_state(self) -> dict[str, bytes]:
        """The first frame of each type that `points` takes its state from: a file is read as if it stood at the start."""
        wanted = set(self._sensor.state)
        if not wanted or not Path(str(self._source).partition("?")[0]).is_file():
            return {}
        first: dict[str, bytes] = {}
        with contextlib.closing(transport(self._source)) as source:
            decoder = self._sensor.decoder(stream=not source.datagrams)
            if isinstance(source, CaptureTransport):
                return first_frames(decoder, source.batches(), wanted)
            for chunk in source.chunks():
                for item in decoder.feed(chunk.data, chunk.at):
                    if item.frame in wanted:
                        first.setdefault(item.frame, item.data)
                if len(first) == len(wanted):
                    break
        return first

    def _read(self) -> Iterator[Arrival]:
        """Every incoming frame, in batches."""
        if isinstance(self._transport, CaptureTransport) and not self.decoder.stream:
            for datagrams in self._transport.batches():
                spans = self.decoder.placed(datagrams.buffer, datagrams.starts, datagrams.sizes, datagrams.at)
                self._senders.see(datagrams.sent(spans))
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
