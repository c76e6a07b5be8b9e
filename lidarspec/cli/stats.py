"""`stats`: how a sensor is doing, a line at a time."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import click

from lidarspec.cli.failures import FINDINGS
from lidarspec.cli.output import note, sensor_option
from lidarspec.cli.streams import Duration, Patience, Share, nothing_came
from lidarspec.device import Device, open as open_device
from lidarspec.packets import Packets
from lidarspec.view.feed import LOOK, Feed
from lidarspec.view.meter import Reading

#: lines after which the names of the columns are said again.
AGAIN = 20
#: name and unit of each figure, the width of its column (0: only in the summary), and its text.
FIGURES: tuple[tuple[str, str, int, Callable[[Reading], str]], ...] = (
    ("speed", "Hz", 6, lambda r: _number(r.speed_hz, ".2f")),
    ("packets", "/s", 8, lambda r: _number(r.packet_rate_hz, ".1f")),
    ("points", "/scan", 7, lambda r: _number(r.points, ".0f")),
    ("valid", "/scan", 7, lambda r: _number(r.valid, ".0f")),
    ("errors", "%", 7, lambda r: _number(_hundredfold(r.error_rate), ".3f")),
    ("skipped", "%", 7, lambda r: _number(_hundredfold(r.skipped_rate), ".3f")),
    ("loss", "%", 7, lambda r: _number(_hundredfold(r.loss_rate), ".3f")),
    ("jitter", "ms", 8, lambda r: _number(r.jitter_s and r.jitter_s * 1e3, ".3f")),
    ("gap", "ms", 0, lambda r: _number(r.longest_gap_s and r.longest_gap_s * 1e3, ".2f")),
    ("input", "kB/s", 0, lambda r: _number(r.bytes_per_s and r.bytes_per_s / 1e3, ".1f")),
)
COLUMNS = [figure for figure in FIGURES if figure[2]]


@dataclass
class Lines:
    """What is printed: a row of figures for each interval, or a JSON object."""

    device: Device
    as_json: bool
    printed: int = 0

    def interval(self, at: float | None, reading: Reading) -> None:
        """The figures of one interval, which ended `at` seconds after the beginning."""
        if self.as_json:
            self._emit({"kind": "interval", "at_s": at, **self._figures(reading)})
            return
        if self.printed % AGAIN == 0:
            click.echo(_row(["time", *(name for name, _, _, _ in COLUMNS), "queue"]))
            click.echo(_row(["s", *(unit for _, unit, _, _ in COLUMNS), ""]))
        self.printed += 1
        waiting = self.device.queued
        click.echo(_row([_number(at, ".1f"), *(text(reading) for _, _, _, text in COLUMNS), "-" if waiting is None else str(waiting)]))
        sys.stdout.flush()

    def summary(self, reading: Reading) -> None:
        """The figures of everything."""
        if self.as_json:
            self._emit({"kind": "summary", **self._figures(reading), "stats": self.device.stats.to_dict()})
            return
        lasted = f" in {reading.seconds:.1f} s" if reading.seconds else ""
        click.echo(f"\n{self.device.sensor.id}: {reading.packets} packets, {reading.scans} whole scans{lasted}; {self.device.stats}")
        for name, unit, _, text in FIGURES:
            if text(reading) != "-":
                click.echo(f"  {name:<8} {text(reading):>10} {unit}")

    def _figures(self, reading: Reading) -> dict[str, Any]:
        return {"sensor": self.device.sensor.id, **reading.to_dict(), "queue": self.device.queued, "state": self.device.state}

    def _emit(self, value: dict[str, Any]) -> None:
        click.echo(json.dumps(value, allow_nan=False))
        sys.stdout.flush()


@click.command()
@click.argument("source", metavar="SOURCE")
@sensor_option
@click.option("-n", "--count", type=click.IntRange(min=1), help="Lines at most.")
@click.option("-t", "--duration", type=Duration(), help="How long, such as 10s; without it until the input ends.")
@click.option("--interval", type=Duration(), default="1s", show_default=True, help="From line to line.")
@click.option("--max-errors", type=Share(), help="Exit code 1 where more of the frames are wrong or lost, such as 1%.")
@click.option("--json", "as_json", is_flag=True, help="Print a JSON object on each line.")
def stats(
    source: str, sensor_id: str | None, count: int | None, duration: float | None, interval: float, max_errors: float | None, as_json: bool
) -> None:
    """How a sensor is doing: speed, rates, errors, loss, jitter, queue.

    A line for each interval, and a summary at the end. Errors are frames whose checksum, length or values are wrong; loss counts
    what is missing by the sensor's own numbers. A file is read as fast as possible, in batches, and by the time of its packets:
    there an interval can be longer than asked for.
    """
    with open_device(source, sensor_id, period=LOOK) as device:
        lines = Lines(device, as_json)
        end = min(duration or math.inf, interval * count if count else math.inf)
        run = _Live(device, lines, interval, end, Patience(device, source)) if device.is_live else _File(device, lines, interval, end)
        try:
            run.run()
        except KeyboardInterrupt:
            lines.summary(run.summary())
            raise
        found = run.summary()
        if found.packets == 0:
            raise nothing_came(device, source, found.seconds)
        for warning in device.warnings:
            note(warning)
        lines.summary(found)
        worst = max(found.error_rate, found.loss_rate or 0.0)
        if max_errors is not None and worst > max_errors:
            note(f"{worst:.3%} of the frames are wrong or lost, more than {max_errors:.3%}")
            click.get_current_context().exit(FINDINGS)


class _Live:
    """A line for each interval of the clock."""

    def __init__(self, device: Device, lines: Lines, interval: float, end: float, patience: Patience) -> None:
        self._device, self._lines, self._interval, self._end, self._patience = device, lines, interval, end, patience
        self._feed = Feed(device)
        self._start = time.monotonic()

    def run(self) -> None:
        """Print until the end."""
        edge = last = self._start
        end = self._start + self._end
        while edge < end and not self._feed.ended:
            edge = min(edge + self._interval, end)
            self._feed.pump(edge)
            self._patience.check()
            now = time.monotonic()
            self._lines.interval(round(now - self._start, 3), self._feed.meter.reading(self._device.stats, now - last))
            last = now

    def summary(self) -> Reading:
        """The figures of everything."""
        return self._feed.meter.summary(self._device.stats, time.monotonic() - self._start)


class _File:
    """A line for each interval of the packets' own time, where they have one; as long as a batch at least."""

    def __init__(self, device: Device, lines: Lines, interval: float, end: float) -> None:
        self._device, self._lines, self._interval, self._end = device, lines, interval, end
        self._feed = Feed(device, each=self._count)
        self._start: int | None = None
        self._edges = 0
        self._enough = False

    def run(self) -> None:
        """Print until the end."""
        while not (self._feed.ended or self._enough):
            self._feed.pump(0.0)

    def summary(self) -> Reading:
        """The figures of everything."""
        return self._feed.meter.summary(self._device.stats)

    def _count(self, packets: Packets) -> None:
        times = packets.host_ns if packets.host_ns.any() else packets.time_ns
        self._start = int(times[0]) if self._start is None else self._start
        passed = (int(times[-1]) - self._start) * 1e-9
        if passed >= (self._edges + 1) * self._interval:
            self._edges = int(passed / self._interval)
            self._lines.interval(round(passed, 3), self._feed.meter.reading(self._device.stats))
        self._enough = passed >= self._end


def _row(texts: list[str]) -> str:
    widths = [6, *(width for _, _, width, _ in COLUMNS), 6]
    return " ".join(text.rjust(width) for text, width in zip(texts, widths, strict=True)).rstrip()


def _number(value: float | None, form: str) -> str:
    return "-" if value is None or not math.isfinite(value) else format(value, form)


def _hundredfold(value: float | None) -> float | None:
    return None if value is None else 100 * value
