"""Count losses among packets that always arrive in order.

The packets come from byte streams, or are datagrams with neither a counter nor a clock.
`ArrivalOrder` estimates the number of lost packets from skipped bytes, and from the clock if its
pace is declared.

A short checksum accepts some damaged packets, whose times may be wrong by any amount. A time is
confirmed if the next packet follows it at the declared pace. If instead the next packet continues
from the last confirmed time, the times between them were wrong, and do not count.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.expressions.columns import Batch
from lidarspec.frames.arrays import broadcast_value
from lidarspec.framing.results import Counters
from lidarspec.packets.clocks import Times
from lidarspec.packets.pace import MAX_STEP_NS, Paces, read_paces, shortest_pace
from lidarspec.packets.packets import Index
from lidarspec.spec.timing import Clock


@dataclass
class UnconfirmedTimes:
    """Consecutive packets, each at an irregular time after the packet before.

    Attributes:
        confirmed_ns: the time of the packet before these packets.
        last_ns: the time of the last of these packets.
        next_row: the row of the packet that follows them.
        packets: the number of these packets.
        lost: the number of packets counted as lost since the confirmed time.
        skipped: the number of packets lost since then according to skipped bytes.
    """

    confirmed_ns: int
    last_ns: int
    next_row: int
    packets: int = 0
    lost: int = 0
    skipped: int = 0

    def are_wrong(self, time: int) -> bool:
        """Return whether the times are wrong, because the next packet is at `time`, ns."""
        is_ascending = self.confirmed_ns <= self.last_ns <= time
        return not is_ascending and 0 <= time - self.confirmed_ns <= MAX_STEP_NS


class ArrivalOrder:
    """Numbers the packets of one stream as they arrive, and counts lost packets.

    Args:
        stats: counts the lost packets.
        clock: the clock of the packets; None to find losses by skipped bytes alone.
        grain_ns: the resolution of the clock in ns; 0 if it is unknown.
    """

    def __init__(self, stats: Counters, clock: Clock | None, grain_ns: float) -> None:
        self._stats = stats
        self._clock = clock
        self._grain_ns = grain_ns
        self._time: int | None = None  # of the packet that arrived last, ns
        self._index = -1  # of that packet
        self._unconfirmed: UnconfirmedTimes | None = None  # that end with that packet
        self._largest = 1  # bytes of the largest packet so far

    def push(
        self, batch: Batch, times: Times | None, skipped: NDArray[np.int64]
    ) -> tuple[Index, NDArray[np.bool_]]:
        """Return the index of each packet, and whether the stream breaks before the packet.

        Both have the shape (n,). The stream breaks where packets were lost or the clock was set.
        The index has gaps for lost packets.

        Args:
            times: times by the sensor's clock, (n,) ns; None without a clock.
            skipped: number of bytes outside frames before each packet, (n,).
        """
        count = len(batch)
        first = self._index + 1
        skipped_rows, skipped_packets = self._count_skipped(batch, skipped)
        if first == 0 and len(skipped_rows) and skipped_rows[0] == 0:
            skipped_packets[0] = 0  # nothing is known to be lost before the first packet
        if self._clock is None or times is None:
            rows = skipped_rows
            missing = skipped_packets
        else:
            rows, missing = self._find_gaps(
                self._clock, batch, times, skipped_rows, skipped_packets
            )
        if not missing.any():
            self._index += count
            return range(first, first + count), batch.breaks
        batch.breaks[rows] |= missing > 0
        self._index += count + int(missing.sum())
        return partial(_make_index_with_gaps, first, count, rows, missing), batch.breaks

    def forget(self) -> None:
        """Forget the last clock reading, because input was lost."""
        self._time = None
        self._unconfirmed = None

    def _count_skipped(
        self, batch: Batch, skipped: NDArray[np.int64]
    ) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
        """Return the rows after skipped bytes, and the number of packets lost before each."""
        sizes = batch.table.sizes
        size = broadcast_value(sizes)
        rows = np.empty(0, np.intp)
        packets = np.empty(0, np.int64)
        if broadcast_value(skipped) != 0:
            rows = np.flatnonzero(skipped > 0)
            if size is not None:
                largest = sizes[rows]
            else:
                largest = np.maximum.accumulate(sizes)[rows]
            packets = np.rint(skipped[rows] / np.maximum(largest, self._largest)).astype(np.int64)
        self._largest = max(self._largest, int(sizes.max()) if size is None else size)
        return rows, packets

    def _find_gaps(
        self,
        clock: Clock,
        batch: Batch,
        times: Times,
        skipped_rows: NDArray[np.intp],
        skipped_packets: NDArray[np.int64],
    ) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
        """Return the rows after possible gaps, and the number of packets missing in each."""
        last = times.item(0) - 1 if self._time is None else self._time
        steps = np.diff(times, prepend=last)
        self._time = times.item(-1)
        paces = read_paces(clock, batch)
        shortest = shortest_pace(paces)
        limit = min(shortest + max(self._grain_ns, shortest / 2), MAX_STEP_NS)
        if int(steps.min()) >= 0 and int(steps.max()) <= limit and not skipped_packets.any():
            self._unconfirmed = None  # all times are regular
            return skipped_rows, skipped_packets
        is_odd = (steps < 0) | (steps > limit)
        is_odd[skipped_rows] = True
        rows = np.flatnonzero(is_odd)
        by_bytes = np.zeros(len(rows), np.int64)
        by_bytes[np.searchsorted(rows, skipped_rows)] = skipped_packets
        own_steps = steps[rows]
        own_paces = paces[rows]
        was_set = (own_steps < 0) | (own_steps > MAX_STEP_NS)
        is_irregular = was_set | (self._count_missing(own_steps, own_paces, 0) > 0)
        missing = self._count_missing(own_steps, own_paces, by_bytes)
        missing[was_set] = 0
        self._stats.lost += int(missing.sum())
        self._correct_lost(
            np.flatnonzero(is_irregular).tolist(), rows, times, steps, paces, missing, by_bytes
        )
        missing[was_set] = 1
        return rows, missing

    def _count_missing(self, steps: Any, paces: Any, by_bytes: Any) -> NDArray[np.int64]:
        """Return the number of packets missing in each step of the clock, (n,).

        Args:
            steps: the steps, (n,) ns.
            paces: the declared time between consecutive packets, (n,) ns; nan if unknown.
            by_bytes: the number of missing packets according to skipped bytes, (n,).
        """
        # If the clock resolves half the pace, it is more precise than the skipped bytes. A coarse
        # clock may miss packets, so that the larger of both estimates is used.
        tolerance = np.maximum(self._grain_ns, paces / 2)
        by_clock = np.fmax(np.ceil((steps - tolerance) / paces) - 1, 0).astype(np.int64)
        is_fine = self._grain_ns <= paces / 2
        missing: NDArray[np.int64] = np.where(is_fine, by_clock, np.maximum(by_clock, by_bytes))
        return missing

    def _correct_lost(
        self,
        irregular: list[int],
        rows: NDArray[np.intp],
        times: Times,
        steps: Times,
        paces: Paces,
        missing: NDArray[np.int64],
        by_bytes: NDArray[np.int64],
    ) -> None:
        """Correct the number of lost packets if times were wrong.

        The index of packets is not corrected, because packets before may be in an earlier batch.

        Args:
            irregular: the indices in `rows` of the packets at irregular times.
            rows: the rows of the packets to which `missing` and `by_bytes` apply, (k,).
            missing: the number of packets counted as lost before each packet, (k,).
            by_bytes: the same number according to skipped bytes, (k,).
        """
        for index in irregular:
            row = rows.item(index)
            time = times.item(row)
            unconfirmed = self._unconfirmed
            if unconfirmed is None or unconfirmed.next_row != row:
                time_before = time - steps.item(row)
                unconfirmed = UnconfirmedTimes(time_before, time_before, row)
                self._unconfirmed = unconfirmed
            unconfirmed.lost += missing.item(index)
            unconfirmed.skipped += by_bytes.item(index)
            if unconfirmed.are_wrong(time):
                pace = paces.item(row)
                step = time - unconfirmed.confirmed_ns - unconfirmed.packets * pace
                lost = int(self._count_missing(step, pace, unconfirmed.skipped))
                self._stats.lost += lost - unconfirmed.lost
                unconfirmed.lost = lost
            unconfirmed.last_ns = time
            unconfirmed.next_row += 1
            unconfirmed.packets += 1
        if self._unconfirmed is not None:
            if self._unconfirmed.next_row == len(times):
                self._unconfirmed.next_row = 0  # in the next batch
            else:
                self._unconfirmed = None


def _make_index_with_gaps(
    first: int, count: int, rows: NDArray[np.intp], missing: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return `count` consecutive indices from `first` on, with gaps for losses.

    Args:
        rows: the rows of the packets after each gap.
        missing: the number of packets missing in each gap.
    """
    index = np.ones(count, np.int64)
    index[:1] = first
    index[rows] += missing
    return np.cumsum(index, out=index)
