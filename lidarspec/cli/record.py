"""`record`: everything that a source sends, with its arrival times, into one file."""

from __future__ import annotations

import contextlib
import os
import shlex
import time
from dataclasses import dataclass, replace

import click

from lidarspec.cli.failures import INTERRUPTED
from lidarspec.cli.output import Progress, emit_json, note, sensor_option, size
from lidarspec.cli.streams import DURATION, nothing_came
from lidarspec.device.capture_thread import BoundedQueue, Capture, Mark
from lidarspec.device.device import Device
from lidarspec.device.settings import named
from lidarspec.discovery.detect import declared
from lidarspec.errors import CommandError, LidarSpecError, SourceError, UnknownFormat, UsageError, WireError, suggest
from lidarspec.plugins import sensor as named_sensor
from lidarspec.recording.appending import Appender
from lidarspec.recording.format import Header
from lidarspec.recording.recorders import Recorder, check_suffix, recorder
from lidarspec.spec.sensor import Sensor
from lidarspec.transports.files import RecordingTransport
from lidarspec.transports.open_url import live_address, transport
from lidarspec.transports.protocol import Chunk, LiveTransport, Transport

#: seconds between two looks at the time and at the disk.
TURN = 0.1


@dataclass
class Task:
    """What is to be recorded, for how long, and how far it is.

    Attributes:
        seconds, count: when it ends; None where nothing says.
        salvage: go on behind damaged places of a recording.
        packets: data packets of the sensor so far, or datagrams.
        elapsed: seconds since the source was open.
    """

    source: str
    target: str
    sensor: Sensor | None
    seconds: float | None
    count: int | None
    start: bool
    overwrite: bool
    salvage: bool
    progress: Progress
    packets: int = 0
    elapsed: float = 0.0
    began: float = 0.0
    recorder: Appender | None = None
    device: Device | None = None

    def opened(self, source: Transport) -> Appender:
        """The recorder, now that the source is open."""
        counts = source.datagrams or (self.sensor is not None and isinstance(source, LiveTransport))
        if self.count is not None and not counts:
            raise UsageError(f"-n counts packets, and {self.source} is a byte stream: name the sensor with -s, or give a time with -t")
        header = source.header if isinstance(source, RecordingTransport) else Header(source=self.source, baud=source.baud)
        self.recorder = recorder(
            self.target,
            self.sensor or header.sensor,
            header.source,
            datagrams=source.datagrams,
            baud=header.baud,
            overwrite=self.overwrite,
        )
        self.began = time.monotonic()
        return self.recorder

    def goes_on(self, *, timed: bool = True) -> bool:
        """Whether it has neither taken its time nor got all that was asked for; raises what went wrong with the file."""
        assert self.recorder is not None
        if self.recorder.error is not None:
            self.recorder.sync()
        self.elapsed = time.monotonic() - self.began
        self.progress(self.told)
        is_late = timed and self.seconds is not None and self.elapsed >= self.seconds
        return not is_late and (self.count is None or self.packets < self.count)

    def told(self) -> str:
        """What has been recorded, in words."""
        assert self.recorder is not None
        packets = f"{self.packets} packets, " if self.packets else ""
        return f"{packets}{self.recorder.records} records, {size(self.recorder.bytes)} in {self.elapsed:.1f} s"

    def say(self, text: str) -> None:
        """A remark, in place of the line that shows the progress."""
        self.progress.clear()
        note(text)


@click.command()
@click.argument("source", metavar="SOURCE")
@click.option("-o", "--output", "target", metavar="FILE", required=True, help="The file: .lsr, .pcap for Wireshark, .bin for bytes alone.")
@sensor_option
@click.option("-t", "--duration", "seconds", type=DURATION, help="How long, such as 10s; until Ctrl-C by default.")
@click.option("-n", "--count", type=click.IntRange(min=1), help="So many packets at least: the sensor's data packets, or datagrams.")
@click.option("--no-start", is_flag=True, help="Send the sensor no commands.")
@click.option("--force", is_flag=True, help="Overwrite FILE.")
@click.option("--salvage", is_flag=True, help="Go on behind damaged places, where SOURCE is a recording.")
@click.option("--json", "as_json", is_flag=True, help="Print a summary as JSON.")
def record(
    source: str,
    target: str,
    sensor_id: str | None,
    seconds: float | None,
    count: int | None,
    no_start: bool,
    force: bool,
    salvage: bool,
    as_json: bool,
) -> None:
    """Everything that a source sends, with the time of its arrival, in one file that survives a crash.

    A sensor that is named, with -s or by the source (sim:ID), is started, and what it is stands in the file; without, bytes are
    recorded as they come.
    """
    _check_target(target)
    path = source.partition("?")[0]
    if os.path.exists(path) and os.path.exists(target) and os.path.samefile(path, target):
        raise UsageError(f"{target} is the source: it would be overwritten")
    known = named(source)
    is_live = live_address(known.source if known else source) is not None
    sensor = named_sensor(sensor_id) if sensor_id else declared(source) if is_live else known.configured() if known else None
    interrupted = False
    with Progress() as progress:
        task = Task(source, target, sensor, seconds, count, not no_start, force, salvage, progress)
        try:
            _driven(task) if is_live and sensor is not None else _received(task)
        except KeyboardInterrupt:
            if task.recorder is None:
                raise
            interrupted = True
        except UsageError as error:
            if task.recorder is None and os.path.exists(target) and not force:
                suggest(error, "the same with --force, or with another file")
            raise
        except SourceError as error:
            if task.recorder is not None and task.recorder.error is error:
                suggest(error, _following(task))
            raise
    try:
        _sum_up(task, as_json=as_json)
    except LidarSpecError as error:
        if not interrupted:
            raise
        note(str(error))
    if interrupted:
        raise click.exceptions.Exit(INTERRUPTED)


