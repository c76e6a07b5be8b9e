"""`read` and `stats`: print points or packets, or statistics at regular intervals."""

from __future__ import annotations

import itertools
import json
import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import click
import numpy as np

from lidarspec.cli.failures import FINDINGS
from lidarspec.cli.inputs import (
    FirstFrameTimeout,
    iter_device_scans,
    make_no_scan_error,
    report_outcome,
    require_points,
)
from lidarspec.cli.options import (
    DURATION,
    SHARE,
    count_option,
    points_option,
    selection_options,
    sensor_option,
)
from lidarspec.cli.terminal import note, say
from lidarspec.device.device import Device, open as open_device
from lidarspec.errors import UnknownFrame, UsageError, escape_controls
from lidarspec.explaining.clock_text import describe_clock
from lidarspec.packets.clock_monitor import ClockReport
from lidarspec.points.conventions import UNITS
from lidarspec.scans.scan import Scan
from lidarspec.scans.selection import PacketTimes, Selection, TimeSlice
from lidarspec.sensor_operations import Sensor
from lidarspec.view.live_frames import LiveFrames, open_live
from lidarspec.view.live_scans import LOOK_S, LiveScans
from lidarspec.view.rate_meter import MeterReading, format_number

#: Column of points -> (width in characters, number of decimals).
POINT_FORMATS = {
    **dict.fromkeys(("x", "y", "z", "range"), (9, 3)),
    **dict.fromkeys(("azimuth", "elevation"), (9, 4)),
    **{
        "intensity": (9, 0),
        "time": (10, 6),
        "ring": (5, 0),
        "return_index": (12, 0),
        "column": (6, 0),
    },
}
#: Number of significant digits of a packet's field. The next constants are the number of
#: significant digits of a further float32 column, and the minimum width of a column in characters.
FIELD_DIGITS = 10
FLOAT32_DIGITS = 7
MIN_COLUMN_WIDTH = 8
#: Significant digits of a float64 in JSON.
JSON_DIGITS = 14

Row = dict[str, Any]
Units = Mapping[str, str]
#: Number of rows after which the column names are repeated.
ROWS_PER_HEADER = 20
#: Tolerance for sums of intervals, in seconds.
TOLERANCE_S = 1e-6


@click.command()
@click.argument("source", metavar="SOURCE")
@sensor_option
@click.option(
    "--packets",
    "whole",
    is_flag=True,
    help="Print one row per packet instead of one per point.",
)
@click.option("-f", "--frame", metavar="NAME", help="Print the packets of this frame type.")
@count_option("rows")
@click.option("-t", "--duration", type=DURATION, help="Stop after this time, such as 10s.")
@selection_options("times", "scans", "every", "ranges", "returns", "columns", "time")
@points_option
@click.option("--json", "as_json", is_flag=True, help="Print a JSON object on each line.")
def read(
    source: str,
    sensor_id: str | Sensor | None,
    whole: bool,
    frame: str | None,
    count: int | None,
    duration: float | None,
    selection: Selection,
    every_point: bool,
    as_json: bool,
) -> None:
    """Print the points or the packets of a sensor, one per row.

    Points are printed when their scan is complete, with the columns of a PointCloud and the number
    of the scan. Units are metres, radians, and seconds since the scan's stamp. Packets are printed
    with their offset in the input, their time, and the physical values of their fields. Arrays are
    printed only with --json. Packets can be selected only by --slice and --time.
    """
    with open_device(source, sensor_id) as device:
        if frame is not None and frame not in device.sensor.frames:
            raise UnknownFrame(frame, device.sensor.frames, place=device.sensor.id)
        until = time.monotonic() + duration if duration else math.inf
        if frame is None:
            require_points(device, source)
        if whole or frame:
            rows = _iter_packets(
                device, frame, until, FirstFrameTimeout(device, source, frame), selection
            )
        else:
            rows = _iter_points(
                iter_device_scans(device, source, selection, until=until), every_point=every_point
            )
        printed = 0
        for line in _iter_lines(itertools.islice(rows, count), as_json=as_json):
            say(line)
            printed += 1
        if not printed and not device.stats.frames:
            raise make_no_scan_error(device, source, duration)
        report_outcome(device)


