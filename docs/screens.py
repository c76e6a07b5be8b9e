"""Make the screens of the how-to pages from simulated sensors.

`view` is shown as SVG, the output of other verbs as text.
"""

from __future__ import annotations

import random
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

import lidarspec as ls
from lidarspec.simulation.faults import Faults
from lidarspec.spec import Crc
from lidarspec.testing.fixtures import virtual_port
from lidarspec.view.canvas import BLANK, INKS, CellGrid
from lidarspec.view.live_scans import LiveScans
from lidarspec.view.terminal_window import Window

HERE = Path(__file__).parent / "how-to" / "screens"
#: the size of a cell, of the margin, and of a dot, pixels.
CELL_WIDTH = 8
CELL_HEIGHT = 16
MARGIN = 12
DOT = 2.3
BACKGROUND = "#101218"
FOREGROUND = "#d8dae0"
#: The sensor's port in the pages' commands.
PORT = "/dev/ttyUSB0"


def draw_window(
    source: str,
    sensor: str,
    *,
    columns: int,
    lines: int,
    seconds: float,
    ramp: str = "range",
    called: str = "",
) -> CellGrid:
    """Return the window of `view` after some seconds."""
    with ls.open(source, sensor) as device:
        feed = LiveScans(device, played=True)
        window = Window(feed, called or source, ramp=ramp)
        end = time.monotonic() + seconds
        while time.monotonic() < end and not feed.ended:
            feed.read(time.monotonic() + 0.1)
            shown = window.cells(columns, lines)
        return shown


def svg(cells: CellGrid) -> str:
    """Return a screen as an SVG document.

    Braille is drawn dot by dot, because in few fonts it is as wide as letters.
    """
    columns, lines = cells.size
    width = columns * CELL_WIDTH + 2 * MARGIN
    height = lines * CELL_HEIGHT + 2 * MARGIN
    return "\n".join(
        [
            (
                f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}"'
                f' width="{width}" height="{height}" font-family="ui-monospace, Menlo, Consolas,'
                ' monospace" font-size="13">'
            ),
            (
                f'<rect width="100%" height="100%" rx="8" fill="{BACKGROUND}"/><g'
                f' transform="translate({MARGIN} {MARGIN})">'
            ),
            *_dots(cells),
            *_texts(cells),
            "</g></svg>",
            "",
        ]
    )


def _dots(cells: CellGrid) -> Iterator[str]:
    bits = np.where(_braille(cells), cells.codes - BLANK, 0)
    places = ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2), (0, 3), (1, 3))
    for ink in np.unique(cells.inks[bits > 0]).tolist():
        path = []
        for bit, (across, down) in enumerate(places):
            found = np.argwhere((bits >> bit & 1) & (cells.inks == ink)).tolist()
            path += [
                f"M{column * CELL_WIDTH + across * 4 + 2} {row * CELL_HEIGHT + down * 4 + 2}h0"
                for row, column in found
            ]
        yield (
            f'<path d="{"".join(path)}" stroke="{_colour(ink)}" stroke-width="{DOT}"'
            ' stroke-linecap="round"/>'
        )


def _braille(cells: CellGrid) -> NDArray[np.bool_]:
    return (cells.codes > BLANK) & (cells.codes < BLANK + 256)


def _texts(cells: CellGrid) -> Iterator[str]:
    inks = np.where(_braille(cells) | (cells.codes == ord(" ")), -1, cells.inks).tolist()
    for row, line in enumerate(cells.lines()):
        start = 0
        for ink, run in groupby(inks[row]):
            end = start + len(list(run))
            if ink >= 0:
                weight = ' font-weight="bold"' if INKS[ink].bold else ""
                yield (
                    f'<text x="{start * CELL_WIDTH}" y="{row * CELL_HEIGHT + 12}"'
                    f' textLength="{(end - start) * CELL_WIDTH}" lengthAdjust="spacingAndGlyphs"'
                    f' fill="{_colour(ink)}"{weight}>{escape(line[start:end])}</text>'
                )
            start = end


def _colour(ink: int) -> str:
    rgb = INKS[ink].rgb
    return FOREGROUND if rgb is None else "#" + "".join(f"{part:02x}" for part in rgb)


def main() -> None:
    HERE.mkdir(exist_ok=True)
    flat = draw_window(
        "sim:ldrobot-stl27l?errors=0.0001",
        "ldrobot-stl27l",
        columns=80,
        lines=24,
        seconds=4,
        called="/dev/ttyUSB0",
    )
    (HERE / "view-2d.svg").write_text(svg(flat), encoding="utf-8")
    tall = draw_window(
        "sim:velodyne-vlp16", "velodyne-vlp16", columns=110, lines=36, seconds=2.2, called=":2368"
    )
    (HERE / "view-3d.svg").write_text(svg(tall), encoding="utf-8")
    for name in ("find.md", "troubleshoot.md", "explain.md", "stats.md"):
        page = HERE.parent / name
        page.write_text(renew_page(page.read_text(encoding="utf-8")), encoding="utf-8")


def renew_page(page: str) -> str:
    """Return a page with the current output of its commands.

    Commands that name a port read a simulated sensor, and commands that name a file read generated
    bytes. Outputs that the page shortens with "..." are kept.
    """
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder, "port")
        Path(folder, "unknown.bin").write_bytes(
            b"".join(make_unknown_frame(index) for index in range(60))
        )
        with virtual_port("ldrobot-stl27l", link=link, faults=Faults(errors=0.0001)):
            return re.sub(
                r"(?<=```text\n)\$ lidarspec (.*)\n(?:(?!\.\.\.$).*\n)*?(?=```)",
                lambda found: run_command(found[1], link),
                page,
                flags=re.MULTILINE,
            )


def run_command(command: str, link: Path) -> str:
    """Run a command of the page; return its command line and output as text."""
    words = [str(link) if word == PORT else word for word in command.split()]
    program = [sys.executable, "-m", "lidarspec", *words]
    done = subprocess.run(
        program,
        cwd=link.parent,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    wider = " " * (len(str(link)) - len(PORT))
    text = done.stdout.replace("source" + wider, "source").replace(str(link), PORT)
    return f"$ lidarspec {command}\n{text}"


def make_unknown_frame(index: int) -> bytes:
    """Return a frame of an unknown sensor: two sync bytes, a counter, noise and a CRC."""
    body = b"\x9a\x51" + index.to_bytes(2, "little") + random.Random(index).randbytes(20)
    return body + Crc(16, 0x1021, 0xFFFF)(body).to_bytes(2, "little")


if __name__ == "__main__":
    main()
