"""The window that shows a sensor at work: keys in, pictures out, a dozen times a second at most.

Around the picture stand title, figures, the meaning of the colours and the keys.
"""

from __future__ import annotations

import math
import textwrap
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidarspec.points.look import STEPS, Look, look, ramps
from lidarspec.recording.switch import RecordingSwitch
from lidarspec.scans.scans import Scan
from lidarspec.view.canvas import ALARM, FAINT, FIRST_STEP, GOOD, LABEL, PLAIN, STRONG, Cells
from lidarspec.view.feed import NOTHING, Feed, Reading, told
from lidarspec.view.polar import picture
from lidarspec.view.screen import Screen

#: seconds from picture to picture at least, and between two readings of the figures.
FRAME, FIGURES = 0.08, 1.0
#: what one key press zooms by, and the share of the picture that it moves.
ZOOM, MOVE = 1.25, 0.2
#: a picture that is found to need less than this share of its reach is drawn larger.
ROOMY = 0.7
_MOVES = {"up": (1, 0), "down": (-1, 0), "left": (0, 1), "right": (0, -1)}
#: cells of the figures beside the picture, and of the narrowest picture that has them there.
BESIDE, NARROWEST = 25, 36
#: from what error or loss rate on a figure is an alarm.
ALARMING = 0.01
KEYS = (
    ("space", "pause and go on"),
    ("c", "what colours show"),
    ("+ -", "zoom in and out"),
    ("arrows", "move what is in the middle"),
    ("0", "all of it again"),
    ("r", "record to a file, and stop; not of files"),
    ("q", "quit"),
    ("?", "this page"),
)
_HINTS = (("space pause", "c colour"), ("+ - zoom", "0 all"), ("? help", "q quit"))

Figure = tuple[str, str, int]


def _write_beside(whole: Cells, left: int, figures: Sequence[Figure], look: Look) -> None:
    """What stands beside the picture: figures, the meaning of the colours, keys."""
    columns, lines = whole.size
    for row in range(1, lines):
        whole.write(row, left, "│", FAINT)
    for row, (name, value, ink) in enumerate(figures[: lines - 1], start=1):
        whole.write(row, left + 2, name, LABEL)
        whole.write(row, columns - 1 - len(value), value, ink)
    row = len(figures) + 2
    if row + 2 <= lines - len(_HINTS):
        _write_ramp(whole, row, left + 2, look)
    if row + 2 <= lines - len(_HINTS) - 1:
        for place, (first, second) in enumerate(_HINTS):
            whole.write(lines - len(_HINTS) + place, left + 2, f"{first:<13}{second}", FAINT)


def help_page(columns: int, lines: int) -> Cells:
    """The keys, in a box, for the middle of a window."""
    width = min(max(len(text) for _, text in KEYS) + 14, columns)
    page = Cells.blank(width, min(len(KEYS) + 4, lines))
    page.write(0, 0, "─" * width, FAINT)
    page.write(0, 2, " keys ", LABEL)
    for row, (key, text) in enumerate(KEYS, start=2):
        page.write(row, 3, key, STRONG)
        page.write(row, 11, text)
    page.write(page.size[1] - 1, 0, "─" * width, FAINT)
    return page


def message(columns: int, text: str) -> Cells:
    """Some lines of text for the middle of a picture."""
    lines = textwrap.wrap(text, max(columns - 4, 1))
    found = Cells.blank(min(max(map(len, lines)) + 4, columns), len(lines) + 2)
    for row, line in enumerate(lines, start=1):
        found.write(row, 2, line, ALARM)
    return found


def _write_title(whole: Cells, sensor: str, source: str, state: str, ink: int) -> None:
    room = whole.size[0] - len(sensor) - len(state) - 6
    shown = (
        source
        if len(source) <= room
        else "..." + source[len(source) - room + 3 :]
        if room > 8
        else ""
    )
    whole.write(0, 1, sensor, STRONG)
    whole.write(0, len(sensor) + 3, shown, LABEL)
    whole.write(0, whole.size[0] - len(state) - 1, state, ink)


