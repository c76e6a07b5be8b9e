"""Read and count the frames of an open device that measures no points, such as an IMU."""

from __future__ import annotations

import time
from collections.abc import Collection

import numpy as np

from lidarspec.device.device import Device
from lidarspec.errors import UsageError
from lidarspec.packets.clock_monitor import ClockMonitor
from lidarspec.packets.packets import Packets
from lidarspec.scans.selection import EVERYTHING, Selection
from lidarspec.view.live_scans import LOOK_S, LiveScans, Times
from lidarspec.view.rate_meter import RateMeter


def open_live(device: Device, select: Selection = EVERYTHING) -> LiveScans | LiveFrames:
    """Return the reader of an open device.

    Returns:
        `LiveScans` if the device measures points, otherwise `LiveFrames`.

    Raises:
        UsageError: if `select` selects scans, but the device measures no points.
    """
    if device.sensor.has_points:
        return LiveScans(device, select=select)
    if select != EVERYTHING:
        raise UsageError(
            f"{device.sensor.id} measures no points: omit the options that select scans"
        )
    return LiveFrames(device)


class LiveFrames:
    """Reads and counts the frames of all types of an open device.

    Args:
        device: the open device; it is not closed.

    Attributes:
        packets: the packets that were read last, one batch for each frame type.
    """

    def __init__(self, device: Device) -> None:
        self.device = device
        self.packets: Collection[Packets] = ()
        self.ended = False
        self.meter = RateMeter(device.stats, counts_losses=device.sensor.counts_losses)
        self.clock = ClockMonitor(device.sensor)
        self._batches = device.packets_by_frame(device.sensor.main_frames, wait=LOOK_S)

    @property
    def times_ns(self) -> Times:
        """Arrival times of the frames that were read last, ascending, (n,) ns."""
        arrivals = np.concatenate(
            [np.zeros(0, np.int64), *(packets.host_ns for packets in self.packets)]
        )
        return np.sort(arrivals[arrivals > 0])

    def read(self, until: float) -> None:
        """Read frames until a time or the end of the input, but at least one batch.

        Args:
            until: a time of `time.monotonic`.

        Raises:
            LidarSpecError: if the source fails.
        """
        while not self.ended:
            batch = next(self._batches, None)
            self.ended = batch is None
            self.packets = [] if batch is None else batch.values()
            for packets in self.packets:
                self.clock.add(packets)
            self.meter.add_frames(sum(map(len, self.packets)), self.times_ns)
            if time.monotonic() >= until:
                return
