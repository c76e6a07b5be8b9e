"""The main job with nothing attached, end to end: a simulated sensor on a real line, asked to start, read, recorded, read again.

A serial sensor stands on a pseudo-terminal, or on a TCP port where the system has none; the others send UDP datagrams on loopback.
The line does its harm on the way. What was recorded is decoded once more, and has to give the same points.

`demo`: the main job with nothing attached.
"""

from __future__ import annotations

import hashlib
import itertools
import shutil
import socket
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
from rich.text import Text

from lidarspec.cli.failures import FINDINGS
from lidarspec.cli.output import drawn, emit_json, sensor_option, size
from lidarspec.cli.sensors import NO_SENSORS
from lidarspec.device.device import Device, open as open_device
from lidarspec.device.session import Reply
from lidarspec.errors import SourceError, UsageError
from lidarspec.framing.results import Counters
from lidarspec.plugins import registry, sensor as named_sensor
from lidarspec.scans.scans import Scan
from lidarspec.simulation.device import SimulatedDevice
from lidarspec.simulation.faults import Faults
from lidarspec.spec.sensor import Sensor
from lidarspec.transports.outlets import HERE, has_terminals, simulated_outlet
from lidarspec.transports.serving import Served
from lidarspec.view.polar import look, picture

#: seconds that the scans may take beyond those that they last.
PATIENCE = 15.0
#: seconds without a scan after which nothing is on the way any more.
QUIET = 0.2


@dataclass(frozen=True, eq=False)
class DemoResult:
    """What the demo saw.

    Attributes:
        sensor, place: whose, and where it stood.
        replies: to the commands that opened it.
        scans: those that came, the last one the last whole one.
        stats: the decoder's counters.
        sent, intact: packets that were sent, and that left the line unharmed.
        digest: SHA-256 of the points of the whole scans.
        again: the same of the recording.
        recorded: bytes in the recording.
    """

    sensor: Sensor
    place: str
    replies: tuple[Reply, ...]
    scans: tuple[Scan, ...]
    stats: Counters
    sent: int
    intact: int
    digest: str
    again: str
    recorded: int


def run(sensor: Sensor, *, turns: int = 5, errors: float = 0.01, seed: int = 1) -> DemoResult:
    """Let a simulated sensor work until so many whole scans have come.

    Args:
        turns: whole scans wanted.
        errors: share of the bytes of a stream that are damaged, or of the datagrams that are lost.

    Raises:
        SourceError: where no line can be had, or the scans do not come.
    """
    faults = Faults(loss=errors) if sensor.datagrams else Faults(errors=errors)
    simulated = SimulatedDevice(sensor, seed=seed, faults=faults)
    with tempfile.TemporaryDirectory(prefix="lidarspec-demo-") as folder:
        path = Path(folder) / "demo.lsr"
        place, replies, scans, stats = _live(simulated, path, turns)
        line, recorded = simulated.lines["data"], path.stat().st_size
        with open_device(path, sensor) as recording:
            again = digest(_whole(recording.scans(), turns))
    digested = digest([scan for scan in scans if scan.complete])
    return DemoResult(sensor, place, replies, scans, stats, line.sent, line.intact, digested, again, recorded)


def digest(scans: Sequence[Scan]) -> str:
    """SHA-256 of the coordinates, ranges and intensities of scans."""
    found = hashlib.sha256()
    for scan in scans:
        points = scan.points
        for column in (points.xyz, points.range, points.intensity):
            found.update(b"" if column is None else column.tobytes())
    return found.hexdigest()


def _live(simulated: SimulatedDevice, path: Path, turns: int) -> tuple[str, tuple[Reply, ...], tuple[Scan, ...], Counters]:
    """The place of the sensor, its replies, its scans and the counters; everything that came is recorded."""
    sensor = simulated.sensor
    if sensor.datagrams:
        port = _free_port()
        at = f"udp://{HERE}:{port}"
        with open_device(at, sensor, start=False, record=path) as device, Served(simulated, simulated_outlet(sensor, at)) as served:
            return at, *_read(device, served, turns)
    to = "pty" if has_terminals() else f"tcp://{HERE}:0"
    with (
        Served(simulated, simulated_outlet(sensor, to), patient=True) as served,
        open_device(served.path, sensor, start=False, record=path) as device,
    ):
        return served.path, *_read(device, served, turns)


