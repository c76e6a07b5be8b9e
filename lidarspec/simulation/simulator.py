"""Frames that a sensor would send from a scene, made from its own spec, and when it would send them.

The sensor's `sweep` says what is not measured (angles, counters, time). The packets are filled with that, `points` says where the
beams go, the scene says how far, and the ranges go back through the scale of the fields that they come from (`measuring`).

When each packet is sent follows from what the spec says of time, in this order: the rate that is declared; the sensor's clock, which
its `sweep` sets; the times of the points, which say how long one takes; the speed of its serial line, which no sensor outruns.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.columns.columns import Batch
from lidarspec.errors import UsageError
from lidarspec.framing.examples import example
from lidarspec.packets.clocks import clock_ns
from lidarspec.simulation.frame_maker import FrameMaker, sealed
from lidarspec.simulation.measuring import Beams, Measurement
from lidarspec.simulation.scenes import Room, Scene
from lidarspec.spec.description import Spec
from lidarspec.spec.links import Serial
from lidarspec.spec.tree import exact
from lidarspec.wire.frame_table import Rows

Times = NDArray[np.int64]
#: bits on a serial line for each byte: start, eight, stop.
BITS = 10
#: ns; a clock that strays less from even steps is taken for a coarse one, and the steps for even.
COARSE = 1_000_000
#: packets simulated beyond those asked for, since directions may depend on the next packet.
AHEAD = 1
#: packets on which it is found out how a sensor carries its ranges, and how fast it is.
PROBED = 256


class Pace:
    """The times of a sensor's packets, batch by batch.

    Args:
        beams: those of the first packets, `table`.

    Attributes:
        interval: ns from one packet to the next, on average; 0 where the spec says nothing of time.
    """

    def __init__(self, sensor: Spec, frame: str, table: Rows, beams: Beams) -> None:
        self._sensor, self._rate = sensor, sensor.simulation_of(frame).rate
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


@dataclass(frozen=True, eq=False)
class Block:
    """Packets in a row: their bytes, and (n + 1,) int64 ns from the first one to each, and to the one after them."""

    frames: list[bytes]
    times: NDArray[np.int64]


class Simulation:
    """A data frame type of a sensor, ready to be simulated.

    Attributes:
        interval: ns from one packet to the next, on average; 0 where the spec says nothing of time.

    Raises:
        UsageError: where the sensor declares no `sweep`.
        SpecError: where its ranges cannot be traced back to fields.
    """

    def __init__(self, sensor: Spec, frame: str) -> None:
        sweep = sensor.simulation_of(frame).sweep
        if sweep is None:
            raise UsageError(f"{sensor.id} declares no sweep for {frame!r} frames, and cannot be simulated")
        self._sweep: Callable[[int], Mapping[str, Any]] = sweep
        self._maker = FrameMaker(sensor, frame)
        table = self._maker.table([sweep(index) for index in range(PROBED)])
        self._measurement = Measurement(sensor, frame, table)
        self._pace = Pace(sensor, frame, table, self._measurement.beams(table))
        self.interval = self._pace.interval

    def block(self, start: int, count: int, scene: Scene, since: float = 0.0) -> Block:
        """The packets from number `start` on.

        Args:
            since: seconds since the scene began at the first of them.
        """
        table = self._maker.table([self._sweep(start + index) for index in range(count + AHEAD)])
        times = self._pace.times(table, functools.partial(self._measurement.beams, table))
        self._measurement.fill(table, scene, since + times / 1e9)
        return Block(sealed(table)[:count], times[: count + 1])


@functools.lru_cache(maxsize=64)
def simulation(sensor: Spec, frame: str) -> Simulation:
    """The simulation of a data frame type; kept, since it takes a while to find out how a sensor carries its ranges."""
    return Simulation(sensor, frame)


def simulate(sensor: Spec, packets: int = 100, *, start: int = 0, scene: Scene | None = None) -> list[bytes]:
    """The data frames that a sensor standing in a scene sends, one after another.

    Args:
        packets: how many.
        start: the number of the first one since the sensor was switched on.
        scene: what it sees, such as `read_scene` reads from a file; a room where left out.

    Raises:
        UsageError: where the sensor declares no `sweep`.
        SpecError: where its ranges cannot be traced back to fields.
    """
    made = simulation(sensor, sensor.data_frame)
    return made.block(start, packets, scene or Room(), start * made.interval / 1e9).frames


def opening(sensor: Spec) -> bytes:
    """What the sensor sends before its data frames: the frame that they come after; empty where they need none."""
    after = sensor.frames[sensor.data_frame].after
    return b"" if after is None else example(sensor, after)
