"""Measure a running sensor: speed, rates, losses and jitter."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.framing.results import Counters
from lidarspec.packets.packets import Packets
from lidarspec.scans.scan import Scan

#: Maximum number of scans that means are calculated from.
MAX_KEPT_SCANS = 1 << 12
#: A scan whose duration differs from the median by more than this share is not used for the speed:
#: the end of a scan may be lost.
MAX_PERIOD_DEVIATION = 0.5
Seconds = NDArray[np.float64]


@dataclass(frozen=True)
class MeterReading:
    """Statistics of a period of time; None for an unknown value.

    Attributes:
        seconds: the duration.
        speed_hz: scans per second, from the times of the scans.
        scans: number of complete scans.
        packets: number of packets.
        packet_rate_hz: packets per second.
        points: mean number of points per scan.
        valid: mean number, per scan, of points with a return.
        error_rate: the share of frames with a wrong checksum, length or value, from 0 to 1.
        skipped_rate: the share of bytes that are not in frames and are not fillers, from 0 to 1.
        loss_rate: the share of lost packets, from 0 to 1; None if losses are not counted.
        jitter_s: standard deviation of the time between the arrivals of packets.
        longest_gap_s: maximum time between the arrivals of two packets.
        bytes_per_s: bytes of input per second.
    """

    seconds: float | None
    speed_hz: float | None
    scans: int
    packets: int
    packet_rate_hz: float | None
    points: float | None
    valid: float | None
    error_rate: float
    skipped_rate: float
    loss_rate: float | None
    jitter_s: float | None
    longest_gap_s: float | None
    bytes_per_s: float | None

    def to_dict(self) -> dict[str, Any]:
        """Return the statistics by name."""
        return asdict(self)


EMPTY_READING = MeterReading(
    seconds=None,
    speed_hz=None,
    scans=0,
    packets=0,
    packet_rate_hz=None,
    points=None,
    valid=None,
    error_rate=0.0,
    skipped_rate=0.0,
    loss_rate=None,
    jitter_s=None,
    longest_gap_s=None,
    bytes_per_s=None,
)


class RateTally:
    """Counts packets and scans from its creation on.

    Args:
        counters: the current counters of the decoder.
    """

    def __init__(self, counters: Counters) -> None:
        self._totals_before = totals(counters)
        self.scans = 0
        self.packets = 0
        self._periods = deque[float](maxlen=MAX_KEPT_SCANS)
        # The points and the valid points of each scan.
        self._sizes = deque[tuple[int, int]](maxlen=MAX_KEPT_SCANS)
        self._gap_count = 0
        self._gap_sum = 0.0
        self._gap_square_sum = 0.0
        self._longest_gap = 0.0
        self._is_by_host = True

    def add_packets(self, count: int, gaps: Seconds, *, by_host: bool) -> None:
        """Count packets.

        Args:
            count: number of packets.
            gaps: time from each packet to the next, (n,) seconds.
            by_host: whether the gaps are from arrival times, instead of times of the sensor's
                clock.
        """
        self.packets += count
        self._is_by_host = by_host
        if len(gaps):
            self._gap_count += len(gaps)
            self._gap_sum += float(gaps.sum())
            self._gap_square_sum += float(np.square(gaps).sum())
            self._longest_gap = max(self._longest_gap, float(gaps.max()))

    def add_scan(self, points: int, valid: int, rate_hz: float) -> None:
        """Count a complete scan."""
        self.scans += 1
        self._sizes.append((points, valid))
        if rate_hz > 0 and np.isfinite(rate_hz):
            self._periods.append(1 / rate_hz)

    def make_reading(
        self, counters: Counters, *, seconds: float | None, counts_losses: bool
    ) -> MeterReading:
        """Return the statistics since the tally was made.

        Args:
            counters: the current counters of the decoder.
            seconds: the duration; None to use the sum of the times between packets.
            counts_losses: whether lost packets are counted (`Sensor.counts_losses`).
        """
        duration = seconds or self._gap_sum or None
        change = {
            name: total - self._totals_before[name] for name, total in totals(counters).items()
        }
        good_bytes = change["bytes_in"] - change["skipped"]
        return MeterReading(
            seconds=duration,
            speed_hz=self._speed(),
            scans=self.scans,
            packets=self.packets,
            packet_rate_hz=self._packet_rate(duration),
            points=_mean([points for points, _ in self._sizes]),
            valid=_mean([valid for _, valid in self._sizes]),
            error_rate=_share(change["rejected"], change["frames"]),
            skipped_rate=_share(change["skipped"], good_bytes),
            loss_rate=_share(max(change["lost"], 0), self.packets) if counts_losses else None,
            jitter_s=self._jitter() if self._has_arrivals else None,
            longest_gap_s=self._longest_gap if self._has_arrivals else None,
            bytes_per_s=change["bytes_in"] / duration if duration else None,
        )

    def _speed(self) -> float | None:
        """Return the scans per second; None if unknown."""
        if not self._periods:
            return None
        periods = np.sort(self._periods)
        # The lower of two middle values: a mean of both may be far from every period.
        median = periods[(len(periods) - 1) // 2]
        is_usual = np.abs(periods - median) <= MAX_PERIOD_DEVIATION * median
        # Arrival times may be coarse, so the mean is more exact than the median.
        return float(1 / periods[is_usual].mean())

    @property
    def _has_arrivals(self) -> bool:
        return self._gap_sum > 0 and self._is_by_host

    def _packet_rate(self, duration: float | None) -> float | None:
        """Return the packets per second; None if unknown.

        Args:
            duration: the duration in seconds, which is used if the packets have no times.
        """
        if self._gap_sum:
            return self._gap_count / self._gap_sum
        if duration:
            return self.packets / duration
        return None

    def _jitter(self) -> float:
        mean = self._gap_sum / self._gap_count
        return math.sqrt(max(self._gap_square_sum / self._gap_count - mean * mean, 0.0))


class RateMeter:
    """Counts packets and scans, since the last reading and from the beginning.

    Args:
        counters: the current counters of the decoder.
        counts_losses: whether lost packets are counted (`Sensor.counts_losses`).
    """

    def __init__(self, counters: Counters, *, counts_losses: bool) -> None:
        self._counts_losses = counts_losses
        self._last_ns: int | None = None
        self._recent = RateTally(counters)
        self._all = RateTally(counters)

    def add_packets(self, packets: Packets) -> None:
        """Count a batch of packets."""
        arrivals = packets.host_ns[packets.host_ns > 0]
        if len(arrivals):
            self._count_packets(len(packets), arrivals, by_host=True)
        else:
            self._count_packets(len(packets), packets.time_ns, by_host=False)

    def add_frames(self, count: int, arrivals: NDArray[np.int64]) -> None:
        """Count frames of several types.

        Args:
            count: number of frames.
            arrivals: their arrival times, ascending, (n,) ns.
        """
        self._count_packets(count, arrivals, by_host=True)

    def _count_packets(self, count: int, times: NDArray[np.int64], *, by_host: bool) -> None:
        """Count packets by their times, (n,) ns, ascending."""
        previous = np.array([] if self._last_ns is None else [self._last_ns], np.int64)
        gaps = np.diff(np.concatenate([previous, times])) * 1e-9
        if len(times):
            self._last_ns = int(times[-1])
        for tally in (self._recent, self._all):
            tally.add_packets(count, gaps, by_host=by_host)

    def add_scan(self, scan: Scan) -> None:
        """Count a complete scan; ignore an incomplete scan."""
        if not scan.whole:
            return
        valid = int(scan.points.valid.sum())
        for tally in (self._recent, self._all):
            tally.add_scan(len(scan), valid, scan.rate_hz)

    def take_reading(self, counters: Counters, seconds: float | None = None) -> MeterReading:
        """Return the statistics since the last call of this method, and start a new period."""
        reading = self._recent.make_reading(
            counters, seconds=seconds, counts_losses=self._counts_losses
        )
        self._recent = RateTally(counters)
        return reading

    def summary(self, counters: Counters, seconds: float | None = None) -> MeterReading:
        """Return the statistics since the meter was made."""
        return self._all.make_reading(counters, seconds=seconds, counts_losses=self._counts_losses)


def totals(counters: Counters) -> dict[str, int]:
    """Return the counts that the rates in a `MeterReading` are calculated from."""
    rejected = (
        counters.bad_checksum + counters.bad_length + counters.bad_constant + counters.implausible
    )
    return {
        "bytes_in": counters.bytes_in,
        "frames": sum(counters.frames.values()),
        "rejected": rejected,
        "skipped": counters.bytes_skipped - counters.bytes_filler,
        "lost": counters.lost,
    }


def format_number(value: float | None, form: str, factor: float = 1) -> str:
    """Return a number as text; "-" if it is unknown.

    Args:
        value: the number; None if unknown.
        form: the format, for `str.format`.
        factor: the number is multiplied by this factor.
    """
    if value is None or not math.isfinite(value):
        return "-"
    return form.format(value * factor)


def _share(part: int, rest: int) -> float:
    total = part + rest
    if total > 0:
        return part / total
    return 0.0


def _mean(values: Sequence[int]) -> float | None:
    if values:
        return float(np.mean(values))
    return None