def _check_target(target: str) -> None:
    try:
        check_suffix(target)
    except UnknownFormat as error:
        raise suggest(error, "lidarspec record --help") from None


def _driven(task: Task) -> None:
    """Record a live source whose sensor is known: it is started and stopped, and what arrives is decoded to be counted."""
    assert task.sensor is not None
    state = ""
    with Device(task.source, task.sensor, start=task.start, record=task.opened) as task.device:
        for packets in task.device.packets(wait=TURN):
            task.packets += len(packets)
            if not task.goes_on():
                break
            if task.device.state != state:
                state = task.device.state
                task.say("\n".join(task.device.warnings)) if task.device.warnings else None


def _received(task: Task) -> None:
    """Record a source as it comes, or what is in a file."""
    source = RecordingTransport(task.source, salvage=True) if task.salvage else transport(task.source, task.sensor)
    with contextlib.closing(source), task.opened(source):
        if isinstance(source, LiveTransport):
            _captured(task, source)
        else:
            _copied(task, source)
        for warning in source.warnings:
            task.say(warning)


def _captured(task: Task, source: LiveTransport) -> None:
    """What arrives is recorded by a thread; here it is counted and thrown away."""
    queue = BoundedQueue()
    with contextlib.closing(Capture(source, queue, log=task.recorder)):
        while task.goes_on():
            for _, item in queue.take(TURN):
                if isinstance(item, BaseException):
                    raise item
                if isinstance(item, Chunk):
                    task.packets += source.datagrams
                elif item is not Mark.SILENT:
                    task.say(f"{task.source}: the device is {'gone; waiting for it to come back' if item is Mark.LOST else 'back'}")


def _copied(task: Task, source: Transport) -> None:
    """What is in a file, as fast as the disk takes it; standard input gets the time of its arrival."""
    assert task.recorder is not None
    first: int | None = None
    for chunk in source.chunks():
        at = time.time_ns() if chunk.at is None and task.source == "-" else chunk.at
        first = at if first is None else first
        is_late = task.seconds is not None and at is not None and first is not None and at - first >= task.seconds * 1e9
        if is_late or not task.goes_on(timed=False):
            break
        task.recorder.keep_up()
        task.recorder.write(replace(chunk, at=at))
        task.packets += source.datagrams


def _sum_up(task: Task, *, as_json: bool) -> None:
    """What was recorded, and what can be done with it; an empty file is not left behind."""
    kept, device = task.recorder, task.device
    assert kept is not None
    if not kept.records:
        with contextlib.suppress(OSError):
            os.unlink(task.target)
        if device is not None:
            raise nothing_came(device, task.source, task.elapsed)
        is_live = live_address(task.source) is not None
        error: LidarSpecError = (
            CommandError(f"{task.source} sent nothing") if is_live else WireError(f"{task.source} holds nothing that was received")
        )
        raise suggest(error, f"lidarspec doctor {shlex.quote(task.source)}" if is_live else "lidarspec record --help")
    stats = device.stats if device is not None else None
    note(f"{task.target}: {task.told()}{f'; {stats}' if stats else ''}")
    note(f"next: {_following(task)}")
    if as_json:
        facts = {"output": task.target, "source": task.source, "sensor": task.sensor.id if task.sensor else None}
        counts = {"records": kept.records, "bytes": kept.bytes, "packets": task.packets, "seconds": task.elapsed, "dropped": kept.dropped}
        emit_json({**facts, **counts, "stats": stats.to_dict() if stats else None}, None)
    if stats is not None and not stats.frames and device is not None:
        raise nothing_came(device, task.source, task.elapsed)


def _following(task: Task) -> str:
    """The command that shows what was recorded."""
    file, kept = shlex.quote(task.target), task.recorder
    if isinstance(kept, Recorder) and kept.header.sensor:
        return f"lidarspec view {file}"
    return f"lidarspec view {file} -s {task.sensor.id}" if task.sensor else f"lidarspec detect {file}"
