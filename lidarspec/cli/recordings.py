"""`record` and `replay`: record a source to a file, and send a recording again."""

from __future__ import annotations

import contextlib
import os
import re
import shlex

import click

from lidarspec.cli.failures import INTERRUPTED
from lidarspec.cli.inputs import exit_if_damaged, make_no_scan_error, refuse_overwriting
from lidarspec.cli.options import DURATION, SPEED, count_option, selection_options, sensor_option
from lidarspec.cli.output import Progress, emit_json, format_size
from lidarspec.cli.terminal import note, say
from lidarspec.detect.identification import find_declared_sensor, verb_to_show
from lidarspec.device.named_devices import find_device
from lidarspec.device.source_recording import SourceRecording, make_recorder
from lidarspec.errors import (
    CommandError,
    LidarSpecError,
    SourceError,
    UsageError,
    WireError,
    suggest,
)
from lidarspec.framing.results import Counters
from lidarspec.plugins import sensor as named_sensor
from lidarspec.recording.background_writer import BackgroundWriter
from lidarspec.recording.recorders import SUFFIXES, Recorder, check_suffix, declared_port
from lidarspec.scans.selection import Selection
from lidarspec.sensor_operations import Sensor
from lidarspec.transports.destinations import make_replay_outlet
from lidarspec.transports.files import RecordingTransport
from lidarspec.transports.open_url import is_live, live_address, open_transport
from lidarspec.transports.outlets import Outlet
from lidarspec.transports.protocol import Transport
from lidarspec.transports.replays import LATE_NS, Replay


@click.command()
@click.argument("source", metavar="SOURCE")
@click.option(
    "-o",
    "--output",
    "target",
    metavar="FILE",
    required=True,
    help="Output file: .lsr, .pcap or .pcapng for Wireshark, .bin for raw bytes.",
)
@sensor_option
@click.option(
    "-t",
    "--duration",
    "seconds",
    type=DURATION,
    help="Stop after this time, such as 10s; default: at Ctrl-C.",
)
@count_option("data packets, or datagrams if no sensor is named; a few more may be recorded")
@click.option("--no-start", is_flag=True, help="Send no commands to the sensor.")
@click.option("--force", is_flag=True, help="Overwrite FILE.")
@click.option(
    "--salvage", is_flag=True, help="Continue after damaged records if SOURCE is a recording."
)
@click.option("--slice", "times", hidden=True)
@click.option("--json", "as_json", is_flag=True, help="Print a summary as JSON.")
def record(
    source: str,
    target: str,
    sensor_id: str | Sensor | None,
    seconds: float | None,
    count: int | None,
    no_start: bool,
    force: bool,
    salvage: bool,
    times: str | None,
    as_json: bool,
) -> None:
    """Record a source with arrival times; a crash does not damage the file.

    With -s ID or a source sim:ID, the sensor is started, and its id and options are stored in the
    file. Without a sensor, raw bytes are recorded.
    """
    check_suffix(target)
    if times is not None:
        raise _make_slice_error(source, target, times)
    refuse_overwriting(target, source, sensor_id)
    configured_device = find_device(source)
    sensor: Sensor | None = None
    if sensor_id:
        sensor = named_sensor(sensor_id)
    elif is_live(source):
        sensor = find_declared_sensor(source)
    elif configured_device:
        sensor = configured_device.configure()
    task = SourceRecording(
        source,
        target,
        sensor,
        seconds=seconds,
        count=count,
        start=not no_start,
        overwrite=force,
        salvage=salvage,
    )
    interrupted = False
    try:
        _print_recording(task)
    except KeyboardInterrupt:
        if task.recorder is None:
            raise
        interrupted = True
    except UsageError as error:
        if task.recorder is None and os.path.exists(target) and not force:
            suggest(error, "repeat with --force, or with another file")
        raise
    except SourceError as error:
        if task.recorder is not None and task.recorder.error is error:
            suggest(error, _make_view_command(task.recorder, sensor))
        raise
    assert task.recorder is not None
    try:
        _sum_up_recording(task, task.recorder, source, sensor, as_json=as_json)
    except LidarSpecError as error:
        if not interrupted:
            raise
        note(str(error))
    if interrupted:
        raise click.exceptions.Exit(INTERRUPTED)
    exit_if_damaged(task.unread)


def _make_slice_error(source: str, target: str, times: str) -> UsageError:
    """Return the error for `record --slice`, which suggests a command that works."""
    if is_live(source):
        return suggest(
            UsageError("--slice requires a recording: use -t for a live source"),
            "lidarspec record --help",
        )
    command = (
        f"lidarspec replay {shlex.quote(source)} --to {shlex.quote(target)} --slice"
        f" {shlex.quote(times)}"
    )
    return suggest(UsageError("record copies only whole files: use replay to copy a part"), command)


