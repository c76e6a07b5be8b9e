"""Find lost, late and duplicate datagrams by their clock, if they have no counter.

`ClockOrder` compares each datagram with the newest packets. A datagram is a duplicate if a stored
packet has the same time and the same bytes. Each packet gets an index and an order. The index is a
sequence number with gaps for missing packets. The order is the time since the first packet in
nanoseconds, by which `Reorder` sorts the packets.

If the pace of the clock is not declared, lost packets are not found, and the index has no gaps.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from dataclasses import dataclass
from operator import attrgetter
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from lidarspec.expressions.columns import Batch
from lidarspec.framing.results import Counters, Numbers
from lidarspec.packets.clocks import Times
from lidarspec.packets.masked_sector import MaskedGaps
from lidarspec.packets.pace import MAX_STEP_NS, Paces, read_paces, shortest_pace
from lidarspec.spec.timing import Clock

#: The maximum number of places by which a packet can be late. If the clock goes back further, the
#: clock was set or the sensor restarted.
MAX_PLACES_LATE = 64
#: The maximum time by which a packet can be late if the pace is unknown, ns.
MAX_LATE_NS = 10**9
#: The checksums of this number of newest packets are stored. A packet with the time of an older
#: packet counts as a duplicate, without a comparison of bytes.
REMEMBERED_CHECKSUMS = 16

_time_of = attrgetter("time")


@dataclass
class RecentPacket:
    """A packet that was received recently.

    Attributes:
        order: the sort key, ns.
        index: the sequence number, with gaps for missing packets.
        missing: the number of packets missing directly before this packet.
        checksum: the CRC-32 of its bytes; None if it is no longer stored.
        angle: the angle at which it begins, in turns; nan if unknown.
        masked: how many packets a masked sector leaves out directly before this packet.
    """

    time: int
    order: int
    index: int
    missing: int
    checksum: int | None
    angle: float = math.nan
    masked: int = 0


class ClockOrder:
    """Finds lost, late and duplicate datagrams of one stream by their clock.

    Args:
        stats: counts lost, late and duplicate packets.
        gaps: recognizes gaps at masked sectors; None to count all gaps as losses.
    """

    def __init__(self, stats: Counters, clock: Clock, gaps: MaskedGaps | None = None) -> None:
        self._stats = stats
        self._clock = clock
        self._arrived: int | None = None  # time of the packet that arrived last, ns
        self._newest: RecentPacket | None = None
        self._neighbours = list[RecentPacket]()  # in the order of their times
        self._offset = 0  # added to a time to get an order
        self._gaps = gaps
        # the time before the clock's last large jump, ns, and the packet after the jump
        self._jump: tuple[int, RecentPacket] | None = None

    def push(self, batch: Batch, times: Times) -> tuple[Numbers, NDArray[np.int64]]:
        """Find the place of each packet in the stream, and mark breaks.

        Args:
            batch: the packets. `batch.breaks` is set to True for each packet before which packets
                were lost or the clock was set.
            times: times by the sensor's clock, (n,) ns.

        Returns:
            (index, order), each with one number per packet, (n,). The index is a sequence number
            that also counts lost packets. The order is the time in ns by which packets are sorted.
        """
        paces = read_paces(self._clock, batch)
        if self._gaps is not None:
            self._gaps.read(batch.table)
        odd_rows = self._find_unexpected(times, paces)
        count = len(times)
        self._arrived = times.item(-1)
        if not odd_rows and self._is_next(times.item(0), paces.item(0)):
            first = self._add_run(batch, times, 0, count)
            self._trim()
            return range(first, first + count), times + self._offset
        index = np.empty(count, np.int64)
        order = np.empty(count, np.int64)
        odd_rows.append(count)
        next_odd = row = 0
        while row < count:
            while odd_rows[next_odd] <= row:
                next_odd += 1
            if self._is_next(times.item(row), paces.item(row)):
                stop = odd_rows[next_odd]
                first = self._add_run(batch, times, row, stop)
                index[row:stop] = np.arange(first, first + stop - row)
                order[row:stop] = times[row:stop] + self._offset
                row = stop
            else:
                place = self._place(batch, row, times.item(row), paces.item(row))
                index[row] = place.index
                order[row] = place.order
                row += 1
            self._trim()
        return index, order

    def forget(self) -> None:
        """Forget all stored packets, because input was lost."""
        self._arrived = None
        self._neighbours.clear()
        if self._gaps is not None:
            self._gaps.forget()

    def _find_unexpected(self, times: Times, paces: Paces) -> list[int]:
        """Return the rows of packets that do not directly follow the previous packet."""
        passed = np.empty(len(times), np.int64)
        passed[0] = 1 if self._arrived is None else times.item(0) - self._arrived
        np.subtract(times[1:], times[:-1], out=passed[1:])
        if passed.min() > 0 and passed.max() <= min(1.5 * shortest_pace(paces), MAX_STEP_NS):
            return []
        is_odd = (passed <= 0) | (passed > MAX_STEP_NS) | (passed > 1.5 * paces)
        return np.flatnonzero(is_odd).tolist()

    def _is_next(self, time: int, pace: float) -> bool:
        """Return whether a packet directly follows the newest packet."""
        if not self._neighbours:
            return False
        passed = time - self._neighbours[-1].time
        return 0 < passed <= MAX_STEP_NS and not passed > 1.5 * pace

    def _add_run(self, batch: Batch, times: Times, start: int, stop: int) -> int:
        """Store consecutive packets, and return the index of the first of them."""
        assert self._newest is not None
        first = self._newest.index + 1
        for row in range(max(start, stop - MAX_PLACES_LATE), stop):
            if row >= stop - REMEMBERED_CHECKSUMS:
                checksum = crc32(batch.table.frame(row))
            else:
                checksum = None
            time = times.item(row)
            self._newest = RecentPacket(
                time, time + self._offset, first + row - start, 0, checksum, self._get_angle(row)
            )
            self._neighbours.append(self._newest)
        return first

    def _place(self, batch: Batch, row: int, time: int, pace: float) -> RecentPacket:
        """Store a packet that does not directly follow the newest packet, and return it."""
        # For a duplicate, the packet that was stored first is returned.
        checksum = crc32(batch.table.frame(row))
        if self._newest is None or not self._neighbours:
            return self._restart(batch, row, time, checksum)
        newest = self._neighbours[-1]
        passed = time - newest.time
        if self._jump is not None and self._undoes_jump(time, passed, pace):
            self._stats.lost -= self._jump[1].missing  # one reading was damaged
            return self._restart(batch, row, time, checksum)
        if passed > MAX_STEP_NS or self._is_too_far_back(time, passed, pace):
            return self._restart(batch, row, time, checksum)
        start = bisect_left(self._neighbours, time, key=_time_of)
        stop = bisect_right(self._neighbours, time, key=_time_of)
        for twin in self._neighbours[start:stop]:
            if twin.checksum is None or twin.checksum == checksum:
                self._stats.duplicates += 1
                return twin
        if stop < len(self._neighbours):
            return self._insert(stop, row, time, pace, checksum)
        missing = _count_missing(passed, pace)
        angle = self._get_angle(row)
        masked = 0
        if missing and self._gaps is not None:
            masked = self._gaps.count_masked(newest.angle, angle, missing)
            missing -= masked
        self._stats.lost += missing
        batch.breaks[row] |= missing > 0
        order = max(time + self._offset, newest.order + 1)
        self._newest = RecentPacket(
            time, order, newest.index + 1 + missing, missing, checksum, angle, masked
        )
        self._neighbours.append(self._newest)
        if missing > MAX_PLACES_LATE:
            self._jump = (newest.time, self._newest)
        else:
            self._jump = None
        if missing and self._gaps is not None:
            self._stats.lost -= self._gaps.revoke_losses(row, newest.angle, angle, self._newest)
        return self._newest

    def _get_angle(self, row: int) -> float:
        if self._gaps is None:
            return math.nan
        return self._gaps.angle_at(row)

    @property
    def _max_places_late(self) -> int:
        """The maximum number of places by which a packet can be late."""
        return MAX_PLACES_LATE + (0 if self._gaps is None else self._gaps.masked)

    def _undoes_jump(self, time: int, passed: int, pace: float) -> bool:
        """Return whether the clock continues from its time before the last large jump."""
        assert self._jump is not None
        reach = self._max_places_late * pace
        return abs(passed) > reach and 0 < time - self._jump[0] <= reach

    def _is_too_far_back(self, time: int, passed: int, pace: float) -> bool:
        """Return whether a time is too far back to be that of a late packet."""
        if pace > 0:
            return passed < -self._max_places_late * pace
        is_full = len(self._neighbours) >= MAX_PLACES_LATE
        return passed < -MAX_LATE_NS or (is_full and time < self._neighbours[0].time)

    def _restart(self, batch: Batch, row: int, time: int, checksum: int) -> RecentPacket:
        """Store the first packet of the stream, or the first one after the clock was set."""
        before = self._newest
        if before is None:
            self._offset = -time
            index = 0
        else:
            self._offset = before.order + 2 * MAX_STEP_NS - time
            index = before.index + 2
            batch.breaks[row] = True
        self._newest = RecentPacket(
            time, time + self._offset, index, 0, checksum, self._get_angle(row)
        )
        if before is None:
            self._jump = None
        else:
            self._jump = (before.time, self._newest)
        self._neighbours = [self._newest]
        return self._newest

    def _insert(
        self, position: int, row: int, time: int, pace: float, checksum: int
    ) -> RecentPacket:
        """Store a late packet, and correct the number of packets missing around it."""
        self._stats.late += 1
        after = self._neighbours[position]
        missing_after = _count_missing(after.time - time, pace)
        masked_after = min(after.masked, missing_after)
        missing_after -= masked_after
        masked = after.masked - masked_after
        order = time + self._offset
        if position:
            before = self._neighbours[position - 1]
            missing = max(_count_missing(time - before.time, pace) - masked, 0)
            index = max(min(before.index + 1 + missing, after.index - 1), before.index)
            order = max(order, before.order + 1)
        else:
            missing = max(after.missing - 1 - missing_after, 0)
            index = after.index - 1 - missing_after
        self._stats.lost += missing + missing_after - after.missing
        after.missing = missing_after
        after.masked = masked_after
        placed = RecentPacket(time, order, index, missing, checksum, self._get_angle(row), masked)
        self._neighbours.insert(position, placed)
        return placed

    def _trim(self) -> None:
        """Remove the oldest stored packets and checksums if there are too many."""
        if len(self._neighbours) > MAX_PLACES_LATE:
            del self._neighbours[:-MAX_PLACES_LATE]
        for neighbour in reversed(self._neighbours[:-REMEMBERED_CHECKSUMS]):
            if neighbour.checksum is None:
                break
            neighbour.checksum = None


def _count_missing(passed: int, pace: float) -> int:
    """Return the number of packets missing between two packets.

    Args:
        passed: the time between the packets, ns.
        pace: the time between consecutive packets, ns; nan or 0 if unknown.
    """
    if not pace > 0:
        return 0
    return max(math.ceil(passed / pace - 0.5), 1) - 1
