"""A sensor on a source: packets and scans as they come, commands, counters.

A `Device` asks its input for what has arrived: a `FileInput` or a `LiveInput`, which look the same
from here. `PacketReader` makes packets of one type out of it, with what one batch has to know of
the one before, and scans out of those.
"""

from __future__ import annotations

import time
import weakref
from collections import deque
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Any, NoReturn, overload

from lidarspec.detect.identification import contradiction, detected, said, simulated_sensor
from lidarspec.device.arrivals import Arrival, FileInput, Input
from lidarspec.device.first_frames import FirstFrames
from lidarspec.device.live_input import PERIOD, LiveInput
from lidarspec.device.session import Reply
from lidarspec.device.settings import named
from lidarspec.errors import SourceError, SourceTimeout, UsageError, suggest
from lidarspec.framing.decoder import Decoder, Witness
from lidarspec.framing.results import Counters, Found, Frames
from lidarspec.packets.imu import ImuSamples, joined
from lidarspec.packets.packets import Packets
from lidarspec.packets.stream import ImuStream, PacketStream, data_frame
from lidarspec.plugins import sensor as named_sensor
from lidarspec.points.cloud import Mount
from lidarspec.recording.appending import Log
from lidarspec.recording.recorders import RecordTo, recorder_for
from lidarspec.scans.scans import Scan, ScanStream, handed_out
from lidarspec.scans.selection import Selection, Sieve
from lidarspec.spec.sensor import Sensor
from lidarspec.transports.open_url import transport
from lidarspec.transports.protocol import Closing, LiveTransport, Transport

#: batches kept while nobody knows yet which data frame the sensor answers in.
UNDECIDED = 256
#: frames that are asked whether they are another sensor's.
EXAMINED = 64
#: samples of an IMU kept at least while no scan ends.
FELT = 1 << 16
#: seconds that one wait for data takes where there is no end to waiting.
LONG = 3600.0


class PacketReader:
    """The packets of one type out of what arrives.

    Args:
        frame: the type; where the sensor has several data frames and none is named, the first that
            arrives decides.
        decoder: where the frames come from.
        state: frames of other types, by name, that count as seen before the first packet.

    Attributes:
        last: the packets of the last arrival.
        imu: what the sensor's IMU felt.
        felt: the samples of the last arrival.
    """

    def __init__(
        self, sensor: Sensor, frame: str | None, decoder: Decoder, first: FirstFrames
    ) -> None:
        self._sensor = sensor
        self._decoder = decoder
        self._first = first
        self._named = frame
        self._waiting: deque[Frames] = deque(maxlen=UNDECIDED)
        self._stream = self._made(frame) if frame is not None else None
        self.last: Packets | None = None
        self.imu, self.felt = self._feeling(), joined([])

    def feel(self, arrival: Arrival, data: Packets | None) -> None:
        """Take the IMU's samples of an arrival, and of its packets."""
        if arrival.replaced:
            waiting, self.imu = self.imu.waiting, self._feeling()
            self.imu.waiting = waiting
        self.felt = self.imu.add(arrival.found, data)
        if self.imu.waiting is not None:
            self.imu.waiting.keep(FELT)
        if arrival.interrupted:
            self.imu.interrupt()

    def _feeling(self) -> ImuStream:
        return ImuStream(
            self._sensor,
            self._decoder.stats,
            backend=self._decoder.backend,
            state=self._first.state,
        )

    def add(self, arrival: Arrival) -> Packets | None:
        """The packets among these frames; None while nobody knows of which type."""
        if arrival.replaced:
            self._waiting.clear()
            self._stream = None if self._named is None else self._made(self._named)
        self._waiting += arrival.found
        found = list(self._waiting)
        if self._stream is None:
            name = data_frame(self._sensor, found)
            self._stream = self._made(name) if name is not None else None
        if self._stream is None:
            return None
        self._waiting.clear()
        self.last = self._stream.add(found)
        if arrival.interrupted:
            self._stream.interrupt()
        return self.last

    def none(self) -> Packets:
        """A batch of no packets."""
        return (self._stream or self._made(self._sensor.data_frame)).add([])

    def scans(self, stream: ScanStream, arrival: Arrival, *, read: bool = False) -> Iterator[Scan]:
        """The scans that an arrival completes; an interruption ends the one under way, and the
        stream with it.

        Args:
            read: it is the last one, of which packets were made before.
        """
        packets = self.last
        if not read:
            packets = self.add(arrival)
            self.feel(arrival, packets)
        if packets is not None and len(packets):
            yield from handed_out(stream.add(packets))
        if arrival.interrupted:
            yield from stream.finish()

    def __getstate__(self) -> dict[str, Any]:
        """What is pickled goes on with the next packets, without the last ones."""
        return {**vars(self), "last": None, "felt": joined([])}

    def _made(self, name: str) -> PacketStream:
        decoder = self._decoder
        first = self._first
        return PacketStream(
            self._sensor,
            name,
            decoder.stats,
            backend=decoder.backend,
            state=first.state,
            reference=first.reference,
        )


