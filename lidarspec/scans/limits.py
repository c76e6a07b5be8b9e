"""Limit the length and the size of a scan, so that it ends even if its end does not arrive.

A scan takes at most twice as long as the slowest revolution, by the times of the packets. Its size
is limited to twice the number of points of a scan, if that is constant. On a serial line, the limit
is the number of bytes that the line carries in that time; otherwise it is `MAX_BYTES`. If packets
are missing, and with them perhaps the end, the scan may become only slightly longer than the scan
before.
"""

from __future__ import annotations

import numpy as np

from lidarspec.scans.completeness import OpenScan, PacketCounts
from lidarspec.spec.links import Serial
from lidarspec.spec.sensor import SensorDescription
from lidarspec.spec.timing import Every

#: the time of the slowest revolution, if the sensor does not declare it.
SLOWEST_TURN_S = 1.0
#: the lowest time limit if packets have arrival times, because arrival may pause.
MIN_LIMIT_S = 1.0
#: the largest scan if neither points nor a serial line limit it.
MAX_BYTES = 1 << 26
#: how much longer than the last whole scan a scan with a gap may become, as a factor.
MAX_GROWTH = 1.125


def longest_scan_s(sensor: SensorDescription) -> float | None:
    """Return the seconds of the slowest scan; None if the sensor does not declare them."""
    if isinstance(sensor.scan, Every):
        return sensor.scan.seconds
    if sensor.turn:
        return 1 / sensor.turn[0]
    return None


class ScanLimits:
    """The limits of the scans of one sensor.

    Attributes:
        seconds: the longest time that a scan takes.
        longest_ns: the same in ns.
        has_point_limit: whether the size is limited in points, not in bytes.
    """

    def __init__(self, sensor: SensorDescription) -> None:
        self.seconds = 2 * (longest_scan_s(sensor) or SLOWEST_TURN_S)
        if sensor.clock is None:
            self.seconds = max(self.seconds, MIN_LIMIT_S)
        self.longest_ns = int(self.seconds * 1e9)
        self.has_point_limit = sensor.beams is not None
        link = sensor.links.get("data")
        self._largest: float = MAX_BYTES
        if sensor.beams:
            self._largest = 2 * sensor.beams
        elif isinstance(link, Serial):
            self._largest = self.seconds * link.baud / 10

    def allows(self, scan: OpenScan, packets: PacketCounts, usual: float) -> bool:
        """Return whether a scan is within the limits.

        Args:
            scan: the scan, including these packets.
            packets: the last packets of the scan.
            usual: the number of packets of a whole scan.
        """
        latest = int(packets.times.max())
        earliest = int(packets.times.min())
        if max(latest - scan.since, scan.since - earliest) > self.longest_ns:
            return False
        if scan.size > self._largest:
            return False
        return not scan.lost or scan.packets - 1 + scan.lost <= MAX_GROWTH * usual

    def find_excess(
        self, scan: OpenScan, packets: PacketCounts, usual: float
    ) -> tuple[int | None, bool]:
        """Find the first packet with which a scan exceeds the limits.

        Args:
            scan: the scan, without these packets.
            packets: the next packets.
            usual: the number of packets of a whole scan.

        Returns:
            The row of the packet, or None; and whether the end of the scan is overdue. If it is not
            overdue, the scan exceeds only the limit for scans with missing packets.
        """
        since = scan.since if scan.packets else packets.times.item(0)
        is_overdue = np.abs(packets.times - since) > self.longest_ns
        is_overdue |= scan.size + np.cumsum(packets.sizes) > self._largest
        lost = scan.lost + np.cumsum(packets.missing)
        length = scan.packets + np.cumsum(packets.counts) - 1 + lost
        is_over = is_overdue | ((lost > 0) & (length > MAX_GROWTH * usual))
        if not scan.packets:
            is_over[0] = False  # a scan has at least one packet
        row = int(is_over.argmax())
        if is_over[row]:
            return row, bool(is_overdue[row])
        return None, False
