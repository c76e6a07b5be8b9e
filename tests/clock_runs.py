"""Simulated runs of `shape-synced` in virtual time: a clock, its faults, and late arrivals."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarspec.packets.clock_findings import FINDING_TYPES
from lidarspec.packets.clock_monitor import ClockMonitor
from lidarspec.packets.packets import Packets
from lidarspec.sensor_operations import Sensor
from tests.shapes import SHAPES
from tests.shapes.synced import LOCKED

SYNCED = SHAPES["shape-synced"]
BEGAN_S = 1_767_225_600 + 15.5 * 86_400  # 2026-01-16, 12:00 UTC
RATE_HZ = 240
JITTER_S = 5e-3
TAI_S = 37


@dataclass
class Run:
    """Packets of a sensor whose clock drifts, with arrival times that vary by 5 ms.

    Attributes:
        sent_s: when each packet was sent, seconds since the start.
        clock_s: what the clock shows then, seconds.
        status: the clock's status, one value for each packet.
        began_s: the host's time at the start, seconds since 1970.
    """

    sent_s: NDArray[np.float64]
    clock_s: NDArray[np.float64]
    status: NDArray[np.int64]
    began_s: float = BEGAN_S
    seed: int = 0

    def packets(self, sensor: Sensor = SYNCED, frame_type: str | None = None) -> Packets:
        """Return the packets, decoded from frames."""
        frame = SYNCED.build("data", number=0, sync=0, time=0, azimuth=0, distances=[0] * 4)
        rows = np.tile(np.frombuffer(frame, np.uint8), (len(self.sent_s), 1))
        rows[:, 2:4] = (np.arange(len(rows)) % 65_536).astype("<u2")[:, None].view(np.uint8)
        rows[:, 4] = self.status
        times = np.rint(self.clock_s * 1e9).astype("<i8")
        rows[:, 5:13] = times[:, None].view(np.uint8)
        packets = sensor.decode(rows, frame=frame_type)
        late = np.random.default_rng(self.seed).uniform(0, JITTER_S, len(rows))
        packets.host_ns = np.rint((self.began_s + self.sent_s + late) * 1e9).astype(np.int64)
        return packets


def make_run(
    seconds: float,
    *,
    ppm: float = 0.0,
    ahead_s: float = TAI_S,
    rate_hz: float = RATE_HZ,
    began_s: float = BEGAN_S,
    seed: int = 0,
) -> Run:
    """Return a run without faults.

    Args:
        seconds: its duration.
        ppm: the drift of the clock.
        ahead_s: by how much the clock is ahead of UTC at the start.
    """
    sent_s = np.arange(int(seconds * rate_hz)) / rate_hz
    clock_s = began_s + ahead_s + sent_s * (1 + ppm * 1e-6)
    return Run(sent_s, clock_s, np.full(len(sent_s), LOCKED), began_s, seed)


def watch(packets: Packets, began_s: float, step_s: float = 0.1) -> Watched:
    """Return the results of a monitor for packets that arrive in pieces.

    Args:
        began_s: the host's time at the start, seconds since 1970.
        step_s: the duration of a piece.
    """
    monitor = ClockMonitor(packets.sensor)
    arrivals_s = packets.host_ns / 1e9 - began_s
    edges = np.searchsorted(arrivals_s, np.arange(0, arrivals_s[-1] + step_s, step_s))
    watched = Watched(monitor, {}, {})
    for start, end in itertools.pairwise(edges.tolist()):
        for event in monitor.add(packets.take(slice(start, end))):
            watched.events.setdefault(event.code, arrivals_s.item(end - 1))
        for finding in monitor.report().findings:
            watched.findings.setdefault(finding.code, arrivals_s.item(end - 1))
    return watched


@dataclass
class Watched:
    """The result of `watch`.

    Attributes:
        monitor: the monitor.
        events: code of each event -> when it was named first, seconds since the start.
        findings: code of each finding -> when it was reported first, seconds since the start.
    """

    monitor: ClockMonitor
    events: dict[str, float]
    findings: dict[str, float]

    @property
    def faults(self) -> set[str]:
        """The codes of all faults that were named."""
        codes = {*self.events, *self.findings}
        return {code for code in codes if FINDING_TYPES[code].is_fault}
