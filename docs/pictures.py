"""Make the pictures of the front page and the README from simulated sensors.

    python docs/pictures.py [--into FOLDER]
        a terminal, a point cloud and a packet diagram, as SVG
    python docs/pictures.py --page [--into FOLDER]
        the page in the browser, as PNG; requires Chromium

`make docs` runs both commands. The SVG files are the same each time, and
tests/docs/test_pictures.py fails if they are out of date. The bytes of the PNG depend on the
installed fonts, so it goes only into the site. For the README, make the PNG by hand when the page
has changed.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from screens import svg as drawn

import lidarspec as ls
from lidarspec.exports import select_frame
from lidarspec.exports.diagram import svg as diagram
from lidarspec.points.appearance import choose_appearance, fit_to_points
from lidarspec.simulation.simulator import simulate
from lidarspec.view.live_scans import LiveScans
from lidarspec.view.svg import svg
from lidarspec.view.terminal_window import FIGURES_PERIOD_S, Window

HERE = Path(__file__).parent / "pictures"
#: the size of the page, pixels.
SIZE = (1280, 800)
SCHEME = "dark"
#: how long the page runs before the screenshot, milliseconds.
RUN_MS = 10_800
#: the number of colours of the PNG.
COLOURS = 256
#: options of Chromium: it draws in software.
FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def write_simulated_file(sensor: str, file: Path, duration: str) -> Path:
    """Write the data of a simulated sensor to a file; return its path."""
    words = ["sim", sensor, "--to", str(file), "-t", duration, "--seed", "7", "-q"]
    subprocess.run(
        [sys.executable, "-m", "lidarspec", *words], check=True, stdout=subprocess.DEVNULL
    )
    return file


def terminal(folder: Path) -> str:
    """Return the window of `view`, some seconds into a file."""
    with ls.open(
        write_simulated_file("ldrobot-stl27l", folder / "room.pcap", "5s"), "ldrobot-stl27l"
    ) as device:
        feed = LiveScans(device)
        window = Window(feed, "/dev/ttyUSB0")
        feed.read(0.0)
        time.sleep(FIGURES_PERIOD_S)  # then the window reads its figures
        return drawn(window.cells(92, 28))


def cloud() -> str:
    """Return a scan of a spinning lidar."""
    sensor = ls.sensor("ouster-os1")
    scan = next(scan for scan in sensor.scans(simulate(sensor, 600)) if scan.complete)
    return svg(
        scan.points,
        fit_to_points(scan.points, choose_appearance(scan.points)),
        f"{sensor.id}: {len(scan):,} points",
        side=520,
        max_dots=9000,
    )


def packet() -> str:
    """Return the packet diagram of a sensor."""
    return diagram(select_frame(ls.sensor("ldrobot-stl27l"), "data"))


def write_page(folder: Path, target: Path) -> None:
    """Write a screenshot of the page while it plays a file, as PNG with few colours.

    Args:
        folder: folder for the file that is played.
        target: the PNG.
    """
    from PIL import Image
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium")
    if chromium is None:
        print("the picture of the page stays as it was: Chromium is not installed", file=sys.stderr)
        return
    file = write_simulated_file("robosense-m1", folder / "room.lsr", "15s")
    command = [
        sys.executable,
        "-m",
        "lidarspec",
        "view",
        file.name,
        "-s",
        "robosense-m1",
        "--web",
        "-q",
    ]
    with (
        subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True) as serving,
        sync_playwright() as running,
    ):
        assert serving.stdout is not None
        browser = running.chromium.launch(executable_path=chromium, args=FLAGS)
        try:
            seen = browser.new_page(
                viewport={"width": SIZE[0], "height": SIZE[1]}, color_scheme=SCHEME
            )
            seen.goto(serving.stdout.readline().strip())
            seen.wait_for_timeout(RUN_MS)
            seen.screenshot(path=target)
        finally:
            browser.close()
            serving.terminate()
    Image.open(target).convert("RGB").quantize(
        COLOURS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE
    ).save(target, optimize=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Makes the pictures of the front page and the README."
    )
    parser.add_argument("--into", type=Path, default=HERE, metavar="FOLDER")
    parser.add_argument(
        "--page", action="store_true", help="the page in the browser, and nothing else"
    )
    given = parser.parse_args()
    given.into.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        if given.page:
            write_page(Path(folder), given.into / "page.png")
            return
        pictures = {"terminal": terminal(Path(folder)), "cloud": cloud(), "packet": packet()}
    for name, text in pictures.items():
        (given.into / f"{name}.svg").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