def _iter_lines(rows: Iterable[tuple[Units, Row]], *, as_json: bool) -> Iterator[str]:
    """Yield each row as JSON, or as aligned columns below names and units."""
    widths: list[int] = []
    for units, row in rows:
        if as_json:
            yield json.dumps(
                {name: _to_json(value) for name, value in row.items()}, allow_nan=False
            )
            continue
        shown = {name: value for name, value in row.items() if not isinstance(value, np.ndarray)}
        if not widths:
            headers = [f"{name} [{units[name]}]" if units.get(name) else name for name in shown]
            widths = [
                max(len(header), _find_width(name))
                for header, name in zip(headers, shown, strict=True)
            ]
            yield _format_row(headers, widths)
        yield _format_row([_format_value(name, value) for name, value in shown.items()], widths)


def _iter_points(scans: Iterable[Scan], *, every_point: bool) -> Iterator[tuple[Units, Row]]:
    """Yield (units, row) for each point."""
    units: Units = UNITS
    for number, scan in enumerate(scans):
        if every_point:
            cloud = scan.points
        else:
            cloud = scan.points[scan.points.valid]
        columns = dict(cloud.columns)
        units = {**units, **cloud.units}
        for values in zip(*columns.values(), strict=True):
            yield units, {"scan": number, **dict(zip(columns, values, strict=True))}


def _iter_packets(
    device: Device,
    frame: str | None,
    until: float,
    patience: FirstFrameTimeout,
    selection: Selection,
) -> Iterator[tuple[Units, Row]]:
    """Yield (units, row) for each packet; the row has the fields in their units."""
    if replace(selection, times=(None, None), time="sensor") != Selection():
        raise UsageError("packets can be selected only by --slice and --time")
    wanted = TimeSlice(selection.times)
    clock = PacketTimes(selection.time, device.source)
    number = 0
    for batch in device.packets(frame, wait=LOOK_S):
        patience.check()
        times = clock.read(batch)
        packets = batch.with_times(times).take(wanted.select_times(times))
        number += len(packets)
        fields = {
            path: info for path, info in packets.table.schema.fields.items() if info.const is None
        }
        units = {path: info.unit for path, info in fields.items()}
        texts = {
            path for path, info in packets.table.schema.columns.items() if info.kind == "other"
        }
        columns = {
            path: packets.table.raw(path) if path in texts else packets[path] for path in fields
        }
        for index in range(len(packets)):
            place = {"offset": int(packets.offset[index]), "time_ns": int(packets.time_ns[index])}
            yield (
                units,
                {**place, **{path: _to_scalar(column[index]) for path, column in columns.items()}},
            )
        if time.monotonic() >= until or wanted.ended:
            break
    for warning in clock.warnings:
        note(warning)
    if wanted.first is not None and not number:
        raise wanted.make_no_data_error(device.source)


def _to_scalar(value: Any) -> Any:
    """Convert a number to float; return an array, a text or None unchanged."""
    if np.ndim(value) or value is None or isinstance(value, str):
        return value
    return float(value)


def _find_width(name: str) -> int:
    if name in POINT_FORMATS:
        return POINT_FORMATS[name][0]
    if name.endswith("_ns"):
        return 20
    return MIN_COLUMN_WIDTH


def _format_value(name: str, value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, str):
        return escape_controls(value)
    if isinstance(value, int | np.bool_):
        return str(int(value))
    if not math.isfinite(value):
        if math.isnan(value):
            return "-"
        return "inf"
    digits = FLOAT32_DIGITS if isinstance(value, np.float32) else FIELD_DIGITS
    if name in POINT_FORMATS:
        return f"{value:.{POINT_FORMATS[name][1]}f}"
    return f"{value:.{digits}g}"


def _format_row(cells: Sequence[str], widths: Sequence[int]) -> str:
    return " ".join(cell.rjust(width) for cell, width in zip(cells, widths, strict=True)).rstrip()


def _to_json(value: Any) -> Any:
    """Return a value for JSON: None for nan and infinity, whole floats as integers."""
    if isinstance(value, np.ndarray):
        return [_to_json(item) for item in value]
    if isinstance(value, np.generic):
        number = value.item()
    else:
        number = value
    single = isinstance(value, np.float32)
    if isinstance(number, float):
        if not math.isfinite(number):
            return None
        # A float32 is printed with the digits that identify it. A float64 is rounded, because
        # decimal scales cause errors in its last digits.
        if number.is_integer() and abs(number) < 2**53:
            return int(number)
        return float(str(value) if single else f"{number:.{JSON_DIGITS}g}")
    return number


