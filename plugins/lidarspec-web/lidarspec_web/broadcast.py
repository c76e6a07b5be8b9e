"""Read a source once, and show it to any number of viewers.

One thread reads the source (`run`). Other threads use the newest scan, the statistics, and the
newest bytes. Each viewer, for example a page, can pause a file, continue the file at another
position, or change its speed; this affects all viewers. Viewers do not affect a live source.

Other threads only store their requests (`seek`, `step`, `play`). The reading thread performs them
in the next pass of its loop.
"""

from __future__ import annotations

import math
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from lidarspec import Device, LidarSpecError, Scan, Selection, UsageError
from lidarspec.explaining.clock_text import describe_clock
from lidarspec.packets.clock_monitor import ClockReport
from lidarspec.recording.recorder_switch import RecordingSwitch
from lidarspec.transports.host_clock import HostClock
from lidarspec.view.live_scans import DEFAULT_STEP_S, LOOK_S, LiveScans
from lidarspec_web.recent_bytes import RecentBytes
from lidarspec_web.scan_message import make_scan_message

#: Duration for which statistics are stored.
HISTORY_S = 60.0
#: Time between two readings of the statistics.
FIGURES_PERIOD_S = 1.0
#: Limits of the speed of a file, relative to real time.
MIN_SPEED = 0.01
MAX_SPEED = 100.0
#: Time between two checks for requests while a file is paused.
PAUSED_CHECK_S = 0.25


class ShownScan:
    """A scan that viewers show.

    Attributes:
        number: number of the shown scan, counted from 0.
        position: the time of the scan, in seconds after the first scan of the source.
        arrival: the arrival time of the scan's last packet, in seconds since 1970. For a file, it
            is the time at which the scan was read from the file.
    """

    def __init__(self, scan: Scan, number: int, position: float, arrival: float) -> None:
        self.scan = scan
        self.number = number
        self.position = position
        self.arrival = arrival
        self._message = b""
        self._message_max_points = -1

    def message(self, max_points: int) -> bytes:
        """Return the scan as a message of at most `max_points` points."""
        if max_points != self._message_max_points:
            self._message = make_scan_message(
                self.scan,
                self.number,
                position=self.position,
                arrival=self.arrival,
                max_points=max_points,
            )
            self._message_max_points = max_points
        return self._message


