"""A source recorded as it comes: a live one until it is told to end, a file as fast as the disk takes it.

A live source whose sensor is known is a `Device`: it is started and stopped, and what arrives is decoded to be counted. Without a
sensor a `Capture` reads it and nothing is sent. The recorder is made when the source is open, since only then it is known what it
carries.
"""

from __future__ import annotations

import contextlib
import re
import time
from collections.abc import Generator
from dataclasses import replace

from lidarspec.device.capture_thread import BoundedQueue, Capture, Mark
from lidarspec.device.device import Device
from lidarspec.errors import SourceError, UsageError
from lidarspec.recording.appending import Appender
from lidarspec.recording.format import Header
from lidarspec.recording.recorders import MadeFor, recorder
from lidarspec.spec.description import Spec
from lidarspec.spec.sensor import Sensor
from lidarspec.transports.base import HostClock
from lidarspec.transports.files import RecordingTransport
from lidarspec.transports.open_url import is_live, transport
from lidarspec.transports.protocol import Chunk, LiveTransport, Transport

#: seconds between two looks at the time and at the disk.
TURN = 0.1
#: what may change in a warning that has been said.
_FIGURES = re.compile(r"[\d.]+")


def recorder_like(opened: Transport, source: str, target: str, sensor: Spec | str | None, *, overwrite: bool) -> Appender:
    """The recorder of a new file in the place of an open source: of a recording its sensor, source and baud rate are taken over.

    Raises:
        UnknownFormat, UsageError, SourceError: as `recorder`.
    """
    header = opened.header if isinstance(opened, RecordingTransport) else Header(source=source, baud=opened.baud)
    whose, link = sensor or header.sensor, opened.datagrams
    return recorder(target, whose, header.source, datagrams=link, baud=header.baud, overwrite=overwrite)


class SourceRecording:
    """Everything that a source sends, brought into one file.

    Args:
        source: any SOURCE.
        target: an .lsr, .pcap, .pcapng or .bin file.
        sensor: whose bytes they are; without it they are recorded as they come.
        seconds, count: when it ends: after a time, or so many data packets of the sensor, or datagrams; None: never.
        start: whether the sensor is sent the commands for its start and end.
        overwrite: whether the file may exist.
        salvage: go on behind damaged places, where the source is a recording.

    Attributes:
        recorder: the file, None before the source is open.
        device: what reads a live source, None where its sensor is not known.
        packets: data packets of the sensor so far, or datagrams.
        elapsed: seconds since the source was open.
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
        self._source, self._target, self._sensor, self._seconds, self._count = source, target, sensor, seconds, count
        self._start, self._overwrite, self._salvage = start, overwrite, salvage
        self.recorder: Appender | None = None
        self.device: Device | None = None
        self.packets, self.elapsed, self._began = 0, 0.0, 0.0

    def run(self) -> Generator[str, None, None]:
        """Record until the end; again and again what is to be said, or "".

        Raises:
            UsageError: for a file that exists, or cannot hold what the source gives.
            SourceError: where the source cannot be read, or the file not be written.
        """
        return self._driven(self._sensor) if self._sensor is not None and is_live(self._source) else self._received()

    def _driven(self, sensor: Sensor) -> Generator[str, None, None]:
        """What a sensor sends is recorded by a thread; here it is decoded to be counted, whatever that fails at."""
        news, failures, known = list[str](), dict[str, None](), set[str]()
        with Device(self._source, sensor, start=self._start, record=MadeFor(self._opened)) as self.device:
            while self._goes_on():
                try:
                    self.packets += len(next(self.device.packets(wait=TURN), ()))
                    news = self.device.warnings
                except SourceError:
                    raise
                except (Exception, SystemExit) as error:
                    failures[f"{sensor.id}: decoding fails ({type(error).__name__}: {error}); the recording goes on"] = None
                    time.sleep(TURN)
                told = {_FIGURES.sub("", text): text for text in [*news, *failures]}
                yield "\n".join(text for what, text in told.items() if what not in known)
                known = set(told)

    def _received(self) -> Generator[str, None, None]:
        source = RecordingTransport(self._source, salvage=True) if self._salvage else transport(self._source, self._sensor)
        with contextlib.closing(source), self._opened(source, self._sensor) as file:
            yield from self._captured(source, file) if isinstance(source, LiveTransport) else self._copied(source, file)
            yield from source.warnings

    def _captured(self, source: LiveTransport, file: Appender) -> Generator[str, None, None]:
        """What arrives is recorded by a thread; here it is counted and thrown away."""
        queue = BoundedQueue()
        with contextlib.closing(Capture(source, queue, log=file)) as capture:
            while self._goes_on():
                yield ""
                for _, item in queue.take(TURN):
                    if isinstance(item, BaseException):
                        raise item
                    if isinstance(item, Chunk):
                        self.packets += source.datagrams
                    elif item is not Mark.SILENT:
                        yield f"{self._source}: the device is {'gone; waiting for it to come back' if item is Mark.LOST else 'back'}"
            yield from capture.warnings

    def _copied(self, source: Transport, file: Appender) -> Generator[str, None, None]:
        """What is in a file; standard input gets the time of its arrival."""
        first, clock = None, HostClock()
        for chunk in source.chunks():
            at = clock.now() if chunk.at is None and self._source == "-" else chunk.at
            first = at if first is None else first
            is_late = self._seconds is not None and at is not None and first is not None and at - first >= self._seconds * 1e9
            if is_late or not self._goes_on(timed=False):
                return
            yield ""
            file.keep_up()
            file.write(replace(chunk, at=at))
            self.packets += source.datagrams

    def _opened(self, source: Transport, sensor: Spec | str | None) -> Appender:
        """The recorder, now that the source is open, and the sensor known as it is read."""
        counts = source.datagrams or (self._sensor is not None and isinstance(source, LiveTransport))
        if self._count is not None and not counts:
            raise UsageError(f"-n counts packets, and {self._source} is a byte stream: name the sensor with -s, or give a time with -t")
        self.recorder = recorder_like(source, self._source, self._target, sensor, overwrite=self._overwrite)
        self._began = time.monotonic()
        return self.recorder

    def _goes_on(self, *, timed: bool = True) -> bool:
        """Whether it has neither taken its time nor got all that was asked for; raises what went wrong with the file."""
        assert self.recorder is not None
        if self.recorder.error is not None:
            self.recorder.sync()
        self.elapsed = time.monotonic() - self._began
        is_late = timed and self._seconds is not None and self.elapsed >= self._seconds
        return not is_late and (self._count is None or self.packets < self._count)
