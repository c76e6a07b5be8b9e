"""`view`: draw a live sensor in the terminal, on a web page, or in Rerun's viewer."""

from __future__ import annotations

import math
import shutil
import sys
import time
import webbrowser
from collections.abc import Sequence
from pathlib import Path

import click

from lidarspec.cli.inputs import (
    FIRST_FRAME_TIMEOUT_S,
    make_no_scan_error,
    refuse_overwriting,
    report_outcome,
    require_points,
)
from lidarspec.cli.options import DURATION, colour_option, selection_options, sensor_option
from lidarspec.cli.output import render
from lidarspec.cli.terminal import handle_sigterm, note, say
from lidarspec.device.device import Device, open as open_device
from lidarspec.errors import UsageError
from lidarspec.points.appearance import choose_appearance
from lidarspec.recording.recorder_switch import RecordingSwitch
from lidarspec.scans.selection import Selection
from lidarspec.sensor_operations import Sensor
from lidarspec.transports.open_url import is_live
from lidarspec.transports.protocol import Origin
from lidarspec.view.canvas import CellGrid
from lidarspec.view.live_scans import LOOK_S, LiveScans
from lidarspec.view.page_server import PageServer, open_page_server
from lidarspec.view.polar import draw_cloud
from lidarspec.view.terminal_screen import (
    Screen,
    TerminatedError,
    is_interactive,
    keyboard,
    supports_braille,
)
from lidarspec.view.terminal_window import Window


@click.command()
@click.argument("source", metavar="SOURCE")
@sensor_option
@click.option(
    "-t",
    "--duration",
    type=DURATION,
    help="Stop after this time, such as 30s; with --once: timeout for the first scan.",
)
@click.option(
    "--once",
    is_flag=True,
    help="Print one picture and exit; this is the default if output is not a terminal.",
)
@selection_options("times", "scans", "every", "ranges", "returns", "time")
@colour_option
@click.option(
    "--web",
    is_flag=True,
    help="Serve a page with the scans, and print its link for the browser.",
)
@click.option("--open", "opens", is_flag=True, help="Open the page in the browser.")
@click.option(
    "--address",
    metavar="HOST[:PORT]",
    help="Address of the page; default: 127.0.0.1 and a free port.",
)
@click.option(
    "--control",
    is_flag=True,
    help="Allow the page to send commands; always allowed for simulated sensors.",
)
@click.option(
    "--rerun",
    "in_rerun",
    is_flag=True,
    help="Show the scans in Rerun's 3D viewer instead of the terminal.",
)
@click.option(
    "-o",
    "--output",
    metavar="FILE.rrd|URL",
    help="With --rerun: write to this file, or send to a running viewer"
    " (rerun+http://HOST:9876/proxy).",
)
def view(
    source: str,
    sensor_id: str | Sensor | None,
    duration: float | None,
    once: bool,
    selection: Selection,
    ramp: str,
    web: bool,
    opens: bool,
    address: str | None,
    control: bool,
    in_rerun: bool,
    output: str | None,
) -> None:
    """Draw a live sensor in the terminal, or with --web in the browser.

    The points are drawn from above, and also from the side if they are not in one plane. A file is
    played in real time, by its recorded times. If standard output is not a terminal, one picture is
    printed.

    Keys: space pauses, r records, c switches colours, + - zoom, arrows move, 0 shows all points, ?
    lists the keys, q quits.

    With --rerun, a file is read as fast as possible, and played in Rerun's viewer. This requires
    lidarspec[rerun].
    """
    if once + web + in_rerun > 1:
        raise UsageError("--once, --web and --rerun cannot be combined")
    if (opens or address is not None or control) and not web:
        raise UsageError("--open, --address and --control require --web")
    if output is not None and not in_rerun:
        raise UsageError("-o requires --rerun: use lidarspec plot to write a picture to a file")
    if web:
        _serve(
            source, sensor_id, duration, selection, opens=opens, address=address, control=control
        )
        return
    if in_rerun:
        _show_in_rerun(source, sensor_id, output or "", ramp, duration, selection)
        return
    if once or not is_interactive():
        with open_device(source, sensor_id) as device:
            require_points(device, source)
            say(
                _draw_once(device, source, ramp, duration or FIRST_FRAME_TIMEOUT_S, selection),
                colour=True,
            )
            report_outcome(device)
        return
    if is_live(source):
        switch = RecordingSwitch(source, Path.cwd())
    else:
        switch = None
    with open_device(
        source, sensor_id, record=switch.attach if switch else None, period=LOOK_S
    ) as device:
        require_points(device, source)
        if switch is not None:
            switch.sensor_id = device.sensor.id
        _run_window(
            device,
            Window(
                LiveScans(device, played=True, select=selection),
                source,
                ramp=ramp,
                record=switch,
                duration=duration,
            ),
            stdin_is_data=source == "-",
        )
        report_outcome(device)
    if switch is not None:
        _report_recordings(switch.written, switch.trouble)


