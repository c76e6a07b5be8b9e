"""Packets put in order by their sequence, doubles left out, so that a late packet gives the same scan as a punctual one."""

from __future__ import annotations

import numpy as np

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
        first, settled = int(packets.index[0]), self._next is not None or len(packets) > WINDOW
        if settled and self._held is None and self._next in (None, first) and bool((np.diff(packets.index) == 1).all()):
            self._next = int(packets.index[-1]) + 1
            return [packets]
        return self._ordered(packets)

    def finish(self) -> list[Packets]:
        """The packets that are still kept back."""
        held, self._held = self._held, None
        if held is None:
            return []
        return [self._marked(held.take(np.argsort(held.index, kind="stable")), self._next)]

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
        packets.breaks = np.diff(packets.index, prepend=start - 1) != 1
        return packets
