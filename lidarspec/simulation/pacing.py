"""When a simulated sensor sends each packet, from what its spec says of time.

In this order: the rate that the frame type declares; the sensor's clock, which its `sweep` sets; the times of the points, which say
how long one takes; the speed of its serial line, which no sensor outruns.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.clocks import clock_ns
from lidarspec.frames.columns import Batch
from lidarspec.frames.tables import Rows
from lidarspec.links import Serial
from lidarspec.simulation.measuring import Beams
from lidarspec.spec import Sensor
from lidarspec.units import exact

Times = NDArray[np.int64]
#: bits on a serial line for each byte: start, eight, stop.
BITS = 10
#: ns; a clock that strays less from even steps is taken for a coarse one, and the steps for even.
COARSE = 1_000_000


class Pace:
    """The times of a sensor's packets, batch by batch.

    Args:
        beams: those of the first packets, `table`.

    Attributes:
        interval: ns from one packet to the next, on average; 0 where the spec says nothing of time.
    """

    def __init__(self, sensor: Sensor, frame: str, table: Rows, beams: Beams) -> None:
        self._sensor, self._rate = sensor, sensor.frames[frame].rate
        self._point = _seconds_per_point(beams)
        self._baud = next((link.baud for link in (sensor.links.get("data"),) if isinstance(link, Serial)), 0)
        times = self.times(table, lambda: beams)
        self.interval = float(times[-1]) / (len(times) - 1)

    def times(self, table: Rows, beams: Callable[[], Beams]) -> Times:
        """(n,) ns of each packet of a batch after its first; `beams` gives those of the batch where they are needed."""
        if self._rate:
            return np.asarray(np.rint(np.arange(len(table)) * 1e9 / self._rate), np.int64)
        if self._sensor.clock:
            return self._by_clock(table)
        steps = (
            beams().counts * self._point * 1e9
            if self._point
            else _sizes(table) * BITS * 1e9 / self._baud
            if self._baud
            else np.zeros(len(table))
        )
        return np.asarray(np.rint(np.concatenate([[0], np.cumsum(steps[:-1])])), np.int64)

    def _by_clock(self, table: Rows) -> Times:
        assert self._sensor.clock is not None
        steps = np.diff(clock_ns(self._sensor, Batch(table, np.zeros(len(table), np.bool_))))
        if self._sensor.clock.wraps_at:
            turn = int(exact(self._sensor.clock.wraps_at) * 10**9)
            steps = (steps + turn // 2) % turn - turn // 2
        times = np.concatenate([[0], np.cumsum(steps)])
        even = np.asarray(np.rint(np.linspace(0, times[-1], len(times))), np.int64)
        return even if bool((np.abs(even - times) <= COARSE).all()) else times


def _seconds_per_point(beams: Beams) -> float:
    """From one point of a packet to the next, 0 where the points bear one time."""
    times = np.broadcast_to(beams.time, beams.range.shape).reshape(len(beams.range), -1)
    steps: NDArray[Any] = np.diff(times, axis=1)
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0


def _sizes(table: Rows) -> NDArray[np.intp]:
    sizes = np.zeros(len(table), np.intp)
    for group in table.groups:
        sizes[group.where] = group.layout.size
    return sizes