#: (name, unit, width of the column, function that formats it) of each measured value. A value with
#: the width 0 is printed only in the summary.
FIGURES: tuple[tuple[str, str, int, Callable[[MeterReading], str]], ...] = (
    ("speed", "Hz", 6, lambda r: format_number(r.speed_hz, "{:.2f}")),
    ("packets", "/s", 8, lambda r: format_number(r.packet_rate_hz, "{:.1f}")),
    ("points", "/scan", 7, lambda r: format_number(r.points, "{:.0f}")),
    ("valid", "/scan", 7, lambda r: format_number(r.valid, "{:.0f}")),
    ("errors", "%", 7, lambda r: format_number(r.error_rate, "{:.3f}", 100)),
    ("skipped", "%", 7, lambda r: format_number(r.skipped_rate, "{:.3f}", 100)),
    ("loss", "%", 7, lambda r: format_number(r.loss_rate, "{:.3f}", 100)),
    ("jitter", "ms", 8, lambda r: format_number(r.jitter_s, "{:.3f}", 1e3)),
    ("gap", "ms", 0, lambda r: format_number(r.longest_gap_s, "{:.2f}", 1e3)),
    ("input", "kB/s", 0, lambda r: format_number(r.bytes_per_s, "{:.1f}", 1e-3)),
)
COLUMNS = [figure for figure in FIGURES if figure[2]]
#: Widths of the columns of `stats`: the time, the measured values, and the queue.
WIDTHS = [6, *(width for _, _, width, _ in COLUMNS), 6]


@dataclass
class StatsPrinter:
    """Prints the statistics of each interval as a row or a JSON object."""

    device: Device
    as_json: bool
    printed: int = 0

    def print_interval(self, at: float | None, reading: MeterReading) -> None:
        """Print the values of an interval that ended `at` seconds after the start."""
        if self.as_json:
            self._emit({"kind": "interval", "at_s": at, **self._collect_figures(reading)})
            return
        if self.printed % ROWS_PER_HEADER == 0:
            say(_format_row(["time", *(name for name, _, _, _ in COLUMNS), "queue"], WIDTHS))
            say(_format_row(["s", *(unit for _, unit, _, _ in COLUMNS), ""], WIDTHS))
        self.printed += 1
        figures = [text(reading) for _, _, _, text in COLUMNS]
        say(
            _format_row(
                [format_number(at, "{:.1f}"), *figures, format_number(self.device.queued, "{}")],
                WIDTHS,
            )
        )
        sys.stdout.flush()

    def print_summary(self, reading: MeterReading, clock: ClockReport) -> None:
        """Print the totals and the rates of the whole input."""
        if self.as_json:
            self._emit(
                {
                    "kind": "summary",
                    **self._collect_figures(reading),
                    "clock": clock.to_dict(),
                    "stats": self.device.stats.to_dict(),
                    "info": self.device.info,
                }
            )
            return
        if reading.seconds:
            lasted = f" in {reading.seconds:.1f} s"
        else:
            lasted = ""
        if self.device.sensor.has_points:
            counted = f"{reading.packets} packets, {reading.scans} complete scans"
        else:
            counted = f"{reading.packets} frames"
        say(f"\n{self.device.sensor.id}: {counted}{lasted}; {self.device.stats}")
        for name, unit, _, text in FIGURES:
            if text(reading) != "-":
                say(f"  {name:<8} {text(reading):>10} {unit}")
        if self.device.sensor.clock is not None:
            say(f"  clock    {describe_clock(clock)}")
        for fact, value in self.device.info.items():
            say(f"  {fact}: {escape_controls(value)}")

    def _collect_figures(self, reading: MeterReading) -> dict[str, Any]:
        facts = {"source": str(self.device.source), "sensor": self.device.sensor.id}
        return {
            **facts,
            **reading.to_dict(),
            "queue": self.device.queued,
            "state": self.device.state,
        }

    def _emit(self, value: dict[str, Any]) -> None:
        say(json.dumps(value, allow_nan=False))
        sys.stdout.flush()


