"""A sensor at work in a cell of a notebook, drawn by the same code as the page."""

from __future__ import annotations

import functools
import math
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lidarspec import LidarSpecError, Selection, Sensor, UsageError, open as open_device
from lidarspec.errors import suggest, suggestion
from lidarspec.transports.protocol import Closing
from lidarspec.view.feed import LOOK
from lidarspec_web.answers import Answers
from lidarspec_web.broadcast import Broadcast

#: what draws, as it was built; the height of the picture in pixels; and seconds from one state to
#: the next.
DRAWING, HEIGHT, STATE = Path(__file__).parent / "page" / "widget.js", 420, 0.5


class Viewer(Closing):
    """A source in the cell whose value this is: ``Viewer("/dev/ttyUSB0", "vendor-model")``; a file
    is played.

    It reads in a thread of its own until it is closed, by `close` or with its cell. What is wrong
    with the source stands in the cell.

    Args:
        source: port, socket, file or ``sim:`` URL.
        sensor: found out where it is left out.
        select: which scans, and what of each.
        height: of the picture, pixels.

    Raises:
        UsageError: if anywidget is not installed.
    """

    def __init__(
        self,
        source: str | Path,
        sensor: str | Sensor | None = None,
        *,
        select: Selection | None = None,
        height: int = HEIGHT,
    ) -> None:
        self._source, self._sensor, self._select = str(source), sensor, select
        self._lock, self._closed = threading.RLock(), False
        self._broadcast: Broadcast | None = None
        self._answers: Answers | None = None
        self._greets, self._most, self._sent, self._failure, self._ending = False, 0, -1, "", ""
        self._due = (
            math.inf
        )  # when the cell, once it has asked who it is, is told how that is doing
        self._widget = _widget(height)
        self._widget.on_msg(lambda widget, message, buffers: self._hear(message))
        self._thread = threading.Thread(target=self._run, name=f"viewer of {source}", daemon=True)
        self._thread.start()

    @property
    def failure(self) -> str:
        """What is wrong with the source, and what helps, in one line; "" where nothing is."""
        return self._failure

    def close(self) -> None:
        """Give the source back; the last picture stays."""
        self._closed = True
        if self._broadcast is not None:
            self._broadcast.stop()
        if self._thread is not threading.current_thread():
            self._thread.join()

    def _repr_mimebundle_(self, **_: Any) -> Any:
        return self._widget._repr_mimebundle_()

    def _run(self) -> None:
        """Read until the end, which the cell is told of."""
        try:
            device = open_device(self._source, self._sensor, period=LOOK)
            reopened = functools.partial(open_device, self._source, device.sensor)
            with Broadcast(
                self._source, device, reopened=reopened, select=self._select
            ) as broadcast:
                broadcast.news = self._tell
                self._broadcast, self._answers = broadcast, Answers(broadcast, control=False)
                if not self._closed:
                    broadcast.run(math.inf)
        except LidarSpecError as error:
            self._failure = "; next: ".join(filter(None, (str(error), suggestion(error))))
        self._ending = self._failure or f"{self._source} is closed"
        self._tell()

    def _hear(self, message: Mapping[str, Any]) -> None:
        """Do what the cell asks for."""
        word, broadcast = message.get("do"), self._broadcast
        if word == "next":
            self._most = int(message["most"])
        elif word == "hello":
            self._greets, self._sent = True, -1
        elif word == "close":
            threading.Thread(target=self.close, daemon=True).start()
        elif word in ("pause", "play") and broadcast is not None and not broadcast.is_live:
            getattr(broadcast, word)()
        self._tell()

    def _tell(self) -> None:
        """Answer with what there is: who it is with the first scan, then each scan that was asked
        for.
        """
        with self._lock:
            shown = self._broadcast.shown if self._broadcast is not None else None
            if shown is not None and self._answers is not None:
                if self._greets:
                    self._greets, self._due = False, 0.0
                    self._say(self._answers.hello())
                if time.monotonic() >= self._due:
                    self._due = time.monotonic() + STATE
                    self._say(
                        self._answers.state(
                            frozen=False, since=self._answers.broadcast.backlog.damaged
                        )
                    )
                if self._most and shown.number != self._sent:
                    most, self._most, self._sent = self._most, 0, shown.number
                    self._say({"is": "scan"}, shown.message(most))
            if self._ending:
                self._say({"is": "ended", "text": self._ending})

    def _say(self, message: Mapping[str, Any], *buffers: bytes) -> None:
        self._widget.send(message, list(buffers))


def _widget(height: int) -> Any:
    """Return the widget that draws in the cell.

    Raises:
        UsageError: if anywidget is not installed.
    """
    try:
        import anywidget
        import traitlets  # anywidget requires it
    except ImportError as error:
        text = f"the viewer in notebooks needs anywidget, which cannot be imported: {error}"
        raise suggest(UsageError(text), "pip install 'anywidget>=0.9.13'") from error
    attributes = {"_esm": DRAWING, "height": traitlets.Int(height).tag(sync=True)}
    return type("Viewer", (anywidget.AnyWidget,), attributes)()
