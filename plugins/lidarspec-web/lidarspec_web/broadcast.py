"""A source that is read once and shown to any number of viewers: the newest scan, how the sensor is
doing, its newest bytes.

One thread reads, and whoever asks in another sees what has come by then. A file is played: it can
be paused, moved through, and played at another speed, for all viewers together. What is live goes
on whatever they do.
"""

from __future__ import annotations

import threading
import time
import weakref
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from lidarspec import Device, LidarSpecError, Scan, Selection, UsageError
from lidarspec.recording.switch import RecordingSwitch
from lidarspec.transports.host_clock import HostClock
from lidarspec.transports.protocol import Closing
from lidarspec.view.feed import LOOK, STEP, Feed
from lidarspec_web.backlog import Backlog
from lidarspec_web.scan_message import message

#: seconds of figures that are kept, and how fast a file is played at the slowest and the fastest.
HISTORY, SLOWEST, FASTEST = 60.0, 0.01, 100.0
#: seconds after which a picture that stands is looked at again.
IDLE = 0.25
#: seconds between two readings of the figures.
FIGURES = 1.0


class Shown:
    """A scan as viewers are shown it.

    Attributes:
        number: how many were shown before it.
        position: seconds from the first scan of the source.
        sent: when its last packet arrived; of a file, when it was shown; seconds since 1970.
    """

    def __init__(self, scan: Scan, number: int, position: float, sent: float) -> None:
        self.scan, self.number, self.position, self.sent = scan, number, position, sent
        self._message, self._most = b"", -1

    def message(self, most: int) -> bytes:
        """The scan as a message of so many points at most, made once for all who ask alike."""
        if most != self._most:
            self._message = message(
                self.scan, self.number, position=self.position, sent=self.sent, most=most
            )
            self._most = most
        return self._message