def _print_recording(task: SourceRecording) -> None:
    with Progress() as progress, contextlib.closing(task.run()) as remarks:
        progress.run_task(
            remarks,
            lambda: _describe_recording(task, task.recorder) if task.recorder is not None else "",
        )


def _describe_recording(task: SourceRecording, recorder: BackgroundWriter) -> str:
    """Return a text with the number of packets, records and bytes, and the duration."""
    packets = f"{task.packets} packets, " if task.packets else ""
    written = f"{recorder.records} records, {format_size(recorder.bytes)}"
    return f"{packets}{written} in {task.elapsed:.1f} s"


def _sum_up_recording(
    task: SourceRecording,
    recorder: BackgroundWriter,
    source: str,
    sensor: Sensor | None,
    *,
    as_json: bool,
) -> None:
    """Print a summary of a recording and the next command."""
    device = task.device
    if not recorder.records:
        if not recorder.discard():
            note(f"{recorder.path} was not changed")
        if device is not None:
            raise make_no_scan_error(device, source, task.elapsed)
        if live_address(source) is not None:
            raise suggest(
                CommandError(f"{source} sent nothing"), f"lidarspec doctor {shlex.quote(source)}"
            )
        raise suggest(
            WireError(f"{source} contains no data from a sensor, so nothing was recorded"),
            f"lidarspec info {shlex.quote(source)}",
        )
    stats = device.stats if device is not None else None
    summary = f"{recorder.path}: {_describe_recording(task, recorder)}"
    if stats is not None and (damage := _describe_damage(stats)):
        summary += f"; {damage}"
    note(summary)
    note(f"next: {_make_view_command(recorder, sensor)}")
    if as_json:
        facts = {"output": recorder.path, "source": source, "sensor": sensor.id if sensor else None}
        counts = {
            "records": recorder.records,
            "bytes": recorder.bytes,
            "packets": task.packets,
            "seconds": task.elapsed,
            "dropped": recorder.dropped,
        }
        emit_json({**facts, **counts, "stats": stats.to_dict() if stats else None}, None)
    if stats is not None and not stats.frames and device is not None:
        raise make_no_scan_error(device, source, task.elapsed)


def _describe_damage(stats: Counters) -> str:
    """Format the counters of lost and damaged input."""
    counters = stats.to_dict()
    for name in ("frames", "bytes_in", "pending"):
        del counters[name]
    return ", ".join(f"{name} {value}" for name, value in counters.items() if value)


def _make_view_command(recorder: BackgroundWriter, sensor: Sensor | None) -> str:
    """Return the command that shows a recording."""
    if isinstance(recorder, Recorder) and recorder.header.sensor:
        verb = "view" if sensor is None else verb_to_show(sensor)
        return f"lidarspec {verb} {shlex.quote(recorder.path)}"
    return f"lidarspec {_make_view_words(sensor, recorder.path)}"


@click.command()
@click.argument("file", metavar="FILE")
@click.option(
    "--to",
    "target",
    default="pty",
    show_default=True,
    metavar="PLACE",
    help="Destination: pty, udp://host[:port], tcp://host:port, or a new file.",
)
@click.option(
    "--speed",
    type=SPEED,
    help="1 is the recorded speed, 0.5 is half of it, max is without pauses."
    "  [default: 1; to a file: max]",
)
@click.option("--loop", is_flag=True, help="Repeat until Ctrl-C.")
@click.option("--force", is_flag=True, help="Overwrite the destination file.")
@sensor_option
@selection_options("times")
@click.option(
    "--json",
    "as_json",
    is_flag=True,
    help="Print a summary as JSON, with the SHA-256 of all bytes.",
)
def replay(
    file: str,
    target: str,
    speed: float | None,
    loop: bool,
    force: bool,
    sensor_id: str | Sensor | None,
    selection: Selection,
    as_json: bool,
) -> None:
    """Replay a recording or capture, byte for byte and in real time.

    With a pty or tcp://, the replay starts when a reader opens the port. udp:// without a port
    sends to the ports of the recording. A new .lsr or .pcap file contains the arrival times of the
    recording. --slice selects by arrival time.
    """
    if is_live(file):
        raise suggest(
            UsageError(f"only a file can be replayed, but {file} is a live source"),
            f"lidarspec record {shlex.quote(file)} -o recording.lsr",
        )
    is_file = target.endswith(SUFFIXES) and "://" not in target
    if is_file and loop:
        raise UsageError("--loop requires a port or socket, not a file")
    if file == "-" and loop:
        raise UsageError("standard input can be read only once: omit --loop")
    if is_file:
        refuse_overwriting(target, file, sensor_id)
    with contextlib.ExitStack() as undo:
        source = undo.enter_context(contextlib.closing(open_transport(file)))
        sensor = _find_sensor(source, sensor_id)
        destination: Outlet | BackgroundWriter
        if is_file:
            destination = _make_file(source, file, target, sensor, force=force)
        else:
            port = declared_port(sensor)
            destination = make_replay_outlet(target, datagrams=source.datagrams, port=port)
        undo.pop_all()  # the replay closes the source
    if isinstance(destination, Outlet):
        target = destination.local_source
        _announce(file, target, sensor, as_json=as_json)
    factor = speed or None  # 0 is as fast as possible
    if speed is None and not is_file:
        factor = 1.0
    played = Replay(
        file,
        destination,
        speed=factor,
        needs_times=speed is not None,
        loop=loop,
        transport=source,
        times=selection.times,
    )
    is_interrupted = _run_replay(played, destination, file)
    _print_summary(file, target, sensor, played, is_file=is_file, as_json=as_json)
    if is_interrupted:
        raise click.exceptions.Exit(INTERRUPTED)
    exit_if_damaged(played.unread)