def _write_line(whole: Cells, figures: Sequence[Figure]) -> None:
    columns, lines = whole.size
    column = 1
    for name, value, ink in figures:
        if value == "-":
            continue
        if column + len(name) + len(value) + 1 >= columns:
            break
        whole.write(lines - 1, column, name, LABEL)
        whole.write(lines - 1, column + len(name) + 1, value, ink)
        column += len(name) + len(value) + 3


def _write_ramp(whole: Cells, row: int, column: int, look: Look) -> None:
    """What the colours mean: a bar of the ramp, and the values at its ends."""
    for step in range(STEPS):
        whole.write(row, column + step, "━", FIRST_STEP + step)
    begin, end = look.ends
    whole.write(row + 1, column, begin, LABEL)
    whole.write(row + 1, column + (STEPS - len(look.ramp)) // 2, look.ramp, LABEL)
    whole.write(row + 1, column + STEPS - len(end), end, LABEL)


def _rate(name: str, rate: float | None) -> Figure:
    return name, told(rate, "{:.2f} %", 100), ALARM if (rate or 0.0) >= ALARMING else PLAIN


@dataclass(frozen=True)
class Choice:
    """What the keys have chosen.

    Attributes:
        ramp: what colours show.
        zoom: how many times larger than all of it.
        middle: what is in the middle, metres forward and left of the sensor.
        paused, helped, done: whether the picture stands, the keys are listed, the window is to
            close.
    """

    ramp: str = "range"
    zoom: float = 1.0
    middle: tuple[float, float] = (0.0, 0.0)
    paused: bool = False
    helped: bool = False
    done: bool = False

    def after(
        self, key: str, reach: float, ramps: Sequence[str] = ("range", "intensity")
    ) -> Choice:
        """The choice after a key press; `reach` is what is shown now, in metres, and `ramps` what
        colours can show.
        """
        if key in ("q", "Q"):
            return replace(self, done=True)
        if key == " ":
            return replace(self, paused=not self.paused)
        if key in ("c", "C"):
            following = ramps.index(self.ramp) + 1 if self.ramp in ramps else 0
            return replace(self, ramp=ramps[following % len(ramps)])
        if key in ("+", "="):
            return replace(self, zoom=min(self.zoom * ZOOM, 1e3))
        if key in ("-", "_"):
            return replace(self, zoom=max(self.zoom / ZOOM, 1e-2))
        if key == "0":
            return replace(self, zoom=1.0, middle=(0.0, 0.0))
        if key in _MOVES:
            forward, left = (
                self.middle[axis] + _MOVES[key][axis] * MOVE * reach for axis in (0, 1)
            )
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
        self,
        feed: Feed,
        source: str,
        *,
        ramp: str = "range",
        record: RecordingSwitch | None = None,
        duration: float | None = None,
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
        """The window as it is now; the figures stand beside the picture, or below it in one line
        where the window is narrow.
        """
        self._take()
        is_wide = columns >= NARROWEST + BESIDE + 1 and lines >= 14
        width, height = (
            columns - BESIDE - 1 if is_wide else columns,
            max(lines - (1 if is_wide else 2), 1),
        )
        look, scan, complaint = self._current_look(), self._scan, self._complaint()
        drawn = (
            Cells.blank(width, height)
            if scan is None
            else picture(scan.points, width=width, height=height, look=look)
        )
        if complaint:
            note = message(width, complaint)
            drawn.paste(max((height - note.size[1]) // 2, 0), (width - note.size[0]) // 2, note)
        whole = Cells.blank(columns, lines)
        _write_title(whole, self._feed.device.sensor.id, self._source, *self._state())
        whole.paste(1, 0, drawn)
        if is_wide:
            _write_beside(whole, width, self._figures(), look)
        else:
            _write_line(whole, self._figures())
        if self.choice.helped:
            page = help_page(columns, lines)
            whole.paste(
                max((lines - page.size[1]) // 2, 0), max((columns - page.size[0]) // 2, 0), page
            )
        return whole

    def _press(self, key: str) -> None:
        known = ramps(self._scan.points) if self._scan is not None else ["range", "intensity"]
        self.choice = self.choice.after(key, self._current_look().reach, known)
        if key in ("r", "R") and self._record is not None:
            self._record.toggle()

    def _take(self) -> None:
        """The newest scan and figures."""
        now, newest = time.monotonic(), self._feed.scan
        if now - self._read_at >= FIGURES:
            self._reading = self._feed.meter.reading(
                self._feed.device.stats, now - self._read_at if self._live else None
            )
            self._read_at = now
        if (
            newest is None
            or newest is self._scan
            or (self.choice.paused and self._scan is not None)
        ):
            return
        self._scan = newest
        found, before = look(self._scan.points, ramp=self.choice.ramp), self._look
        if before is not None and _fits(found.reach, before.reach):
            found = replace(found, reach=before.reach)
        if before is not None and before.ramp == found.ramp and _fits(found.full, before.full):
            found = replace(found, full=before.full, low=min(before.low, found.low))
        self._look = found

    def _current_look(self) -> Look:
        """The scale of all of it, with what the keys have changed."""
        if self._look is None:
            return Look("range", 1.0, 1.0)
        if self._scan is not None and self._look.ramp != self.choice.ramp:
            found = look(self._scan.points, ramp=self.choice.ramp)
            self._look = replace(found, reach=self._look.reach)
            self.choice = replace(self.choice, ramp=found.ramp)
        return replace(
            self._look, reach=self._look.reach / self.choice.zoom, middle=self.choice.middle
        )

    def _state(self) -> tuple[str, int]:
        """What is going on, in a word, and the ink of it."""
        device = self._feed.device
        if self._record is not None and (recording := self._record.recording) is not None:
            return f"● {recording[0]}", ALARM
        if self.choice.paused:
            return "‖ paused", STRONG
        if not self._live:
            return ("end", STRONG) if self._feed.ended else ("▶ playing", GOOD)
        return ("● live", GOOD) if device.state == "streaming" else (device.state, ALARM)

    def _figures(self) -> list[Figure]:
        """The figures of the last moments and of the scan that is shown, each with its ink."""
        device, reading = self._feed.device, self._reading or NOTHING
        points = len(self._scan) if self._scan is not None else 0
        valid = (
            self._scan.points.range[self._scan.points.valid]
            if self._scan is not None
            else np.empty(0)
        )
        near = float(valid.min()) if len(valid) else math.nan
        lost = device.stats.lost
        figures = [
            ("speed", told(reading.speed_hz, "{:.1f} Hz"), STRONG),
            ("packets", told(reading.packet_rate_hz, "{:.0f} /s"), PLAIN),
            ("input", told(reading.bytes_per_s, "{:.1f} kB/s", 1e-3), PLAIN),
            *(
                [("calibration", "nominal", ALARM)]
                if self._scan is not None and self._scan.points.nominal
                else []
            ),
            ("points", str(points), PLAIN),
            ("valid", told(len(valid) / points if points else None, "{:.1f} %", 100), PLAIN),
            ("nearest", told(near, "{:.2f} m"), PLAIN),
            _rate("errors", reading.error_rate if self._reading else None),
            _rate("skipped", reading.skipped_rate if self._reading else None),
            (
                "lost",
                str(lost) if lost or reading.loss_rate is not None else "-",
                ALARM if lost else PLAIN,
            ),
            ("jitter", told(reading.jitter_s, "{:.2f} ms", 1e3), PLAIN),
        ]
        return (
            figures if device.queued is None else [*figures, ("queue", str(device.queued), PLAIN)]
        )

    def _complaint(self) -> str:
        """What is to be said in place of points."""
        device = self._feed.device
        if self._record is not None and self._record.trouble:
            return self._record.trouble
        failure = device.stats.failure(device.sensor.id)
        if failure is not None:
            return str(failure)
        if self._feed.ended:
            return (
                ""
                if self._scan is not None
                else (device.warnings or ["the input ended without a scan"])[-1]
            )
        troubled = self._live and device.state not in ("streaming", "waiting")
        return device.warnings[-1] if troubled and device.warnings else ""


def _fits(needed: float, kept: float) -> bool:
    """Whether a scale can stay, so that the picture does not breathe with every scan."""
    return ROOMY * kept <= needed <= kept
