"""Record a source to a file.

A live source is recorded until a limit is reached or the caller stops. A file is copied as fast as
possible.

If the sensor of a live source is known, a `Device` starts the sensor and counts its packets.
Otherwise, nothing is sent.
"""

from __future__ import annotations

import contextlib
import math
import re
import time
from collections.abc import Generator, Iterable
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lidarspec.device.capture_thread import BoundedQueue, CaptureThread, LinkEvent
from lidarspec.device.device import Device
from lidarspec.errors import SourceError, UsageError
from lidarspec.recording.background_writer import BackgroundWriter
from lidarspec.recording.format import Header
from lidarspec.recording.recorders import RecorderFactory, open_recorder
from lidarspec.sensor_operations import Sensor
from lidarspec.transports.files import RecordingTransport
from lidarspec.transports.host_clock import HostClock
from lidarspec.transports.open_url import is_live, open_transport
from lidarspec.transports.protocol import Chunk, LiveTransport, Transport

#: Time between two checks of the limits and of the disk.
CHECK_PERIOD_S = 0.1
#: Matches the numbers in a warning. A warning is not reported again if only its numbers change.
_NUMBERS = re.compile(r"[\d.]+")


def make_recorder(
    opened: Transport, source: str, target: str, sensor: Sensor | str | None, *, overwrite: bool
) -> BackgroundWriter:
    """Create a recording for a source, and return the recorder that writes it.

    If the source is itself a recording, its header is copied.

    Args:
        source: the SOURCE, which is stored in the header.
        sensor: the sensor, or its id; None if unknown.

    Raises:
        UnknownFormat, UsageError, SourceError: the errors of `open_recorder`.
    """
    if isinstance(opened, RecordingTransport):
        header = opened.header
    else:
        header = Header(source=source, baud=opened.baud)
    return open_recorder(
        target,
        sensor or header.sensor,
        header.source,
        datagrams=opened.datagrams,
        baud=header.baud,
        overwrite=overwrite,
    )


class LimitedRecorder:
    """A recorder with a time limit for arriving data.

    Args:
        recorder: the recorder that writes the file; `LimitedRecorder.close` closes it, too.
        seconds: the time limit, counted from the first arrival; None for no limit.

    Attributes:
        first: arrival time of the first recorded chunk, ns; None if nothing has arrived.
        last: arrival time of the last recorded chunk, ns; None if nothing has arrived.
        is_over: whether the time limit has passed.
    """

    def __init__(self, recorder: BackgroundWriter, seconds: float | None) -> None:
        self._recorder = recorder
        if seconds is None:
            self._limit_ns = math.inf
        else:
            self._limit_ns = seconds * 1e9
        self.first: int | None = None
        self.last: int | None = None
        self.is_over = False

    @property
    def error(self) -> SourceError | None:
        """The error of writing the file; None if there was none."""
        return self._recorder.error

    @property
    def duration(self) -> float | None:
        """Seconds from the first to the last recorded arrival; None if they are unknown.

        In a corrupt capture, the last arrival may be before the first.
        """
        if self.first is None or self.last is None or self.last < self.first:
            return None
        return (self.last - self.first) / 1e9

    def contains(self, chunk: Chunk) -> bool:
        """Return whether a received chunk was written to the file."""
        if chunk.at is None:
            return True  # the time limit does not apply
        return self.last is not None and chunk.at <= self.last

    def write(self, chunk: Chunk, direction: Literal["in", "out"] = "in") -> None:
        """Record a sent chunk, or a received chunk if it arrived before the time limit."""
        if direction == "in":
            self._check_limit(chunk)
            if self.is_over:
                return
            if chunk.at is not None:
                self.last = chunk.at
        self._recorder.write(chunk, direction)

    def _check_limit(self, chunk: Chunk) -> None:
        """End the recording if a chunk arrived after the time limit."""
        if chunk.at is None:
            return
        if self.first is None:
            self.first = chunk.at
        if chunk.at - self.first >= self._limit_ns:
            self.is_over = True

    def event(self, name: str, at: int | None = None, **details: Any) -> None:
        """Record an event of the link."""
        self._recorder.event(name, at, **details)

    def end(self) -> None:
        """Ignore all further arrivals."""
        self.is_over = True

    def close(self) -> None:
        """Close the recorder."""
        self._recorder.close()


