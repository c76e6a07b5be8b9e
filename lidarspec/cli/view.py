"""`view`: a sensor at work, drawn in the terminal."""

from __future__ import annotations

import shutil
import sys
import time
from pathlib import Path

import click

from lidarspec.cli.inputs import PATIENCE, conclude, nothing_came
from lidarspec.cli.options import DURATION, colour_option, selecting, sensor_option
from lidarspec.cli.output import drawn
from lidarspec.cli.terminal import note, say
from lidarspec.device.device import Device, open as open_device
from lidarspec.scans.selection import Selection
from lidarspec.spec.sensor import Sensor
from lidarspec.transports.open_url import is_live
from lidarspec.view.canvas import Cells
from lidarspec.view.feed import LOOK, Feed
from lidarspec.view.live import Switch, Window
from lidarspec.view.polar import look, picture
from lidarspec.view.screen import Screen, Terminated, encodable, interactive, keyboard


@click.command()
@click.argument("source", metavar="SOURCE")
@sensor_option
@click.option("-t", "--duration", type=DURATION, help="How long at most, such as 30s; for a first picture 10s.")
@click.option("--once", is_flag=True, help="Print one picture and end, as where standard output is no terminal.")
@selecting("times", "scans", "every", "ranges", "time")
@colour_option
def view(source: str, sensor_id: str | Sensor | None, duration: float | None, once: bool, selection: Selection, ramp: str) -> None:
    """A sensor at work, drawn in the terminal.

    From above, and from the side where the points are not in one plane. A file is played at its own speed. One picture is printed
    where standard output is no terminal.

    Keys: space pauses, r records, c switches colours, + - zoom, arrows move, 0 shows all again, ? helps, q quits.
    """
    if once or not interactive():
        with open_device(source, sensor_id) as device:
            say(_printed(device, source, ramp, duration or PATIENCE, selection), colour=True)
            conclude(device)
        return
    switch = Switch(source, Path.cwd()) if is_live(source) else None
    with open_device(source, sensor_id, record=switch.attached if switch else None, period=LOOK) as device:
        if switch is not None:
            switch.sensor_id = device.sensor.id
        _show(
            device,
            Window(Feed(device, played=True, select=selection), source, ramp=ramp, record=switch, duration=duration),
            taken=source == "-",
        )
        conclude(device)
    for path, size in switch.written if switch else ():
        note(f"recorded {size} bytes; next: lidarspec view {Path(path).name}")


def _show(device: Device, window: Window, *, taken: bool) -> None:
    """The window, until it is closed or its terminal is.

    Args:
        taken: standard input is the data.
    """
    try:
        with Screen(sys.stdout, keyboard(taken=taken)) as screen:
            window.run(screen)
    except Terminated as end:
        click.get_current_context().exit(end.code)
    except EOFError:
        device.close()


def _printed(device: Device, source: str, ramp: str, patience: float, selection: Selection) -> str:
    """One picture of the first whole scan, and a line about it.

    Raises:
        WireError, CommandError: where none comes.
    """
    feed, end = Feed(device, select=selection), time.monotonic() + patience
    while not feed.ended and time.monotonic() < end and not (feed.scan is not None and feed.scan.whole):
        feed.pump(0.0)
    if feed.scan is None:
        raise nothing_came(device, source, patience)
    columns, lines = shutil.get_terminal_size((80, 24))
    chosen = look(feed.scan.points, ramp=ramp)
    cells: Cells = picture(feed.scan.points, width=columns, height=max(lines - 2, 4), look=chosen)
    if not encodable(sys.stdout):
        cells = cells.ascii()
    colours = f"{chosen.ramp} {' to '.join(chosen.ends)}"
    return f"{drawn(cells.text())}\n{device.sensor.id}: {feed.scan}; colours: {colours}"
