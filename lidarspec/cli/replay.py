"""`replay`: what was recorded goes out again, byte for byte and in time."""

from __future__ import annotations

import contextlib
import hashlib
import os
import shlex
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import click

from lidarspec.cli.failures import INTERRUPTED, suggest
from lidarspec.cli.output import Progress, emit_json, note, sensor_option, size
from lidarspec.cli.streams import Parameter
from lidarspec.device.settings import named
from lidarspec.errors import LidarSpecError, UsageError, WireError
from lidarspec.plugins import sensor as named_sensor
from lidarspec.recording.recorders import SUFFIXES, recorder
from lidarspec.recording.recordings import Header
from lidarspec.recording.replaying import Player, replayed
from lidarspec.spec.links import Udp
from lidarspec.spec.sensor import Sensor
from lidarspec.transports.files import RecordingTransport
from lidarspec.transports.open_url import live_address, transport
from lidarspec.transports.outlets import FilePlayer, player
from lidarspec.transports.protocol import Chunk, Disconnected, Transport

#: ns; a chunk that goes out later than this is worth a word.
LATE = 20_000_000


class Speed(Parameter):
    """A factor above 0, or "max"."""

    name = "speed"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """The factor; 0 for "max"."""
        if value == "max":
            return 0.0
        try:
            speed = float(str(value).removesuffix("x"))
        except ValueError:
            speed = 0.0
        if not 0 < speed < float("inf"):
            self.fail(f"{value!r} is no speed: a factor such as 1, 0.5 or 10, or max", param, ctx)
        return speed


@dataclass
class Played:
    """What went out so far.

    Attributes:
        latest: by how many ns the latest chunk was late; `late` how many were, by enough to be told.
        senders: addresses that datagrams came from then.
        is_timed: whether the source has times.
    """

    chunks: int = 0
    bytes: int = 0
    late: int = 0
    latest: int = 0
    senders: set[str] = field(default_factory=set)
    is_timed: bool = True
    digest: Any = field(default_factory=hashlib.sha256)
    began: float = field(default_factory=time.monotonic)

    def add(self, chunk: Chunk, late: int) -> None:
        """Count a chunk that was sent."""
        self.chunks += 1
        self.bytes += len(chunk.data)
        self.digest.update(chunk.data)
        self.late, self.latest = self.late + (late > LATE), max(self.latest, late)
        if chunk.sender is not None:
            self.senders.add(chunk.sender[0])

    def told(self) -> str:
        """In words."""
        return f"{self.chunks} chunks, {size(self.bytes)} in {time.monotonic() - self.began:.1f} s"


@click.command()
@click.argument("file", metavar="FILE")
@click.option(
    "--to", "place", default="pty", show_default=True, metavar="PLACE", help="pty, udp://host[:port], tcp://host:port, or a new file."
)
@click.option("--speed", type=Speed(), help="1 as it came, 0.5 half as fast, max as fast as possible.  [default: 1; max into a file]")
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
        factor = (None if is_file else 1.0) if speed is None else speed or None
        target = (
            _player(source, file, place, sensor, force=force) if is_file else player(place, datagrams=source.datagrams, port=_port(sensor))
        )
    _announce(file, target, sensor)
    played, is_interrupted = Played(), False
    with contextlib.closing(target), Progress() as progress:
        try:
            _play(file, target, factor, played, progress, loop=loop, needs_times=speed is not None)
        except KeyboardInterrupt:
            is_interrupted = True
    _sum_up(file, target, sensor, played, as_json=as_json)
    if is_interrupted:
        raise click.exceptions.Exit(INTERRUPTED)


