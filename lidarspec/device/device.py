"""A sensor on a source: it yields packets and scans, and takes commands.

A `Device` gets frames from a `FileInput` or a `LiveInput`. A `PacketReader` makes packets and scans
from the frames.
"""

from __future__ import annotations

import time
import weakref
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Any, NoReturn, overload

from lidarspec.detect.identification import (
    detect,
    find_contradiction,
    find_simulated_sensor,
    read_info,
)
from lidarspec.detect.unknown_codes import find_unknown_codes
from lidarspec.device.device_input import DeviceInput, FileInput, FrameBatch
from lidarspec.device.live_input import PERIOD_S, LiveInput
from lidarspec.device.named_devices import find_device
from lidarspec.device.packet_reader import PacketReader
from lidarspec.device.session import Reply
from lidarspec.errors import SourceError, SourceTimeout, UsageError, suggest
from lidarspec.framing.decoder import DecoderObserver
from lidarspec.framing.results import Counters, Found
from lidarspec.packets.imu import ImuSamples, join_samples
from lidarspec.packets.packets import Packets
from lidarspec.packets.returns import describe_incomplete_groups
from lidarspec.plugins import sensor as named_sensor
from lidarspec.points.mount import Mount
from lidarspec.recording.background_writer import TrafficLog
from lidarspec.recording.recorders import RecordTo, get_recorder
from lidarspec.scans.scan import Scan
from lidarspec.scans.selection import ScanSelector, Selection
from lidarspec.scans.stream import ScanStream
from lidarspec.sensor_operations import Sensor
from lidarspec.transports.open_url import open_transport
from lidarspec.transports.protocol import ClosingContext, LiveTransport, Transport

#: number of frames at the start of the input that are compared with related models.
_MAX_CHECKED_FRAMES = 64
#: An iterator without a time limit waits for data in steps of this length.
_LONG_WAIT_S = 3600.0


