"""The interface of a device's input, and the input of a file.

`FileInput` reads a file or standard input. `live_input.LiveInput` reads a live source. Both return
frames in batches.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from shlex import quote
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lidarspec.captures.bulk import CapturedDatagrams
from lidarspec.detect.identification import find_reporting_frames, read_info
from lidarspec.device.first_frames import FirstFrames, find_first_frames, needs_first_frames
from lidarspec.device.sender_filter import SenderCheck, find_frame_senders
from lidarspec.device.session import Reply
from lidarspec.errors import CommandError, SourceError
from lidarspec.frames.schema import make_schema
from lidarspec.framing.decoder import Decoder
from lidarspec.framing.results import Counters, Found, Frames
from lidarspec.remote_files import is_remote
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.description import Reported
from lidarspec.transports.files import CaptureTransport
from lidarspec.transports.open_url import open_transport
from lidarspec.transports.protocol import Chunk, Transport


@dataclass(frozen=True, eq=False)
class FrameBatch:
    """The frames in a portion of the input, in stream order.

    Attributes:
        interrupted: whether input was lost after these frames, so that no frame or scan extends
            into the next batch.
        replaced: whether this batch and all later batches are from another sensor than the batches
            before. Frames of the earlier sensor that wait to be decoded are then discarded.
    """

    frames: list[Frames] = field(default_factory=list)
    interrupted: bool = False
    replaced: bool = False


class DeviceInput(Protocol):
    """The source of a device's frames.

    `FileInput` and `LiveInput` are its subclasses. The methods that this class implements are for
    files, and `LiveInput` overrides some of them.

    Attributes:
        sensor: the sensor, configured with the options in `learned`.
        learned: the options that the sensor has reported in replies: name -> value.
        info_frames: name in `Sensor.info` -> the last frame with this information.
    """

    is_live: bool = False
    sensor: Sensor
    decoder: Decoder
    stays_on: bool = True
    learned: Mapping[str, Any] = MappingProxyType({})
    info_frames: Mapping[str, Found] = MappingProxyType({})

    def store_info_frames(self, batches: Sequence[Frames]) -> None:
        """For each name in `Sensor.info`, store the last frame with this information."""
        for frames in batches:
            for role, fact in self.sensor.reported.items():
                for name in frames.names:
                    if fact.path_in(name):
                        self._store_info_frame(role, fact, name, frames)

    def _store_info_frame(self, role: str, fact: Reported, name: str, frames: Frames) -> None:
        """Store the last frame of one type that reports a fact, such as the serial number."""
        rows = np.flatnonzero(np.equal(frames.kinds, frames.names.index(name)))
        if fact.where is not None:
            rows = rows[find_reporting_frames(self.sensor, fact, name, frames.select(rows))]
        for item in frames.select(rows[-1:]).to_found():
            if not self._lacks_values(role, item):
                self.info_frames = {**self.info_frames, role: item}

    def _lacks_values(self, role: str, item: Found) -> bool:
        """Return whether a frame lacks information that the stored frame has."""
        earlier = self.info_frames.get(role)
        if earlier is None or not make_schema(self.sensor.frames[item.frame].tree).parts:
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
        """The current warnings about the source."""

    @property
    def stats(self) -> Counters:
        """The counters of everything read so far, with the counters of the transports."""

    @property
    def queued(self) -> int | None:
        """The number of chunks that wait to be decoded; None if there is no queue."""
        return None

    @property
    def progress(self) -> tuple[int, int] | None:
        """The number of bytes read from a file, and its size; None if unknown."""
        return None

    def skip_until(self, time_ns: int) -> bool:
        """Skip data that arrived before a time; return whether data was skipped.

        Args:
            time_ns: ns since 1970.
        """
        return False

    def read_ahead(self, size: int) -> None:
        """Set how many bytes of a file are read and decoded at a time.

        For a live source, this method has no effect.

        Args:
            size: the number of bytes; 0 for the size with which a file is read fastest.
        """

    def delay_decoding(self, until: float) -> None:
        """Delay decoding of live data until a time, to decode more together.

        Args:
            until: a time of `time.monotonic`.
        """

    def begin(self) -> None:
        """Send the commands that the sensor declares for opening.

        Raises:
            CommandError: if an opening command fails. If data can be read without its reply, a
                warning is added instead.
        """

    def next(self, wait: float) -> FrameBatch | None:
        """Return the next batch of frames; wait at most `wait` seconds.

        Returns:
            The batch, or None if no frame arrives in time, or at the end.

        Raises:
            SourceError: if the source cannot be read any more.
            UsageError: if several sensors send frames in one file.
        """

    def count_arrived(self) -> int:
        """Return the number of chunks that have arrived so far; 0 for a file."""
        return 0

    def has_decoded_until(self, arrived: int) -> bool:
        """Return whether the first `arrived` chunks have been decoded; True for a file."""
        return True

    def send(self, name: str, /, *, timeout: float | None = None, **arguments: Any) -> Reply:
        """Send a command from any thread, and return the reply."""

    def write(self, data: bytes, link: str = "data") -> None:
        """Send bytes without interpreting them or waiting for a reply."""

    def first_frames(self) -> FirstFrames:
        """Return the frames that the first packets require; empty for a live source."""
        return FirstFrames()

    def close(self) -> None:
        """Stop the sensor if it was started, and release all resources."""


def decode_chunks(decoder: Decoder, chunks: Sequence[Chunk]) -> list[Frames]:
    """Return the frames that consecutive chunks complete.

    The arrival time of a frame is that of its last byte.
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
    return _assign_arrival_times(batches, np.array(ends), np.array(times))


