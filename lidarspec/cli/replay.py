"""`replay`: what was recorded goes out again, byte for byte and in time."""

from __future__ import annotations

import contextlib
import os
import shlex

import click

from lidarspec.cli.failures import INTERRUPTED
from lidarspec.cli.output import Progress, emit_json, note, sensor_option, size
from lidarspec.cli.streams import SPEED
from lidarspec.device.settings import named
from lidarspec.errors import LidarSpecError, UsageError, WireError, suggest
from lidarspec.plugins import sensor as named_sensor
from lidarspec.recording.format import Header
from lidarspec.recording.recorders import SUFFIXES, declared_port, recorder
from lidarspec.spec.sensor import Sensor
from lidarspec.transports.files import RecordingTransport
from lidarspec.transports.open_url import live_address, transport
from lidarspec.transports.outlets import FileOutlet, Outlet, replay_outlet
from lidarspec.transports.protocol import Transport
from lidarspec.transports.serving import LATE, Replay


@click.command()
@click.argument("file", metavar="FILE")
@click.option(
    "--to", "place", default="pty", show_default=True, metavar="PLACE", help="pty, udp://host[:port], tcp://host:port, or a new file."
)
@click.option("--speed", type=SPEED, help="1 as it came, 0.5 half as fast, max as fast as possible.  [default: 1; max into a file]")
@click.option("--loop", is_flag=True, help="Begin again at the end, until Ctrl-C.")
@click.option("--force", is_flag=True, help="Overwrite a file to play to.")
@sensor_option
@click.option("--json", "as_json", is_flag=True, help="Print a summary as JSON, with the SHA-256 of all bytes.")
def replay(file: str, place: str, speed: float | None, loop: bool, force: bool, sensor_id: str | None, as_json: bool) -> None:
    """A recording or capture, sent again as it came: bit for bit, and by the clock.

    To a pty or tcp:// it begins when somebody opens it. udp:// without a port uses those of the recording. A new .lsr or .pcap
    file keeps the times of the recording.
    """
    device = named(file)
    if live_address(file if device is None else device.source) is not None:
        raise suggest(UsageError(f"{file} is live: only what was recorded can be replayed"), f"lidarspec record {file} -o recording.lsr")
    is_file = place.endswith(SUFFIXES) and "://" not in place
    if is_file and loop:
        raise UsageError("a file cannot take a replay that never ends: leave out --loop")
    if is_file and os.path.exists(place) and os.path.samefile(file.partition("?")[0], place):
        raise UsageError(f"{place} is the source: it would be overwritten")
    with contextlib.closing(transport(file)) as source:
        sensor = _sensor(source, sensor_id)
        outlet = (
            _file(source, file, place, sensor, force=force)
            if is_file
            else replay_outlet(place, datagrams=source.datagrams, port=declared_port(sensor))
        )
    _announce(file, outlet, sensor)
    factor = (None if is_file else 1.0) if speed is None else speed or None
    played = Replay(file, outlet, speed=factor, needs_times=speed is not None, loop=loop)
    is_interrupted = _run(played, outlet, file)
    _sum_up(file, outlet, sensor, played, as_json=as_json)
    if is_interrupted:
        raise click.exceptions.Exit(INTERRUPTED)


def _run(played: Replay, outlet: Outlet, file: str) -> bool:
    """Whether it was interrupted before its end."""
    with contextlib.closing(outlet), Progress() as progress:
        try:
            for remark in played.run():
                progress(lambda: _told(played))
                if remark:
                    progress.clear()
                    note(remark)
        except KeyboardInterrupt:
            return True
        except WireError as error:
            raise suggest(error, f"lidarspec show {file}") from None
        finally:
            outlet.finish()
    return False


def _sensor(source: Transport, sensor_id: str | None) -> Sensor | None:
    """The sensor that is named, or the one of the recording if it is installed; None where nobody knows."""
    if sensor_id:
        return named_sensor(sensor_id)
    with contextlib.suppress(LidarSpecError):
        return source.header.known_sensor() if isinstance(source, RecordingTransport) else None
    return None


def _file(source: Transport, file: str, place: str, sensor: Sensor | None, *, force: bool) -> FileOutlet:
    """A new file in the place of the old one's source."""
    header = source.header if isinstance(source, RecordingTransport) else Header(source=file)
    try:
        whose, link = sensor or header.sensor, source.datagrams
        return FileOutlet(recorder(place, whose, header.source, datagrams=link, baud=header.baud, overwrite=force))
    except UsageError as error:
        raise suggest(error, "the same with --force, or with another file") if os.path.exists(place) and not force else error from None


def _announce(file: str, outlet: Outlet, sensor: Sensor | None) -> None:
    """Where it plays to, and what to type there."""
    if isinstance(outlet, FileOutlet):
        return
    place = outlet.place
    if place.startswith("udp:") and ":" not in place.removeprefix("udp://"):
        place = "udp://" if sensor else "udp://:PORT"
    waits = "" if place.startswith("udp:") else ", as soon as it is opened"
    note(f"playing {file} to {outlet.place}{waits}")
    note(f"next: lidarspec {_shown(sensor, place)}")


def _shown(sensor: Sensor | None, place: str) -> str:
    """The verb that shows what is there."""
    return f"view {shlex.quote(place)} -s {sensor.id}" if sensor else f"detect {shlex.quote(place)}"


def _told(played: Replay) -> str:
    return f"{played.chunks} chunks, {size(played.bytes)} in {played.seconds:.1f} s"


def _sum_up(file: str, outlet: Outlet, sensor: Sensor | None, played: Replay, *, as_json: bool) -> None:
    is_file = isinstance(outlet, FileOutlet)
    note(f"{file} to {outlet.place}: {_told(played)}")
    if not played.is_timed:
        note(f"{file} does not say when its bytes arrived: they went out as fast as they were taken")
    if played.late:
        note(f"{played.late} chunks went out more than {LATE // 1_000_000} ms late, up to {played.latest / 1e6:.0f} ms")
    if len(played.senders) > 1 and not is_file:
        note(f"{len(played.senders)} senders were recorded, and all went out from one address; choose one with '{file}?src=ADDRESS'")
    if is_file:
        note(f"next: lidarspec {_shown(sensor, outlet.place)}")
    if as_json:
        facts = {"source": file, "to": outlet.place, "chunks": played.chunks, "bytes": played.bytes, "sha256": played.digest.hexdigest()}
        emit_json({**facts, "seconds": played.seconds, "late": played.late, "latest_ns": played.latest}, None)
