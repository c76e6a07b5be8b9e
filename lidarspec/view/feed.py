"""What a device delivers, taken in between two pictures or two lines of figures: counted, and the newest scan kept."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

from lidarspec.device import Device
from lidarspec.packets import Packets
from lidarspec.scans import Scan, ScanStream
from lidarspec.view.meter import Meter

#: seconds from scan to scan of a file where their times do not say it, and the longest pause that is kept.
STEP, LONGEST = 0.1, 2.0
#: seconds that one look at a live source waits for data.
LOOK = 0.04


class Feed:
    """The scans of an open device.

    Args:
        device: open; stays so.
        played: scans of a file come at the times that they bear; else as fast as they are read.
        each: called with each batch of packets.
        seen: called with each scan and piece of one.

    Attributes:
        scan: the newest one; the first piece stands in until there is a whole one.
        number: how many scans have come.
        ended: whether the input has.
        meter: the figures.
    """

    def __init__(
        self,
        device: Device,
        *,
        played: bool = False,
        each: Callable[[Packets], None] | None = None,
        seen: Callable[[Scan], None] | None = None,
    ) -> None:
        self.device, self.number = device, 0
        self.scan: Scan | None = None
        self.meter = Meter(device.stats, sequenced=device.sensor.sequence is not None)
        self._played, self._each, self._seen = played and not device.is_live, each, seen
        self._packets, self._stream = device.packets(wait=LOOK), ScanStream(device.sensor, device.mount)
        self._waiting: deque[Scan] = deque()
        self._disconnects, self._read_out = 0, False
        self._due: float | None = None
        self._stamp = 0

    @property
    def ended(self) -> bool:
        """Whether everything was taken in."""
        return self._read_out and not self._waiting

    def pump(self, until: float) -> None:
        """Take in what comes until a time of `time.monotonic`, or the end; at least one look.

        Raises:
            LidarSpecError: where the source fails.
        """
        while not self.ended:
            if self._waiting:
                self._show_due(until)
            else:
                self._take()
            if time.monotonic() >= until:
                return

    def rest(self) -> None:
        """Let the time of a file stand still; call it while the picture does."""
        self._due = None

    def _take(self) -> None:
        """The next batch, or the end."""
        packets = next(self._packets, None)
        if packets is None:
            self._read_out = True
            self._keep(self._stream.finish())
            return
        if self.device.stats.disconnects != self._disconnects:
            self._disconnects = self.device.stats.disconnects
            self._keep(self._stream.finish())
            self._stream = ScanStream(self.device.sensor, self.device.mount)
        if len(packets):
            self.meter.packets(packets)
            self._keep(self._stream.add(packets))
            if self._each is not None:
                self._each(packets)

    def _keep(self, scans: list[Scan]) -> None:
        if self._played:
            self._waiting += scans
        else:
            for scan in scans:
                self._show(scan)

    def _show(self, scan: Scan) -> None:
        self.meter.scan(scan)
        if self._seen is not None:
            self._seen(scan)
        if scan.complete or self.scan is None or not self.scan.complete:
            self.scan = scan
            self.number += 1

    def _show_due(self, until: float) -> None:
        """The next scan of a file when it is due: as long after the one before as its time says."""
        scan = self._waiting[0]
        if self._due is None:
            self._due = time.monotonic()
        else:
            step = (scan.stamp_ns - self._stamp) * 1e-9
            due = max(self._due + (step if 0 < step <= LONGEST else STEP), time.monotonic() - LONGEST)
            if due > until:
                time.sleep(max(until - time.monotonic(), 0.0))
                return
            time.sleep(max(due - time.monotonic(), 0.0))
            self._due = due
        self._stamp = scan.stamp_ns
        self._show(self._waiting.popleft())
