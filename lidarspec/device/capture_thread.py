"""Read a live source in a thread, and queue the data for decoding.

The thread only reads, records and queues, so that a slow consumer causes no loss in the recording.
If the queue is full, the policy "drop_oldest" drops the oldest chunks, and "block" makes the thread
wait.

If the device disappears, the thread reports this, and tries to open the device again with growing
pauses.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import replace
from enum import Enum

from lidarspec.errors import SourceError, UsageError
from lidarspec.recording.background_writer import TrafficLog
from lidarspec.transports.host_clock import HostClock
from lidarspec.transports.protocol import POLL_S, Chunk, Disconnected, LiveTransport

#: The limits of a queue. They allow several seconds of data of the fastest sensors.
MAX_QUEUED_CHUNKS = 1 << 16
MAX_QUEUED_BYTES = 1 << 25
#: First and longest pause between attempts to open a device again.
MIN_RETRY_PAUSE_S = 0.02
MAX_RETRY_PAUSE_S = 0.25
POLICIES = ("drop_oldest", "block")


class LinkEvent(Enum):
    """A change of a link: it became silent, was lost, or is back."""

    SILENT = "silent"
    LOST = "lost"
    BACK = "back"


Item = Chunk | LinkEvent | BaseException
Event = tuple[str, Item]


class BoundedQueue:
    """A queue of events from the links of a device: chunks, link events and errors.

    Args:
        policy: what a full queue does: "drop_oldest" or "block".
        size: maximum total size of the chunks, in bytes.
    """

    def __init__(
        self,
        policy: str = "drop_oldest",
        *,
        chunks: int = MAX_QUEUED_CHUNKS,
        size: int = MAX_QUEUED_BYTES,
    ) -> None:
        if policy not in POLICIES:
            raise UsageError(
                f"invalid overflow policy: expected {' or '.join(POLICIES)}, got {policy!r}"
            )
        self._blocks = policy == "block"
        self._max_chunks = chunks
        self._max_bytes = size
        self._events: deque[Event] = deque()
        self._kept_events: dict[Event, None] = {}  # events other than data that left the full queue
        self._links_with_gap = set[str]()  # links with dropped chunks; their next chunk has a gap
        self._waiting = self._size = 0
        self._changed = threading.Condition()
        self.produced = self.consumed = self.dropped = 0
        self.closed = False

    def __len__(self) -> int:
        return self._waiting

    def put(self, link: str, items: Iterable[Item]) -> None:
        """Add events of a link in order; if the queue is full, apply the policy."""
        with self._changed:
            for item in items:
                if isinstance(item, Chunk):
                    size = len(item.data)
                    if self._waiting >= self._max_chunks or self._size + size > self._max_bytes:
                        self._make_room(size)
                    if self.closed:
                        return
                    self.produced += 1
                    self._waiting += 1
                    self._size += size
                self._events.append((link, item))
            self._changed.notify_all()

    def take(
        self, timeout: float, *, until: float = 0.0, max_events: int = MAX_QUEUED_CHUNKS
    ) -> list[Event]:
        """Remove events from the queue and return them; wait if it is empty.

        Args:
            timeout: maximum time to wait, in seconds. If no event arrives in time, the result is
                empty.
            until: a time of `time.monotonic` until which events are collected.
            max_events: maximum number of events.
        """
        pause = min(until - time.monotonic(), timeout)
        if pause > 0 and not self.closed:
            time.sleep(pause)  # data that arrives meanwhile does not wake this thread
        with self._changed:
            self._changed.wait_for(
                lambda: self._events or self._kept_events or self.closed, timeout - max(pause, 0.0)
            )
            events = list(self._kept_events)
            self._kept_events.clear()
            if len(events) + len(self._events) <= max_events and not self._links_with_gap:
                events += self._events
                self._events.clear()
                self.consumed += self._waiting
                self._waiting = self._size = 0
            while self._events and len(events) < max_events:
                events.append(self._take_oldest())
            self._changed.notify_all()
            return events

    def close(self) -> None:
        """Accept no further events, and wake all waiting threads."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()

    def _take_oldest(self) -> Event:
        link, item = self._events.popleft()
        if isinstance(item, Chunk):
            self.consumed += 1
            self._waiting -= 1
            self._size -= len(item.data)
            if link in self._links_with_gap:
                self._links_with_gap.discard(link)
                item = replace(item, gap=True)
        return link, item

    def _make_room(self, size: int) -> None:
        while (
            self._waiting
            and not self.closed
            and (self._waiting >= self._max_chunks or self._size + size > self._max_bytes)
        ):
            if self._blocks:
                self._changed.notify_all()
                self._changed.wait(POLL_S)
                continue
            link, item = self._events.popleft()
            if isinstance(item, Chunk):
                self.dropped += 1
                self._waiting -= 1
                self._size -= len(item.data)
                self._links_with_gap.add(link)
            else:
                self._kept_events.pop((link, item), None)
                self._kept_events[(link, item)] = None