class Broadcast:
    """Reads a device for viewers. It is a context manager that closes the device.

    Args:
        reopen: a function that opens the source again; called to seek in a file.
        switch: the object that starts and stops recordings of a live source; None for a file.

    Attributes:
        shown: the newest scan; None before the first scan.
        paused: whether a file is paused.
        speed: speed of a file, relative to real time.
        info: facts about the device, for example its serial number, by name.
        clock: a description of the sensor's clock; "" if the sensor sends no time.
        history: the statistics of the last minute, one dict for each second.
        failure: the error that ended the reading; None if there was no error.
        on_news: a function that the reading thread calls when there is something new to show.
    """

    def __init__(
        self,
        source: str,
        device: Device,
        *,
        reopen: Callable[[], Device],
        select: Selection | None = None,
        switch: RecordingSwitch | None = None,
    ) -> None:
        self.source = source
        self.device = device
        self.switch = switch
        self.shown: ShownScan | None = None
        self.backlog = RecentBytes(device.sensor)
        self.paused = False
        self.speed = 1.0
        self.warnings: list[str] = []
        self.info: dict[str, str] = {}
        self.clock = ""
        self.history = deque[dict[str, Any]](maxlen=round(HISTORY_S / FIGURES_PERIOD_S))
        self.failure: LidarSpecError | None = None
        self.on_news: Callable[[], None] = lambda: None
        self._reopen = reopen
        self._select = select or Selection()
        self._clock = HostClock()
        self._first_scan: Scan | None = None
        self._scan_count = 0
        self._by_number = weakref.WeakValueDictionary[int, ShownScan]()
        self._seek_target: float | None = None
        self._steps = 0  # requested, but not done yet
        self._has_moved = False
        self._has_ended = False
        self._is_stopped = False
        self._has_request = threading.Event()
        self._measured_at = time.monotonic()
        self._feed = self._make_feed(self._select)
        self._seen_count = 0  # number of scans of the feed that were stored

    def __enter__(self) -> Broadcast:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def is_live(self) -> bool:
        """Whether data arrives from a sensor in real time, and not from a file."""
        return self.device.is_live

    @property
    def can_seek(self) -> bool:
        """Whether the source is a file that supports seeking."""
        return not self.is_live and not self._select.is_partial and self.source != "-"

    @property
    def state(self) -> str:
        """`Device.state` of a live source; "playing", "paused" or "ended" for a file."""
        if self.is_live:
            return self.device.state
        if self._feed.ended:
            return "ended"
        if self.paused:
            return "paused"
        return "playing"

    @property
    def has_ended(self) -> bool:
        """Whether the source has failed, or a file is at its end."""
        return self.failure is not None or self._has_ended

    @property
    def end_reason(self) -> str:
        """The reason why there are no more scans, if `has_ended`."""
        if self.failure is not None:
            return str(self.failure)
        return "; ".join([f"{self.source} has ended", *self.warnings])

    @property
    def start_ns(self) -> int:
        """The arrival time of the first scan's first packet, ns since 1970; 0 if unknown."""
        if self._first_scan is None:
            return 0
        return self._first_scan.host_ns

    def now(self) -> float:
        """Return the time in seconds since 1970, by the clock for arrival times."""
        return self._clock.now() * 1e-9

    def find_scan(self, number: int) -> ShownScan | None:
        """Return a scan by its number; None if it is no longer stored."""
        return self._by_number.get(number)

    def pause(self) -> None:
        """Pause a file.

        Raises:
            UsageError: if the source is live.
        """
        self._refuse_live("it cannot be paused, but each page can pause its own view")
        self.paused = True

    def play(self) -> None:
        """Continue to play a file; at the end of the file, begin again.

        Raises:
            UsageError: if the source is live.
        """
        self._refuse_live("only a file can be played")
        if self._feed.ended:
            self.seek(0.0)
        self.paused = False
        self._has_request.set()

    def step(self) -> None:
        """Show the next scan of a file, and pause at this scan.

        Raises:
            UsageError: if the source is live.
        """
        self._refuse_live("the next scan cannot be shown, because it has not arrived yet")
        self.paused = True
        self._steps += 1
        self._has_request.set()

    def seek(self, position: float) -> None:
        """Continue a file at a position, in seconds after its first scan.

        Raises:
            UsageError: if the source does not support seeking.
        """
        if not self.can_seek:
            raise UsageError(f"cannot seek in {self.source}")
        self._seek_target = max(position, 0.0)
        self._has_request.set()

    def set_speed(self, factor: float) -> None:
        """Play a file at a multiple of its recorded speed.

        Raises:
            UsageError: if the source is live, or the speed is out of range.
        """
        self._refuse_live("the speed cannot be changed")
        if not MIN_SPEED <= factor <= MAX_SPEED:
            raise UsageError(
                f"expected a speed from {MIN_SPEED:g} to {MAX_SPEED:g}, got {factor:g}"
            )
        self.speed = factor

    def run(self, until: float) -> None:
        """Read until a time of `time.monotonic`, or until `stop`.

        Raises:
            LidarSpecError: if the source fails; `failure` is set to this error.
        """
        try:
            while not self._is_stopped and time.monotonic() < until:
                self._read_or_wait()
                self._update()
        except LidarSpecError as error:
            self.failure = error
            self.on_news()
            raise

    def stop(self) -> None:
        """Make `run` return."""
        self._is_stopped = True
        self._has_request.set()

    def close(self) -> None:
        """Close the device."""
        self.device.close()

    def _read_or_wait(self) -> None:
        """Perform one stored request, read for a short time, or wait for a short time."""
        feed = self._feed
        target = self._seek_target
        if target is not None:
            self._seek_target = None
            self._reopen_at(target)
        elif self._steps:
            self._steps -= 1
            self._read(feed.step)
        elif self._is_playing:
            feed.speed = self.speed
            self._read(lambda: feed.read(time.monotonic() + LOOK_S))
        else:
            feed.stop_clock()
            self._has_request.wait(PAUSED_CHECK_S)
            self._has_request.clear()

    @property
    def _is_playing(self) -> bool:
        return self.is_live or not (self.paused or self._feed.ended)

    def _read(self, read: Callable[[], None]) -> None:
        """Read from the feed."""
        try:
            read()
        except UsageError:
            if not self._has_moved:
                raise

    def _reopen_at(self, target: float) -> None:
        """Open a file again, and show the first scan at or after `target`, in seconds."""
        device = self._reopen()
        self.device.close()
        self.device = device
        self._has_moved = target > 0
        self.backlog.forget()
        self._seen_count = 0
        select = self._select
        if self._has_moved:
            select = replace(select, times=(target, None))
        self._feed = self._make_feed(select)
        self._read(self._feed.step)

    def _make_feed(self, select: Selection) -> LiveScans:
        self.device.observe(self.backlog)
        return LiveScans(self.device, played=True, select=select)

    def _update(self) -> None:
        """Update the scan, the statistics and the state of the file."""
        has_news = self._update_scan()
        if self._update_statistics():
            has_news = True
        if self._update_end():
            has_news = True
        if has_news:
            self.on_news()

    def _update_scan(self) -> bool:
        """Update the shown scan, and return whether there is a new scan."""
        feed = self._feed
        if feed.scan is None or feed.number == self._seen_count:
            return False
        self._seen_count = feed.number
        if self._first_scan is None:
            self._first_scan = feed.scans[0] if feed.scans else feed.scan
        number = self._scan_count
        self.shown = ShownScan(
            feed.scan, number, self._find_position(feed.scan), self._find_arrival(feed.scan)
        )
        self._by_number[number] = self.shown
        self._scan_count += 1
        return True

    def _update_statistics(self) -> bool:
        """Read the statistics once a second, and return whether they were read."""
        now = time.monotonic()
        duration_s = now - self._measured_at
        if duration_s < FIGURES_PERIOD_S:
            return False
        self._measured_at = now
        if self._is_playing:
            self.history.append(self._make_statistics(duration_s))
        self.warnings = self.device.warnings
        self.info = self.device.info
        return True

    def _update_end(self) -> bool:
        """Return whether a file has ended or begun again since the last call."""
        ended = self._feed.ended
        if ended == self._has_ended:
            return False
        self._has_ended = ended
        if ended:
            self.warnings = self.device.warnings
        return True

    def _make_statistics(self, duration_s: float) -> dict[str, Any]:
        stats = self.device.stats
        reading = self._feed.meter.take_reading(stats, duration_s if self.is_live else None)
        now = self.now()
        latency_s = None
        if self.is_live and self.shown is not None:
            latency_s = now - self.shown.arrival
        clock = self._feed.clock.report()
        if self.device.sensor.clock is not None:
            self.clock = describe_clock(clock)
        return {
            "at": now,
            **reading.to_dict(),
            "clock_offset_s": self._find_clock_offset(clock),
            "lost": stats.lost,
            "incomplete_returns": stats.incomplete_returns,
            "disconnects": stats.disconnects,
            "latency_s": latency_s,
        }

    def _find_clock_offset(self, clock: ClockReport) -> float | None:
        """Return the seconds by which the sensor's clock is ahead; None if unknown."""
        if not math.isnan(clock.error_s):
            return clock.error_s
        samples = self._feed.clock.samples
        if not samples:
            return None
        return clock.offset_s - samples[0].offset_s

    def _find_arrival(self, scan: Scan) -> float:
        """Return the arrival time of a scan's last packet, in seconds since 1970."""
        if self.is_live and len(scan):
            host_ns = scan.provenance(len(scan) - 1).host_ns
            if host_ns:
                return host_ns * 1e-9
        return self.now()

    def _find_position(self, scan: Scan) -> float:
        """Return the position of a scan, in seconds after the first scan."""
        first = self._first_scan
        assert first is not None
        if self.is_live:
            return (scan.host_ns - first.host_ns) * 1e-9
        if scan.host_ns or scan.sensor.clock is not None:
            return (scan.stamp_ns - first.stamp_ns) * 1e-9
        return self._scan_count * DEFAULT_STEP_S

    def _refuse_live(self, reason: str) -> None:
        if self.is_live:
            raise UsageError(f"{self.source} is live: {reason}")