class Broadcast(Closing):
    """A device that is read for viewers.

    Args:
        source: as the user called it.
        device: open; closed with this.
        reopened: opens the source once more, where it is a file that is moved through.
        select: which scans, and what of each.
        switch: what records the source, where it is live.

    Attributes:
        shown: the newest scan; None before there is one.
        backlog: the newest bytes.
        paused, speed: of a file.
        warnings, info: those of the device.
        history: the figures of the last minute, one after another, by name.
        failure: what ended the reading; None while it goes on.
        news: called in the thread that reads, whenever there is something new.
    """

    def __init__(
        self,
        source: str,
        device: Device,
        *,
        reopened: Callable[[], Device],
        select: Selection | None = None,
        switch: RecordingSwitch | None = None,
    ) -> None:
        self.source, self.device, self.switch = source, device, switch
        self._reopened = reopened
        self._select = select or Selection()
        self.shown: Shown | None = None
        self.paused, self.speed = False, 1.0
        self.warnings, self.info = list[str](), dict[str, str]()
        self.history = deque[dict[str, Any]](maxlen=round(HISTORY / FIGURES))
        self.failure: LidarSpecError | None = None
        self.news: Callable[[], None] = lambda: None
        self.backlog = Backlog(device.sensor)
        self._numbered = weakref.WeakValueDictionary[int, Shown]()
        self._number, self._seen, self._has_ended = 0, 0, False
        self._first: Scan | None = None
        self._moved, self._steps = False, 0
        self._target: float | None = None
        self._stirred, self._stopped, self._measured = threading.Event(), False, time.monotonic()
        self._clock = HostClock()
        self._feed = self._fed(self._select)

    @property
    def is_live(self) -> bool:
        """Whether data come at their own pace, and not from a file."""
        return self.device.is_live

    @property
    def can_seek(self) -> bool:
        """Whether it can be moved through: a file, of which no scans were chosen by time or number."""
        return not self.is_live and not self._select.is_counted and self.source != "-"

    @property
    def state(self) -> str:
        """What `Device.state` says; of a file "playing", "paused" or "ended"."""
        if self.is_live:
            return self.device.state
        return "ended" if self._feed.ended else "paused" if self.paused else "playing"

    @property
    def has_ended(self) -> bool:
        """Whether nothing more comes, unless a file is played again."""
        return self.failure is not None or self._has_ended

    @property
    def ending(self) -> str:
        """Why nothing more comes."""
        if self.failure is not None:
            return str(self.failure)
        return "; ".join([f"{self.source} has ended", *self.warnings])

    def now(self) -> float:
        """Seconds since 1970, as times of arrival count them."""
        return self._clock.now() * 1e-9

    @property
    def began_ns(self) -> int:
        """When the first packet of the first scan arrived, ns since 1970; 0 where nobody knows it."""
        return self._first.host_ns if self._first is not None else 0

    def numbered(self, number: int) -> Shown | None:
        """A scan by its number, while anybody holds it."""
        return self._numbered.get(number)

    def pause(self) -> None:
        """Let a file stand still."""
        self._refuse_live("pauses for its viewers, each by itself")
        self.paused = True

    def play(self) -> None:
        """Go on; a file that has ended begins anew."""
        self._refuse_live("plays by itself")
        if self._feed.ended:
            self.seek(0.0)
        self.paused = False
        self._stirred.set()

    def step(self) -> None:
        """Show the next scan, and stand still there."""
        self._refuse_live("has no next scan before it comes")
        self.paused = True
        self._steps += 1
        self._stirred.set()

    def seek(self, to: float) -> None:
        """Go on from a time, in seconds from the first scan."""
        if not self.can_seek:
            raise UsageError(f"{self.source} cannot be moved through")
        self._target = max(to, 0.0)
        self._stirred.set()

    def play_at(self, times: float) -> None:
        """Play so many times as fast as it was."""
        self._refuse_live("comes as fast as it does")
        if not SLOWEST <= times <= FASTEST:
            raise UsageError(
                f"a file is played {SLOWEST:g} to {FASTEST:g} times as fast, not {times:g} times"
            )
        self.speed = times

    def run(self, until: float) -> None:
        """Read up to a time of `time.monotonic`, or until it is stopped.

        Raises:
            LidarSpecError: where the source fails; `failure` has it then.
        """
        try:
            while not self._stopped and time.monotonic() < until:
                self._turn()
        except LidarSpecError as error:
            self.failure = error
            self.news()
            raise

    def stop(self) -> None:
        """Let `run` end."""
        self._stopped = True
        self._stirred.set()

    def close(self) -> None:
        """Give the source back."""
        self.device.close()

    def _turn(self) -> None:
        """Read for a moment, or stand still for one."""
        feed, target = self._feed, self._target
        if target is not None:
            self._target = None
            self._move(target)
        elif self._steps:
            self._steps -= 1
            self._guarded(feed.step)
        elif self.is_live or not (self.paused or feed.ended):
            feed.speed = self.speed
            self._guarded(lambda: feed.pump(time.monotonic() + LOOK))
        else:
            feed.rest()
            self._stirred.wait(IDLE)
            self._stirred.clear()
        self._look()

    def _guarded(self, read: Callable[[], None]) -> None:
        """Read; behind the end of a file that was moved through there is nothing."""
        try:
            read()
        except UsageError:
            if not self._moved:
                raise

    def _move(self, target: float) -> None:
        """Open a file once more, and show its first scan from a time on."""
        device = self._reopened()
        self.device.close()
        self.device, self._moved = device, target > 0
        self.backlog.forget()
        self._seen = 0
        self._feed = self._fed(
            replace(self._select, times=(target, None)) if target else self._select
        )
        self._guarded(self._feed.step)

    def _fed(self, select: Selection) -> Feed:
        self.device.observe(self.backlog)
        return Feed(self.device, played=True, select=select)

    def _look(self) -> None:
        """Take note of a new scan, and of how the sensor is doing."""
        feed, now, is_new = self._feed, time.monotonic(), False
        if feed.scan is not None and feed.number != self._seen:
            self._seen, is_new = feed.number, True
            self._first = self._first or next(iter(feed.scans), feed.scan)
            self.shown = Shown(
                feed.scan, self._number, self._position(feed.scan), self._sent(feed.scan)
            )
            self._numbered[self._number] = self.shown
            self._number += 1
        if now - self._measured >= FIGURES:
            if self.is_live or not (self.paused or feed.ended):
                self.history.append(self._figures(now - self._measured))
            self.warnings, self.info = self.device.warnings, self.device.info
            self._measured, is_new = now, True
        if is_new or feed.ended != self._has_ended:
            self._has_ended = feed.ended
            self.warnings = self.device.warnings if feed.ended else self.warnings
            self.news()

    def _figures(self, seconds: float) -> dict[str, Any]:
        stats = self.device.stats
        reading = self._feed.meter.reading(stats, seconds if self.is_live else None).to_dict()
        at = self.now()
        latency = at - self.shown.sent if self.is_live and self.shown is not None else None
        return {
            "at": at,
            **reading,
            "lost": stats.lost,
            "disconnects": stats.disconnects,
            "latency_s": latency,
        }

    def _sent(self, scan: Scan) -> float:
        """When the last packet of a scan arrived; of a file: now."""
        arrived = scan.provenance(len(scan) - 1).host_ns if self.is_live and len(scan) else 0
        return arrived * 1e-9 if arrived else self.now()

    def _position(self, scan: Scan) -> float:
        """Seconds from the first scan: by arrival, of a file as its scans are selected, or by their
        number where they bear no times.
        """
        assert self._first is not None
        if self.is_live:
            return (scan.host_ns - self._first.host_ns) * 1e-9
        has_times = scan.host_ns or scan.sensor.clock is not None
        return (scan.stamp_ns - self._first.stamp_ns) * 1e-9 if has_times else self._number * STEP

    def _refuse_live(self, reason: str) -> None:
        if self.is_live:
            raise UsageError(f"{self.source} is live, and {reason}")
