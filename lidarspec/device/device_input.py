"""The interface of a device's input, live or not, and the input of a file.

An input returns frames in batches. `FileInput` reads a file or standard input as fast as the caller
requests frames. `live_input` has the input of a live source.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from shlex import quote
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lidarspec.captures.bulk import CapturedDatagrams
from lidarspec.detect.identification import read_info
from lidarspec.device.first_frames import FirstFrames, find_first_frames, is_searched
from lidarspec.device.sender_filter import SenderCheck, frame_senders
from lidarspec.device.session import Reply
from lidarspec.errors import CommandError, SourceError
from lidarspec.frames.schema import schema
from lidarspec.framing.decoder import Decoder
from lidarspec.framing.results import Counters, Found, Frames
from lidarspec.remote_files import is_stored
from lidarspec.sensor_operations import Sensor
from lidarspec.transports.files import CaptureTransport
from lidarspec.transports.open_url import transport
from lidarspec.transports.protocol import Chunk, Transport


@dataclass(frozen=True, eq=False)
class Arrival:
    """Frames of a piece of input, in stream order.

    Attributes:
        found: the frames of every incoming type.
        interrupted: whether input is missing after them: no frame, packet or scan continues there.
        replaced: whether these frames come from another sensor than the previous ones, which have
            to be discarded.
    """

    found: list[Frames] = field(default_factory=list)
    interrupted: bool = False
    replaced: bool = False


class DeviceInput(Protocol):
    """The source of a device's frames; the defaults here are those of a file.

    Attributes:
        is_live: whether data arrives at its own pace, and not from a file.
        decoder: finds the frames of the data link.
        stays_on: whether the sensor is left running at the end.
        sensor: the sensor, configured with the `learned` options.
        learned: the options that the sensor reported.
        info_frames: the last frame of each type with a field of `Sensor.info`, from any link.
    """

    is_live: bool = False
    sensor: Sensor
    decoder: Decoder
    stays_on: bool = True
    learned: Mapping[str, Any] = MappingProxyType({})
    info_frames: Mapping[str, Found] = MappingProxyType({})

    def store_info_frames(self, batches: Sequence[Frames]) -> None:
        """Keep the latest frame of each type that reports values of the sensor.

        A frame with parts is ignored if it lacks values that an earlier frame reported.
        """
        for frames in batches:
            for name in self.sensor.info_frames:
                if name not in frames.names:
                    continue
                rows = np.flatnonzero(np.equal(frames.kinds, frames.names.index(name)))
                for item in frames.select(rows[-1:]).found():
                    if not self._lacks_values(item):
                        self.info_frames = {**self.info_frames, name: item}

    def _lacks_values(self, item: Found) -> bool:
        """Return whether a frame with parts lacks values that an earlier one reported."""
        earlier = self.info_frames.get(item.frame)
        if earlier is None or not schema(self.sensor.frames[item.frame].tree).parts:
            return False
        return not read_info(self.sensor, [earlier]).keys() <= read_info(self.sensor, [item]).keys()

    @property
    def state(self) -> str:
        """The state of the source, in one or two words."""

    @property
    def ended(self) -> bool:
        """Whether the input has ended."""

    @property
    def warnings(self) -> list[str]:
        """The present warnings about the source."""

    @property
    def stats(self) -> Counters:
        """The counters of everything read so far, including those of the transports."""

    @property
    def queued(self) -> int | None:
        """The number of chunks that wait to be decoded; None if there is no queue."""
        return None

    @property
    def place(self) -> tuple[int, int] | None:
        """The bytes of the stored file read so far, and its size.

        None if they are not known.
        """
        return None

    def skip(self, at: int) -> bool:
        """Skip data that arrived before a time, ns since 1970, if the source can seek.

        Returns:
            Whether data was skipped.
        """
        return False

    def read_ahead(self, size: int) -> None:
        """Read a file in portions of about `size` bytes from now on.

        Live sources ignore this.
        """

    def gather(self, until: float) -> None:
        """Let arriving data wait until a time of `time.monotonic`.

        It is then decoded together. It does not wait longer than the `wait` of `next`.
        """

    def begin(self) -> None:
        """Send the commands that the sensor declares for its start.

        Raises:
            CommandError: if the device does not start, unless it sends data nevertheless.
        """

    def next(self, wait: float) -> Arrival | None:
        """Return the next frames.

        Args:
            wait: seconds to wait.

        Returns:
            None if none arrive in time, or at the end.

        Raises:
            SourceError: if nothing can be read any more.
            UsageError: if frames of several senders would be mixed.
        """

    def mark(self) -> int:
        """Return the amount of data produced so far, for `caught_up`."""
        return 0

    def caught_up(self, mark: int) -> bool:
        """Return whether everything produced before a mark has been decoded.

        For a file it is always true: each scan is processed in order.
        """
        return True

    def send(self, name: str, /, *, timeout: float | None = None, **arguments: Any) -> Reply:
        """Send a command and return the reply; other threads may do the same.

        Raises:
            UnknownCommand, UnknownField, MissingField, OutOfRange: for an invalid command; nothing
                is sent.
            CommandError: if the device refuses, the connection is lost, or there is no device.
            ReplyTimeout: if the device does not reply.
        """

    def write(self, data: bytes, link: str = "data") -> None:
        """Send bytes as they are; a reply is read like all other data.

        Raises:
            UsageError: for a text, or a link that the sensor does not have.
            SourceError: if the connection is lost, or there is no device.
        """

    def first_frames(self) -> FirstFrames:
        """Return the frames that apply from the first packet on; of a live sensor none."""
        return FirstFrames()

    def close(self) -> None:
        """Stop the sensor if it was started, and release all resources.

        A second call does nothing.
        """


def decode_chunks(decoder: Decoder, chunks: Sequence[Chunk]) -> list[Frames]:
    """Return the frames that consecutive chunks complete.

    Each frame has the arrival time of the chunk that holds its last byte.
    """
    if not decoder.stream:
        return [decoder.datagrams([chunk.data for chunk in chunks], [chunk.at for chunk in chunks])]
    if len(chunks) == 1:
        return decoder.frames(chunks[0].data, chunks[0].at)
    end = decoder.stats.bytes_in
    ends = list[int]()
    times = list[int]()
    for chunk in chunks:
        end += len(chunk.data)
        ends.append(end)
        times.append(-1 if chunk.at is None else chunk.at)
    batches = decoder.frames(b"".join([chunk.data for chunk in chunks]), chunks[-1].at)
    return _set_arrival(batches, np.array(ends), np.array(times))


def _decode_stream(
    decoder: Decoder, packets: CapturedDatagrams, size: int
) -> Iterator[list[Frames]]:
    """Yield the frames that the packets of a byte stream complete.

    Each frame has the arrival time of the packet that holds its last byte.

    Args:
        size: bytes decoded together.
    """
    data = packets.joined
    ends = decoder.stats.bytes_in + np.cumsum(packets.sizes)
    times = np.where(packets.at, packets.at, -1)
    for start in range(0, len(data), size):
        yield _set_arrival(decoder.frames(data[start : start + size]), ends, times)


def _set_arrival(
    batches: Iterable[Frames], ends: NDArray[np.int64], times: NDArray[np.int64]
) -> list[Frames]:
    """Return frames with the arrival times of the pieces of input that hold their last bytes.

    Args:
        ends: of the pieces, (n,) bytes from the start of the input.
        times: of the pieces, (n,) ns since 1970; -1 if unknown.
    """
    return [
        frames.with_arrivals(times[ends.searchsorted(frames.offsets + frames.sizes)])
        for frames in batches
    ]


def select_frames(batches: Sequence[Frames], awaited: frozenset[str]) -> list[Found]:
    """Return the frames of some types, one by one."""
    picked = []
    for frames in batches:
        kinds = [index for index, name in enumerate(frames.names) if name in awaited]
        picked += frames.select(np.isin(frames.kinds, kinds)).found()
    return picked


#: bytes or datagrams decoded together.
BATCH_BYTES = 1 << 18
BATCH_CHUNKS = 1024


class FileInput(DeviceInput):
    """Input from a transport that ends, such as a file.

    The consumer sets the pace, so nothing is ever dropped.

    Attributes:
        state: "streaming", "ended" or "closed".
        senders: the senders of its frames.
    """

    state = "streaming"

    def __init__(
        self, source: str | Path, sensor: Sensor, opened: Transport, *, backend: str
    ) -> None:
        self._source = source
        self.sensor = sensor
        self._transport = opened
        self.decoder: Decoder = sensor.decoder(stream=not opened.datagrams, backend=backend)
        self.senders = SenderCheck(source, sensor)
        self._batch_bytes = 0  # in bytes; 0 for the fastest size
        self._arrivals = self._read()

    @property
    def ended(self) -> bool:
        return self.state != "streaming"

    @property
    def warnings(self) -> list[str]:
        warnings = list(self._transport.warnings)
        stats = self.decoder.stats
        if (
            self.state == "ended"
            and stats.bytes_in
            and not any(name in stats.frames for name in self.sensor.data_frames)
        ):
            text = (
                f"{self._source}: {stats.bytes_in} bytes, and no data frame of {self.sensor.id}"
                " among them"
            )
            warnings.append(f"{text}; next: lidarspec detect {quote(str(self._source))}")
        return warnings

    @property
    def stats(self) -> Counters:
        stats = self.decoder.stats
        stats.foreign = self._transport.foreign
        stats.disconnects = self._transport.disconnects
        stats.unread = self._transport.unread
        return stats

    @property
    def place(self) -> tuple[int, int] | None:
        return self._transport.place

    def next(self, wait: float) -> Arrival | None:
        arrival = next(self._arrivals, None)
        if arrival is None:
            self.state = "ended"
        else:
            self.store_info_frames(arrival.found)
        return arrival

    def skip(self, at: int) -> bool:
        return self._transport.skip(at)

    def gather(self, until: float) -> None:
        """Do nothing: the data of a file does not arrive over time."""

    def read_ahead(self, size: int) -> None:
        self._batch_bytes = size

    def begin(self) -> None:
        """Do nothing: a file has no sensor that could be started."""

    def send(self, name: str, /, *, timeout: float | None = None, **arguments: Any) -> Reply:
        raise CommandError(
            f"{self.sensor.id} {name}: {self._source} is a file, there is no device to send it to"
        )

    def write(self, data: bytes, link: str = "data") -> None:
        raise SourceError(f"{self._source} is a file, there is no device to send bytes to")

    def close(self) -> None:
        self.state = "closed"
        self._transport.close()
        self._arrivals = iter(())  # it refers to this object and to the data that was read

    def first_frames(self) -> FirstFrames:
        """Find the frames that apply from the start of the file.

        They are the state of points and the reference of the clock.
        """
        path = Path(str(self._source).partition("?")[0])
        if not is_searched(self.sensor) or not (
            is_stored(self._source) or path.is_file() or path.is_dir()
        ):
            return FirstFrames()
        with contextlib.closing(transport(self._source)) as source:
            decoder = self.sensor.decoder(stream=not source.datagrams)
            if isinstance(source, CaptureTransport) and source.datagrams:
                batches = (
                    [decoder.decode_placed(batch.buffer, batch.starts, batch.sizes, batch.at)]
                    for batch in source.batches()
                )
                return find_first_frames(self.sensor, batches)
            return find_first_frames(
                self.sensor, (decode_chunks(decoder, [chunk]) for chunk in source.chunks())
            )

    def _read(self) -> Iterator[Arrival]:
        """Yield every incoming frame, in batches."""
        if isinstance(self._transport, CaptureTransport):
            for datagrams in self._transport.batches():
                if datagrams.gap:
                    yield Arrival(self.decoder.take_pending(), interrupted=True)
                if self.decoder.stream:
                    yield from map(
                        Arrival,
                        _decode_stream(self.decoder, datagrams, self._batch_bytes or BATCH_BYTES),
                    )
                    continue
                for part in (
                    datagrams.parts(self._batch_bytes) if self._batch_bytes else [datagrams]
                ):
                    spans = self.decoder.decode_placed(
                        part.buffer, part.starts, part.sizes, part.at
                    )
                    self.senders.check(part.sent(spans))
                    yield Arrival([spans])
            yield Arrival(self.decoder.take_pending())
            return
        for batch in self._batches():
            if batch[0].gap or batch[0].quiet:
                yield Arrival(self.decoder.take_pending(), interrupted=batch[0].gap)
            batches = decode_chunks(self.decoder, batch)
            if not self.decoder.stream:
                self.senders.check(frame_senders(batch, batches[0], self.decoder.stats.bytes_in))
            yield Arrival(batches)
        yield Arrival(self.decoder.take_pending())

    def _batches(self) -> Iterator[list[Chunk]]:
        """Yield chunks in batches that are worth decoding together.

        A batch ends before an interruption or silence of the line.
        """
        batch: list[Chunk] = []
        size = 0
        for chunk in self._portions():
            if batch and (
                chunk.gap
                or chunk.quiet
                or size >= (self._batch_bytes or BATCH_BYTES)
                or len(batch) >= BATCH_CHUNKS
            ):
                yield batch
                batch = []
                size = 0
            batch.append(chunk)
            size += len(chunk.data)
        if batch:
            yield batch

    def _portions(self) -> Iterator[Chunk]:
        """Yield the chunks; chunks of a stream are cut to the size of `read_ahead`."""
        for chunk in self._transport.chunks():
            rest = chunk
            while self.decoder.stream and 0 < (size := self._batch_bytes) < len(rest.data):
                yield replace(rest, data=rest.data[:size])
                rest = replace(rest, data=rest.data[size:], gap=False, quiet=False)
            yield rest
