"""How long a packet takes by the sensor's clock: declared by the spec, or learned from the stream."""

from __future__ import annotations

import math
from bisect import bisect
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.expressions.columns import Batch
from lidarspec.expressions.graph import header_function
from lidarspec.packets.clocks import Times
from lidarspec.spec.timing import Clock

#: packets from which the pace is learned first, and next; both are numbers of packets since the
#: start.
FIRST_LESSONS = ((0, 8), (8, 72))
#: the pace is learned again from the first packets of each so many.
LESSON_EVERY = 512
#: a clock is fine if one of its steps is at most this part of the time between most packets.
FINE_SHARE = 0.5


class Paces:
    """Nanoseconds that each packet of a batch takes, nan if unknown.

    Args:
        runs: from which packet on each takes so many nanoseconds; the first run begins at packet 0.
    """

    def __init__(self, runs: list[tuple[int, float]]) -> None:
        self._runs = runs

    def at(self, row: int) -> float:
        """Return the pace of one packet."""
        return self._runs[bisect(self._runs, row, key=_first_of) - 1][1]

    def at_each(self, rows: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return the pace of some packets, (k,)."""
        if len(self._runs) == 1:
            return np.full(len(rows), self._runs[0][1])
        firsts, paces = zip(*self._runs, strict=True)
        return np.array(paces)[np.searchsorted(firsts, rows, side="right") - 1]

    @property
    def shortest(self) -> float:
        """The shortest pace of the batch; inf if none is known."""
        return min((pace for _, pace in self._runs if pace > 0), default=math.inf)


class Pace:
    """How long a packet takes by the sensor's clock, as the spec declares it or as most of the
    packets before show it.

    The pace is learned from some packets now and then and applies to the packets after them, so
    that it does not depend on batches. A clock that does not advance evenly has no pace.

    Args:
        clock: the sensor's clock.
        grain: the step of the clock, ns; 0 if a function computes it.
    """

    def __init__(self, clock: Clock, grain: float) -> None:
        self.grain = grain
        self._declared = clock.pace
        self._pace = math.nan
        self._seen = 0
        self._lessons = 0
        self._times = list[int]()

    def of(self, batch: Batch, times: Times) -> Paces:
        """Return the pace of each packet of a batch.

        Args:
            times: of the packets, (n,) ns.
        """
        if self._declared is not None:
            (seconds,) = header_function(self._declared, batch.table.schema, _seconds)(batch)
            if (seconds == seconds[0]).all():
                return Paces([(0, seconds.item(0) * 1e9)])
            return Paces([(row, second * 1e9) for row, second in enumerate(seconds.tolist())])
        runs = [(0, self._pace)]
        first, end = self._next_lesson()
        while first < len(times):
            if first >= 0 and self._lessons >= len(FIRST_LESSONS):
                starts = np.arange(first, len(times) + first - end + 1, LESSON_EVERY)
                is_same = self._is_same(
                    times[starts + end - first - 1] - times[starts], end - first - 1
                )
                self._lessons += len(is_same) if is_same.all() else int(is_same.argmin())
                first, end = self._next_lesson()
            self._times += times[max(first, 0) : end].tolist()
            if end > len(times):
                break
            has_changed = not self._is_same(self._times[-1] - self._times[0], end - first - 1)
            if self._lessons < len(FIRST_LESSONS) or has_changed:
                self._pace = self._usual_step(self._times)
                runs.append((end, self._pace))
            self._times = []
            self._lessons += 1
            first, end = self._next_lesson()
        self._seen += len(times)
        return Paces(runs)

    def forget(self) -> None:
        """Begin the current lesson anew: time has passed that no packet shows."""
        self._seen += self._next_lesson()[0]
        self._times = []

    def _next_lesson(self) -> tuple[int, int]:
        """Return the first packet of the next lesson, and the one after its last, counted from the
        next packet on.
        """
        further = (self._lessons - len(FIRST_LESSONS) + 1) * LESSON_EVERY
        if further <= 0:
            first, last = FIRST_LESSONS[self._lessons]
        else:
            first, last = further, further + FIRST_LESSONS[-1][1] - FIRST_LESSONS[-1][0]
        return first - self._seen, last + 1 - self._seen

    def _is_same(self, passed: Any, packets: int) -> Any:
        """Return whether so many packets have taken as long as the pace says."""
        return abs(passed - packets * self._pace) <= packets * self._pace / 10

    def _usual_step(self, times: list[int]) -> float:
        """Return the time that most of these packets take, in any order and some of them doubled;
        nan if they differ.
        """
        steps = sorted(after - before for before, after in pairwise(sorted(times)))
        forward = steps[bisect(steps, 0) :]
        if forward and self.grain <= FINE_SHARE * forward[len(forward) // 2]:
            steps = forward  # packets of one time came twice
        limit = 1.5 * steps[len(steps) // 2] + self.grain
        near = steps[: bisect(steps, limit)]
        pace = sum(near) / len(near)
        even = bisect(near, 1.25 * pace + self.grain) - bisect(near, 0.75 * pace - self.grain)
        return pace if pace > 0 and even > 0.55 * len(steps) else math.nan


def _first_of(run: tuple[int, float]) -> int:
    return run[0]


def _seconds(values: Any, number: int) -> NDArray[np.float64]:
    return np.broadcast_to(np.asarray(values, np.float64).reshape(-1), (number,))
