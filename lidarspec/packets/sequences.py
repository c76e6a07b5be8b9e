"""Sequence numbers of packets: what was lost, what came twice or late, and where each packet stands.

Numbers are unwrapped to an index that runs on over restarts of the counter (`SequenceTracker`). By this index packets are put in
order, doubles left out (`Reorder`), so that a late packet gives the same scan as a punctual one: what stands behind a gap is kept
back for a while.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.columns.columns import Batch
from lidarspec.columns.graph import header_function
from lidarspec.errors import SpecError
from lidarspec.framing.results import Counters
from lidarspec.packets.packets import Packets, joined
from lidarspec.spec.timing import Sequence

#: how far back a packet may come and still be a late one; further back the sensor has started again.
LATE = 64
#: the same where the packet would stand before the first one of all, which is more likely a turn that was missed.
EARLY = 10
#: counters with at least so many values start again at 0 only when the sensor does.
LONG = 1 << 16
#: counters with more values fill 64 bits: differences wrap by themselves.
WIDE = 1 << 63
#: the index of a first packet, and a step from one to the next, are no larger: an index fits 64 bits however often the sensor starts again.
FARTHEST = 1 << 32


def _whole(values: Any, number: int) -> NDArray[np.int64]:
    found = np.asarray(values, np.float64).reshape(-1).astype(np.int64)
    return found if len(found) == 1 else np.broadcast_to(found, (number,))


class SequenceTracker:
    """The sequence of one stream of packets; counts into `stats`."""

    def __init__(self, rule: Sequence, stats: Counters) -> None:
        self._rule, self._stats = rule, stats
        self._number: int | None = None
        self._period = 0
        self._index = -1
        self._first = 0
        self._missing: set[int] = set()

    def push(self, batch: Batch) -> tuple[NDArray[np.int64], NDArray[np.bool_] | None]:
        """The index of each packet, (n,), and True where packets are missing before it, (n,); None where nowhere.

        Raises:
            SpecError: where the counter is no field of the header.
        """
        info = batch.table.schema.fields.get(self._rule.field)
        if info is None or info.axes:
            raise SpecError("a sequence is a field of the header", path=self._rule.field)
        numbers = batch.table.raw(self._rule.field)
        there = batch.table.present(self._rule.field)
        periods = self._last(batch, (1 << info.bits) - 1) - self._rule.first + 1
        if not isinstance(periods, int) or periods <= WIDE:
            numbers = numbers.astype(np.int64)
        if there is None or bool(there.all()):
            return self._runs(numbers, periods)
        each = np.broadcast_to(periods, numbers.shape)
        steps = zip(numbers.tolist(), each.tolist(), there.tolist(), strict=True)
        found = [self._step(number, period) if known else self._unnumbered() for number, period, known in steps]
        return np.array([index for index, _ in found], np.int64), np.array([jump for _, jump in found], np.bool_)

    def _runs(self, numbers: NDArray[Any], periods: int | NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_] | None]:
        """The index of packets that are all numbered, and where some are missing; those that follow one another are counted together."""
        one, each = (periods, None) if isinstance(periods, int) else (0, periods)
        steady = numbers[1:] - numbers[:-1]
        ones = steady == 1
        if one <= WIDE and np.count_nonzero(ones) < len(ones):
            ones |= (steady - 1) % np.maximum(one if each is None else each[1:], 1) == 0
        steady = ones if each is None else ones & (each[1:] == each[:-1])
        if np.count_nonzero(steady) == len(steady) and self._follows(numbers.item(0), one if each is None else each.item(0)):
            self._number, self._index = numbers.item(-1), self._index + len(numbers)
            return np.arange(self._index + 1 - len(numbers), self._index + 1), None
        odd = [*(np.flatnonzero(~steady) + 1).tolist(), len(numbers)]
        index, jumps = np.empty(len(numbers), np.int64), None
        spot = turn = 0
        while spot < len(numbers):
            while odd[turn] <= spot:
                turn += 1
            number, period = numbers.item(spot), one if each is None else each.item(spot)
            follows = self._follows(number, period)
            end = odd[turn] if follows else spot + 1
            if follows:
                index[spot:end] = np.arange(self._index + 1, self._index + 1 + end - spot)
                self._number, self._index = int(numbers[end - 1]), self._index + end - spot
            else:
                index[spot], jump = self._step(number, period)
                if jump:
                    jumps = np.zeros(len(numbers), np.bool_) if jumps is None else jumps
                    jumps[spot] = True
            spot = end
        return index, jumps

    def _follows(self, number: int, period: int) -> bool:
        return self._number is not None and period == self._period and (number - self._number - 1) % period == 0

    def _last(self, batch: Batch, widest: int) -> int | NDArray[np.int64]:
        """The highest number of the counter, for each packet or for all."""
        last = self._rule.last
        if callable(last):
            (values,) = header_function(last, batch.table.schema, _whole)(batch)
            return values.item(0) if (values == values[0]).all() else values
        return widest if last is None else int(last)

    def _step(self, number: int, period: int) -> tuple[int, bool]:
        period = max(period, 1)
        if self._number is None or period != self._period:
            restart = self._number is not None
            self._begin(number, period)
            return self._index, restart
        ahead = (number - self._number) % period
        behind = period - ahead
        reach = LATE if self._index - behind >= self._first else EARLY
        if ahead == 0 or behind <= min(reach, period // 2):
            return self._back(0 if ahead == 0 else behind), False
        if period >= LONG and ahead > min(period // 2, FARTHEST):
            self._begin(number, period)
            return self._index, True
        lost = range(self._index + 1, self._index + ahead)
        self._stats.lost += len(lost)
        self._missing.update(lost[-LATE:])
        self._number, self._index = number, self._index + ahead
        self._missing = {index for index in self._missing if index > self._index - LATE}
        return self._index, ahead > 1

    def _unnumbered(self) -> tuple[int, bool]:
        """A packet whose header leaves the counter out follows the one before it."""
        self._index += 1
        return self._index, False

    def _begin(self, number: int, period: int) -> None:
        """A first packet, or the sensor started again: nothing is known to be lost."""
        turn = min(period, FARTHEST)
        start = (number - self._rule.first) % period % turn
        turns = 0 if self._index < 0 else self._index // turn + 2
        self._number, self._period, self._index = number, period, turns * turn + start
        self._first, self._missing = self._index, set()

    def _back(self, behind: int) -> int:
        index = self._index - behind
        if index in self._missing and index > self._index - LATE:
            self._missing.discard(index)
            self._stats.lost -= 1
            self._stats.late += 1
        elif behind and index < self._first:
            self._stats.late += 1
        else:
            self._stats.duplicates += 1
        return index


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
        """Packets none of which is late, in order: those behind the first gap that is still open are kept back.

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
        """These packets with a break wherever the index jumps, and nowhere else."""
        start = int(packets.index[0]) if before is None else before
        marked = copy.copy(packets)
        marked.breaks = np.diff(packets.index, prepend=start - 1) != 1
        return marked
