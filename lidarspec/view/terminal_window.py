"""The terminal window of a running sensor, drawn at most twelve times a second."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

from lidarspec.points.appearance import CloudAppearance, choose_appearance, list_ramps
from lidarspec.recording.recorder_switch import RecordingSwitch
from lidarspec.scans.scan import Scan
from lidarspec.view.canvas import ALARM, GOOD, PLAIN, STRONG, CellGrid
from lidarspec.view.live_scans import LiveScans
from lidarspec.view.polar import draw_cloud
from lidarspec.view.rate_meter import EMPTY_READING, MeterReading, format_number
from lidarspec.view.terminal_screen import Screen
from lidarspec.view.terminal_window_parts import (
    WindowFigure,
    draw_keys,
    draw_message,
    write_last_line,
    write_side,
    write_title,
)

#: minimum time between two pictures.
FRAME_PERIOD_S = 0.08
#: time between two readings of the statistics.
FIGURES_PERIOD_S = 1.0
#: zoom factor of one key press. The next constants are the limits of the zoom.
ZOOM_FACTOR = 1.25
MAX_ZOOM = 1e3
MIN_ZOOM = 1e-2
#: movement of one key press, as a share of the distance from the middle of the picture to its edge.
MOVE_SHARE = 0.2
#: key -> (movement forward, movement to the left).
MOVES = {"up": (1, 0), "down": (-1, 0), "left": (0, 1), "right": (0, -1)}
#: if the points need less than this share of the picture, the scale is enlarged.
MIN_USED_SHARE = 0.7
#: width of the column with statistics at the right of the picture, in characters.
SIDE_COLUMNS = 25
#: minimum width of the picture if the statistics are at its right. If the picture would be
#: narrower, or the window has fewer than `MIN_SIDE_LINES`, the statistics are in the last line.
MIN_PICTURE_COLUMNS = 36
MIN_SIDE_LINES = 14
#: an error or loss rate from this value on is shown as an alarm.
ALARM_RATE = 0.01
DEFAULT_RAMPS = ("range", "intensity")


@dataclass(frozen=True)
class ViewSettings:
    """The settings that keys change.

    Attributes:
        ramp: the column of the points that determines their colours.
        zoom: magnification; 1.0 shows all points.
        middle: the middle of the picture, in metres forward and left of the sensor.
        shows_keys: whether the list of keys is shown.
        is_closing: whether the window is to be closed.
    """

    ramp: str = "range"
    zoom: float = 1.0
    middle: tuple[float, float] = (0.0, 0.0)
    paused: bool = False
    shows_keys: bool = False
    is_closing: bool = False

    def after_key(
        self, key: str, reach: float, ramps: Sequence[str] = DEFAULT_RAMPS
    ) -> ViewSettings:
        """Return the settings after a key press.

        Args:
            reach: distance from the middle of the picture to its edge, in metres.
            ramps: the columns of the points that can determine their colours.
        """
        if key in ("q", "Q"):
            return replace(self, is_closing=True)
        if key == " ":
            return replace(self, paused=not self.paused)
        if key in ("c", "C"):
            return replace(self, ramp=self._next_ramp(ramps))
        if key in ("+", "="):
            return replace(self, zoom=min(self.zoom * ZOOM_FACTOR, MAX_ZOOM))
        if key in ("-", "_"):
            return replace(self, zoom=max(self.zoom / ZOOM_FACTOR, MIN_ZOOM))
        if key == "0":
            return replace(self, zoom=1.0, middle=(0.0, 0.0))
        if key in MOVES:
            step = MOVE_SHARE * reach
            forward, left = MOVES[key]
            middle = (self.middle[0] + forward * step, self.middle[1] + left * step)
            return replace(self, middle=middle)
        if key in ("?", "h"):
            return replace(self, shows_keys=not self.shows_keys)
        if key == "escape":
            return replace(self, shows_keys=False)
        return self

    def _next_ramp(self, ramps: Sequence[str]) -> str:
        if self.ramp not in ramps:
            return ramps[0]
        return ramps[(ramps.index(self.ramp) + 1) % len(ramps)]


class Window:
    """Shows the scans of a device, with statistics.

    Args:
        live: the scans of the open device.
        source: the SOURCE as typed by the user.
        ramp: the column of the points that determines their colours until a key changes it.
        record: switches the recording of a live source on and off; None for a file.
        duration: seconds after which the window closes; None if only a key closes it.
    """

    def __init__(
        self,
        live: LiveScans,
        source: str,
        *,
        ramp: str = "range",
        record: RecordingSwitch | None = None,
        duration: float | None = None,
    ) -> None:
        self._live = live
        self._device = live.device
        self._source = source
        self._record = record
        self.settings = ViewSettings(ramp)
        self._scan: Scan | None = None
        self._look: CloudAppearance | None = None
        self._reading: MeterReading | None = None
        self._read_at = time.monotonic()
        if duration is None:
            self._end = math.inf
        else:
            self._end = self._read_at + duration

    def run(self, screen: Screen) -> None:
        """Draw until the user quits or the duration is over.

        Raises:
            LidarSpecError: if the source fails.
        """
        drawn_at = 0.0
        drawn_number = -1
        drawn_size = (0, 0)
        while not self.settings.is_closing and time.monotonic() < self._end:
            keys = self._wait(screen)
            for key in keys:
                self._handle_key(key)
            now = time.monotonic()
            has_scan = self._live.number != drawn_number and not self.settings.paused
            is_old = now - drawn_at >= FIGURES_PERIOD_S / 2
            size = screen.size()
            if keys or has_scan or is_old or size != drawn_size:
                screen.show(self.cells(*size))
                drawn_at = now
                drawn_number = self._live.number
                drawn_size = size

    def _wait(self, screen: Screen) -> list[str]:
        """Read data until the next picture is due, and return the pressed keys."""
        if self._live.ended or (self.settings.paused and not self._device.is_live):
            self._live.stop_clock()
            return screen.keys.read(FRAME_PERIOD_S)
        self._live.read(time.monotonic() + FRAME_PERIOD_S)
        return screen.keys.read(0)

    def cells(self, columns: int, lines: int) -> CellGrid:
        """Return a picture of the window, with the statistics at the right or in the last line."""
        self._update_reading()
        self._update_scan()
        is_wide = columns > MIN_PICTURE_COLUMNS + SIDE_COLUMNS and lines >= MIN_SIDE_LINES
        width = columns - SIDE_COLUMNS - 1 if is_wide else columns
        height = max(lines - (1 if is_wide else 2), 1)
        current_look = self._get_current_look()
        window = CellGrid.blank(columns, lines)
        window.paste(1, 0, self._draw_picture(width, height, current_look))
        write_title(window, self._device.sensor.id, self._source, *self._describe_state())
        if is_wide:
            write_side(window, width, self._list_figures(), current_look)
        else:
            write_last_line(window, self._list_figures())
        if self.settings.shows_keys:
            _paste_in_middle(window, draw_keys(columns, lines))
        return window

    def _draw_picture(self, width: int, height: int, current_look: CloudAppearance) -> CellGrid:
        """Draw the scan, and the current warning, if any, in the middle."""
        if self._scan is None:
            drawn = CellGrid.blank(width, height)
        else:
            drawn = draw_cloud(self._scan.points, width=width, height=height, look=current_look)
        warning = self._find_warning()
        if warning:
            _paste_in_middle(drawn, draw_message(width, warning))
        return drawn

    def _handle_key(self, key: str) -> None:
        ramps = DEFAULT_RAMPS if self._scan is None else list_ramps(self._scan.points)
        self.settings = self.settings.after_key(key, self._get_current_look().reach, ramps)
        if key in ("r", "R") and self._record is not None:
            self._record.toggle()

    def _update_reading(self) -> None:
        """Read the statistics if a second has passed since the last reading."""
        now = time.monotonic()
        duration = now - self._read_at
        if duration < FIGURES_PERIOD_S:
            return
        seconds = duration if self._device.is_live else None
        self._reading = self._live.meter.take_reading(self._device.stats, seconds)
        self._read_at = now

    def _update_scan(self) -> None:
        """Use the newest scan; keep the scale of the previous scan if it still fits."""
        newest = self._live.scan
        if newest is None or newest is self._scan:
            return
        if self.settings.paused and self._scan is not None:
            return
        self._scan = newest
        new = choose_appearance(newest.points, ramp=self.settings.ramp)
        old = self._look
        if old is not None and _can_keep_scale(new.reach, old.reach):
            new = replace(new, reach=old.reach)
        if old is not None and old.ramp == new.ramp and _can_keep_scale(new.full, old.full):
            new = replace(new, full=old.full, low=min(old.low, new.low))
        self._look = new

    def _get_current_look(self) -> CloudAppearance:
        """Return the appearance of the picture, with the settings that keys have changed."""
        if self._look is None:
            return CloudAppearance("range", 1.0, 1.0)
        if self._scan is not None and self._look.ramp != self.settings.ramp:
            new = choose_appearance(self._scan.points, ramp=self.settings.ramp)
            self._look = replace(new, reach=self._look.reach)
            self.settings = replace(self.settings, ramp=new.ramp)
        reach = self._look.reach / self.settings.zoom
        return replace(self._look, reach=reach, middle=self.settings.middle)

    def _describe_state(self) -> tuple[str, int]:
        """Return the state of the source in one or two words, and the ink to show it in."""
        if self._record is None:
            recording = None
        else:
            recording = self._record.current_file
        if recording is not None:
            return f"● {recording[0]}", ALARM
        if self.settings.paused:
            return "‖ paused", STRONG
        if self._device.is_live:
            state = self._device.state
            if state == "streaming":
                return ("● live", GOOD)
            return (state, ALARM)
        if self._live.ended:
            return ("end", STRONG)
        return ("▶ playing", GOOD)

    def _list_figures(self) -> list[WindowFigure]:
        """Return the statistics of the last second and of the shown scan."""
        reading = self._reading or EMPTY_READING
        figures = [
            WindowFigure("speed", format_number(reading.speed_hz, "{:.1f} Hz"), STRONG),
            WindowFigure("packets", format_number(reading.packet_rate_hz, "{:.0f} /s")),
            WindowFigure("input", format_number(reading.bytes_per_s, "{:.1f} kB/s", 1e-3)),
            *self._list_scan_figures(),
            _make_rate_figure("errors", reading.error_rate if self._reading else None),
            _make_rate_figure("skipped", reading.skipped_rate if self._reading else None),
            self._make_lost_figure(reading),
            WindowFigure("jitter", format_number(reading.jitter_s, "{:.2f} ms", 1e3)),
        ]
        if self._device.queued is not None:
            figures.append(WindowFigure("queue", str(self._device.queued)))
        return figures

    def _list_scan_figures(self) -> list[WindowFigure]:
        """Return the statistics of the shown scan."""
        if self._scan is None:
            return [
                WindowFigure("points", "0"),
                WindowFigure("valid", "-"),
                WindowFigure("nearest", "-"),
            ]
        points = self._scan.points
        ranges = points.range[points.valid]
        if len(points):
            valid_share = len(ranges) / len(points)
        else:
            valid_share = None
        nearest = float(ranges.min()) if len(ranges) else None
        figures = [
            WindowFigure("points", str(len(points))),
            WindowFigure("valid", format_number(valid_share, "{:.1f} %", 100)),
            WindowFigure("nearest", format_number(nearest, "{:.2f} m")),
        ]
        if points.nominal:
            figures.insert(0, WindowFigure("calibration", "nominal", ALARM))
        return figures

    def _make_lost_figure(self, reading: MeterReading) -> WindowFigure:
        lost = self._device.stats.lost
        if lost:
            return WindowFigure("lost", str(lost), ALARM)
        return WindowFigure("lost", "-" if reading.loss_rate is None else "0")

    def _find_warning(self) -> str:
        """Return the warning for the middle of the picture; "" for no warning."""
        device = self._device
        if self._record is not None and self._record.trouble:
            return self._record.trouble
        failure = device.stats.failure(device.sensor.id)
        if failure is not None:
            return str(failure)
        warnings = device.warnings
        if self._live.ended:
            if self._scan is not None:
                return ""
            if warnings:
                return warnings[-1]
            return "the input ended without a scan"
        is_disturbed = device.is_live and device.state not in ("streaming", "waiting")
        if is_disturbed and warnings:
            return warnings[-1]
        return ""


def _make_rate_figure(name: str, rate: float | None) -> WindowFigure:
    is_alarm = rate is not None and rate >= ALARM_RATE
    return WindowFigure(name, format_number(rate, "{:.2f} %", 100), ALARM if is_alarm else PLAIN)


def _paste_in_middle(target: CellGrid, box: CellGrid) -> None:
    row = (target.size[1] - box.size[1]) // 2
    column = (target.size[0] - box.size[0]) // 2
    target.paste(max(row, 0), max(column, 0), box)


def _can_keep_scale(needed: float, kept: float) -> bool:
    """Return whether the scale of the previous scan is suitable for a new scan.

    Args:
        needed: the distance to show for the new scan, in metres.
        kept: the distance that the previous scale shows, in metres.
    """
    return MIN_USED_SHARE * kept <= needed <= kept
