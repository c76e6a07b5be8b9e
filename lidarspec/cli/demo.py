"""`demo`: the main job with nothing attached."""

from __future__ import annotations

import shutil

import click
import numpy as np
from rich.text import Text

from lidarspec.cli.failures import FINDINGS
from lidarspec.cli.look import NO_SENSORS
from lidarspec.cli.output import drawn, emit_json, sensor_option
from lidarspec.cli.progress import size
from lidarspec.demo import DemoResult, has_terminals, run
from lidarspec.errors import UsageError
from lidarspec.plugins import registry, sensor as named_sensor
from lidarspec.scans import Scan
from lidarspec.view.polar import look, picture

#: cells of the picture at most, and lines that are kept for the summary.
WIDEST, HIGHEST, SUMMARY = 100, 42, 8


@click.command()
@sensor_option
@click.option("-n", "--count", type=click.IntRange(min=1), default=5, show_default=True, help="Whole scans to wait for.")
@click.option("--errors", type=click.FloatRange(0, 1), default=0.01, show_default=True, help="Share of the bytes that the line damages.")
@click.option("--json", "as_json", is_flag=True, help="Print the summary as JSON.")
def demo(sensor_id: str | None, count: int, errors: float, as_json: bool) -> None:
    """A simulated sensor on a port: started, read through a bad line, recorded, read again, drawn."""
    sensor = named_sensor(sensor_id) if sensor_id else next((s for s in registry().sensors().values() if s.sweep), None)
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
