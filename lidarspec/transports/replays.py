"""Send the bytes of a recording at their recorded times, or at another speed.

The bytes are sent to an outlet (a port or socket of this computer that other programs read), or to
a file.

All deadlines are computed from the deadline of the first chunk, so that delays do not add up. A
late chunk is sent immediately.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import time
from collections.abc import Callable, Iterable, Iterator

from lidarspec.errors import UsageError, WireError
from lidarspec.recording.background_writer import BackgroundWriter
from lidarspec.scans.selection import Times, iter_received
from lidarspec.transports.open_url import open_transport
from lidarspec.transports.outlets import READER_LEFT, Outlet
from lidarspec.transports.protocol import (
    Chunk,
    Disconnected,
    Sender,
    Transport,
    name_senders,
    no_bytes_message,
)

_SECOND_NS = 1_000_000_000
#: A chunk is counted as late if it is sent more than this time after its deadline.
LATE_NS = 20_000_000
#: If a recorded time is earlier than a previous time by more than this, the clock of the recording
#: computer was set.
_MAX_REORDERING_NS = _SECOND_NS


class Deadlines:
    """Computes the deadline of each chunk of a replay, in ns of the monotonic clock."""

    def __init__(self, speed: float | None, start: int) -> None:
        self._speed = speed
        self._start = start
        self._origin: int | None = None
        self._latest = 0

    def find(self, at: int | None) -> int:
        """Return the deadline of the next chunk.

        Args:
            at: the recorded arrival time of the chunk, ns; None if unknown.
        """
        if self._speed is None or at is None:
            return self._start
        if self._origin is None:
            self._origin = at
            self._latest = at
        # a small step back is a reordered datagram; after a large step, a clock was set
        elif at < self._latest - _MAX_REORDERING_NS:
            self._origin += at - self._latest
            self._latest = at
        self._latest = max(self._latest, at)
        return self._start + round((at - self._origin) / self._speed)


def iter_at_deadlines(
    chunks: Iterable[Chunk],
    *,
    speed: float | None = 1.0,
    now: Callable[[], int] = time.monotonic_ns,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[tuple[Chunk, int]]:
    """Yield each chunk at its deadline, with its delay in ns.

    Args:
        speed: 2.0 is twice as fast as recorded; None is as fast as possible.
        now: returns the time, ns.
    """
    deadlines: Deadlines | None = None
    for chunk in chunks:
        if deadlines is None:
            deadlines = Deadlines(speed, now())
        deadline = deadlines.find(chunk.at)
        while (remaining := deadline - now()) > 0:
            sleep(remaining / _SECOND_NS)
        yield chunk, 0 if speed is None else -remaining


class Replay:
    """Sends a recording to an outlet or a file.

    Args:
        source: the SOURCE of the recording, capture or raw file.
        destination: an outlet, or a new file; it is not closed.
        speed: 2.0 is twice as fast as recorded; None is as fast as possible.
        needs_times: whether a file without times is an error. If False, a file without times is
            sent as fast as possible.
        loop: whether to start again at the end.
        transport: the open transport of `source`, for example standard input; None to open it.
        times: the range of arrival times to send, as for `Selection(times=...)`.

    Attributes:
        late: number of chunks that were sent more than 20 ms late.
        greatest_delay_ns: the greatest delay of a chunk.
        is_timed: whether the chunks of the file have times.
        digest: SHA-256 of all bytes.
        unread: number of bytes that could not be read from a damaged file.
    """

    def __init__(
        self,
        source: str,
        destination: Outlet | BackgroundWriter,
        *,
        speed: float | None = 1.0,
        needs_times: bool = False,
        loop: bool = False,
        transport: Transport | None = None,
        times: Times = (None, None),
    ) -> None:
        self._source = source
        self._destination = destination
        self._speed = speed
        self._needs_times = needs_times
        self._loop = loop
        self._transport = transport
        self._times = times
        self._start = time.monotonic()
        self._endpoints: set[tuple[Sender | None, Sender | None]] = set()
        self.chunks = 0
        self.bytes = 0
        self.late = 0
        self.greatest_delay_ns = 0
        self.is_timed = True
        self.digest = hashlib.sha256()
        self.unread = 0

    @property
    def seconds(self) -> float:
        """The time since the first listener connected, in seconds."""
        return time.monotonic() - self._start

    @property
    def senders(self) -> set[str]:
        """The names of the recorded senders of datagrams."""
        return set(name_senders(self._endpoints).values()) - {""}

    def run(self) -> Iterator[str]:
        """Send the file once, or repeatedly if `loop` is set.

        Yields:
            "" after each sent chunk, so that the caller can show the progress or stop. In between,
            messages for the user, for example that the reader has disconnected.

        Raises:
            UsageError: if the file has no times, but they are required.
            WireError: if the file contains no data. This is raised before waiting for a reader.
            SourceError: if the file cannot be read, or nothing can be sent.
        """
        yield from self._run_once()
        while self._loop:
            yield from self._run_once()

    def _run_once(self) -> Iterator[str]:
        opened = self._transport or open_transport(self._source)
        self._transport = None
        with contextlib.closing(opened) as source:
            chunks = self._check_times(iter_received(source, self._times, self._source))
            # Reading before waiting for a listener, so that errors of the file are raised at once.
            first = next(chunks, None)
            if first is None:
                raise WireError(no_bytes_message(self._source, source.warnings))
            yield from self._await_listener()
            try:
                yield from self._send_all(itertools.chain([first], chunks))
            except Disconnected as error:
                yield str(error)
                return
            self.unread = source.unread
            if not self._loop:
                yield from source.warnings

    def _await_listener(self) -> Iterator[str]:
        """Wait until a reader has opened the outlet.

        If the reader of the turn before has disconnected meanwhile, yield a message about it.
        """
        if isinstance(self._destination, Outlet):
            has_reader_left = self._destination.await_listener()
            if has_reader_left:
                yield f"{self._destination.local_source}: {READER_LEFT}"
        if not self.chunks:
            self._start = time.monotonic()

    def _send_all(self, chunks: Iterable[Chunk]) -> Iterator[str]:
        """Send chunks at their deadlines, and yield "" after each."""
        for chunk, late_ns in iter_at_deadlines(chunks, speed=self._speed):
            self._send(chunk)
            self._count(chunk, late_ns)
            yield ""

    def _send(self, chunk: Chunk) -> None:
        if isinstance(self._destination, Outlet):
            self._destination.deliver(chunk)
        else:
            self._destination.wait_for_room()
            self._destination.write(chunk)

    def _check_times(self, chunks: Iterable[Chunk]) -> Iterator[Chunk]:
        """Yield the chunks; raise an error if a required time is missing."""
        for chunk in chunks:
            if chunk.at is None and self._speed is not None and self.is_timed:
                if self._needs_times:
                    raise UsageError(
                        f"{self._source} has no arrival times, so only --speed max is supported"
                    )
                self.is_timed = False
            yield chunk

    def _count(self, chunk: Chunk, late_ns: int) -> None:
        self.chunks += 1
        self.bytes += len(chunk.data)
        self.digest.update(chunk.data)
        if late_ns > LATE_NS:
            self.late += 1
        self.greatest_delay_ns = max(self.greatest_delay_ns, late_ns)
        self._endpoints.add((chunk.sender, chunk.receiver))
