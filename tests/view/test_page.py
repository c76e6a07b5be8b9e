"""The page in a real browser: what is drawn is the room, bytes and fields mark each other, and what one clicks happens."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import math
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.simulation.scenes import Room

BUNDLE = Path(ls.__file__).parent / "view" / "page" / "dist" / "page.js"
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
#: graphics without a graphics card.
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
#: the columns of the points that are shown, and their places in the picture, one after another.
SHOWN = """(() => {
  const { picture } = lidarspec, { columns } = picture.scan, [x, y, z] = ["x", "y", "z"].map((name) => columns.get(name));
  return [Object.fromEntries([...columns].map(([name, column]) => [name, [...column]])), [...x].flatMap((_, row) => picture.place(x[row], y[row], z[row]))];
})()"""
#: the size of the picture, and the numbers of the pixels in it that are neither black, grey nor white.
COLOURED = """(async () => {
  const image = await createImageBitmap(await lidarspec.picture.image()), { width, height } = image;
  const context = new OffscreenCanvas(width, height).getContext("2d");
  context.drawImage(image, 0, 0);
  const { data } = context.getImageData(0, 0, width, height), coloured = [];
  for (let pixel = 0; pixel < width * height; pixel++) {
    const [red, green, blue] = [data[4 * pixel], data[4 * pixel + 1], data[4 * pixel + 2]];
    if (Math.max(red, green, blue) - Math.min(red, green, blue) > 60) coloured.push(pixel);
  }
  return [width, height, coloured];
})()"""
#: pixels around the sensor in which its axes are drawn.
AXES = 50
#: seconds that a machine with other work may need.
PATIENCE = 60.0

if CHROMIUM is None:
    pytest.skip("Chromium is not installed", allow_module_level=True)
if not BUNDLE.is_file():
    pytest.skip("the page is not built: make page", allow_module_level=True)
for library in ("playwright.sync_api", "starlette", "uvicorn", "websockets"):
    pytest.importorskip(library, reason=f"{library.partition('.')[0]} is not installed: the page is not served")


@contextlib.contextmanager
def served(*words: str, address: str = "127.0.0.1") -> Iterator[str]:
    """The link to the page of a source."""
    command = [sys.executable, "-m", "lidarspec", "view", *words, "--web", "--address", address]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        link = re.search(r"http://\S+", line)
        assert link, process.communicate()[1]
        yield link[0]
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=PATIENCE)


class Visit:
    """A page that is open, and what it and the server have said to each other.

    Attributes:
        asked: what the page has sent, newest last.
        told: the last message of each kind that it was sent.
        scans: how many scans it was sent.
    """

    def __init__(self, browser: Any, link: str, *, theme: str = "dark") -> None:
        self.link = link
        self.asked: list[dict[str, Any]] = []
        self.told: dict[str, dict[str, Any]] = {}
        self.scans = 0
        self.errors: list[str] = []
        self.page = browser.new_page(viewport={"width": 1440, "height": 900}, color_scheme=theme)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("console", lambda message: message.type == "error" and self.errors.append(message.text))
        self.page.on("websocket", self._listen)
        self.page.goto(link)
        self.until(lambda: self.value("lidarspec.figures.latency > 0"), "nothing is drawn")

    def _listen(self, socket: Any) -> None:
        socket.on("framesent", lambda text: self.asked.append(json.loads(text)))
        socket.on("framereceived", self._hear)

    def _hear(self, data: str | bytes) -> None:
        if isinstance(data, bytes):
            self.scans += 1
        else:
            message = json.loads(data)
            self.told[message["is"]] = message

    def value(self, expression: str, argument: Any = None) -> Any:
        return self.page.evaluate(expression, argument)

    def until(self, holds: Callable[[], Any], otherwise: str) -> Any:
        """What holds, once it does."""
        end = time.monotonic() + PATIENCE
        while not (found := holds()):
            assert time.monotonic() < end, otherwise
            self.page.wait_for_timeout(30)
        return found

    def text(self, selector: str) -> str:
        return str(self.page.locator(selector).inner_text())

    def asked_for(self, word: str) -> list[dict[str, Any]]:
        return [message for message in self.asked if message["do"] == word]

    def pause(self) -> None:
        """Let the picture stand, and be on the screen."""
        self.page.click("#play")
        self.until(lambda: self.text("#status") == "paused", "it is not paused")
        self.page.wait_for_timeout(500)

    def play(self) -> None:
        self.page.click("#play")
        self.until(lambda: self.text("#status") != "paused", "it does not go on")

    @property
    def scan(self) -> dict[str, np.ndarray]:
        """The columns of the points that are shown, and where each of them is in the picture, in pixels."""
        columns, places = self.value(SHOWN)
        return {**{name: np.array(column) for name, column in columns.items()}, "place": np.array(places).reshape(-1, 2)}

    @property
    def coloured(self) -> tuple[np.ndarray, np.ndarray]:
        """Which pixels of the picture have a colour, and which are nothing but points and what lies under them, (height, width) each."""
        width, height, pixels = self.value(COLOURED)
        coloured, looked = np.zeros(height * width, bool), np.ones((height, width), bool)
        coloured[pixels] = True
        looked[-60:, -220:] = False  # what the colours mean
        across, down = (round(part) for part in self.value("lidarspec.picture.place(0, 0, 0)"))
        looked[max(down - AXES, 0) : down + AXES, max(across - AXES, 0) : across + AXES] = False
        return coloured.reshape(height, width), looked

    def saved(self) -> list[dict[str, str]]:
        """The scan that is shown as the server saves it, row by row."""
        number = self.value("lidarspec.picture.scan.scan")
        answer = self.page.request.get(f"{self.link}save/{number}.csv")
        assert answer.ok, answer.text()
        return list(csv.DictReader(io.StringIO(answer.text())))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield started
        started.close()


@pytest.fixture(scope="module")
def m1(browser: Any) -> Iterator[Visit]:
    with served("sim:robosense-m1") as link:
        visit = Visit(browser, link)
        yield visit
        visit.page.close()
        assert not visit.errors


def near(mask: np.ndarray, reach: int) -> np.ndarray:
    """The pixels that are at most so far from one of these, along each axis."""
    for axis in (0, 1):
        mask = np.any([np.roll(mask, step, axis) for step in range(-reach, reach + 1)], axis=0)
    return mask


def check_drawing(visit: Visit) -> None:
    """Hold the pixels of the picture against the scan that the server saves: points are where it has some, and nowhere else."""
    scan, (coloured, looked) = visit.scan, visit.coloured
    own = np.array([[float(row[axis]) for axis in "xyz"] for row in visit.saved()])
    assert visit.value("lidarspec.picture.scan.of") == len(own)
    np.testing.assert_allclose(np.stack([scan[axis] for axis in "xyz"], axis=1), own[scan["index"]], atol=1e-3)
    across, down = np.rint(scan["place"]).astype(int).T
    inside = (across >= 0) & (across < coloured.shape[1]) & (down >= 0) & (down < coloured.shape[0])
    points = np.zeros_like(coloured)
    points[down[inside], across[inside]] = True
    assert np.count_nonzero(points & looked) > 300
    assert near(coloured, 2)[points & looked].mean() > 0.95, "points of the scan are not drawn"
    assert near(points, 4)[coloured & looked].mean() > 0.95, "something is drawn where the scan has no points"


def test_the_room_of_a_3d_sensor_is_seen(m1: Visit) -> None:
    m1.page.click("#views [data-value=top]")
    m1.pause()
    (ahead, left, home) = (m1.value("place => lidarspec.picture.place(...place)", place) for place in ([1, 0, 0], [0, 1, 0], [0, 0, 0]))
    assert ahead[1] < home[1] and left[0] < home[0], "forward is up, and left is left"
    assert math.isclose(home[1] - ahead[1], home[0] - left[0], rel_tol=1e-3)
    check_drawing(m1)
    walls = Room().walls
    assert walls is not None
    assert np.mean(np.abs(m1.scan["x"] - walls.high[0]) < 0.05) > 0.1, "the wall ahead is in the scan"
    m1.page.click("#views [data-value=orbit]")
    check_drawing(m1)
    m1.play()


def test_colours_and_keys(m1: Visit) -> None:
    for name in ("intensity", "height", "range"):
        m1.page.select_option("#colour", name)
    m1.page.locator("#picture").click(position={"x": 5, "y": 5})
    m1.page.keyboard.press("c")
    assert m1.page.locator("#colour").input_value() == "intensity"
    m1.page.keyboard.press("?")
    assert m1.page.locator("#keys").is_visible()
    m1.page.keyboard.press("Escape")
    home = m1.value("lidarspec.picture.place(0, 0, 0)")
    m1.page.keyboard.press("ArrowUp")
    assert m1.value("lidarspec.picture.place(0, 0, 0)") != home
    m1.page.keyboard.press("0")


def test_a_click_on_a_point_opens_its_frame_and_pointing_at_a_byte_names_its_field(m1: Visit) -> None:
    m1.page.click("#views [data-value=orbit]")
    m1.pause()
    scan = m1.scan
    across, down = scan["place"][len(scan["x"]) // 2]
    asked = len(m1.asked_for("frame"))
    m1.page.locator("#picture canvas").nth(1).click(position={"x": across, "y": down})
    m1.until(lambda: len(m1.asked_for("frame")) > asked and m1.told.get("frame", {}).get("why") == "point", "no frame is asked for")
    index = m1.asked_for("frame")[-1]["point"]["index"]
    row = int(np.flatnonzero(scan["index"] == index)[0])
    frame = m1.told["frame"]
    kept = m1.page.locator(".branch.kept")
    assert m1.until(lambda: kept.count() and kept.get_attribute("data-path"), "the point's value is not marked") == frame["value"]
    explained = ls.explain(bytes.fromhex(frame["hex"]), ls.sensor("robosense-m1"))
    path = frame["value"].rpartition(".")[0] or frame["value"]
    element = next(one for one in explained.rows if one.path and (frame["value"] + ".").startswith(one.path + "."))
    assert any(math.isclose(point.range, scan["range"][row], abs_tol=1e-3) for point in element.points), path
    assert m1.page.locator(".dump i.kept").count() > 0
    check_bytes(m1, explained)
    m1.play()


def check_bytes(visit: Visit, explained: Any) -> None:
    """Point at some bytes of the dump that are seen, and at a field."""
    offsets = [int(cell.get_attribute("data-offset")) for cell in visit.page.locator(".hex i").all()[::40]]
    assert offsets
    for offset in offsets:
        visit.page.locator(f".hex i[data-offset='{offset}']").hover()
        names = [value.path for value in explained.fields.values() if value.covers(offset)]
        said = visit.page.locator(".said b").all_inner_texts()
        assert said == names[: len(said)] and len(said) == len(names), f"byte {offset}"
    path = visit.page.locator(".branch[data-path]").last.get_attribute("data-path")
    visit.page.locator(f".branch[data-path='{path}']").hover()
    marked = {int(cell.get_attribute("data-offset")) for cell in visit.page.locator(".hex i.pointed").all()}
    owned = {offset for value in explained.fields.values() for offset in range(len(explained.data)) if f"{value.path}.".startswith((f"{path}.", f"{path}[")) and value.covers(offset)}
    assert marked <= owned


def test_a_hidden_page_asks_for_nothing(m1: Visit) -> None:
    m1.value("Object.defineProperty(document, 'hidden', { value: true, configurable: true })")
    session = m1.page.context.new_cdp_session(m1.page)
    session.send("Emulation.setFocusEmulationEnabled", {"enabled": False})
    other = m1.page.context.new_page()
    other.bring_to_front()
    print(m1.value("document.visibilityState"))
    m1.page.wait_for_timeout(1000)
    asked = len(m1.asked_for("next"))
    m1.page.wait_for_timeout(1500)
    assert len(m1.asked_for("next")) - asked == 0
    other.close()