class Device(ClosingContext):
    """A sensor that was opened on a source; a context manager.

    Attributes:
        source: the SOURCE.
        sensor: the sensor, given or detected.
        mount: the pose of the sensor on its carrier, such as a vehicle, from `lidarspec.toml`; None
            if the file has none. With a mount, scans are in the axes of the carrier, and packets in
            the axes of the sensor.
        imu_samples: the IMU samples that arrived with the last batch of `packets`, in the axes of
            the carrier for a sensor with a mount.
    """

    def __init__(
        self,
        source: str | Path,
        sensor: Sensor,
        *,
        backend: str = "auto",
        start: bool = True,
        record: RecordTo | None = None,
        overflow: str | None = None,
        period: float = PERIOD_S,
        mount: Mount | None = None,
    ) -> None:
        self.sensor = sensor
        self.source = source
        self.mount = mount
        self.imu_samples = join_samples([])
        self._readers: dict[str | None, PacketReader] = {}
        self._latest_stream: ScanStream | None = None
        self._unseen_scans: deque[Scan] = deque()
        # The batch in which `latest` found its last scan of a file.
        self._ahead: FrameBatch | None = None
        self._selector: ScanSelector | None = None
        self._first_frames: list[Found] = []
        self._is_checked = False
        self._contradiction = ""
        self._unknown_codes: list[str] = []
        self._own_recorders: list[TrafficLog] = []
        self._input = self._open_input(backend, record, overflow, period, will_begin=start)
        self._finalizer = weakref.finalize(self, _close, self._input, self._own_recorders)
        if start:
            try:
                self._input.begin()
            except BaseException:
                self.close()
                raise
        if self.learned:
            self.sensor = self._input.sensor
            self._latest_stream = ScanStream(self.sensor, mount)

    async def __aenter__(self) -> NoReturn:
        """Raise an error that names `open_async`.

        Raises:
            UsageError: always.
        """
        self.close()
        raise UsageError(
            "lidarspec.open(...) is used with `with`; for `async with` call"
            " lidarspec.open_async(...)"
        )

    async def __aexit__(self, *_: object) -> None:
        """Do nothing; without this method Python would not call `__aenter__`."""

    @property
    def stats(self) -> Counters:
        """The counters of everything read so far."""
        return self._input.stats

    @property
    def warnings(self) -> list[str]:
        """The current warnings about the source and the sensor.

        Examples are a truncated file, silence, a probably wrong baud rate, frames of another
        sensor, a nominal calibration, and errors of the plugin.
        """
        stats = self.stats
        warnings = [*self._input.warnings, *self._check_first_frames()]
        for text in (stats.unended, stats.undated, stats.masked):
            if text:
                warnings.append(f"{self.source}: {text}")
        if stats.incomplete_returns:
            text = describe_incomplete_groups(stats.incomplete_returns)
            warnings.append(f"{self.source}: {text}")
        if stats.nominal:
            warnings.append(_describe_nominal(self.sensor))
        if self._selector is not None:
            warnings += self._selector.warnings
        failure = stats.failure(self.sensor.id)
        if failure is not None:
            warnings.append(str(failure))
        return warnings

    @property
    def learned(self) -> Mapping[str, Any]:
        """The values of options that the sensor reported when the device was opened."""
        return self._input.learned

    @property
    def info(self) -> dict[str, str]:
        """The facts that the sensor has reported about itself so far, by name.

        Many sensors report "serial", "firmware", "model" or "temperature".
        """
        return read_info(self.sensor, self._input.info_frames.values())

    @property
    def state(self) -> str:
        """The state of the source.

        One of "streaming", "waiting" (for a first frame), "silent" (no data for three seconds), "no
        frames" (bytes, but no valid frame), "disconnected", "ended" (a file) and "closed".
        """
        return self._input.state

    @property
    def queued(self) -> int | None:
        """The number of chunks that wait to be decoded; None for a file."""
        return self._input.queued

    @property
    def progress(self) -> tuple[int, int] | None:
        """(number of bytes read, size) of a file; None for a pipe or a live source.

        For a compressed file, both count compressed bytes.
        """
        return self._input.progress

    @property
    def is_live(self) -> bool:
        """Whether data arrives from a live source, not from a file."""
        return self._input.is_live

    def packets(self, frame: str | None = None, *, wait: float | None = None) -> Iterator[Packets]:
        """Yield packets in batches, until the input ends or the device is closed.

        A file is read only once: all iterators share one position in it. After a call of `latest`
        for a file, a new iterator begins with the batch of packets in which the returned scan ends.

        Args:
            frame: the name of a frame type; by default the data frame.
            wait: if no packet arrives for this number of seconds, yield an empty batch.

        Raises:
            UsageError: if no `frame` is named for a sensor without points.
            SourceError: if a file has already been read to its end.
        """
        if frame is None:
            self.sensor.require_points()
        reader = self._get_reader(frame)
        ahead = self._take_batch_of_latest()
        yield_timer = _YieldTimer(wait)
        for batch in self._iter_batches(wait, ahead):
            packets = None
            if batch is not None and batch is ahead and frame is None:
                packets = reader.last_packets
            elif batch is not None:
                packets = reader.read_packets(batch)
                if frame is None:
                    reader.read_imu(batch, packets)
            self.imu_samples = self._get_imu_samples(reader, batch)
            has_data = (packets is not None and len(packets)) or len(self.imu_samples)
            if has_data or batch is None or yield_timer.is_due():
                yield reader.make_empty_batch() if packets is None else packets
                yield_timer.restart()

    def packets_by_frame(
        self, frames: Sequence[str], *, wait: float | None = None
    ) -> Iterator[dict[str, Packets]]:
        """Yield packets of several frame types in batches, until the input ends.

        A file is read only once: all iterators share one position in it.

        Args:
            frames: the names of the frame types.
            wait: if no packet arrives for this number of seconds, yield an empty dict.

        Yields:
            Dicts: frame type -> packets. Types without new packets are omitted.

        Raises:
            UnknownFrame: for a frame type that the sensor does not have.
            SourceError: if a file has already been read to its end.
        """
        readers = {frame: self._get_reader(frame) for frame in frames}
        yield_timer = _YieldTimer(wait)
        for batch in self._iter_batches(wait, self._take_batch_of_latest()):
            packets_by_frame = dict[str, Packets]()
            if batch is not None:
                for frame, reader in readers.items():
                    packets = reader.read_packets(batch)
                    if packets is not None and len(packets):
                        packets_by_frame[frame] = packets
            if packets_by_frame or batch is None or yield_timer.is_due():
                yield packets_by_frame
                yield_timer.restart()

    @overload
    def scans(self, *, select: Selection | None = None) -> Iterator[Scan]: ...

    @overload
    def scans(self, *, wait: float, select: Selection | None = None) -> Iterator[Scan | None]: ...

    def scans(self, *, wait: float | None = None, select: Selection | None = None) -> Iterator[Any]:
        """Yield scans, until the input ends or the device is closed.

        The first and the last scan, and the scans before and after an interruption, have
        ``complete=False``. If the end of a scan is missing, the scan is yielded with a warning when
        it lasts twice as long as the slowest revolution of the sensor.

        A file is read only once: all iterators share one position in it. After a call of `latest`
        for a file, a new iterator begins with the batch of packets in which the returned scan ends.

        Args:
            wait: if no scan arrives for this number of seconds, yield None.
            select: which scans, and which parts of them, to yield.

        Raises:
            SourceError: if a file has already been read to its end.
            UsageError: for a sensor without points, or if the selection contains no scan.
        """
        self.sensor.require_points()
        scans = self._iter_scans(wait)
        if select is None:
            return scans
        return self.make_selector(select, self.skip_until).iter_selected(scans)

    def imu(self, *, wait: float | None = None) -> Iterator[ImuSamples]:
        """Yield the samples of the sensor's IMU in batches, until the input ends.

        For a sensor with a mount, samples are in the axes of the carrier. A file is read only once:
        all iterators share one position in it. `Scan.imu` has the samples of one scan.

        Args:
            wait: if no sample arrives for this number of seconds, yield an empty batch.

        Raises:
            UsageError: if no frame of the sensor has IMU samples.
            SourceError: if a file has already been read to its end.
        """
        self.sensor.require_imu()
        reader = self._get_reader(None)
        ahead = self._take_batch_of_latest()
        yield_timer = _YieldTimer(wait)
        for batch in self._iter_batches(wait, ahead):
            if batch is not None and batch is not ahead:
                reader.read_imu(batch, reader.read_packets(batch))
            if reader.waiting_imu is not None:
                reader.waiting_imu.take_until(None)  # free memory: no scan uses them
            samples = self._get_imu_samples(reader, batch)
            if len(samples) or batch is None or yield_timer.is_due():
                yield samples
                yield_timer.restart()

    def latest(self, timeout: float | None = None) -> Scan:
        """Return the newest whole scan; wait if it was already returned.

        Older scans are dropped. For a file, each call returns the next whole scan.

        Args:
            timeout: seconds to wait; None for no limit.

        Raises:
            SourceTimeout: if no whole scan arrives in time.
            SourceError: if the input has ended or the device was closed.
            UsageError: for a sensor without points.
        """
        self.sensor.require_points()
        if timeout is None:
            deadline = None
        else:
            deadline = time.monotonic() + timeout
        while True:
            if deadline is None:
                wait = _LONG_WAIT_S
            else:
                wait = max(deadline - time.monotonic(), 0.0)
            scan = self.newest(wait)
            if scan is not None:
                return scan
            if deadline is not None and time.monotonic() >= deadline:
                raise self.make_timeout_error()

    def newest(self, wait: float) -> Scan | None:
        """Return the newest whole scan like `latest`, or None if none arrives in time.

        Args:
            wait: seconds to wait.

        Raises:
            SourceError: if the input has ended or the device was closed.
        """
        deadline = time.monotonic() + wait
        arrived = self._input.count_arrived()
        while not (self._unseen_scans and self._input.has_decoded_until(arrived)):
            if self._input.ended:
                raise SourceError(
                    f"{self.source}: no more scans, because the input is {self._input.state}"
                )
            batch = self._next_batch(max(deadline - time.monotonic(), 0.0))
            if batch is not None:
                self._find_whole_scans(batch)
            has_no_more = batch is None or self._input.has_decoded_until(arrived)
            if not self._unseen_scans and has_no_more and time.monotonic() >= deadline:
                return None
        if not self.is_live:
            return self._unseen_scans.popleft()
        scan = self._unseen_scans[-1]
        self._unseen_scans.clear()
        return scan

    def make_timeout_error(self) -> SourceTimeout:
        """Return the error for a scan that did not arrive in time."""
        error = SourceTimeout(
            f"{self.source}: no scan within the timeout; the source is {self.state}"
        )
        return suggest(error, f"lidarspec doctor {quote(str(self.source))} -s {self.sensor.id}")

    def make_selector(
        self, select: Selection, skip: Callable[[int], bool] | None = None
    ) -> ScanSelector:
        """Return a selector for the scans of this device.

        Args:
            select: the scans to select.
            skip: skips data that arrived before a time; see `ScanSelector`.
        """
        self._selector = ScanSelector(select, self.source, skip)
        return self._selector

    def skip_until(self, time_ns: int) -> bool:
        """Skip input that arrived before a time, if the source can seek.

        Frames that were already read are still returned.

        Args:
            time_ns: ns since 1970.

        Returns:
            Whether input was skipped.
        """
        return self._input.skip_until(time_ns)

    def delay_decoding(self, until: float) -> None:
        """Delay decoding until a time, to decode more data together.

        This saves processor time. An iterator with `wait` still returns data after at most `wait`
        seconds. For a file, this method has no effect.

        Args:
            until: a time of `time.monotonic`.
        """
        self._input.delay_decoding(until)

    def read_ahead(self, size: int) -> None:
        """Set how many bytes of a file are read and decoded at a time.

        The counters include all bytes that were read. So a viewer that shows a file at its recorded
        speed sets a small size, to show counters that fit the picture. For a live source, this
        method has no effect.

        Args:
            size: the number of bytes; 0, the default, for the fastest size.
        """
        self._input.read_ahead(size)

    def observe(self, observer: DecoderObserver) -> None:
        """Pass all input that is decoded from now on to an observer.

        The observer is called in the thread that reads.
        """
        self._input.decoder.observer = observer

    def send(self, name: str, /, *, timeout: float | None = None, **arguments: Any) -> Reply:
        """Send a command and return the reply.

        If the sensor documents no reply, returns at once with ``confirmed=False``.

        Args:
            name: the name of the command.
            timeout: seconds to wait for the reply; by default the timeout that the sensor declares.
            arguments: the arguments of the command by name, in their units.

        Raises:
            UnknownCommand, UnknownField, MissingField, OutOfRange: for an invalid command; nothing
                is sent.
            CommandError: if the device refuses, or the connection is lost.
            ReplyTimeout: if no reply arrives in time.
        """
        return self._input.send(name, timeout=timeout, **arguments)

    def write(self, data: bytes, link: str = "data") -> None:
        """Send bytes as they are, without waiting for a reply.

        The bytes are not interpreted. A reply arrives among the other frames. `close` does not stop
        a sensor that the bytes have started.

        Args:
            link: the name of one of the sensor's links.

        Raises:
            UsageError: if `data` is a str, or for an unknown link.
            SourceError: if the connection is lost, or there is no device.
        """
        self._input.write(data, link)

    def leave_on(self) -> None:
        """Do not stop the sensor when the device is closed."""
        self._input.stays_on = True

    def close(self) -> None:
        """Stop the sensor if it was started, and close the source."""
        self._finalizer()

    def __repr__(self) -> str:
        return f"Device({self.sensor.id} on {self.source}, {self.state}: {self.stats})"

    def _open_input(
        self,
        backend: str,
        record: RecordTo | None,
        overflow: str | None,
        period: float,
        *,
        will_begin: bool,
    ) -> DeviceInput:
        opened = open_transport(self.source, self.sensor)
        try:
            if not isinstance(opened, LiveTransport):
                if record is not None:
                    raise UsageError(f"{self.source} is already a file, so it cannot be recorded")
                return FileInput(self.source, self.sensor, opened, backend=backend)
            # This must not refer to the device: the cycle would keep it alive.
            make_recorder = partial(
                _make_recorder, record, self.source, opened, self._own_recorders
            )
            return LiveInput(
                self.source,
                self.sensor,
                opened,
                backend=backend,
                policy=opened.overflow if overflow is None else overflow,
                record=make_recorder,
                will_begin=will_begin,
                period=period,
            )
        except BaseException:
            _close(opened, self._own_recorders)
            raise

    def _get_reader(self, frame: str | None) -> PacketReader:
        if frame not in self._readers:
            self._readers[frame] = PacketReader(
                self.sensor, frame, self._input.decoder, self._input.first_frames()
            )
        return self._readers[frame]

    def _get_imu_samples(self, reader: PacketReader, batch: FrameBatch | None) -> ImuSamples:
        if batch is None:
            return join_samples([])
        if self.mount is None:
            return reader.imu_samples
        return reader.imu_samples.turn(self.mount.rotation)

    def _make_scan_stream(self) -> ScanStream:
        return ScanStream(self.sensor, self.mount, self._get_reader(None).waiting_imu)

    def _iter_scans(self, wait: float | None) -> Iterator[Scan | None]:
        reader = self._get_reader(None)
        ahead = self._take_batch_of_latest()
        yield_timer = _YieldTimer(wait)
        stream = self._make_scan_stream()
        for batch in self._iter_batches(wait, ahead):
            if batch is not None:
                for scan in reader.find_scans(stream, batch, is_read=batch is ahead):
                    yield scan
                    del scan  # only the caller may keep it alive
                    yield_timer.restart()
                if batch.interrupted:
                    stream = self._make_scan_stream()
            if yield_timer.is_due() or (batch is None and wait is not None):
                yield None
                yield_timer.restart()
        yield from stream.finish()

    def _find_whole_scans(self, batch: FrameBatch) -> None:
        """Add the whole scans that a batch completes to `_unseen_scans`."""
        if self._latest_stream is None:
            self._latest_stream = self._make_scan_stream()
        reader = self._get_reader(None)
        scans = [scan for scan in reader.find_scans(self._latest_stream, batch) if scan.whole]
        self._unseen_scans += scans
        self._ahead = batch if scans and not self.is_live else None
        if batch.interrupted:
            self._latest_stream = None

    def _take_batch_of_latest(self) -> FrameBatch | None:
        """Return the batch that a new iterator has to yield first, or None."""
        ahead = self._ahead
        self._ahead = None
        if ahead is not None:
            self._latest_stream = None
            self._unseen_scans.clear()
        elif self._input.state == "ended":
            raise SourceError(
                f"{self.source} has been read to its end: open it again to start over"
            )
        return ahead

    def _iter_batches(
        self, wait: float | None, ahead: FrameBatch | None = None
    ) -> Iterator[FrameBatch | None]:
        """Yield batches; yield None if no batch arrives for `wait` seconds."""
        if ahead is not None:
            yield ahead
        while not self._input.ended:
            batch = self._next_batch(_LONG_WAIT_S if wait is None else wait)
            if batch is not None or not self._input.ended:
                yield batch

    def _next_batch(self, wait: float) -> FrameBatch | None:
        """Return the next batch; store the first frames, which `_check_first_frames` needs."""
        batch = self._input.next(wait)
        if self._is_checked or batch is None or len(self._first_frames) >= _MAX_CHECKED_FRAMES:
            return batch
        for frames in batch.frames:
            self._first_frames += frames.select(slice(0, _MAX_CHECKED_FRAMES)).to_found()
        return batch

    def _check_first_frames(self) -> list[str]:
        """Return warnings about frames of another model, or with unknown codes."""
        has_enough = len(self._first_frames) >= _MAX_CHECKED_FRAMES or self._input.ended
        if not self._is_checked and has_enough:
            self._is_checked = True
            simulated = find_simulated_sensor(self.source)
            if simulated is None or simulated.id != self.sensor.id:
                if self.sensor.relatives or "model" in self.sensor.info:
                    self._contradiction = find_contradiction(self.sensor, self._first_frames)
                self._unknown_codes = find_unknown_codes(self.sensor, self._first_frames)
        warnings = [f"{self.source}: {text}" for text in self._unknown_codes]
        if self._contradiction:
            warnings.append(
                f"{self.source}: decoded as {self.sensor.id}, but {self._contradiction}; next:"
                f" lidarspec detect {quote(str(self.source))}"
            )
        return warnings


