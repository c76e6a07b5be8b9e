"""Tests of the notebook widget, with messages of ipywidgets and a real browser."""

from __future__ import annotations

import base64
import contextlib
import queue
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from lidarspec_web import Viewer
from lidarspec_web.viewer import SCRIPT
from tests.cli.running import ran
from tests.libraries import needs

pytestmark = [pytest.mark.slow, needs("anywidget")]
#: The front end of a notebook for a widget of anywidget: a model that sends and receives, and an
#: element to render into.
CELL = """async (esm) => {
    const heard = new Set();
    window.fromKernel = (content, buffers) => {
        const views = buffers.map((text) => new DataView(Uint8Array.from(atob(text), (one) => one.charCodeAt(0)).buffer));
        for (const one of heard) one(content, views);
    };
    const model = {get: () => 300, send: window.toKernel, on: (_, one) => heard.add(one), off: (_, one) => heard.delete(one)};
    const url = URL.createObjectURL(new Blob([esm], {type: "text/javascript"}));
    const close = (await import(url)).default.render({model, el: document.getElementById("cell")});
    window.leave = () => { close(); document.getElementById("cell").remove(); };
}"""


class Comm:
    """The connection of a widget to its cell: a queue of messages from any thread."""

    comm_id = "one"

    def __init__(self) -> None:
        self.sent: queue.Queue[tuple[Any, Any]] = queue.Queue()
        self.heard: Callable[[Any], None] = lambda message: None

    def on_msg(self, heard: Callable[[Any], None]) -> None:
        self.heard = heard

    def send(self, data: Any = None, metadata: Any = None, buffers: Any = None) -> None:
        self.sent.put((data, buffers or []))


class Cell:
    """A viewer in a cell of a page."""

    def __init__(self, page: Any, viewer: Viewer) -> None:
        self.page, self.viewer, self.comm = page, viewer, Comm()
        self.asked: list[str] = []
        self.scans, self.most = 0, 0
        viewer._widget.comm = self.comm
        page.set_content(
            "<body style='background:#111;color:#ddd'><div id=cell style='width:600px'></div>"
        )
        page.expose_function("toKernel", self._to_kernel)
        page.evaluate(CELL, SCRIPT.read_text(encoding="utf-8"))

    def _to_kernel(self, content: dict[str, Any]) -> None:
        self.asked.append(content["do"])
        self.comm.heard(
            {"content": {"data": {"method": "custom", "content": content}}, "buffers": []}
        )

    def until(self, reached: Callable[[], bool], seconds: float = 20.0) -> None:
        """Carry messages in both directions until a condition holds."""
        end = time.monotonic() + seconds
        while not reached():
            assert time.monotonic() < end, (self.text, self.asked[-5:])
            while not self.comm.sent.empty():
                data, buffers = self.comm.sent.get()
                if data["method"] == "custom":
                    self.scans += data["content"]["is"] == "scan"
                    self.page.evaluate(
                        "([content, buffers]) => window.fromKernel(content, buffers)",
                        [data["content"], [base64.b64encode(one).decode() for one in buffers]],
                    )
                self.most = max(self.most, abs(self.asked.count("next") - self.scans))
            self.page.wait_for_timeout(20)

    @property
    def text(self) -> str:
        return str(self.page.inner_text("body"))


@pytest.fixture
def page(browser: Any) -> Iterator[Any]:
    with contextlib.closing(browser.new_page(viewport={"width": 640, "height": 480})) as page:
        yield page


def test_a_cell_shows_one_scan_after_another_and_closes_its_source(page: Any) -> None:
    cell = Cell(page, Viewer("sim:robosense-m1"))
    cell.until(lambda: cell.scans >= 5)
    assert cell.most <= 1  # being sent
    assert "RoboSense RS-LiDAR-M1" in cell.text
    assert "78,750 points" in cell.text
    assert [
        option.inner_text() for option in page.query_selector_all("select[title=colour] option")
    ] == [
        "range",
        "intensity",
        "ring",
        "height",
    ]
    assert colours(page) > 20  # of points, on the ground and the lines of the picture
    page.click("button")
    cell.until(lambda: cell.comm.sent.empty() and cell.asked.count("next") <= cell.scans + 1)
    scans = cell.scans
    time.sleep(0.5)
    page.click("button")
    assert cell.scans == scans
    cell.until(lambda: cell.scans >= scans + 2)
    page.select_option("select[title=view]", "top")
    page.evaluate("window.leave()")
    cell.until(lambda: not cell.viewer._thread.is_alive())
    assert cell.asked[-1] == "close"


def test_a_sensor_of_one_plane_is_seen_from_above(page: Any) -> None:
    with Viewer("sim:ldrobot-stl27l") as viewer:
        cell = Cell(page, viewer)
        cell.until(lambda: cell.scans >= 2)
        assert page.input_value("select[title=view]") == "polar"
    cell.until(lambda: "sim:ldrobot-stl27l is closed" in cell.text)


def test_a_file_is_played_paused_and_ended(page: Any, tmp_path: Path) -> None:
    ran("sim", "ldrobot-stl27l", "--to", tmp_path / "a.pcap", "-t", "4s")
    with Viewer(tmp_path / "a.pcap", "ldrobot-stl27l") as viewer:
        cell = Cell(page, viewer)
        cell.until(lambda: cell.scans >= 2 and "playing" in cell.text)
        page.click("button")
        cell.until(lambda: "paused" in cell.text)
        page.click("button")
        cell.until(lambda: "ended" in cell.text)
        assert cell.scans > 10


def test_a_cell_shows_the_error_of_a_source_in_one_line(page: Any) -> None:
    cell = Cell(page, Viewer("/dev/ttyUSB99"))
    cell.until(lambda: "no such port" in cell.text)
    assert (
        cell.text.strip()
        == cell.viewer.failure
        == "/dev/ttyUSB99: no such port; next: lidarspec ports"
    )


def colours(page: Any) -> int:
    """Return the number of colours in the middle of the picture."""
    shot = base64.b64encode(page.locator("canvas").nth(1).screenshot()).decode()
    script = """async (png) => {
        const image = await createImageBitmap(await (await fetch("data:image/png;base64," + png)).blob());
        const context = Object.assign(document.createElement("canvas"), {width: image.width, height: image.height}).getContext("2d");
        context.drawImage(image, 0, 0);
        const data = new Uint32Array(context.getImageData(0, 0, image.width, image.height).data.buffer);
        return new Set(data).size;
    }"""
    return int(page.evaluate(script, shot))
