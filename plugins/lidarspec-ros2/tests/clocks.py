"""Simulate a sensor's clock and a connection, and measure the errors of the stamps.

    python plugins/lidarspec-ros2/tests/clocks.py [RUNS]

prints the table of docs/explanation/ros-time.md.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarspec.packets.clock_estimate import DeviceClock
from lidarspec_ros2.clock import describe_jump

Random = np.random.Generator
Floats = NDArray[np.float64]

#: by how many seconds packets arrive late, by name.
JITTERS: dict[str, Callable[[Random, int], Floats]] = {
    "uniform, 0 to 5 ms": lambda random, n: random.uniform(0, 5e-3, n),
    "exponential, mean 5 ms": lambda random, n: random.exponential(5e-3, n),
    "half-normal, sigma 5 ms": lambda random, n: np.abs(random.normal(0, 5e-3, n)),
    "uniform, 0 to 10 ms": lambda random, n: random.uniform(0, 10e-3, n),
}
#: seconds at which the clock is set, and starts again, and after which stamps are to be right.
SET, AGAIN, END, SETTLING = 40.0, 80.0, 120.0, 10.0
#: ns since 1970 when it begins, and how far the clock falls back when it starts again: 2**32 us.
BEGAN, TURN = 1_767_225_600_000_000_000, 2**32 * 1000


@dataclass(frozen=True, eq=False)
class Run:
    """One simulated run.

    Attributes:
        times: time of measurement, s.
        device: device time of each scan, ns.
        host: arrival time of each scan, ns.
        stamps: stamp of each scan, ns.
        clock: the object that made the stamps.
        said: its messages about jumps, without repetitions.
    """

    times: Floats
    device: NDArray[np.int64]
    host: NDArray[np.int64]
    stamps: NDArray[np.int64]
    clock: DeviceClock
    said: list[str]

    @property
    def errors(self) -> Floats:
        """Return the error of each stamp, s."""
        return (self.stamps - BEGAN) * 1e-9 - self.times

    @property
    def is_settled(self) -> NDArray[np.bool_]:
        """Return which scans came some time after the last start or change of the clock."""
        return np.array(self.times % SET >= SETTLING)


def simulate_stamps(
    seed: int,
    jitter: str,
    *,
    drift_ppm: float = 50,
    step: float = 1.5,
    wraps: bool = True,
    rate: float = 10,
    each: int = 1,
    stalls: float = 0.01,
) -> Run:
    """Simulate stamps of scans with a clock that drifts, is set once, and restarts.

    Args:
        step: seconds by which the clock is set.
        rate: scans a second.
        each: number of observed packets for each scan, including its own.
        stalls: share of packets that a stalled machine delays by up to 100 ms more.
    """
    random = np.random.default_rng(seed)
    times = np.arange(0, END, 1 / (rate * each)) + random.uniform(0, 0.1)
    late = JITTERS[jitter](random, len(times))
    late += (random.uniform(size=len(times)) < stalls) * random.uniform(0, 0.1, len(times))
    device = np.rint(times * (1 + drift_ppm * 1e-6) * 1e9).astype(np.int64) + (
        times >= SET
    ) * round(step * 1e9)
    device -= (times >= AGAIN) * TURN * wraps
    host = BEGAN + np.rint(np.maximum.accumulate(times + late) * 1e9).astype(np.int64)
    clock, stamps, said = DeviceClock(), list[int](), dict[str, None]()
    for first in range(0, len(times) - each + 1, each):
        if each > 1:
            clock.observe(device[first : first + each], host[first : first + each])
        stamps.append(clock.stamp(int(device[first]), int(host[first])))
        said |= {describe_jump(clock): None}
    which = slice(0, len(stamps) * each, each)
    return Run(times[which], device[which], host[which], np.array(stamps), clock, list(said)[1:])


#: scans a second, packets observed with each, and the drift in ppm, of the columns.
CASES = ((10, 1, 50), (10, 1, -1000), (5, 1, 50), (10, 40, 50))


def main(runs: int) -> None:
    """Print the table: for each case the 99th percentile of the errors, and the worst."""
    heads = [
        f"{rate} scans{f', {rate * each} packets' * (each > 1)} a second, {drift} ppm"
        for rate, each, drift in CASES
    ]
    print(f"| delay of packets | {' | '.join(heads)} |\n|---|{'---:|' * len(CASES)}")
    for jitter in JITTERS:
        cells = []
        for rate, each, drift in CASES:
            made = [
                simulate_stamps(seed, jitter, rate=rate, each=each, drift_ppm=drift)
                for seed in range(runs)
            ]
            errors = np.abs(np.concatenate([run.errors[run.is_settled] for run in made])) * 1e3
            cells.append(f"{np.quantile(errors, 0.99):.2f} ms, {errors.max():.2f} ms")
        print(f"| {jitter} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