def _decode_stream(
    decoder: Decoder, datagrams: CapturedDatagrams, size: int
) -> Iterator[list[Frames]]:
    """Yield the frames in captured datagrams that carry a byte stream.

    The arrival time of a frame is that of its last byte.

    Args:
        size: number of bytes that are decoded together.
    """
    data = datagrams.joined
    ends = decoder.stats.bytes_in + np.cumsum(datagrams.sizes)
    times = np.where(datagrams.at, datagrams.at, -1)
    for start in range(0, len(data), size):
        yield _assign_arrival_times(decoder.frames(data[start : start + size]), ends, times)


def _assign_arrival_times(
    batches: Iterable[Frames], ends: NDArray[np.int64], times: NDArray[np.int64]
) -> list[Frames]:
    """Return the frames, each with the arrival time of its last byte.

    Args:
        ends: the end of each datagram, (n,) bytes from the start of the input.
        times: the arrival time of each datagram, (n,) ns since 1970; -1 if unknown.
    """
    return [
        frames.with_arrivals(times[ends.searchsorted(frames.offsets + frames.sizes)])
        for frames in batches
    ]


def select_frames(batches: Sequence[Frames], names: frozenset[str]) -> list[Found]:
    """Return the frames whose type is in `names`, in stream order."""
    selected = []
    for frames in batches:
        kinds = [index for index, name in enumerate(frames.names) if name in names]
        selected += frames.select(np.isin(frames.kinds, kinds)).to_found()
    return selected


#: Chunks are collected until they reach one of these limits, and decoded together.
BATCH_BYTES = 1 << 18
BATCH_CHUNKS = 1024


