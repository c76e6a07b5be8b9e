"""Sort packets and drop duplicates.

If a packet is missing, the packets after it are held until it arrives, or until more than `WINDOW`
packets are held. Packets without a gap before them are released at once.

`WINDOW` packets are held at the start, because the first packet to arrive may not be the first that
was sent. If the packets are sorted by a clock without a declared pace, gaps cannot be recognized,
so that `WINDOW` packets are held all the time.
"""

from __future__ import annotations

import copy
from bisect import bisect_left, insort

import numpy as np
from numpy.typing import NDArray

from lidarspec.expressions.columns import Batch
from lidarspec.framing.results import Counters
from lidarspec.packets.clock_order import ClockOrder
from lidarspec.packets.packets import Packets, join_packets

#: The maximum number of packets that are held while an earlier packet is missing.
WINDOW = 10


class Reorder:
    """A buffer that sorts the packets of one stream."""

    def __init__(self) -> None:
        self._next: int | None = None  # index that follows the packets released so far
        self._released = 0  # the order of the last released packet
        self._held: Packets | None = None
        self._clock_order: ClockOrder | None = None

    def push(self, packets: Packets) -> list[Packets]:
        """Add packets, and return a list of at most one batch of released packets."""
        if not len(packets):
            return []
        held_count = 0
        if self._held is not None:
            held_count = len(self._held)
            packets = join_packets([self._held, packets])
            self._held = None
        order = packets.order
        is_ascending = bool((order[1:] > order[:-1]).all())
        if is_ascending and (self._next is None or order.item(0) > self._released):
            return self._push_ascending(packets)
        return self._push_disordered(packets, held_count)

    def finish(self) -> list[Packets]:
        """Return a list of the packets that are still held, sorted, at most one batch."""
        held = self._held
        self._held = None
        if held is None:
            return []
        return [self._mark_breaks(held.take(np.argsort(held.order, kind="stable")), self._next)]

    def _push_ascending(self, packets: Packets) -> list[Packets]:
        """Release packets up to the first gap that may still be filled.

        Args:
            packets: the held packets and the packets that arrived after them, in ascending order.
        """
        index = packets.index
        before = self._next
        gaps = [] if before == index.item(0) else [0]
        steps = index[1:] - index[:-1]
        if len(steps) and int(steps.max()) > 1:
            gaps += (np.flatnonzero(steps > 1) + 1).tolist()
        first_held = len(packets) - WINDOW  # packets from this row on are held if there is a gap
        end = len(packets)
        if not _shows_gaps(packets):
            end = max(first_held, 0)
        for gap in gaps:
            if gap >= first_held:
                end = min(gap, end)
                break
        if end < len(packets):
            self._held = packets.take(slice(end, None))
            packets = packets.take(slice(0, end))
        if not end:
            return []
        self._next = packets.index.item(-1) + 1
        self._released = packets.order.item(-1)
        has_gap = len(gaps) > (before is None) or bool(packets.breaks.any())
        if not packets.is_ordered_by_clock and not has_gap:
            return [packets]
        return [self._mark_breaks(packets, before)]

    def _push_disordered(self, packets: Packets, held_count: int) -> list[Packets]:
        """Sort packets, release those before the first gap, and hold the others.

        Args:
            packets: the held packets, followed by the packets that arrived after them.
            held_count: the number of held packets.
        """
        orders = packets.order.tolist()
        indices = packets.index.tolist()
        shows_gaps = _shows_gaps(packets)
        held = sorted((orders[row], row) for row in range(held_count))
        rows = list[int]()
        before = self._next
        for row in range(held_count, len(orders)):
            order = orders[row]
            if self._next is not None and order <= self._released:
                continue
            position = bisect_left(held, (order, 0))
            if position < len(held) and held[position][0] == order:
                continue
            insort(held, (order, row))
            is_full = len(held) > WINDOW
            if is_full:
                self._next = indices[held[0][1]]
            if not (shows_gaps or is_full):
                continue
            while held and self._next is not None and indices[held[0][1]] <= self._next:
                self._released, released = held.pop(0)
                self._next = max(self._next, indices[released] + 1)
                rows.append(released)
                if not shows_gaps:
                    break
        if held:
            self._held = packets.take(np.array([row for _, row in held], np.intp))
        else:
            self._held = None
        if rows:
            return [self._mark_breaks(packets.take(np.array(rows, np.intp)), before)]
        return []

    def _mark_breaks(self, packets: Packets, before: int | None) -> Packets:
        """Return sorted packets, with a break at each gap of the index.

        Args:
            before: the index that follows the last released packet; None if no packet was released.
        """
        marked = copy.copy(packets)
        if packets.is_ordered_by_clock:
            marked.index, marked.breaks = self._find_breaks_by_clock(packets)
            return marked
        start = packets.index.item(0) if before is None else before
        marked.breaks = np.diff(packets.index, prepend=start - 1) != 1
        return marked

    def _find_breaks_by_clock(
        self, packets: Packets
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return the index and the breaks of sorted packets, found by their clock."""
        if self._clock_order is None:
            assert packets.sensor.clock is not None
            self._clock_order = ClockOrder(Counters(), packets.sensor.clock)
        breaks = np.zeros(len(packets), np.bool_)
        batch = Batch(packets.table, breaks, packets.state, packets.sensor.state)
        index, _ = self._clock_order.push(batch, packets.order)
        return np.asarray(index, np.int64), breaks


def _shows_gaps(packets: Packets) -> bool:
    """Return whether losses are visible as gaps in the index of the packets."""
    # Packets that are ordered by a clock without a declared pace have no gaps.
    clock = packets.sensor.clock
    return not packets.is_ordered_by_clock or (clock is not None and clock.pace is not None)