def _report_recordings(recordings: Sequence[tuple[str, int]], trouble: str) -> None:
    for path, size in recordings:
        note(f"recorded {size} bytes; next: lidarspec view {Path(path).name}")
    if trouble:
        note(trouble)


def _serve(
    source: str,
    sensor_id: str | Sensor | None,
    duration: float | None,
    selection: Selection,
    *,
    opens: bool,
    address: str | None,
    control: bool,
) -> None:
    """Serve the page until the duration is over or the user interrupts it."""
    host, port = parse_address(address)
    server = open_page_server(
        source,
        sensor_id,
        selection=selection,
        host=host,
        port=port,
        control=control,
        report=note,
    )
    try:
        with handle_sigterm(), server:
            say(server.link)
            if opens and not _open_in_browser(server):
                note("no browser found: open the link in a browser")
            server.run(duration)
            report_outcome(server.device)
    finally:
        _report_recordings(server.recordings, server.trouble)


def _open_in_browser(server: PageServer) -> bool:
    """Open the page in the browser, and return whether a browser was found."""
    try:
        return webbrowser.open(server.opening_page())
    except OSError:
        return False


def parse_address(address: str | None) -> tuple[str, int]:
    """Return the host and the port of the page; port 0 means any free port.

    Raises:
        UsageError: if the port is not a number.
    """
    try:
        origin = Origin.parse(address or "127.0.0.1")
    except UsageError:
        raise UsageError(f"--address {address}: expected HOST or HOST:PORT") from None
    return origin.host, origin.port or 0


def _show_in_rerun(
    source: str,
    sensor_id: str | Sensor | None,
    target: str,
    ramp: str,
    duration: float | None,
    selection: Selection,
) -> None:
    """Show scans in Rerun's viewer, or write a file for it."""
    from lidarspec.formats.rerun import RERUN  # imports all formats, which takes a moment
    from lidarspec.view.rerun import SCHEMES, show

    if target and not target.startswith(SCHEMES):
        if not target.lower().endswith(RERUN.suffix):
            raise UsageError(f"{target}: the file for Rerun needs the suffix {RERUN.suffix}")
        refuse_overwriting([target], source, sensor_id)
    with open_device(source, sensor_id, period=LOOK_S) as device:
        require_points(device, source)
        feed = LiveScans(device, select=selection)
        show(feed, target, ramp=ramp, until=time.monotonic() + (duration or math.inf))
        if feed.scan is None:
            raise make_no_scan_error(device, source, duration)
        note(f"{target or 'shown'}: {feed.number} scans of {device.sensor.id}")
        report_outcome(device)


def _run_window(device: Device, window: Window, *, stdin_is_data: bool) -> None:
    """Run the window until the user closes the window or the terminal.

    Args:
        stdin_is_data: whether standard input is the source, so that keys cannot be read from it.
    """
    try:
        with Screen(sys.stdout, keyboard(stdin_is_data=stdin_is_data)) as screen:
            window.run(screen)
    except TerminatedError as end:
        click.get_current_context().exit(end.code)
    except EOFError:
        device.close()


def _draw_once(
    device: Device, source: str, ramp: str, patience: float, selection: Selection
) -> str:
    """Return a picture of the first complete scan, and a line about it."""
    feed = LiveScans(device, select=selection)
    end = time.monotonic() + patience
    while (
        not feed.ended
        and time.monotonic() < end
        and not (feed.scan is not None and feed.scan.whole)
    ):
        feed.read(0.0)
    if feed.scan is None:
        raise make_no_scan_error(device, source, patience)
    columns, lines = shutil.get_terminal_size((80, 24))
    chosen = choose_appearance(feed.scan.points, ramp=ramp)
    cells: CellGrid = draw_cloud(
        feed.scan.points, width=columns, height=max(lines - 2, 4), look=chosen
    )
    if not supports_braille(sys.stdout):
        cells = cells.ascii()
    colours = f"{chosen.ramp} {' to '.join(chosen.ends)}"
    return f"{render(cells.text())}\n{device.sensor.id}: {feed.scan}; colours: {colours}"