def _read(device: Device, served: Served, turns: int) -> tuple[tuple[Reply, ...], tuple[Scan, ...], Counters]:
    replies = tuple(device.send(name) for name in device.sensor.on_open)
    limit = time.monotonic() + PATIENCE + turns
    scans: list[Scan] = []
    for scan in device.scans(wait=0.1):
        scans += [scan] if scan is not None else []
        if sum(one.complete for one in scans) >= turns:
            served.rest()
            while device.newest(QUIET) is not None:
                pass  # what is still on the way counts as sent, so it is read too
            return replies, tuple(scans), device.stats
        if time.monotonic() > limit:
            break
    raise SourceError(
        f"the simulated {device.sensor.id} gave {len(scans)} scans in {PATIENCE + turns:g} s, and not {turns}: {device.stats}"
    )


def _whole(scans: Iterator[Scan], number: int) -> list[Scan]:
    return list(itertools.islice((scan for scan in scans if scan.complete), number))


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((HERE, 0))
        return int(probe.getsockname()[1])


#: cells of the picture at most, and lines that are kept for the summary.
WIDEST, HIGHEST, SUMMARY = 100, 42, 8


@click.command()
@sensor_option
@click.option("-n", "--count", type=click.IntRange(min=1), default=5, show_default=True, help="Whole scans to wait for.")
@click.option("--errors", type=click.FloatRange(0, 1), default=0.01, show_default=True, help="Share of the bytes that the line damages.")
@click.option("--json", "as_json", is_flag=True, help="Print the summary as JSON.")
def demo(sensor_id: str | None, count: int, errors: float, as_json: bool) -> None:
    """A simulated sensor on a port: started, read through a bad line, recorded, read again, drawn."""
    simulated = (one for one in registry().sensors().values() if any(one.simulation_of(name).sweep for name in one.data_frames))
    sensor = named_sensor(sensor_id) if sensor_id else next(simulated, None)
    if sensor is None:
        raise UsageError(NO_SENSORS)
    result = run(sensor, turns=count, errors=errors)
    whole = [scan for scan in result.scans if scan.complete]
    if as_json:
        emit_json(_facts(result, whole), None)
    else:
        click.echo("\n".join([drawn(_picture(whole[-1])), *_summary(result, whole, errors)]))
    if result.digest != result.again:
        click.get_current_context().exit(FINDINGS)


def _picture(scan: Scan) -> Text:
    columns, lines = shutil.get_terminal_size((80, HIGHEST))
    width, height = min(columns, WIDEST), max(min(lines - SUMMARY, HIGHEST), 12)
    return picture(scan.points, width=width, height=height, look=look(scan.points)).text()


def _summary(result: DemoResult, whole: list[Scan], errors: float) -> list[str]:
    stats, name = result.stats, result.sensor.id
    frames = sum(stats.frames.values())
    harm = "of the datagrams lost" if result.sensor.datagrams else "of the bytes damaged"
    where = result.place if result.sensor.datagrams or has_terminals() else f"{result.place}, since this system has no pseudo-terminals"
    passed = f"{errors:.1%} {harm}, {result.intact} came through unharmed"
    told = [
        f"{name}, simulated on {where}: {result.sent} frames sent, {passed}",
        *(str(reply) for reply in result.replies if reply.confirmed),
        f"{frames} frames decoded, {stats.bad_checksum} checksum errors, {stats.bytes_skipped} of {stats.bytes_in} bytes skipped",
    ]
    facts = _facts(result, whole)
    rate = f" at {facts['rate_hz']:.1f} Hz" if facts["rate_hz"] else ""
    told.append(f"{len(whole)} whole scan{'s' * (len(whole) != 1)}{rate}, {facts['points']} points; the last one: {whole[-1]}")
    same = "the same points" if result.digest == result.again else "OTHER points"
    told.append(f"recorded ({size(result.recorded)}) and read again: {same}, SHA-256 {result.again[:16]}...")
    return [*told, f"next: lidarspec view sim:{name}"]


def _facts(result: DemoResult, whole: list[Scan]) -> dict[str, object]:
    rates = [scan.rate_hz for scan in whole if np.isfinite(scan.rate_hz)]
    return {
        "sensor": result.sensor.id,
        "sent": result.sent,
        "intact": result.intact,
        "scans": len(whole),
        "rate_hz": float(np.mean(rates)) if rates else None,
        "place": result.place,
        "replies": [reply.command for reply in result.replies if reply.confirmed],
        "recorded": result.recorded,
        "sha256": result.digest,
        "same_when_replayed": result.digest == result.again,
        "points": sum(int(scan.points.valid.sum()) for scan in whole),
        "stats": result.stats.to_dict(),
    }
