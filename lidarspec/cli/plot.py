"""`plot`: a scan as a picture in a file."""

from __future__ import annotations

from pathlib import Path

import click

from lidarspec.cli.output import emit, note, sensor_option
from lidarspec.cli.streams import nothing_came, scans_of
from lidarspec.device import open as open_device
from lidarspec.errors import UsageError
from lidarspec.scans import Scan
from lidarspec.view.polar import look
from lidarspec.view.svg import svg


@click.command()
@click.argument("source", metavar="IN")
@click.option("-o", "--output", metavar="FILE.svg", required=True, help="Where to; - is standard output.")
@sensor_option
@click.option("-n", "--number", type=click.IntRange(min=1), default=1, show_default=True, help="Which of the whole scans.")
@click.option("--colour", "ramp", type=click.Choice(["range", "intensity"]), default="range", show_default=True, help="What colours show.")
@click.option("--max-range", type=click.FloatRange(min=0, min_open=True), metavar="METRES", help="From the middle to the edge.")
def plot(source: str, output: str, sensor_id: str | None, number: int, ramp: str, max_range: float | None) -> None:
    """A scan as an SVG picture.

    From above, and from the side where the points are not in one plane.
    """
    if output != "-" and Path(output).suffix.lower() != ".svg":
        raise UsageError(f"{output}: pictures are written as .svg; browsers show them, Inkscape and rsvg-convert turn them into others")
    with open_device(source, sensor_id) as device:
        chosen: Scan | None = None
        whole = 0
        for scan in scans_of(device, source):
            whole += scan.complete
            chosen = scan if scan.complete or chosen is None or not chosen.complete else chosen
            if whole == number:
                break
        if chosen is None:
            raise nothing_came(device, source)
        if whole < number:
            note(f"{source} has {whole} whole scan{'s' * (whole != 1)}; drawn is the last piece of it that could be")
        title = f"{device.sensor.id}: {chosen}"
        emit(svg(chosen.points, look(chosen.points, ramp=ramp, reach=max_range), title), output)
