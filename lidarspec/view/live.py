"""The window that shows a sensor at work: keys in, pictures out, a dozen times a second at most."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

import numpy as np

from lidarspec.scans.scans import Scan
from lidarspec.view.canvas import ALARM, GOOD, STRONG, Cells
from lidarspec.view.feed import Feed, Reading
from lidarspec.view.panel import Figure, Layout, Title, composed, figures_of, help_page, message
from lidarspec.view.polar import Look, look, picture
from lidarspec.view.recording import Switch
from lidarspec.view.screen import Screen

#: seconds from picture to picture at least, and between two readings of the figures.
FRAME, FIGURES = 0.08, 1.0
#: what one key press zooms by, and the share of the picture that it moves.
ZOOM, MOVE = 1.25, 0.2
#: a picture that is found to need less than this share of its reach is drawn larger.
ROOMY = 0.7
_MOVES = {"up": (1, 0), "down": (-1, 0), "left": (0, 1), "right": (0, -1)}


@dataclass(frozen=True)
class Choice:
    """What the keys have chosen.

    Attributes:
        ramp: what colours show.
        zoom: how many times larger than all of it.
        middle: what is in the middle, metres forward and left of the sensor.
        paused, helped, done: whether the picture stands, the keys are listed, the window is to close.
    """

    ramp: str = "range"
    zoom: float = 1.0
    middle: tuple[float, float] = (0.0, 0.0)
    paused: bool = False
    helped: bool = False
    done: bool = False

    def after(self, key: str, reach: float) -> Choice:
        """The choice after a key press; `reach` is what is shown now, in metres."""
        if key in ("q", "Q"):
            return replace(self, done=True)
        if key == " ":
            return replace(self, paused=not self.paused)
        if key in ("c", "C"):
            return replace(self, ramp="intensity" if self.ramp == "range" else "range")
        if key in ("+", "="):
            return replace(self, zoom=min(self.zoom * ZOOM, 1e3))
        if key in ("-", "_"):
            return replace(self, zoom=max(self.zoom / ZOOM, 1e-2))
        if key == "0":
            return replace(self, zoom=1.0, middle=(0.0, 0.0))
        if key in _MOVES:
            forward, left = (self.middle[axis] + _MOVES[key][axis] * MOVE * reach for axis in (0, 1))
            return replace(self, middle=(forward, left))
        if key in ("?", "h"):
            return replace(self, helped=not self.helped)
        return replace(self, helped=False) if key == "escape" else self


class Window:
    """The state between two pictures: what is shown, at which scale, and the figures beside it.

    Args:
        source: as the user called it.
        ramp: what colours show at first.
        record: what records the source, where it can be.
        duration: seconds after which the window closes; None leaves that to the keys.
    """

    def __init__(
        self, feed: Feed, source: str, *, ramp: str = "range", record: Switch | None = None, duration: float | None = None
    ) -> None:
        self._feed, self._source, self._record = feed, source, record
        self._live = feed.device.is_live
        self.choice = Choice(ramp)
        self._scan: Scan | None = None
        self._look: Look | None = None
        self._reading: Reading | None = None
        self._read_at = time.monotonic()
        self._end = self._read_at + (math.inf if duration is None else duration)

    def run(self, screen: Screen) -> None:
        """Draw until somebody has had enough.

        Raises:
            LidarSpecError: what ended the input, where it was a failure.
        """
        drawn, shown, size = 0.0, -1, (0, 0)
        while not self.choice.done and time.monotonic() < self._end:
            keys = self._wait(screen, time.monotonic() + FRAME)
            for key in keys:
                self._press(key)
            now = time.monotonic()
            fresh = self._feed.number != shown and not self.choice.paused
            if keys or fresh or now - drawn >= FIGURES / 2 or screen.size() != size:
                size = screen.size()
                screen.show(self.cells(*size))
                drawn, shown = now, self._feed.number

    def _wait(self, screen: Screen, until: float) -> list[str]:
        """Take in data until a picture is due; the keys that were pressed meanwhile."""
        if self._feed.ended or (self.choice.paused and not self._live):
            self._feed.rest()
            return screen.keys.read(FRAME)
        self._feed.pump(until)
        return screen.keys.read(0)

    def cells(self, columns: int, lines: int) -> Cells:
        """The window as it is now."""
        self._take()
        layout = Layout.of(columns, lines)
        found = self._current_look()
        points = self._scan.points if self._scan is not None else None
        drawn = (
            Cells.blank(layout.width, layout.height)
            if points is None
            else picture(points, width=layout.width, height=layout.height, look=found)
        )
        told = self._complaint()
        if told:
            note = message(layout.width, told)
            drawn.paste(max((layout.height - note.size[1]) // 2, 0), (layout.width - note.size[0]) // 2, note)
        whole = composed(columns, lines, self._title(), drawn, self._figures(), found)
        if self.choice.helped:
            page = help_page(columns, lines)
            whole.paste(max((lines - page.size[1]) // 2, 0), max((columns - page.size[0]) // 2, 0), page)
        return whole

    def _press(self, key: str) -> None:
        self.choice = self.choice.after(key, self._current_look().reach)
        if key in ("r", "R") and self._record is not None:
            self._record.toggle()

    def _take(self) -> None:
        """The newest scan and figures."""
        now, newest = time.monotonic(), self._feed.scan
        if now - self._read_at >= FIGURES:
            self._reading = self._feed.meter.reading(self._feed.device.stats, now - self._read_at if self._live else None)
            self._read_at = now
        if newest is None or newest is self._scan or (self.choice.paused and self._scan is not None):
            return
        self._scan = newest
        found, before = look(self._scan.points, ramp=self.choice.ramp), self._look
        if before is not None and _fits(found.reach, before.reach):
            found = replace(found, reach=before.reach)
        if before is not None and before.ramp == found.ramp and _fits(found.full, before.full):
            found = replace(found, full=before.full)
        self._look = found

    def _current_look(self) -> Look:
        """The scale of all of it, with what the keys have changed."""
        if self._look is None:
            return Look("range", 1.0, 1.0)
        if self._scan is not None and self._look.ramp != self.choice.ramp:
            found = look(self._scan.points, ramp=self.choice.ramp)
            self._look = replace(found, reach=self._look.reach)
            self.choice = replace(self.choice, ramp=found.ramp)
        return replace(self._look, reach=self._look.reach / self.choice.zoom, middle=self.choice.middle)

    def _title(self) -> Title:
        device, choice = self._feed.device, self.choice
        if self._record is not None and self._record.name is not None:
            state, ink = f"● {self._record.name}", ALARM
        elif choice.paused:
            state, ink = "‖ paused", STRONG
        elif not self._live:
            state, ink = ("end", STRONG) if self._feed.ended else ("▶ playing", GOOD)
        else:
            state, ink = ("● live", GOOD) if device.state == "streaming" else (device.state, ALARM)
        return Title(device.sensor.id, self._source, state, ink)

    def _figures(self) -> list[Figure]:
        device = self._feed.device
        points = self._scan.points if self._scan is not None else None
        valid = points.range[points.valid] if points is not None else np.empty(0)
        near = float(valid.min()) if len(valid) else None
        return figures_of(
            self._reading,
            points=0 if points is None else len(points),
            valid=len(valid),
            near=near if near is not None and math.isfinite(near) else None,
            lost=device.stats.lost,
            queue=None if device.queued is None else str(device.queued),
        )

    def _complaint(self) -> str:
        """What is to be said in place of points."""
        device = self._feed.device
        if self._record is not None and self._record.trouble:
            return self._record.trouble
        if self._feed.ended:
            return "" if self._scan is not None else "the input ended without a scan"
        troubled = self._live and device.state not in ("streaming", "waiting")
        return device.warnings[-1] if troubled and device.warnings else ""


def _fits(needed: float, kept: float) -> bool:
    """Whether a scale can stay, so that the picture does not breathe with every scan."""
    return ROOMY * kept <= needed <= kept
