"""Record a source as data arrives.

A live source is recorded until the recording is ended, a file as fast as the disk allows.

A live source with a known sensor is a `Device`: it is started and stopped, and the data is decoded
to be counted. Without a sensor a `CaptureThread` reads it and nothing is sent. The recorder is made
after the source is opened, because its format depends on the source.
"""

from __future__ import annotations

import contextlib
import math
import re
import time
from collections.abc import Generator
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from lidarspec.device.capture_thread import BoundedQueue, CaptureThread, LinkEvent
from lidarspec.device.device import Device
from lidarspec.errors import SourceError, UsageError
from lidarspec.recording.background_writer import BackgroundWriter
from lidarspec.recording.format import Header
from lidarspec.recording.recorders import RecorderFactory, recorder
from lidarspec.sensor_operations import Sensor
from lidarspec.transports.files import RecordingTransport
from lidarspec.transports.host_clock import HostClock
from lidarspec.transports.open_url import is_live, transport
from lidarspec.transports.protocol import Chunk, LiveTransport, Transport

#: seconds between two checks of the time and of the disk.
TURN = 0.1
#: the parts of a warning that change from one to the next.
_FIGURES = re.compile(r"[\d.]+")


def recorder_like(
    opened: Transport, source: str, target: str, sensor: Sensor | str | None, *, overwrite: bool
) -> BackgroundWriter:
    """Return the recorder of a new file for an open source.

    If the source is a recording, its sensor, source and baud rate are taken over.

    Raises:
        UnknownFormat, UsageError, SourceError: as `recorder`.
    """
    if isinstance(opened, RecordingTransport):
        header = opened.header
    else:
        header = Header(source=source, baud=opened.baud)
    whose = sensor or header.sensor
    link = opened.datagrams
    return recorder(
        target, whose, header.source, datagrams=link, baud=header.baud, overwrite=overwrite
    )


