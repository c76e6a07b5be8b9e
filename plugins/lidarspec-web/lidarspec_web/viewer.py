"""A source in a cell of a notebook, drawn by the code of the page.

A thread reads the source. The cell works like a page: it sends `hello` when it is shown, and
requests each scan by `next` after it has drawn the previous scan. `page_messages` makes the
messages to the cell.
"""

from __future__ import annotations

import functools
import math
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from lidarspec import LidarSpecError, Selection, Sensor, UsageError, open as open_device
from lidarspec.errors import suggest, suggestion
from lidarspec.view.live_scans import LOOK_S
from lidarspec_web.broadcast import Broadcast
from lidarspec_web.page_messages import PageMessages

#: The file of the built widget.
SCRIPT = Path(__file__).parent / "page" / "widget.js"
HEIGHT_PIXELS = 420
STATE_PERIOD_S = 0.5


class Viewer:
    """Shows a source in a notebook cell: ``Viewer("/dev/ttyUSB0", "vendor-model")``.

    Files are played. The source is read until `close` is called or the cell is removed. If it
    cannot be read, the cell shows the reason.

    Args:
        source: port, socket, file or ``sim:`` URL.
        sensor: the sensor, or its id; by default it is detected.
        select: the scans to show; by default all.
        height: height of the picture, in pixels.

    Raises:
        UsageError: if anywidget is not installed.
    """

    def __init__(
        self,
        source: str | Path,
        sensor: str | Sensor | None = None,
        *,
        select: Selection | None = None,
        height: int = HEIGHT_PIXELS,
    ) -> None:
        self._source = str(source)
        self._sensor = sensor
        self._select = select
        self._lock = threading.RLock()  # the reading thread and the notebook's thread send
        self._broadcast: Broadcast | None = None
        self._answers: PageMessages | None = None
        self._is_closed = False
        self._failure = ""
        self._ending = ""
        self._wants_hello = False
        self._wanted_points = 0  # of the requested scan; 0 for none
        self._sent_scan = -1
        self._state_due = math.inf  # no state before the first message
        self._widget = _make_widget(height)
        self._widget.on_msg(lambda widget, message, buffers: self._handle(message))
        self._thread = threading.Thread(target=self._read, name=f"viewer of {source}", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def failure(self) -> str:
        """The reason why the source cannot be read, and what to do next; "" if it can."""
        return self._failure

    def close(self) -> None:
        """Close the source; the last picture remains visible."""
        self._is_closed = True
        if self._broadcast is not None:
            self._broadcast.stop()
        if self._thread is not threading.current_thread():
            self._thread.join()

    def _repr_mimebundle_(self, **_: Any) -> Any:
        return self._widget._repr_mimebundle_()

    def _read(self) -> None:
        """Read the source until it ends, and send the reason of its end to the cell."""
        try:
            self._show_source()
        except LidarSpecError as error:
            self._failure = "; next: ".join(filter(None, (str(error), suggestion(error))))
        self._ending = self._failure or f"{self._source} is closed"
        self._send_news()

    def _show_source(self) -> None:
        device = open_device(self._source, self._sensor, period=LOOK_S)
        reopen = functools.partial(open_device, self._source, device.sensor)
        with Broadcast(self._source, device, reopen=reopen, select=self._select) as broadcast:
            broadcast.on_news = self._send_news
            self._answers = PageMessages(broadcast, control=False)
            self._broadcast = broadcast
            if not self._is_closed:
                broadcast.run(math.inf)

    def _handle(self, message: Mapping[str, Any]) -> None:
        """Handle a message from the cell."""
        word = message.get("do")
        broadcast = self._broadcast
        if word == "next":
            self._wanted_points = int(message["most"])
        elif word == "hello":
            self._wants_hello = True
            self._sent_scan = -1
        elif word == "close":
            threading.Thread(target=self.close, daemon=True).start()
        elif broadcast is not None and not broadcast.is_live:
            if word == "pause":
                broadcast.pause()
            elif word == "play":
                broadcast.play()
        self._send_news()

    def _send_news(self) -> None:
        """Send the data that the cell has requested, if available."""
        with self._lock:
            if self._broadcast is not None and self._answers is not None:
                self._send_scan(self._broadcast, self._answers)
            if self._ending:
                self._send({"is": "ended", "text": self._ending})

    def _send_scan(self, broadcast: Broadcast, answers: PageMessages) -> None:
        """Send `hello` and the state if they are due, and then the newest scan."""
        shown = broadcast.shown
        if shown is None:
            return
        if self._wants_hello:
            self._wants_hello = False
            self._state_due = 0.0
            self._send(answers.hello())
        now = time.monotonic()
        if now >= self._state_due:
            self._state_due = now + STATE_PERIOD_S
            self._send(answers.state(frozen=False, first_damaged=broadcast.backlog.damaged))
        if self._wanted_points and shown.number != self._sent_scan:
            max_points = self._wanted_points
            self._wanted_points = 0
            self._sent_scan = shown.number
            self._send({"is": "scan"}, shown.message(max_points))

    def _send(self, message: Mapping[str, Any], *buffers: bytes) -> None:
        self._widget.send(message, list(buffers))


def _make_widget(height: int) -> Any:
    """Return the widget that draws in the cell.

    Raises:
        UsageError: if anywidget is not installed.
    """
    try:
        import anywidget
        import traitlets  # a requirement of anywidget
    except ImportError as error:
        text = f"the viewer in notebooks requires anywidget, which cannot be imported: {error}"
        raise suggest(UsageError(text), "pip install 'anywidget>=0.9.13'") from error
    attributes = {"_esm": SCRIPT, "height": traitlets.Int(height).tag(sync=True)}
    return type("Viewer", (anywidget.AnyWidget,), attributes)()