@click.command()
@click.argument("sources", metavar="SOURCE...", nargs=-1, required=True)
@sensor_option
@count_option("lines")
@selection_options("times", "scans", "every", "ranges", "returns", "time")
@click.option(
    "-t",
    "--duration",
    type=DURATION,
    help="Stop after this time, such as 10s; default: at the end of the input.",
)
@click.option(
    "--interval", type=DURATION, default="1s", show_default=True, help="Time between lines."
)
@click.option(
    "--max-errors",
    type=SHARE,
    help="Exit with code 1 if more than this share of the frames is invalid or lost, such as 1%.",
)
@click.option("--json", "as_json", is_flag=True, help="Print a JSON object on each line.")
def stats(
    sources: Sequence[str],
    sensor_id: str | Sensor | None,
    count: int | None,
    selection: Selection,
    duration: float | None,
    interval: float,
    max_errors: float | None,
    as_json: bool,
) -> None:
    """Print scan rate, packet rate, errors, loss, jitter and queue of a sensor.

    A line is printed for each interval, and a summary at the end. The column "speed" contains the
    scan rate. Jitter is the standard deviation of the time from one packet to the next. Queue is
    the number of reads or datagrams that wait to be decoded. Errors are frames with a wrong
    checksum, length or value. Loss is the share of missing packets, computed from the packet
    counter or the clock of the sensor. A file is read as fast as possible, in batches. Its
    intervals are measured by packet time, and can be longer than requested. Several sources are
    read one after another.
    """
    lasting = min(duration or math.inf, interval * count if count else math.inf)
    has_findings = False
    for source in sources:
        if len(sources) > 1 and not as_json:
            say(f"{source}:")
        with open_device(source, sensor_id, period=LOOK_S) as device:
            reading = _print_stats(
                source,
                open_live(device, selection),
                StatsPrinter(device, as_json),
                interval,
                lasting,
            )
            worst = max(reading.error_rate, reading.loss_rate or 0.0)
            if max_errors is not None and worst > max_errors:
                note(
                    f"{worst:.3%} of the frames are invalid or lost;"
                    f" --max-errors allows {max_errors:.3%}"
                )
                has_findings = True
            try:
                report_outcome(device)
            except click.exceptions.Exit:  # damage; the remaining sources are still read
                has_findings = True
    if has_findings:
        raise click.exceptions.Exit(FINDINGS)


def _print_stats(
    source: str, feed: LiveScans | LiveFrames, lines: StatsPrinter, interval: float, lasting: float
) -> MeterReading:
    """Print the lines and the summary of one source, and return the summary."""
    start = time.monotonic()
    try:
        if feed.device.is_live:
            _print_by_clock(
                feed, lines, interval, start, lasting, FirstFrameTimeout(feed.device, source)
            )
        else:
            _print_by_packet_time(feed, lines, interval, lasting)
    except KeyboardInterrupt:
        lines.print_summary(_measure_input(feed, start), feed.clock.report())
        raise
    reading = _measure_input(feed, start)
    if reading.packets == 0:
        raise make_no_scan_error(feed.device, source, reading.seconds)
    lines.print_summary(reading, feed.clock.report())
    return reading


def _measure_input(feed: LiveScans | LiveFrames, start: float) -> MeterReading:
    """Return the measured values of the whole input."""
    return feed.meter.summary(
        feed.device.stats, time.monotonic() - start if feed.device.is_live else None
    )


def _print_by_clock(
    feed: LiveScans | LiveFrames,
    lines: StatsPrinter,
    interval: float,
    start: float,
    lasting: float,
    patience: FirstFrameTimeout,
) -> None:
    """Print a line for each interval, measured by the clock of this computer."""
    edge = last = start
    end = start + lasting
    while end - edge > TOLERANCE_S and not feed.ended:
        edge = min(edge + interval, end)
        feed.read(edge)
        patience.check()
        now = time.monotonic()
        lines.print_interval(
            round(now - start, 3), feed.meter.take_reading(feed.device.stats, now - last)
        )
        last = now


def _print_by_packet_time(
    feed: LiveScans | LiveFrames, lines: StatsPrinter, interval: float, lasting: float
) -> None:
    """Print a line for each interval, measured by the times of the packets."""
    start: int | None = None
    edges = 0
    passed = 0.0
    while not feed.ended and passed < lasting:
        feed.read(0.0)
        times = feed.times_ns
        if not len(times):
            continue
        start = int(times[0]) if start is None else start
        passed = (int(times[-1]) - start) * 1e-9
        if passed >= (edges + 1) * interval:
            edges = int(passed / interval)
            lines.print_interval(round(passed, 3), feed.meter.take_reading(feed.device.stats))
