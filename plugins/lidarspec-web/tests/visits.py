"""Pages of a source in a real browser, with their messages."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

#: The columns of the shown points, and their positions in the picture, concatenated.
SHOWN = """(() => {
  const { picture } = lidarspec, { columns } = picture.scan, [x, y, z] = ["x", "y", "z"].map((name) => columns.get(name));
  const places = [...x].flatMap((_, row) => picture.place(x[row], y[row], z[row]));
  return [Object.fromEntries([...columns].map(([name, column]) => [name, [...column]])), places];
})()"""
#: The size of the picture, and the indices of its pixels that are neither black, grey nor white.
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
#: Pixels around the sensor in which its axes are drawn.
AXES = 50
#: Timeout in seconds for a busy machine.
PATIENCE = 60.0


@contextlib.contextmanager
def serve(*words: str, address: str = "127.0.0.1", folder: Path | None = None) -> Iterator[str]:
    """Yield the link to the page of a source.

    Args:
        folder: the working directory of the server.
    """
    command = [sys.executable, "-m", "lidarspec", "view", *words, "--web", "--address", address]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=folder
    )
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
    """An open page, and the messages between it and the server.

    Attributes:
        asked: the messages from the page, newest last.
        told: the last message of each kind to the page.
        states: number of state messages to the page.
    """

    def __init__(
        self,
        browser: Any,
        link: str,
        *,
        theme: str = "dark",
        size: tuple[int, int] = (1440, 900),
        touch: bool = False,
    ) -> None:
        self.link = link
        self.asked: list[dict[str, Any]] = []
        self.told: dict[str, dict[str, Any]] = {}
        self.states = 0
        self.errors: list[str] = []
        width, height = size
        viewport = {"width": width, "height": height}
        self.context = browser.new_context(
            viewport=viewport, color_scheme=theme, has_touch=touch, is_mobile=touch
        )
        self.page = self.context.new_page()
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on(
            "console", lambda message: message.type == "error" and self.errors.append(message.text)
        )
        self.page.on("websocket", self._listen)
        self.page.goto(link)
        self.until(lambda: self.value("lidarspec.figures.latency > 0"), "nothing is drawn")

    def _listen(self, socket: Any) -> None:
        socket.on("framesent", lambda text: self.asked.append(json.loads(text)))
        socket.on("framereceived", self._hear)

    def _hear(self, data: str | bytes) -> None:
        if isinstance(data, str):
            message = json.loads(data)
            self.told[message["is"]] = message
            self.states += message["is"] == "state"

    def value(self, expression: str, argument: Any = None) -> Any:
        return self.page.evaluate(expression, argument)

    def until(self, holds: Callable[[], Any], otherwise: str) -> Any:
        """Return the value of `holds` once it is true."""
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
        """Pause the picture, and wait until it is on the screen."""
        self.page.click("#play")
        self.until(lambda: self.text("#status") == "paused", "it is not paused")
        self.page.wait_for_timeout(500)

    def play(self) -> None:
        self.page.click("#play")
        self.until(lambda: self.text("#status") != "paused", "it does not go on")

    @property
    def scan(self) -> dict[str, np.ndarray]:
        """Return the columns of the shown points, and their positions in pixels."""
        columns, places = self.value(SHOWN)
        return {
            **{name: np.array(column) for name, column in columns.items()},
            "place": np.array(places).reshape(-1, 2),
        }

    @property
    def find_coloured(self) -> tuple[np.ndarray, np.ndarray]:
        """Return which pixels of the picture are coloured, and which show only points.

        Both have the shape (height, width).
        """
        width, height, pixels = self.value(COLOURED)
        coloured, looked = np.zeros(height * width, bool), np.ones((height, width), bool)
        coloured[pixels] = True
        looked[-60:, -220:] = False  # the legend of the colours
        across, down = (round(part) for part in self.value("lidarspec.picture.place(0, 0, 0)"))
        looked[max(down - AXES, 0) : down + AXES, max(across - AXES, 0) : across + AXES] = False
        return coloured.reshape(height, width), looked

    def save(self) -> list[dict[str, str]]:
        """Return the shown scan as the server saves it, row by row."""
        number = self.value("lidarspec.picture.scan.scan")
        answer = self.page.request.get(self.link.replace("?", f"save/{number}.csv?"))
        assert answer.ok, answer.text()
        return list(csv.DictReader(io.StringIO(answer.text())))


@contextlib.contextmanager
def streaming(visit: Visit) -> Iterator[None]:
    """Let an open page play during one test only, because drawing is slow."""
    if visit.text("#status") == "paused":
        visit.play()
    yield
    if visit.text("#status") != "paused":
        visit.pause()
