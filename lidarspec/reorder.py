"""Packets put in order by their sequence, doubles left out, so that a late packet gives the same scan as a punctual one."""

from __future__ import annotations

import copy

import numpy as np
from numpy.typing import NDArray

from lidarspec.packets import Packets, joined

#: how many packets are kept back while one before them is missing, or may be, as at the beginning.
WINDOW = 10


class Reorder:
    """Orders the packets of one stream; without a sequence everything passes as it comes."""

    def __init__(self, *, enabled: bool) -> None:
        self._enabled = enabled
        self._next: int | None = None
        self._held: Packets | None = None

    def push(self, packets: Packets) -> list[Packets]:
        """The packets that are now in order; at most one batch."""
        if not self._enabled or not len(packets):
            return [packets] if len(packets) else []
        if self._held is None and (self._next is None or int(packets.index[0]) >= self._next):
            steps = packets.index[1:] - packets.index[:-1]
            if not len(steps) or int(steps.min()) > 0:
                return self._ascending(packets, None if not len(steps) or int(steps.max()) == 1 else steps)
        return self._ordered(packets)

    def finish(self) -> list[Packets]:
        """The packets that are still kept back."""
        held, self._held = self._held, None
        if held is None:
            return []
        return [self._marked(held.take(np.argsort(held.index, kind="stable")), self._next)]

    def _ascending(self, packets: Packets, steps: NDArray[np.int64] | None) -> list[Packets]:
        """The same for packets none of which is late: those behind the first gap that is still open are kept back.

        Args:
            steps: of the index from each packet to the next; None where all are 1.
        """
        number, before = len(packets), self._next
        gaps = [] if before == int(packets.index[0]) else [0]
        if steps is not None:
            gaps += (np.flatnonzero(steps > 1) + 1).tolist()
        end = next((gap for gap in gaps if gap >= number - WINDOW), number)
        if end < number:
            self._held = packets.take(slice(end, None))
            packets = packets.take(slice(0, end))
        if not end:
            return []
        self._next = int(packets.index[-1]) + 1
        return [self._marked(packets, before) if len(gaps) > (before is None) or packets.breaks.any() else packets]

    def _ordered(self, packets: Packets) -> list[Packets]:
        known = 0 if self._held is None else len(self._held)
        everything = packets if self._held is None else joined([self._held, packets])
        waiting = {int(index): spot for spot, index in enumerate(everything.index[:known].tolist())}
        released: list[int] = []
        before = self._next
        for spot, index in enumerate(everything.index.tolist()[known:], start=known):
            if index in waiting or (self._next is not None and index < self._next):
                continue
            waiting[index] = spot
            if len(waiting) > WINDOW:
                self._next = min(waiting)
            while self._next in waiting:
                released.append(waiting.pop(self._next))
                self._next += 1
        self._held = everything.take(np.array([waiting[index] for index in sorted(waiting)], np.intp)) if waiting else None
        return [self._marked(everything.take(np.array(released, np.intp)), before)] if released else []

    @staticmethod
    def _marked(packets: Packets, before: int | None = None) -> Packets:
        """The same packets with a break wherever the index jumps, and nowhere else."""
        start = int(packets.index[0]) if before is None else before
        marked = copy.copy(packets)
        marked.breaks = np.diff(packets.index, prepend=start - 1) != 1
        return marked