class _YieldTimer:
    """Measures when an iterator has to yield although no data has arrived."""

    def __init__(self, wait: float | None) -> None:
        self._wait = wait
        self._last_yield = time.monotonic()

    def is_due(self) -> bool:
        return self._wait is not None and time.monotonic() - self._last_yield >= self._wait

    def restart(self) -> None:
        self._last_yield = time.monotonic()


def open(
    source: str | Path,
    sensor: str | Sensor | None = None,
    *,
    backend: str = "auto",
    start: bool = True,
    record: RecordTo | None = None,
    overflow: str | None = None,
    period: float = PERIOD_S,
) -> Device:
    """Open a sensor on any SOURCE.

    Args:
        source: a port, a socket, a simulated device, a file, or "-" for standard input. Examples:
            "/dev/ttyUSB0", "serial:///dev/ttyUSB0?baud=230400", "udp://", "tcp://host:port",
            "capture.pcap", or a device name from `lidarspec.toml`.
        sensor: an id, a path to a sensor's module, or a Sensor; by default it is detected.
        backend: the backend that evaluates `points`: "auto", "numpy" or "jit".
        start: whether to send the commands that the sensor declares for opening and closing.
        record: where to record everything that arrives and is sent: a new file, a `Recorder`, or a
            function that returns a recorder for the open transport.
        overflow: what happens if the data of a live source is consumed too slowly: "drop_oldest" or
            "block". The default is "block" for a simulated sensor without a rate, else
            "drop_oldest".
        period: seconds between two decodings of arrived data.

    Raises:
        SourceError: if the source cannot be opened.
        UsageError, WireError: if no sensor is given, and detection finds none or several.
        CommandError: if the device does not start.
    """
    settings = find_device(source)
    if sensor is None:
        sensor = detect(source)
    return Device(
        source,
        named_sensor(sensor),
        backend=backend,
        start=start,
        record=record,
        overflow=overflow,
        period=period,
        mount=None if settings is None else settings.mount,
    )


def _describe_nominal(sensor: Sensor) -> str:
    """Return a warning that points use the model's nominal calibration."""
    text = f"{sensor.id}: points use the nominal calibration of the model, not that of the device"
    files = [name for name in sensor.configure.files if name not in sensor.options]
    if files:
        return (
            f"{text}; pass it with -s {sensor.id} -O {files[0]}=FILE, or in Python"
            f" sensor.configure({files[0]}=FILE)"
        )
    if sensor.state:
        return f"{text}, because no {' or '.join(sensor.state)} frame has arrived"
    return text


def _make_recorder(
    record: RecordTo | None,
    source: str | Path,
    opened: LiveTransport,
    own_recorders: list[TrafficLog],
    sensor: Sensor,
) -> TrafficLog | None:
    """Return the requested recorder; None if nothing is recorded."""
    if record is None:
        return None
    log, is_own = get_recorder(record, sensor, source, opened)
    if is_own:
        own_recorders.append(log)
    return log


def _close(source: DeviceInput | Transport, recorders: list[TrafficLog]) -> None:
    """Close the source, and then the recorders even if closing the source fails."""
    try:
        source.close()
    finally:
        for recorder in recorders:
            recorder.close()
