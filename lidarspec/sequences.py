"""Sequence numbers of packets: what was lost, what came twice or late, and where each packet stands.

Numbers are unwrapped to an index that runs on over restarts of the counter, so that packets can be put in order.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.access import Fields
from lidarspec.columns import Batch
from lidarspec.decoder import Counters
from lidarspec.errors import SpecError
from lidarspec.splits import Sequence

#: how far back a packet may come and still be a late one; further back the sensor has started again.
LATE = 64
#: the same where the packet would stand before the first one of all, which is more likely a turn that was missed.
EARLY = 10
#: counters with at least so many values start again at 0 only when the sensor does.
LONG = 1 << 16


class SequenceTracker:
    """The sequence of one stream of packets; counts into `stats`."""

    def __init__(self, rule: Sequence, stats: Counters) -> None:
        self._rule, self._stats = rule, stats
        self._number: int | None = None
        self._period = 0
        self._index = -1
        self._first = 0
        self._missing: set[int] = set()

    def push(self, batch: Batch) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """The index of each packet, and True where packets are missing before it."""
        info = batch.table.schema.fields.get(self._rule.field)
        if info is None or info.axes:
            raise SpecError("a sequence is a field of the header", path=self._rule.field)
        numbers = batch.table.raw(self._rule.field).astype(np.int64)
        there = batch.table.present(self._rule.field)
        periods = self._periods(batch, (1 << info.bits) - 1) - self._rule.first + 1
        if (there is None or bool(there.all())) and self._in_order(numbers, periods):
            index = self._index + 1 + np.arange(len(numbers))
            self._number, self._index = int(numbers[-1]), int(index[-1])
            return index, np.zeros(len(numbers), np.bool_)
        numbered = np.ones(len(numbers), np.bool_) if there is None else there
        steps = zip(numbers.tolist(), periods.tolist(), numbered.tolist(), strict=True)
        found = [self._step(number, period) if known else self._unnumbered() for number, period, known in steps]
        return np.array([index for index, _ in found], np.int64), np.array([jump for _, jump in found], np.bool_)

    def _in_order(self, numbers: NDArray[np.int64], periods: NDArray[np.int64]) -> bool:
        if self._number is None or not len(numbers) or not bool((periods == self._period).all()):
            return False
        return bool(((np.diff(numbers, prepend=self._number) - 1) % self._period == 0).all())

    def _periods(self, batch: Batch, widest: int) -> NDArray[np.int64]:
        last: Any = widest if self._rule.last is None else self._rule.last
        values = np.asarray(last(Fields(batch)) if callable(last) else last, np.float64)
        return np.broadcast_to(values.reshape(-1) if values.ndim else values, (len(batch),)).astype(np.int64)

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
        if period >= LONG and ahead > period // 2:
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
        start = (number - self._rule.first) % period
        turns = 0 if self._index < 0 else self._index // period + 2
        self._number, self._period, self._index = number, period, turns * period + start
        self._first, self._missing = self._index, set()

    def _back(self, behind: int) -> int:
        index = self._index - behind
        if index in self._missing:
            self._missing.discard(index)
            self._stats.lost -= 1
            self._stats.late += 1
        elif behind and index < self._first:
            self._stats.late += 1
        else:
            self._stats.duplicates += 1
        return index
