"""Frames that a sensor would send from a scene, made from its own spec, and when it would send them.

The sensor's `sweep` says what is not measured (angles, counters, time). The packets are filled with that, `points` says where the
beams go, the scene says how far, and the ranges go back through the scale of the fields that they come from (`measuring`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import UsageError
from lidarspec.simulation.measuring import Measurement
from lidarspec.simulation.pacing import Pace
from lidarspec.simulation.scenes import Room, Scene
from lidarspec.simulation.sweeps import FrameMaker, sealed
from lidarspec.spec import Sensor

#: packets simulated beyond those asked for, since directions may depend on the next packet.
AHEAD = 1
#: packets on which it is found out how a sensor carries its ranges, and how fast it is.
PROBED = 256


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

    def __init__(self, sensor: Sensor, frame: str) -> None:
        sweep = sensor.frames[frame].sweep or sensor.sweep
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
def simulation(sensor: Sensor, frame: str) -> Simulation:
    """The simulation of a data frame type; kept, since it takes a while to find out how a sensor carries its ranges."""
    return Simulation(sensor, frame)


def simulate(sensor: Sensor, packets: int, *, start: int = 0, scene: Scene | None = None) -> list[bytes]:
    """The data frames numbered `start` to ``start + packets`` of a sensor standing in a scene.

    Raises:
        UsageError: where the sensor declares no `sweep`.
        SpecError: where its ranges cannot be traced back to fields.
    """
    made = simulation(sensor, sensor.data_frame)
    return made.block(start, packets, scene or Room(), start * made.interval / 1e9).frames


def opening(sensor: Sensor) -> bytes:
    """What the sensor sends before its data frames: the frame that they come after; empty where they need none."""
    after = sensor.frames[sensor.data_frame].after
    return b"" if after is None else sensor.example(after)
