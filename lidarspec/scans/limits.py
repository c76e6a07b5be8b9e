"""Limit the duration and the size of scans, in case the end of a scan is missing.

A scan that exceeds one of these limits is cut:

* duration: twice the time of the slowest revolution.
* size: twice the number of points that the sensor declares. If the number of points varies, the
  size is limited in bytes.
* number of packets, only for a scan with missing packets: an eighth more than an earlier scan,
  which is normally the last whole scan.
"""

from __future__ import annotations

import numpy as np

from lidarspec.scans.completeness import OpenScan, PacketCounts
from lidarspec.spec.links import Serial
from lidarspec.spec.sensor import SensorDescription
from lidarspec.spec.timing import Every

#: The duration of the slowest revolution, if the sensor does not declare it.
SLOWEST_TURN_S = 1.0
#: The minimum of the time limit if packets have only arrival times. Packets may arrive with pauses.
MIN_LIMIT_S = 1.0
#: The size limit, bytes, if the number of points varies and the source is not a serial line.
MAX_BYTES = 1 << 26
#: A scan with missing packets may have at most this factor times the packets of an earlier scan.
MAX_GROWTH = 1.125


def longest_scan_s(sensor: SensorDescription) -> float | None:
    """Return the duration of the slowest scan, seconds; None if it is not declared."""
    if isinstance(sensor.scan, Every):
        return sensor.scan.seconds
    if sensor.turn:
        return 1 / sensor.turn[0]
    return None


class ScanLimits:
    """The limits of the scans of one sensor.

    Attributes:
        seconds: the maximum duration of a scan, seconds.
        longest_ns: the maximum duration of a scan, ns.
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

    def allows(self, scan: OpenScan, packets: PacketCounts, usual_count: float) -> bool:
        """Return whether a scan is within the limits.

        Args:
            scan: the counts of the scan so far, including `packets`.
            packets: the last packets of the scan.
            usual_count: the number of packets, received and missing, of an earlier scan; inf if it
                is unknown.
        """
        latest = int(packets.times.max())
        earliest = int(packets.times.min())
        if max(latest - scan.since, scan.since - earliest) > self.longest_ns:
            return False
        if scan.size > self._largest:
            return False
        return not scan.lost or scan.packets - 1 + scan.lost <= MAX_GROWTH * usual_count

    def find_excess(
        self, scan: OpenScan, packets: PacketCounts, usual_count: float
    ) -> tuple[int | None, bool]:
        """Find the first packet with which a scan exceeds the limits.

        Args:
            scan: the counts of the scan so far, without `packets`.
            packets: the next packets.
            usual_count: as for `allows`.

        Returns:
            (row, exceeds_maximum). `row` is the row of this packet; None if there is none.
            `exceeds_maximum` is True if the scan exceeds its maximum duration or size. It is False
            if the scan exceeds only the number of packets that a scan with missing packets may
            have, or if `row` is None.
        """
        since = scan.since if scan.packets else packets.times.item(0)
        exceeds_maximum = np.abs(packets.times - since) > self.longest_ns
        exceeds_maximum |= scan.size + np.cumsum(packets.sizes) > self._largest
        lost = scan.lost + np.cumsum(packets.missing)
        length = scan.packets + np.cumsum(packets.counts) - 1 + lost
        is_over = exceeds_maximum | ((lost > 0) & (length > MAX_GROWTH * usual_count))
        if not scan.packets:
            is_over[0] = False  # a scan has at least one packet
        row = int(is_over.argmax())
        if is_over[row]:
            return row, bool(exceeds_maximum[row])
        return None, False