def _run_replay(played: Replay, destination: Outlet | BackgroundWriter, file: str) -> bool:
    """Run a replay, and return whether the user interrupted it.

    If the replay fails before the first record, the new file is removed.
    """
    try:
        with contextlib.closing(destination), Progress() as progress:
            try:
                progress.run_task(played.run(), lambda: _describe_progress(played))
            except KeyboardInterrupt:
                return True
            except WireError as error:
                path = "FILE" if file == "-" else shlex.quote(file)
                raise suggest(error, f"lidarspec info {path}") from None
            finally:
                if isinstance(destination, Outlet):
                    destination.finish()
    finally:
        if isinstance(destination, BackgroundWriter) and not destination.records:
            destination.discard()
    return False


def _find_sensor(source: Transport, sensor_id: str | Sensor | None) -> Sensor | None:
    """Return the named sensor, or the sensor of the recording if it is installed."""
    if sensor_id:
        return named_sensor(sensor_id)
    with contextlib.suppress(LidarSpecError):
        if isinstance(source, RecordingTransport):
            return source.known_sensor()
        return None
    return None


def _make_file(
    source: Transport, file: str, target: str, sensor: Sensor | None, *, force: bool
) -> BackgroundWriter:
    """Create the file to which a recording is copied."""
    try:
        return make_recorder(source, file, target, sensor, overwrite=force)
    except UsageError as error:
        if os.path.exists(target) and not force:
            raise suggest(error, "repeat with --force, or with another file") from None
        raise


def _announce(file: str, target: str, sensor: Sensor | None, *, as_json: bool) -> None:
    """Print the destination, unless the output is JSON, and the next command."""
    if not as_json:
        say(target)
    if not target.startswith("udp:"):
        note(f"replaying {file} to {target} when a reader opens it")
        note(f"next: lidarspec {_make_view_words(sensor, target)}")
        return
    note(f"replaying {file} to {target}")
    has_port = re.search(r":\d+$", target) is not None
    if has_port:
        note(f"next: lidarspec {_make_view_words(sensor, target)}")
    elif sensor is not None:
        note(f"next: lidarspec {_make_view_words(sensor, 'udp://')}")
    else:
        note("next: lidarspec detect")  # listens to the ports of all sensors


def _make_view_words(sensor: Sensor | None, target: str) -> str:
    """Return the arguments of `lidarspec` that show the data of a source."""
    if sensor is None:
        return f"detect {shlex.quote(target)}"
    return f"{verb_to_show(sensor)} {shlex.quote(target)} -s {sensor.id}"


def _describe_progress(played: Replay) -> str:
    return f"{played.chunks} chunks, {format_size(played.bytes)} in {played.seconds:.1f} s"


def _print_summary(
    file: str,
    target: str,
    sensor: Sensor | None,
    played: Replay,
    *,
    is_file: bool,
    as_json: bool,
) -> None:
    note(f"{file} to {target}: {_describe_progress(played)}")
    if not played.is_timed:
        note(f"{file} has no arrival times, so its bytes were sent as fast as possible")
    if played.late:
        note(
            f"{played.late} chunks were sent more than {LATE_NS // 1_000_000} ms late; the longest"
            f" delay was {played.greatest_delay_ns / 1e6:.0f} ms"
        )
    if len(played.senders) > 1 and not is_file:
        note(
            f"the recording has the datagrams of {len(played.senders)} senders, but all were sent"
            f" from one address: select one sender with '{file}?src=ADDRESS'"
        )
    if is_file:
        note(f"next: lidarspec {_make_view_words(sensor, target)}")
    if as_json:
        summary = {
            "source": file,
            "to": target,
            "chunks": played.chunks,
            "bytes": played.bytes,
            "sha256": played.digest.hexdigest(),
            "seconds": played.seconds,
            "late": played.late,
            "latest_ns": played.greatest_delay_ns,
        }
        emit_json(summary, None)
