"""The scans of an open device, between two pictures or two lines of figures.

`read` reads arrived data, counts it in a `RateMeter` and keeps the newest scan. A file can be
played: then each scan is shown as long after the one before as their times say, and little of the
file is read ahead, so that figures and bytes belong to the scan that is shown.
"""

from __future__ import annotations

import time
from collections import deque

import numpy as np
from numpy.typing import NDArray

from lidarspec.device.device import Device
from lidarspec.device.device_input import BATCH_BYTES
from lidarspec.packets.packets import Packets
from lidarspec.scans.scan import Scan
from lidarspec.scans.selection import ScanSelector, Selection, TimeSlice
from lidarspec.scans.stream import ScanStream
from lidarspec.view.rate_meter import RateMeter

#: seconds that one read of a live source waits for data.
LOOK_S = 0.04
#: seconds between scans of a file without times.
DEFAULT_STEP_S = 0.1
#: the longest pause between two scans of a file in seconds; longer ones become `DEFAULT_STEP_S`.
MAX_STEP_S = 2.0
#: seconds of a played file that one read covers.
READ_AHEAD_S = 0.1
#: bytes of the first read of a played file.
MIN_PORTION_BYTES = 1 << 12

Times = NDArray[np.int64]


class LiveScans:
    """Takes the scans of an open device.

    Raises:
        UsageError: for a sensor without points.

    Args:
        device: open; it is not closed.
        played: whether scans of a file are shown at their own times, or as fast as possible.
        speed: of a file that is played, as a multiple of its own.
        select: the scans to take; by default all.
        ahead: seconds of a file that is played that are read at once; None for as many as are
            decoded fastest.

    Attributes:
        speed: may be changed while a file is played.
        packets: the batch that was read last, None if nothing came.
        scans: the scans, and pieces of scans, of the last `read` or `step`.
        scan: the newest whole scan; before there is one, the newest piece.
        number: how often `scan` has changed.
        meter: counts packets and scans.
    """

    def __init__(
        self,
        device: Device,
        *,
        played: bool = False,
        speed: float = 1.0,
        select: Selection | None = None,
        ahead: float | None = READ_AHEAD_S,
    ) -> None:
        device.sensor.require_points()
        self.device = device
        self.speed = speed
        self.packets: Packets | None = None
        self.scans: list[Scan] = []
        self.scan: Scan | None = None
        self.number = 0
        self.meter = self._make_meter()
        self._select = select or Selection()
        self._sieve = ScanSelector(self._select, device.source, device.skip_until)
        self._times = TimeSlice(self._select.times)
        self._batches = device.packets(wait=LOOK_S)
        self._stream = ScanStream(device.sensor, device.mount)
        self._disconnects = 0
        self._has_counted = False
        self._is_read_out = False
        self._plays_in_real_time = played and not device.is_live
        self._waiting = deque[Scan]()  # scans of a file, until they are due
        self._due: float | None = None  # when the last scan was, by `time.monotonic`
        self._last_stamp_ns = 0
        self._read_ahead_s = ahead if self._plays_in_real_time else None
        self._portion = MIN_PORTION_BYTES
        if self._read_ahead_s is not None:
            device.read_ahead(self._portion)

    @property
    def ended(self) -> bool:
        """Whether the input has ended and every scan was shown."""
        return self._is_read_out and not self._waiting

    @property
    def times_ns(self) -> Times:
        """The times of the packets that were read last, ns: of arrival, or else their own."""
        if self.packets is None:
            return np.zeros(0, np.int64)
        if self.packets.host_ns.any():
            return self.packets.host_ns
        return self.packets.time_ns

    def read(self, until: float) -> None:
        """Read until a time of `time.monotonic`, or the end; at least once.

        Raises:
            LidarSpecError: if the source fails.
            UsageError: if the input ends and no scan of it was selected.
        """
        self.scans = []
        while not self.ended:
            if self._waiting:
                self._show_when_due(until)
            else:
                self._read()
            if time.monotonic() >= until:
                return

    def step(self) -> None:
        """Show the next scan of a played file at once; do nothing at its end.

        Raises:
            LidarSpecError: if the source fails.
            UsageError: if the input ends and no scan of it was selected.
        """
        self.scans = []
        number = self.number
        while self.number == number and not self.ended:
            if self._waiting:
                self._show_next()
            else:
                self._read()
        self.read_rest()

    def read_rest(self) -> None:
        """Stop the clock of a file that is played; call it while the picture does not change."""
        self._due = None

    def _read(self) -> None:
        """Read the next batch, or the end."""
        # Figures begin with the first selected packet, but with the counters before it was read.
        if self._has_counted:
            meter = self.meter
        else:
            meter = self._make_meter()
        if self._sieve.ended:
            packets = None
        else:
            packets = next(self._batches, None)
        self.packets = packets
        if packets is None:
            self._finish()
            return
        if self.device.stats.disconnects != self._disconnects:
            self._disconnects = self.device.stats.disconnects
            self._store_scans(self._stream.finish())
            self._stream = ScanStream(self.device.sensor, self.device.mount)
        if not len(packets):
            return
        selected = self._select_packets(packets)
        self.packets = selected
        if len(selected):
            self.meter = meter
            self.meter.packets(selected)
            self._has_counted = True
        self._store_scans(self._stream.add(packets))
        if self._read_ahead_s is not None:
            self._adjust_portion(packets, self._read_ahead_s)

    def _finish(self) -> None:
        self._is_read_out = True
        if not self._sieve.ended:
            self._store_scans(self._stream.finish())
        if self._sieve.is_empty:
            raise self._sieve.missing()

    def _adjust_portion(self, packets: Packets, ahead: float) -> None:
        """Read about as much at once as is shown in some seconds."""
        portion = self._portion
        duration_s = (int(packets.time_ns[-1]) - int(packets.time_ns[0])) * 1e-9
        if duration_s < ahead / 2 and portion < BATCH_BYTES:
            portion *= 2
        elif duration_s > ahead and portion > MIN_PORTION_BYTES:
            portion //= 2
        if portion != self._portion:
            self._portion = portion
            self.device.read_ahead(portion)

    def _make_meter(self) -> RateMeter:
        """Return a meter that counts from now on."""
        return RateMeter(self.device.stats, counts_losses=self.device.sensor.counts_losses)

    def _select_packets(self, packets: Packets) -> Packets:
        """Return the packets at the selected times."""
        if not self._select.is_timed:
            return packets
        if self._select.time == "host":
            times = packets.host_ns
        else:
            times = packets.time_ns
        is_selected = self._times.holds(times)
        if is_selected.all():
            return packets
        return packets.take(is_selected)

    def _store_scans(self, scans: list[Scan]) -> None:
        """Show the selected ones of some scans, or keep them until they are due."""
        for scan in scans:
            if self._sieve.ended:
                return
            selected = self._sieve.select(scan)
            if selected is None:
                continue
            if self._plays_in_real_time:
                self._waiting.append(selected)
            else:
                self._show(selected)

    def _show(self, scan: Scan) -> None:
        self.meter.scan(scan)
        self.scans.append(scan)
        if scan.whole or self.scan is None or not self.scan.whole:
            self.scan = scan
            self.number += 1

    def _show_when_due(self, until: float) -> None:
        """Wait until the next scan of a file is due, and show it; or wait until a time."""
        now = time.monotonic()
        if self._due is None:
            self._due = now
            self._show_next()
            return
        # A reader that is late catches up by the longest pause at most.
        due = max(self._due + self._step() / self.speed, now - MAX_STEP_S)
        if due > until:
            time.sleep(max(until - now, 0.0))
            return
        time.sleep(max(due - now, 0.0))
        self._due = due
        self._show_next()

    def _step(self) -> float:
        """Return the seconds from the last scan to the next, by their times."""
        step = (self._waiting[0].stamp_ns - self._last_stamp_ns) * 1e-9
        if 0 < step <= MAX_STEP_S:
            return step
        return DEFAULT_STEP_S

    def _show_next(self) -> None:
        scan = self._waiting.popleft()
        self._last_stamp_ns = scan.stamp_ns
        self._show(scan)