class SourceRecording:
    """Records in one file everything that a source sends.

    Args:
        target: an .lsr, .pcap, .pcapng or .bin file.
        sensor: the sensor; None to record raw bytes.
        seconds: the time limit, counted from the opening of a live source, or from the first
            arrival in a file; None for no limit.
        count: the maximum number of data packets, or of datagrams if the sensor is unknown; None
            for no limit.
        start: whether to send the sensor's commands for opening and closing.
        overwrite: whether the file may exist.
        salvage: whether to continue after damaged parts, if the source is a recording.

    Attributes:
        packets: number of data packets so far, or of datagrams if the sensor is unknown.
        elapsed: seconds since the source was opened. At the end, the duration of the recording in
            seconds, if it has arrival times.
        unread: number of bytes that could not be read from a damaged file.
    """

    def __init__(
        self,
        source: str,
        target: str,
        sensor: Sensor | None = None,
        *,
        seconds: float | None = None,
        count: int | None = None,
        start: bool = True,
        overwrite: bool = False,
        salvage: bool = False,
    ) -> None:
        self._source = source
        self._target = target
        self._sensor = sensor
        self._seconds = seconds
        self._count = count
        self._start = start
        self._overwrite = overwrite
        self._salvage = salvage
        self.recorder: BackgroundWriter | None = None
        self.device: Device | None = None
        self._limited_recorder: LimitedRecorder | None = None
        self.packets = 0
        self.elapsed = 0.0
        self.unread = 0
        self._began = 0.0
        self._reported = set[str]()  # the present warnings, without numbers

    def run(self) -> Generator[str, None, None]:
        """Record until the end or a limit; yield messages.

        Yields "" regularly while there is no message, so that the caller can show the progress.

        Raises:
            UsageError: if the file exists, or its format cannot contain the data of the source.
            SourceError: if the source cannot be read, or the file cannot be written.
        """
        if self._sensor is not None and is_live(self._source):
            return self._record_device(self._sensor)
        return self._record_undecoded()

    def _record_device(self, sensor: Sensor) -> Generator[str, None, None]:
        """Record the data of a sensor in a thread, and decode it to count packets."""
        device_warnings = list[str]()  # kept for the case that decoding fails
        failures = list[str]()
        with Device(
            self._source, sensor, start=self._start, record=RecorderFactory(self._open_recorder)
        ) as self.device:
            recorder = self._limited_recorder
            assert recorder is not None  # the device has called `_open_recorder`
            try:
                while not self._is_finished(recorder):
                    try:
                        self._count_next(self.device, recorder)
                        device_warnings = self.device.warnings
                    except SourceError:
                        raise
                    except (Exception, SystemExit) as error:  # a plugin may call sys.exit
                        failure = (
                            f"{sensor.id}: decoding failed ({type(error).__name__}: {error});"
                            " the recording continues"
                        )
                        if failure not in failures:
                            failures.append(failure)
                        time.sleep(CHECK_PERIOD_S)
                    yield "\n".join(self._take_new_warnings([*device_warnings, *failures]))
            finally:
                self._end(recorder)
                with contextlib.suppress(Exception, SystemExit):
                    self._count_remaining(self.device, recorder)

    def _take_new_warnings(self, warnings: Iterable[str]) -> list[str]:
        """Return the warnings that were not passed to the previous call."""
        by_text = {_NUMBERS.sub("", warning): warning for warning in warnings}
        new_warnings = [warning for text, warning in by_text.items() if text not in self._reported]
        self._reported = set(by_text)
        return new_warnings

    def _count_remaining(self, device: Device, recorder: LimitedRecorder) -> None:
        """Count the packets that are in the file, but were not decoded yet."""
        while self._count_next(device, recorder):
            pass

    def _count_next(self, device: Device, recorder: LimitedRecorder) -> bool:
        """Count the next recorded packets; return False if there are none."""
        arrived = _read_arrival_times(device)
        if len(arrived) == 0:
            return False
        count = int(np.count_nonzero(arrived <= (recorder.last or 0)))
        self.packets += count
        return count == len(arrived)

    def _end(self, recorder: LimitedRecorder) -> None:
        """Ignore further arrivals, and set `elapsed` to the duration of the file."""
        recorder.end()
        if recorder.duration is not None:
            self.elapsed = recorder.duration

    def _record_undecoded(self) -> Generator[str, None, None]:
        """Record a live source whose sensor is unknown, or copy a file."""
        source: Transport
        if self._salvage:
            source = RecordingTransport(self._source, salvage=True)
        else:
            source = open_transport(self._source, self._sensor)
        with (
            contextlib.closing(source),
            contextlib.closing(self._open_recorder(source, self._sensor)) as recorder,
        ):
            if isinstance(source, LiveTransport):
                yield from self._record_live(source, recorder)
            else:
                yield from self._copy(source, recorder)
            self.unread = source.unread
            yield from source.warnings

    def _record_live(
        self, source: LiveTransport, recorder: LimitedRecorder
    ) -> Generator[str, None, None]:
        """Record in a separate thread, and count the recorded datagrams."""
        queue = BoundedQueue()
        with contextlib.closing(CaptureThread(source, queue, log=recorder)) as capture:
            try:
                while not self._is_finished(recorder):
                    yield ""
                    for event in self._count_queued(source, queue, recorder, CHECK_PERIOD_S):
                        if event is LinkEvent.LOST:
                            yield (
                                f"{self._source}: the device is disconnected; waiting for it to"
                                " return"
                            )
                        elif event is LinkEvent.BACK:
                            yield f"{self._source}: the device has returned"
            finally:
                self._end(recorder)
                self._count_queued(source, queue, recorder, 0.0)  # arrived before the end
            yield from capture.warnings

    def _count_queued(
        self, source: LiveTransport, queue: BoundedQueue, recorder: LimitedRecorder, wait: float
    ) -> list[LinkEvent]:
        """Empty the queue: count the recorded datagrams, and return the link events.

        Args:
            wait: maximum time to wait for an item, in seconds.
        """
        events = list[LinkEvent]()
        for _, item in queue.take(wait):
            if isinstance(item, BaseException):
                raise item
            if isinstance(item, LinkEvent):
                events.append(item)
            elif source.datagrams and recorder.contains(item):
                self.packets += 1
        return events

    def _copy(self, source: Transport, recorder: LimitedRecorder) -> Generator[str, None, None]:
        """Copy a file, or record standard input with the times of arrival."""
        clock = HostClock()
        assert self.recorder is not None
        try:
            for chunk in source.chunks():
                if self._is_finished(recorder, is_timed=False):
                    return
                yield ""
                self.recorder.wait_for_room()
                needs_time = chunk.at is None and self._source == "-"
                recorder.write(replace(chunk, at=clock.now()) if needs_time else chunk)
                if recorder.is_over:
                    return
                if source.datagrams:
                    self.packets += 1
        finally:
            self._end(recorder)

    def _open_recorder(self, source: Transport, sensor: Sensor | str | None) -> LimitedRecorder:
        """Create the recorder for an open source, and start to measure `elapsed`."""
        is_decoded = sensor is not None and isinstance(source, LiveTransport)
        can_count = source.datagrams or is_decoded
        if self._count is not None and not can_count:
            raise UsageError(
                f"-n counts packets, but {self._source} is a byte stream: name the sensor with"
                " -s, or limit the time with -t"
            )
        self.recorder = make_recorder(
            source, self._source, self._target, sensor, overwrite=self._overwrite
        )
        self._limited_recorder = LimitedRecorder(self.recorder, self._seconds)
        self._began = time.monotonic()
        return self._limited_recorder

    def _is_finished(self, recorder: LimitedRecorder, *, is_timed: bool = True) -> bool:
        """Update `elapsed`, and return whether a limit is reached.

        Args:
            is_timed: whether the time limit applies.
        """
        assert self.recorder is not None
        if self.recorder.error is not None:
            self.recorder.sync()  # raises the error
        self.elapsed = time.monotonic() - self._began
        is_late = (
            is_timed
            and self._seconds is not None
            and (recorder.is_over or self.elapsed >= self._seconds)
        )
        return is_late or (self._count is not None and self.packets >= self._count)


def _read_arrival_times(device: Device) -> NDArray[np.int64]:
    """Return the arrival times of the next packets, (n,) ns since 1970."""
    if device.sensor.has_points:
        packets = next(device.packets(wait=CHECK_PERIOD_S), None)
        batches = [] if packets is None else [packets]
    else:
        every = device.packets_by_frame(device.sensor.main_frames, wait=CHECK_PERIOD_S)
        batches = list(next(every, {}).values())
    return np.concatenate([np.zeros(0, np.int64), *(batch.host_ns for batch in batches)])