class TimedLog:
    """A recorder with a time limit, which starts at the first arrival.

    Sent data is always recorded.

    Args:
        recorder: writes the file; closed with this one.
        seconds: the limit; None for none.

    Attributes:
        first, last: arrival times of the first and the last recorded chunk, ns; None before the
            first.
        is_over: whether it ignores all further arrivals.
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
        """The failure of the file; None if there was none."""
        return self._recorder.error

    @property
    def seconds(self) -> float | None:
        """The time from the first arrival in the file to the last; None if there is none."""
        if self.first is None or self.last is None:
            return None
        return (self.last - self.first) / 1e9

    def has(self, chunk: Chunk) -> bool:
        """Return whether a chunk that was received is in the file."""
        return chunk.at is None or (self.last is not None and chunk.at <= self.last)

    def write(self, chunk: Chunk, direction: Literal["in", "out"] = "in") -> None:
        """Record sent data, and received data until the limit."""
        if direction == "in" and chunk.at is not None:
            if self.first is None:
                self.first = chunk.at
            if chunk.at - self.first >= self._limit_ns:
                self.is_over = True
            if self.is_over:
                return
            self.last = chunk.at
        self._recorder.write(chunk, direction)

    def event(self, name: str, at: int | None = None, **details: Any) -> None:
        """Record an event of the line."""
        self._recorder.event(name, at, **details)

    def end(self) -> None:
        """Ignore all further arrivals."""
        self.is_over = True

    def close(self) -> None:
        """Close the recorder."""
        self._recorder.close()


class SourceRecording:
    """Record everything that a source sends to one file.

    Args:
        source: any SOURCE.
        target: an .lsr, .pcap, .pcapng or .bin file.
        sensor: the sensor; without it raw bytes are recorded.
        seconds, count: the limits: a time, and a number of data packets of the sensor, or of
            datagrams; None for no limit.
        start: whether the commands for its start and end are sent to the sensor.
        overwrite: whether the file may exist.
        salvage: continue after damaged parts, if the source is a recording.

    Attributes:
        recorder: the file, None before the source is open.
        device: reads a live source; None if its sensor is unknown.
        packets: number of data packets of the sensor so far, or of datagrams; at the end, of those
            in the file.
        elapsed: seconds since the source was opened; at the end, between the first and the last
            arrival in the file.
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
        self._log: TimedLog | None = None
        self.packets = 0
        self.elapsed = 0.0
        self._began = 0.0

    def run(self) -> Generator[str, None, None]:
        """Record until the end; yield messages, or "" regularly.

        Raises:
            UsageError: for a file that exists, or cannot contain the data of the source.
            SourceError: if the source cannot be read, or the file cannot be written.
        """
        if self._sensor is not None and is_live(self._source):
            return self._record_device(self._sensor)
        return self._record_bytes()

    def _record_device(self, sensor: Sensor) -> Generator[str, None, None]:
        """Record the data of a sensor, and decode it to be counted.

        A thread records. Failures of decoding do not stop it.
        """
        news = list[str]()
        failures = dict[str, None]()
        printed = set[str]()
        with Device(
            self._source, sensor, start=self._start, record=RecorderFactory(self._open_log)
        ) as self.device:
            log = self._log
            assert log is not None
            try:
                while self._goes_on(log):
                    try:
                        self._count_next(self.device, log)
                        news = self.device.warnings
                    except SourceError:
                        raise
                    except (Exception, SystemExit) as error:
                        failures[
                            f"{sensor.id}: decoding fails ({type(error).__name__}: {error}); the"
                            " recording goes on"
                        ] = None
                        time.sleep(TURN)
                    current = {_FIGURES.sub("", text): text for text in [*news, *failures]}
                    yield "\n".join(text for what, text in current.items() if what not in printed)
                    printed = set(current)
            finally:
                self._end(log)
                with contextlib.suppress(Exception, SystemExit):
                    while self._count_next(self.device, log):
                        pass

    def _count_next(self, device: Device, log: TimedLog) -> bool:
        """Count the next packets that are in the file; return whether there may be more of them."""
        packets = next(device.packets(wait=TURN), None)
        if packets is None or len(packets) == 0:
            return False
        count = int(np.count_nonzero(packets.host_ns <= (log.last or 0)))
        self.packets += count
        return count == len(packets)

    def _end(self, log: TimedLog) -> None:
        """Ignore further arrivals, and set `elapsed` to the duration of the file."""
        log.end()
        if log.seconds is not None:
            self.elapsed = log.seconds

    def _record_bytes(self) -> Generator[str, None, None]:
        source = (
            RecordingTransport(self._source, salvage=True)
            if self._salvage
            else transport(self._source, self._sensor)
        )
        with (
            contextlib.closing(source),
            contextlib.closing(self._open_log(source, self._sensor)) as log,
        ):
            yield from (
                self._record_live(source, log)
                if isinstance(source, LiveTransport)
                else self._copy(source, log)
            )
            yield from source.warnings

    def _record_live(self, source: LiveTransport, log: TimedLog) -> Generator[str, None, None]:
        """Count and discard the data that a thread records."""
        queue = BoundedQueue()
        with contextlib.closing(CaptureThread(source, queue, log=log)) as capture:
            try:
                while self._goes_on(log):
                    yield ""
                    for mark in self._count_queued(source, queue, log, TURN):
                        if mark is LinkEvent.LOST:
                            yield f"{self._source}: the device is gone; waiting for it to come back"
                        elif mark is LinkEvent.BACK:
                            yield f"{self._source}: the device is back"
            finally:
                self._end(log)
                self._count_queued(source, queue, log, 0.0)
            yield from capture.warnings

    def _count_queued(
        self, source: LiveTransport, queue: BoundedQueue, log: TimedLog, wait: float
    ) -> list[LinkEvent]:
        """Take all events from the queue, and count the recorded datagrams.

        Returns:
            The interruptions of the line meanwhile.
        """
        marks = list[LinkEvent]()
        for _, item in queue.take(wait):
            if isinstance(item, BaseException):
                raise item
            if isinstance(item, LinkEvent):
                marks.append(item)
            elif source.datagrams and log.has(item):
                self.packets += 1
        return marks

    def _copy(self, source: Transport, log: TimedLog) -> Generator[str, None, None]:
        """Copy a file; data of standard input gets the time of its arrival."""
        clock = HostClock()
        assert self.recorder is not None
        for chunk in source.chunks():
            if not self._goes_on(log, timed=False):
                return
            yield ""
            self.recorder.wait_for_room()
            is_undated = chunk.at is None and self._source == "-"
            log.write(replace(chunk, at=clock.now()) if is_undated else chunk)
            if log.is_over:
                return
            self.packets += source.datagrams

    def _open_log(self, source: Transport, sensor: Sensor | str | None) -> TimedLog:
        """Return the recorder for an open source and its configured sensor."""
        counts = source.datagrams or (
            self._sensor is not None and isinstance(source, LiveTransport)
        )
        if self._count is not None and not counts:
            raise UsageError(
                f"-n counts packets, and {self._source} is a byte stream: name the sensor with -s,"
                " or give a time with -t"
            )
        self.recorder = recorder_like(
            source, self._source, self._target, sensor, overwrite=self._overwrite
        )
        self._log = TimedLog(self.recorder, self._seconds)
        self._began = time.monotonic()
        return self._log

    def _goes_on(self, log: TimedLog, *, timed: bool = True) -> bool:
        """Return whether neither the time nor the count of packets is reached.

        Raises the error of the recorder, if there is one.
        """
        assert self.recorder is not None
        if self.recorder.error is not None:
            self.recorder.sync()
        self.elapsed = time.monotonic() - self._began
        is_late = (
            timed and self._seconds is not None and (log.is_over or self.elapsed >= self._seconds)
        )
        return not is_late and (self._count is None or self.packets < self._count)