class Device(Closing):
    """A sensor read from a source; a context manager.

    Attributes:
        felt: what the sensor's IMU felt with the last batch of `packets`, in the carrier's axes
            where the sensor is mounted.
        source: where it is read from.
        sensor: the sensor, given or detected.
        mount: how it is mounted, where `lidarspec.toml` says so: scans come in the carrier's axes,
            packets in the sensor's.
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
        period: float = PERIOD,
        mount: Mount | None = None,
    ) -> None:
        self.sensor, self.source, self.mount, self.felt = sensor, source, mount, joined([])
        self._streams: dict[str | None, PacketReader] = {}
        self._latest: ScanStream | None = None
        self._unseen = deque[Scan]()
        self._ahead: Arrival | None = None
        self._first, self._another = (
            list[Found](),
            None if sensor.relatives or "model" in sensor.info else "",
        )
        self._own_recorders = list[Log]()
        self._input = self._opened(backend, record, overflow, period, learns=start)
        self._finalizer = weakref.finalize(self, _close, self._input, self._own_recorders)
        if start:
            try:
                self._input.begin()
            except BaseException:
                self.close()
                raise
        if self.learned:
            self.sensor = self._input.sensor
            self._latest = ScanStream(self.sensor, mount)

    async def __aenter__(self) -> NoReturn:
        """Raise: `async with` takes the device of `open_async`.

        Raises:
            UsageError: always.
        """
        self.close()
        raise UsageError(
            "lidarspec.open(...) is used with `with`; for `async with` call"
            " lidarspec.open_async(...)"
        )

    async def __aexit__(self, *_: object) -> None:
        """Exist beside `__aenter__`, without which Python raises its own TypeError."""

    @property
    def stats(self) -> Counters:
        """The counters of everything read so far."""
        return self._input.stats

    @property
    def warnings(self) -> list[str]:
        """What is to be said about the source now: a file that is cut off, silence, a likely wrong
        baud rate, a small buffer, frames that are another sensor's, scans without an end, times
        without a date, a nominal calibration; and what the plugin failed at."""
        failure = self.stats.failure(self.sensor.id)
        nominal = [_nominal(self.sensor)] if self.stats.nominal else []
        partial = [
            f"{self.source}: {text}"
            for text in (self.stats.unended, self.stats.undated, self.stats.masked)
            if text
        ]
        return [
            *self._input.warnings,
            *self._doubts(),
            *partial,
            *nominal,
            *([] if failure is None else [str(failure)]),
        ]

    @property
    def learned(self) -> Mapping[str, Any]:
        """The options that the sensor has said of itself on opening; `sensor` is configured with
        them.
        """
        return self._input.learned

    @property
    def info(self) -> dict[str, str]:
        """What the sensor has said of itself so far: of "serial", "firmware", "model" and
        "temperature" those that its frames have.
        """
        return said(self.sensor, self._input.told.values())

    @property
    def state(self) -> str:
        """How the source is doing: "streaming", "waiting" (for a first frame), "silent" (for three
        seconds), "no frames" (bytes only), "disconnected", "ended" (a file) or "closed"."""
        return self._input.state

    @property
    def queued(self) -> int | None:
        """Chunks that have arrived and wait to be decoded; None for a file."""
        return self._input.queued

    @property
    def place(self) -> tuple[int, int] | None:
        """How many bytes of a file were read, as it is stored, compressed or not, and how many
        there are; None where nobody knows.
        """
        return self._input.place

    @property
    def is_live(self) -> bool:
        """Whether data come at their own pace, and not from a file."""
        return self._input.is_live

    def spans(self) -> Iterator[list[Frames]]:
        """Every incoming frame of all types, in batches."""
        for arrival in self._arrivals(None):
            if arrival is not None and arrival.found:
                yield arrival.found

    def packets(self, frame: str | None = None, *, wait: float | None = None) -> Iterator[Packets]:
        """The packets of the data frame, or of another type, in batches, until the input ends or
        the device is closed.

        A file is read once, whoever reads it. After `latest` they begin with the batch in which its
        scan was found.

        Args:
            frame: the name of a frame type.
            wait: yield a batch of no packets where none have come for so many seconds, so that the
                caller has a turn.

        Raises:
            SourceError: where a file has been read to its end before.
        """
        reader, ahead, turn = self._reader(frame), self._taken_back(), time.monotonic()
        for arrival in self._arrivals(wait, ahead):
            packets = (
                None
                if arrival is None
                else reader.last
                if arrival is ahead and frame is None
                else reader.add(arrival)
            )
            if (
                frame is None
                and arrival is not None
                and arrival is not ahead
                and self.sensor.imu_frames
            ):
                reader.feel(arrival, packets)
            self.felt, is_due = (
                self._felt(reader, arrival),
                wait is not None and time.monotonic() - turn >= wait,
            )
            if (
                (packets is not None and len(packets))
                or len(self.felt)
                or arrival is None
                or is_due
            ):
                yield reader.none() if packets is None else packets
                turn = time.monotonic()

    @overload
    def scans(self, *, select: Selection | None = None) -> Iterator[Scan]: ...

    @overload
    def scans(self, *, wait: float, select: Selection | None = None) -> Iterator[Scan | None]: ...

    def scans(self, *, wait: float | None = None, select: Selection | None = None) -> Iterator[Any]:
        """Every scan; the first and last piece, and those before and after an interruption, are
        marked ``complete=False``.

        Where a scan does not end within twice the slowest turn, what there is of it is handed out,
        and `warnings` says so.

        A file is read once, whoever reads it. After `latest` they begin with the batch in which its
        scan was found.

        Args:
            wait: yield None where no scan has come for so many seconds, so that the caller has a
                turn.
            select: which of them, and what of each; nothing is read behind the last that is wanted,
                and of a recording nothing that lies long before the first.

        Raises:
            SourceError: where a file has been read to its end before.
            UsageError: where none of its scans is wanted.
        """
        return (
            self._scans(wait)
            if select is None
            else Sieve(select, self.source, self.skip).of(self._scans(wait))
        )

    def _scans(self, wait: float | None) -> Iterator[Scan | None]:
        reader, ahead, turn = self._reader(None), self._taken_back(), time.monotonic()
        stream = self._scan_stream()
        for arrival in self._arrivals(wait, ahead):
            for scan in (
                () if arrival is None else reader.scans(stream, arrival, read=arrival is ahead)
            ):
                yield scan
                del scan  # nobody is to keep it but the caller
                turn = time.monotonic()
            if wait is not None and (arrival is None or time.monotonic() - turn >= wait):
                yield None
                turn = time.monotonic()
            stream = self._scan_stream() if arrival is not None and arrival.interrupted else stream
        yield from stream.finish()

    def imu(self, *, wait: float | None = None) -> Iterator[ImuSamples]:
        """What the sensor's IMU felt, in batches as it comes, in the carrier's axes where the
        sensor is mounted, until the input ends.

        Scans have what was felt during them in `Scan.imu`. A file is read once, whoever reads it.

        Args:
            wait: yield no samples where none have come for so many seconds, so that the caller has
                a turn.

        Raises:
            UsageError: where no frame of the sensor says what an IMU felt.
            SourceError: where a file has been read to its end before.
        """
        if not self.sensor.imu_frames:
            raise UsageError(f"{self.sensor.id}: no frame says what an IMU felt")
        reader, ahead, turn = self._reader(None), self._taken_back(), time.monotonic()
        for arrival in self._arrivals(wait, ahead):
            if arrival is not None and arrival is not ahead:
                reader.feel(arrival, reader.add(arrival))
            if reader.imu.waiting is not None:
                reader.imu.waiting.until(None)  # no scan asks for them
            felt = self._felt(reader, arrival)
            if (
                len(felt)
                or arrival is None
                or (wait is not None and time.monotonic() - turn >= wait)
            ):
                yield felt
                turn = time.monotonic()

    def skip(self, at: int) -> bool:
        """Pass over what arrived before a time, ns since 1970, where the source can do so without
        reading it: whether it does.

        What was read already is still given; then the stream goes on as behind an interruption.
        """
        return self._input.skip(at)

    def gather(self, until: float) -> None:
        """Let what comes of a live source wait up to a time of `time.monotonic`, to be decoded
        together, which takes less of the processor.

        It waits no longer than the `wait` of whoever iterates.
        """
        self._input.gather(until)

    def read_ahead(self, size: int) -> None:
        """Read a file in portions of about so many bytes from now on, for whoever shows it at the
        pace of its times: then counters, and what a `Witness` is shown, are not far ahead of what
        is seen. 0: as many as are decoded quickest."""
        self._input.read_ahead(size)

    def witnessed(self, by: Witness) -> None:
        """Show someone everything that is decoded from now on, and the frames that are found in it,
        in the thread that reads.
        """
        self._input.decoder.witness = by

    def latest(self, timeout: float | None = None) -> Scan:
        """The newest whole scan, newer than the one that the last call gave; waits for it. Older
        ones are passed over.

        A file has no newest scan: it gives one after another.

        Args:
            timeout: seconds to wait.

        Raises:
            SourceTimeout: where none comes in time; SourceError where the input has ended or the
                device was closed.
        """
        deadline = None if timeout is None else time.monotonic() + timeout
        while (
            found := self.newest(
                LONG if deadline is None else max(deadline - time.monotonic(), 0.0)
            )
        ) is None:
            if deadline is not None and time.monotonic() >= deadline:
                raise self.overdue()
        return found

    def newest(self, wait: float) -> Scan | None:
        """The newest whole scan, newer than the one given last; None where none comes within `wait`
        seconds.

        Raises:
            SourceError: where the input has ended or the device was closed.
        """
        deadline, mark, reader = time.monotonic() + wait, self._input.mark(), self._reader(None)
        while not (self._unseen and self._input.caught_up(mark)):
            if self._input.ended:
                raise SourceError(
                    f"{self.source}: no further scan, since the input is {self._input.state}"
                )
            arrival = self._next(max(deadline - time.monotonic(), 0.0))
            if arrival is not None:
                self._latest = self._latest or self._scan_stream()
                found = [scan for scan in reader.scans(self._latest, arrival) if scan.whole]
                self._ahead = arrival if found and not self.is_live else None
                self._unseen += found
                self._latest = None if arrival.interrupted else self._latest
            if (
                not self._unseen
                and time.monotonic() >= deadline
                and (arrival is None or self._input.caught_up(mark))
            ):
                return None
        if not self.is_live:
            return self._unseen.popleft()
        newest = self._unseen[-1]
        self._unseen.clear()
        return newest

    def overdue(self) -> SourceTimeout:
        """What to say when a scan did not come in time."""
        error = SourceTimeout(f"{self.source}: no scan in time; the source is {self.state}")
        return suggest(error, f"lidarspec doctor {quote(str(self.source))} -s {self.sensor.id}")

    def send(self, name: str, /, *, timeout: float | None = None, **arguments: Any) -> Reply:
        """The reply to a command; at once with ``confirmed=False`` where none is documented.

        Args:
            name: of the command.
            timeout: seconds to wait for the reply; by default what the sensor declares.
            arguments: by name, in units.

        Raises:
            UnknownCommand, UnknownField, MissingField, OutOfRange: for what the sensor does not
                take; nothing is sent.
            CommandError: where the device refuses, or the connection is lost; ReplyTimeout where it
                keeps silent.
        """
        return self._input.send(name, timeout=timeout, **arguments)

    def write(self, data: bytes, link: str = "data") -> None:
        """Send bytes by hand, as they are; nothing is waited for, and what answers them comes with
        everything else.

        Args:
            data: the bytes; nobody looks at what they say, so that a sensor that they start is not
                stopped on closing.
            link: over which of the sensor's links.

        Raises:
            UsageError: for a text, and for a link that the sensor does not have.
            SourceError: where the connection is lost, or there is no device.
        """
        self._input.write(data, link)

    def leave_on(self) -> None:
        """Let the sensor go on as it is when the device is closed."""
        self._input.stays_on = True

    def close(self) -> None:
        """Stop the sensor where it was started, and give the source back; a second call does
        nothing.
        """
        self._finalizer()

    def __repr__(self) -> str:
        return f"Device({self.sensor.id} on {self.source}, {self.state}: {self.stats})"

    def _opened(
        self,
        backend: str,
        record: RecordTo | None,
        overflow: str | None,
        period: float,
        *,
        learns: bool,
    ) -> Input:
        opened = transport(self.source, self.sensor)
        try:
            if not isinstance(opened, LiveTransport):
                if record is not None:
                    raise UsageError(f"{self.source} is a file already: there is nothing to record")
                return FileInput(self.source, self.sensor, opened, backend=backend)
            policy = opened.overflow if overflow is None else overflow
            recorder = partial(
                _recorder, record, self.source, opened, self._own_recorders
            )  # which holds no device: it may be forgotten
            return LiveInput(
                self.source,
                self.sensor,
                opened,
                backend=backend,
                policy=policy,
                record=recorder,
                learns=learns,
                period=period,
            )
        except BaseException:
            _close(opened, self._own_recorders)
            raise

    def _reader(self, frame: str | None) -> PacketReader:
        if frame not in self._streams:
            self._streams[frame] = PacketReader(
                self.sensor, frame, self._input.decoder, self._input.first_frames()
            )
        return self._streams[frame]

    def _felt(self, reader: PacketReader, arrival: Arrival | None) -> ImuSamples:
        """What came with an arrival of what the IMU felt."""
        felt = joined([]) if arrival is None else reader.felt
        return felt if self.mount is None else felt.turned(self.mount.rotation)

    def _scan_stream(self) -> ScanStream:
        return ScanStream(self.sensor, self.mount, self._reader(None).imu.waiting)

    def _taken_back(self) -> Arrival | None:
        """What of a file `latest` found its last scan in, for another to begin with; its further
        scans are then no longer waited for.
        """
        ahead, self._ahead = self._ahead, None
        if ahead is not None:
            self._latest = None
            self._unseen.clear()
        elif self._input.state == "ended":
            raise SourceError(
                f"{self.source} has been read to its end: open it again to read it once more"
            )
        return ahead

    def _arrivals(
        self, wait: float | None, ahead: Arrival | None = None
    ) -> Iterator[Arrival | None]:
        """What arrives, until the end; None where nothing has for `wait` seconds."""
        if ahead is not None:
            yield ahead
        while not self._input.ended:
            arrival = self._next(LONG if wait is None else wait)
            if arrival is not None or not self._input.ended:
                yield arrival

    def _next(self, wait: float) -> Arrival | None:
        """What arrives next; the first frames are kept until somebody asks whether they are another
        sensor's.
        """
        arrival = self._input.next(wait)
        if self._another is None and arrival is not None and len(self._first) < EXAMINED:
            for frames in arrival.found:
                self._first += frames.only(slice(0, EXAMINED)).found()
        return arrival

    def _doubts(self) -> list[str]:
        """That the first frames are another sensor's, or name another model: found out once, when
        there are enough of them.
        """
        if self._another is None and (len(self._first) >= EXAMINED or self._input.ended):
            simulated = simulated_sensor(self.source)
            is_certain = simulated is not None and simulated.id == self.sensor.id
            self._another = "" if is_certain else contradiction(self.sensor, self._first)
        if not self._another:
            return []
        text = f"{self.source}: read as {self.sensor.id}, and {self._another}"
        return [f"{text}; next: lidarspec detect {quote(str(self.source))}"]


def _nominal(sensor: Sensor) -> str:
    """That a default calibration stood in, and how the sensor's own is given."""
    text = f"{sensor.id}: points by the nominal calibration of the model, not of this unit"
    if files := [name for name in sensor.configure.files if name not in sensor.options]:
        return f"{text}; its own: -O {files[0]}=FILE, in Python sensor.configure({files[0]}=FILE)"
    return text + (f", where no {' or '.join(sensor.state)} frame had come" if sensor.state else "")


