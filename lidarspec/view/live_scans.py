"""Read, count and play the scans of an open device.

If a file is played, each scan is shown at its recorded time. The file is read only a little ahead
of the shown scan, so that the statistics belong to this scan.
"""

from __future__ import annotations

import time
from collections import deque

import numpy as np
from numpy.typing import NDArray

from lidarspec.device.device import Device
from lidarspec.device.device_input import BATCH_BYTES
from lidarspec.packets.clock_monitor import ClockMonitor
from lidarspec.packets.packets import Packets
from lidarspec.scans.scan import Scan
from lidarspec.scans.selection import PacketTimes, Selection, TimeSlice
from lidarspec.scans.stream import ScanStream
from lidarspec.view.rate_meter import RateMeter

#: maximum time that one read of a live source waits for data.
LOOK_S = 0.04
#: time between two scans of a file without times.
DEFAULT_STEP_S = 0.1
#: maximum time between two scans of a file. A longer time is replaced by `DEFAULT_STEP_S`.
MAX_STEP_S = 2.0
#: seconds of recorded time that one read of a played file covers.
READ_AHEAD_S = 0.1
#: size of the first read of a played file.
MIN_PORTION_BYTES = 1 << 12

Times = NDArray[np.int64]


class LiveScans:
    """Reads, counts and plays the scans of an open device.

    To show a scan, this class counts it, adds it to `scans` and updates `scan`. The caller draws
    the scan.

    Args:
        device: the open device; it is not closed.
        played: whether scans of a file are shown at their recorded times, scaled by `speed`,
            instead of as fast as possible.
        speed: the first value of the attribute `speed`.
        select: the scans to show; None for all.
        ahead: approximately how many seconds of a played file are read at a time; None to read
            pieces of the default size, which is the fastest.

    Attributes:
        speed: how fast a file is played; 2.0 is twice as fast as recorded. It may be changed.
        packets: the batch that was read last; None if nothing arrived.
        scans: the complete and incomplete scans that the last `read` or `step` has shown.
        scan: the newest complete scan; before the first complete scan, an incomplete scan or None.
        number: number of times that `scan` has changed.

    Raises:
        UsageError: for a sensor without points.
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
        self.clock = ClockMonitor(device.sensor)
        self._select = select or Selection()
        self._sieve = device.make_selector(self._select, device.skip_until)
        self._clock = PacketTimes(self._select.time, device.source)
        self._times = TimeSlice(self._select.times)
        self._batches = device.packets(wait=LOOK_S)
        self._stream = ScanStream(device.sensor, device.mount)
        self._disconnects = 0
        self._has_counted = False
        self._is_read_out = False
        self._plays_in_real_time = played and not device.is_live
        self._waiting = deque[Scan]()  # scans of a played file that are not due yet
        self._due: float | None = None  # time at which the last scan was due, by `time.monotonic`
        self._last_stamp_ns = 0
        self._read_ahead_s = ahead if self._plays_in_real_time else None
        self._portion = MIN_PORTION_BYTES
        if self._read_ahead_s is not None:
            device.read_ahead(self._portion)

    @property
    def ended(self) -> bool:
        """Whether the input has ended and all scans were shown."""
        return self._is_read_out and not self._waiting

    @property
    def times_ns(self) -> Times:
        """Arrival times of the packets that were read last, (n,) ns.

        If arrival times are unknown, the times of the sensor's clock are returned.
        """
        if self.packets is None:
            return np.zeros(0, np.int64)
        if self.packets.host_ns.any():
            return self.packets.host_ns
        return self.packets.time_ns

    def read(self, until: float) -> None:
        """Read data, and show the scans that are due, until a time or the end of the input.

        Args:
            until: a time of `time.monotonic`.

        Raises:
            LidarSpecError: if the source fails.
            UsageError: if the input has ended without a selected scan.
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
        """Show the next scan of a played file without waiting until it is due.

        At the end of the file, no scan is shown.

        Raises:
            LidarSpecError: if the source fails.
            UsageError: if the input has ended without a selected scan.
        """
        self.scans = []
        number = self.number
        while self.number == number and not self.ended:
            if self._waiting:
                self._show_next()
            else:
                self._read()
        self.stop_clock()

    def stop_clock(self) -> None:
        """Pause a played file."""
        self._due = None

    def _read(self) -> None:
        """Read the next batch, or handle the end of the input."""
        # The statistics begin with the first selected packet, so the counters of the decoder before
        # this packet are subtracted.
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
            self.meter.add_packets(selected)
            self.clock.add(selected)
            self._has_counted = True
        self._store_scans(self._stream.add(packets))
        if self._read_ahead_s is not None:
            self._adjust_portion(packets, self._read_ahead_s)

    def _finish(self) -> None:
        self._is_read_out = True
        if not self._sieve.ended:
            self._store_scans(self._stream.finish())
        if self._sieve.is_empty:
            raise self._sieve.make_no_scan_error()

    def _adjust_portion(self, packets: Packets, ahead: float) -> None:
        """Double or halve the number of bytes to read at a time, if necessary.

        Args:
            packets: the packets of the last read.
            ahead: the intended duration of the packets of one read, in seconds.
        """
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
        """Return a new meter, with all counts at 0."""
        return RateMeter(self.device.stats, counts_losses=self.device.sensor.counts_losses)

    def _select_packets(self, packets: Packets) -> Packets:
        """Return the packets whose times are in the selected range."""
        if not self._select.has_time_limits:
            return packets
        is_selected = self._times.select_times(self._clock.read(packets))
        if is_selected.all():
            return packets
        return packets.take(is_selected)

    def _store_scans(self, scans: list[Scan]) -> None:
        """Show the selected scans; if a file is played, store them until they are due."""
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
        self.meter.add_scan(scan)
        self.scans.append(scan)
        if scan.whole or self.scan is None or not self.scan.whole:
            self.scan = scan
            self.number += 1

    def _show_when_due(self, until: float) -> None:
        """Show the next scan of a file when it is due, or return at the time `until`."""
        now = time.monotonic()
        if self._due is None:
            self._due = now
            self._show_next()
            return
        # After a delay, scans are shown faster to catch up, but at most for `MAX_STEP_S`.
        due = max(self._due + self._find_step() / self.speed, now - MAX_STEP_S)
        if due > until:
            time.sleep(max(until - now, 0.0))
            return
        time.sleep(max(due - now, 0.0))
        self._due = due
        self._show_next()

    def _find_step(self) -> float:
        """Return the time from the last shown scan to the next scan, in seconds."""
        step = (self._waiting[0].stamp_ns - self._last_stamp_ns) * 1e-9
        if 0 < step <= MAX_STEP_S:
            return step
        return DEFAULT_STEP_S

    def _show_next(self) -> None:
        scan = self._waiting.popleft()
        self._last_stamp_ns = scan.stamp_ns
        self._show(scan)
