"""`plot`: draw a scan, or statistics over time."""

from __future__ import annotations

import io
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from lidarspec.cli.inputs import (
    FIRST_FRAME_TIMEOUT_S,
    iter_device_scans,
    make_no_scan_error,
    refuse_overwriting,
    report_outcome,
    require_points,
)
from lidarspec.cli.options import DURATION, colour_option, selection_options, sensor_option
from lidarspec.cli.output import emit
from lidarspec.cli.terminal import note
from lidarspec.device.device import Device, open as open_device
from lidarspec.errors import UsageError
from lidarspec.formats.common import replace_file
from lidarspec.points.appearance import choose_appearance, fit_to_points
from lidarspec.scans.scan import Scan
from lidarspec.scans.selection import Selection
from lidarspec.sensor_operations import Sensor
from lidarspec.view import matplotlib_figures
from lidarspec.view.live_scans import LiveScans
from lidarspec.view.svg import svg


@click.command()
@click.argument("source", metavar="IN")
@click.option(
    "-o",
    "--output",
    metavar="FILE",
    required=True,
    help="Output file: .svg, .png or .pdf; - is standard output, as SVG.",
)
@sensor_option
@click.option(
    "--kind",
    type=click.Choice(["scan", "intensity", "ranges", "rates"]),
    default="scan",
    show_default=True,
    help="Kind of plot.",
)
@click.option(
    "--scan",
    "number",
    type=click.IntRange(min=1),
    metavar="NUMBER",
    default=1,
    show_default=True,
    help="Which complete scan to plot, counted from 1.",
)
@click.option(
    "-t",
    "--duration",
    type=DURATION,
    help="Time to read a live source.  [default: 10s; for a scan, until it is complete]",
)
@selection_options("times", "scans", "every", "ranges", "returns", "time")
@colour_option
@click.option(
    "--max-range",
    type=click.FloatRange(min=0, min_open=True),
    metavar="METRES",
    help="Range at the edge of the plot.",
)
def plot(
    source: str,
    output: str,
    sensor_id: str | Sensor | None,
    kind: str,
    number: int,
    duration: float | None,
    selection: Selection,
    ramp: str,
    max_range: float | None,
) -> None:
    """Draw a scan, a histogram of intensities, or ranges or rates over time.

    A scan is drawn to scale from above, and also from the side if the points are not in one plane.
    --kind intensity draws a histogram of the intensities. --kind ranges draws the number of returns
    at each range over time. --kind rates draws the packets and scans per second, with losses and
    errors. All plots except a scan in SVG require matplotlib: lidarspec[plot].
    """
    if output == "-":
        suffix = ".svg"
    else:
        suffix = Path(output).suffix.lower()
    if suffix not in matplotlib_figures.SUFFIXES:
        raise UsageError(
            f"{output}: expected a file name that ends in {', '.join(matplotlib_figures.SUFFIXES)}"
        )
    refuse_overwriting(output, source, sensor_id)
    with open_device(source, sensor_id) as device:
        require_points(device, source)
        if kind == "scan":
            scan = _find_scan(device, source, selection, number)
            report_outcome(device)  # before drawing, during which a live source continues
            title = f"{device.sensor.id}: {scan}"
            _draw_scan(scan, title, ramp, max_range, output, suffix)
        else:
            title = f"{kind} of {device.sensor.id}"
            default_duration = FIRST_FRAME_TIMEOUT_S if device.is_live else math.inf
            end_s = time.monotonic() + (duration or default_duration)
            _save(_draw_over_time(device, source, selection, kind, end_s), output, suffix)
        if output != "-":
            note(f"{output}: {title}")


def _draw_scan(
    scan: Scan, title: str, ramp: str, max_range: float | None, output: str, suffix: str
) -> None:
    view = choose_appearance(scan.points, ramp=ramp, reach=max_range)
    if max_range is None:
        view = fit_to_points(scan.points, view)
    if suffix == ".svg":
        emit(svg(scan.points, view, title), output)
    else:
        _save(matplotlib_figures.draw_scan(scan, view, title), output, suffix)


def _find_scan(device: Device, source: str, selection: Selection, number: int) -> Scan:
    """Return the complete scan with this number, counted from 1.

    If the source has fewer complete scans, the last scan is returned.
    """
    chosen: Scan | None = None
    whole_count = 0
    for scan in iter_device_scans(device, source, selection):
        if scan.whole:
            whole_count += 1
        if scan.whole or chosen is None or not chosen.whole:
            chosen = scan
        if whole_count == number:
            break
    if chosen is None:
        raise make_no_scan_error(device, source)
    if not whole_count:
        note(f"{source} has no complete scan, so an incomplete scan is drawn")
    elif whole_count < number:
        plural = "" if whole_count == 1 else "s"
        note(
            f"{source} has only {whole_count} complete scan{plural}, so scan {whole_count} is drawn"
        )
    return chosen


def _draw_over_time(
    device: Device, source: str, selection: Selection, kind: str, end_s: float
) -> Any:
    """Return a figure of the data that arrives until `end_s`, by `time.monotonic`."""
    title = f"{device.sensor.id}, {Path(source).name if device.progress else source}"
    if kind == "rates":
        rates = matplotlib_figures.RateSeries(LiveScans(device, select=selection), end_s)
        report_outcome(device)
        return matplotlib_figures.draw_rates(rates, title)
    scans = iter_device_scans(device, source, selection, until=end_s)
    first = next(scans, None)
    if first is None:
        raise make_no_scan_error(device, source)

    def iter_scans() -> Iterator[Scan]:
        yield first
        yield from scans
        report_outcome(device)

    if kind == "ranges":
        return matplotlib_figures.draw_ranges(iter_scans(), title)
    return matplotlib_figures.draw_intensities(iter_scans(), title)


def _save(figure: Any, output: str, suffix: str) -> None:
    if output == "-":
        text = io.BytesIO()
        matplotlib_figures.save(figure, text, suffix)
        emit(text.getvalue().decode(), output)
        return
    with replace_file(Path(output)) as part:
        matplotlib_figures.save(figure, part, suffix)