def _recorder(
    record: RecordTo | None,
    source: str | Path,
    opened: LiveTransport,
    own: list[Log],
    sensor: Sensor,
) -> Log | None:
    """What is to record a sensor as it is read, None for nothing; added to `own` where it is to be
    closed with the device.
    """
    if record is None:
        return None
    kept, is_own = recorder_for(record, sensor, source, opened)
    own += [kept] * is_own
    return kept


def _close(source: Input | Transport, recorders: list[Log]) -> None:
    """Give everything back; the recording is closed even where the source fails."""
    try:
        source.close()
    finally:
        for recorder in recorders:
            recorder.close()


def open(
    source: str | Path,
    sensor: str | Sensor | None = None,
    *,
    backend: str = "auto",
    start: bool = True,
    record: RecordTo | None = None,
    overflow: str | None = None,
    period: float = PERIOD,
) -> Device:
    """A sensor on any SOURCE: a port, a socket, a simulated device, a file, or "-" for standard
    input.

    Args:
        source: "/dev/ttyUSB0", "serial:///dev/ttyUSB0?baud=230400", "udp://", "tcp://host:port",
            "capture.pcap", or a name of `lidarspec.toml` ...
        sensor: an id, a path to a sensor's module, or a Sensor; found out where left out.
        backend: what evaluates `points`: "auto", "numpy", "jit" or "construct".
        start: False leaves out the commands that the sensor declares for its start, and for its
            end.
        record: a new file, or a `Recorder`, for everything that arrives and is sent; or what makes
            one of the open transport.
        overflow: what a live source does when the consumer is too slow: "drop_oldest", or "block";
            by default the first, but a simulated sensor without a pace of its own waits.
        period: seconds between two decodings of what has come.

    Raises:
        SourceError: where the source cannot be opened.
        UsageError, WireError: where several sensors fit, or none, and `sensor` was left out.
        CommandError: where the device does not start.
    """
    device = named(source)
    if sensor is None:
        sensor = detected(source)
    mount = None if device is None else device.mount
    return Device(
        source,
        named_sensor(sensor),
        backend=backend,
        start=start,
        record=record,
        overflow=overflow,
        period=period,
        mount=mount,
    )
