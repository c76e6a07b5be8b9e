"""Measure the times of several contenders in turn.

If the machine slows down, all contenders slow down equally.
"""

from __future__ import annotations

import math
import resource
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from statistics import median
from typing import Any, Protocol

import numpy as np

#: bytes of a copy: far more than the caches hold.
COPIED = 1 << 26


Clock = Callable[[], float]


class Timed(Protocol):
    """A contender, in this process or in another one."""

    amount: int

    def seconds(self, repeats: int, clock: Clock) -> float:
        """Run `repeats` times; return the mean seconds of a run."""


@dataclass
class Contender:
    """A function to time.

    Attributes:
        run: runs the function once.
        amount: number of points, packets or frames of one run.
        after: called after the runs, not timed.
    """

    run: Callable[[], Any]
    amount: int
    after: Callable[[], None] | None = None

    def seconds(self, repeats: int, clock: Clock) -> float:
        """Run `repeats` times; return the mean seconds of a run."""
        start = clock()
        for _ in range(repeats):
            self.run()
        elapsed = max(clock() - start, LEAST_STEP)
        if self.after:
            self.after()
        return elapsed / repeats


Rates = dict[str, list[float]]

#: seconds; no clock steps by less.
LEAST_STEP = 1e-6


def measure_contenders(
    contenders: Mapping[str, Timed], runs: int, least: float, clock: Clock = time.perf_counter
) -> Rates:
    """Return the seconds per unit of the amount, for each contender and run.

    Args:
        least: minimum seconds of a run. A faster contender is repeated within a run. To find the
            number of repeats, each contender runs twice beforehand; 0 disables this.
    """
    repeats = {
        name: _repeats(contender, least, clock) if least else 1
        for name, contender in contenders.items()
    }
    found: Rates = {name: [] for name in contenders}
    for _ in range(runs):
        for name, contender in contenders.items():
            found[name].append(contender.seconds(repeats[name], clock) / contender.amount)
    return found


def _repeats(contender: Timed, least: float, clock: Clock) -> int:
    contender.seconds(1, clock)
    return max(1, math.ceil(least / contender.seconds(1, clock)))


def cpu_seconds() -> float:
    """Return the processor time of this process and of its finished children."""
    times = [
        resource.getrusage(which) for which in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    ]
    return sum(part.ru_utime + part.ru_stime for part in times)


def times(rates: Rates, fast: str, slow: str) -> float:
    """Return how many times as fast as `slow` the contender `fast` is.

    The result is the median over the runs.
    """
    return median(behind / ahead for ahead, behind in zip(rates[fast], rates[slow], strict=True))


def memcpy(*, quick: bool = False) -> Contender:
    """Return a copy of a large buffer; the amount is bytes."""
    source = np.ones(COPIED >> 4 if quick else COPIED, np.uint8)
    target = np.zeros_like(source)
    return Contender(lambda: np.copyto(target, source), source.size)