class FileInput(DeviceInput):
    """Input from a file or standard input.

    Data is read only when it is requested.

    Attributes:
        state: "streaming", "ended" or "closed".
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
        self._batch_bytes = 0  # 0: BATCH_BYTES
        self._frame_batches = self._iter_frame_batches()

    @property
    def ended(self) -> bool:
        return self.state != "streaming"

    @property
    def warnings(self) -> list[str]:
        warnings = [*self._transport.warnings, *self.senders.warnings]
        stats = self.decoder.stats
        if (
            self.state == "ended"
            and stats.bytes_in
            and not any(name in stats.frames for name in self.sensor.main_frames)
        ):
            kind = "data frame" if self.sensor.has_points else "frame"
            text = f"{self._source}: no {kind} of {self.sensor.id} in {stats.bytes_in} bytes"
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
    def progress(self) -> tuple[int, int] | None:
        return self._transport.progress

    def next(self, wait: float) -> FrameBatch | None:
        batch = next(self._frame_batches, None)
        if batch is None:
            self.state = "ended"
        else:
            self.store_info_frames(batch.frames)
        return batch

    def skip_until(self, time_ns: int) -> bool:
        return self._transport.skip_until(time_ns)

    def delay_decoding(self, until: float) -> None:
        """Do nothing: the data of a file does not arrive over time."""

    def read_ahead(self, size: int) -> None:
        self._batch_bytes = size

    def begin(self) -> None:
        """Do nothing: a file has no sensor that could be started."""

    def send(self, name: str, /, *, timeout: float | None = None, **arguments: Any) -> Reply:
        raise CommandError(
            f"{self.sensor.id} {name}: {self._source} is a file, so no command can be sent"
        )

    def write(self, data: bytes, link: str = "data") -> None:
        raise SourceError(f"{self._source} is a file, so no bytes can be sent")

    def close(self) -> None:
        self.state = "closed"
        self._transport.close()
        self._frame_batches = iter(())  # the old generator holds this object and the read data

    def first_frames(self) -> FirstFrames:
        """Return the frames that are required to decode the first packets of the file.

        The file is opened and read a second time. The result is empty if the sensor requires no
        such frames, or if the source can be read only once.
        """
        path = Path(str(self._source).partition("?")[0])
        if not needs_first_frames(self.sensor) or not (
            is_remote(self._source) or path.is_file() or path.is_dir()
        ):
            return FirstFrames()
        with contextlib.closing(open_transport(self._source)) as source:
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

    def _iter_frame_batches(self) -> Iterator[FrameBatch]:
        """Yield every incoming frame, in batches."""
        if isinstance(self._transport, CaptureTransport):
            for datagrams in self._transport.batches():
                if datagrams.gap:
                    yield FrameBatch(self.decoder.take_pending(), interrupted=True)
                if self.decoder.stream:
                    yield from map(
                        FrameBatch,
                        _decode_stream(self.decoder, datagrams, self._batch_bytes or BATCH_BYTES),
                    )
                    continue
                for part in (
                    datagrams.parts(self._batch_bytes) if self._batch_bytes else [datagrams]
                ):
                    frames = self.decoder.decode_placed(
                        part.buffer, part.starts, part.sizes, part.at
                    )
                    self.senders.check(part.iter_frame_senders(frames))
                    self.senders.count(part.count_by_host())
                    yield FrameBatch([frames])
            yield FrameBatch(self.decoder.take_pending())
            return
        for chunks in self._iter_chunk_batches():
            if chunks[0].gap or chunks[0].quiet:
                yield FrameBatch(self.decoder.take_pending(), interrupted=chunks[0].gap)
            batches = decode_chunks(self.decoder, chunks)
            if not self.decoder.stream:
                self.senders.check(
                    find_frame_senders(chunks, batches[0], self.decoder.stats.bytes_in)
                )
                self.senders.count(Counter(chunk.sender[0] for chunk in chunks if chunk.sender))
            yield FrameBatch(batches)
        yield FrameBatch(self.decoder.take_pending())

    def _iter_chunk_batches(self) -> Iterator[list[Chunk]]:
        """Yield the chunks in batches to decode together."""
        batch: list[Chunk] = []
        size = 0
        for chunk in self._iter_portions():
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

    def _iter_portions(self) -> Iterator[Chunk]:
        """Yield the chunks; cut chunks of a stream to the size set by `read_ahead`."""
        for chunk in self._transport.chunks():
            rest = chunk
            while self.decoder.stream and 0 < (size := self._batch_bytes) < len(rest.data):
                yield replace(rest, data=rest.data[:size])
                rest = replace(rest, data=rest.data[size:], gap=False, quiet=False)
            yield rest