def _play(file: str, target: Player, speed: float | None, played: Played, progress: Progress, *, loop: bool, needs_times: bool) -> None:
    """Once through the file, or again and again, for every listener from its beginning."""
    while True:
        target.wait()
        if not played.chunks:
            played.began = time.monotonic()
        with contextlib.closing(transport(file)) as source:
            try:
                for chunk, late in replayed(_checked(source, file, speed, played, needs_times=needs_times), target, speed=speed):
                    played.add(chunk, late)
                    progress(played.told)
            except Disconnected as gone:
                progress.clear()
                note(str(gone))
            else:
                for warning in [] if loop else getattr(source, "warnings", []):
                    progress.clear()
                    note(warning)
        if not played.chunks:
            raise suggest(WireError(f"{file} holds nothing that was received"), f"lidarspec show {file}")
        if not loop:
            return


def _checked(source: Transport, file: str, speed: float | None, played: Played, *, needs_times: bool) -> Iterator[Chunk]:
    """What was received; without times there is no speed to keep."""
    for chunk in source.chunks():
        if chunk.at is None and speed is not None and played.is_timed:
            if needs_times:
                raise UsageError(f"{file} does not say when its bytes arrived: only --speed max can be kept")
            played.is_timed = False
        yield chunk


def _sensor(source: Transport, sensor_id: str | None) -> Sensor | None:
    """The sensor that is named, or the one of the recording if it is installed; None where nobody knows."""
    if sensor_id:
        return named_sensor(sensor_id)
    with contextlib.suppress(LidarSpecError):
        return source.header.known_sensor() if isinstance(source, RecordingTransport) else None
    return None


def _port(sensor: Sensor | None) -> int:
    """A port that the sensor's datagrams go to, 0 where nobody knows."""
    links = sensor.links.values() if sensor else ()
    return next((port for link in links if isinstance(link, Udp) for port in link.ports), 0)


def _player(source: Transport, file: str, place: str, sensor: Sensor | None, *, force: bool) -> FilePlayer:
    """A new file in the place of the old one's source."""
    header = source.header if isinstance(source, RecordingTransport) else Header(source=file)
    try:
        made = recorder(
            place,
            sensor or header.sensor,
            header.source,
            datagrams=source.datagrams,
            baud=header.baud,
            port=_port(sensor),
            overwrite=force,
        )
    except UsageError as error:
        raise suggest(error, "the same with --force, or with another file") if os.path.exists(place) and not force else error from None
    return FilePlayer(made)


def _announce(file: str, target: Player, sensor: Sensor | None) -> None:
    """Where it plays to, and what to type there."""
    if isinstance(target, FilePlayer):
        return
    place = target.place
    if place.startswith("udp:") and ":" not in place.removeprefix("udp://"):
        place = "udp://" if sensor else "udp://:PORT"
    waits = "" if place.startswith("udp:") else ", as soon as it is opened"
    note(f"playing {file} to {target.place}{waits}")
    note(f"next: lidarspec {_shown(sensor, place)}")


def _shown(sensor: Sensor | None, place: str) -> str:
    """The verb that shows what is there."""
    return f"view {shlex.quote(place)} -s {sensor.id}" if sensor else f"detect {shlex.quote(place)}"


def _sum_up(file: str, target: Player, sensor: Sensor | None, played: Played, *, as_json: bool) -> None:
    note(f"{file} to {target.place}: {played.told()}")
    if not played.is_timed:
        note(f"{file} does not say when its bytes arrived: they went out as fast as they were taken")
    if played.late:
        note(f"{played.late} chunks went out more than {LATE // 1_000_000} ms late, up to {played.latest / 1e6:.0f} ms")
    if len(played.senders) > 1 and not isinstance(target, FilePlayer):
        note(f"{len(played.senders)} senders were recorded, and all went out from one address; choose one with '{file}?src=ADDRESS'")
    if isinstance(target, FilePlayer):
        note(f"next: lidarspec {_shown(sensor, target.place)}")
    if as_json:
        facts = {"source": file, "to": target.place, "chunks": played.chunks, "bytes": played.bytes, "sha256": played.digest.hexdigest()}
        emit_json({**facts, "seconds": time.monotonic() - played.began, "late": played.late, "latest_ns": played.latest}, None)