class CaptureThread:
    """The thread that reads a live transport.

    Args:
        transport: the open transport. `close` closes it.

    Attributes:
        last_arrival: the time of `time.monotonic` when data last arrived, or when the transport was
            opened.
    """

    def __init__(
        self,
        transport: LiveTransport,
        queue: BoundedQueue,
        *,
        link: str = "data",
        log: TrafficLog | None = None,
        clock: HostClock | None = None,
    ) -> None:
        self.transport = transport
        self.connected = True
        self.disconnects = 0
        self.last_arrival = time.monotonic()
        self._queue = queue
        self._link = link
        self._log = log
        self._clock = clock or HostClock()
        self.warnings = list[str]()
        self._stop = threading.Event()
        self._recording_lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, name=f"capture of {link}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop reading and close the port or socket; a second call does nothing."""
        self._stop.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(5.0)
        self.transport.close()

    def record(self, log: TrafficLog | None) -> None:
        """Start, replace or stop the recording.

        Events that are already in the queue are discarded in all three cases. After a recording was
        started or replaced, the consumer therefore gets only events that are in the new recording.

        Args:
            log: the new recording; None to stop recording.
        """
        while not self._recording_lock.acquire(timeout=POLL_S):
            self._queue.take(0.0)  # the thread may wait for room in the queue
        self._log = log
        while self._queue.take(0.0):
            pass
        self._recording_lock.release()

    def _run(self) -> None:
        try:
            silence = 0.0
            gap = False
            quiet = False
            while not self._stop.is_set():
                began = time.monotonic()
                try:
                    chunks = self.transport.read(POLL_S)
                except Disconnected:
                    if not self._reconnect():
                        return
                    silence = 0.0
                    gap = True
                    quiet = False
                    continue
                if chunks:
                    self.last_arrival = time.monotonic()
                    self._record_and_queue(chunks, gap=gap, quiet=quiet)
                    silence = 0.0
                    gap = False
                    quiet = False
                    continue
                silence += time.monotonic() - began
                if silence >= self.transport.silence and not quiet:
                    quiet = True
                    self._queue.put(self._link, [LinkEvent.SILENT])
        except BaseException as error:
            self._queue.put(self._link, [error])

    def _record_and_queue(self, chunks: list[Chunk], *, gap: bool, quiet: bool) -> None:
        """Record and queue chunks."""
        if gap or quiet:
            chunks[0] = replace(chunks[0], gap=gap, quiet=quiet)
        self._check_wall_clock(chunks[0])
        with self._recording_lock:
            if self._log is not None:
                for chunk in chunks:
                    self._log.write(chunk)
            self._queue.put(self._link, chunks)

    def _check_wall_clock(self, chunk: Chunk) -> None:
        """Warn if the computer's wall clock was set, and record the change."""
        step_ns = self._clock.find_step()
        if step_ns is None:
            return
        self.warnings = [
            f"the clock of this computer was stepped by {step_ns / 1e9:+.3f} s; arrival times"
            " continue without this step"
        ]
        if self._log is not None:
            self._log.event("clock", chunk.at, ahead_ns=self._clock.lead_ns)

    def _reconnect(self) -> bool:
        """Wait until the device is back; return False if the capture was stopped first."""
        self.connected = False
        self.disconnects += 1
        self._queue_event(LinkEvent.LOST, "disconnect")
        pause = MIN_RETRY_PAUSE_S
        while not self._stop.wait(pause):
            pause = min(pause * 2, MAX_RETRY_PAUSE_S)
            try:
                self.transport.reopen()
            except SourceError:
                continue
            self.connected = True
            self.last_arrival = time.monotonic()
            self._queue_event(LinkEvent.BACK, "reconnect")
            return True
        return False

    def _queue_event(self, mark: LinkEvent, event: str) -> None:
        if self._log is not None:
            self._log.event(event, self._clock.now())
        self._queue.put(self._link, [mark])
