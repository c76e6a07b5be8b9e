"""Convert the times of a sensor to times of the host, by the arrival of packets.

The sensor's clock may start at any time, run fast or slow, and restart. The host's clock is
correct, but a packet arrives some milliseconds after it was sent.

In this module, the delay of a packet is its arrival time minus the sensor's time. If the delays are
drawn over the sensor's time, all of them lie above a line, which is the shortest possible delay.
The height of the line is the offset between the clocks, and its slope is the drift. `fit_line` fits
the line to the smallest delay of each quarter of a second.

Source: S. B. Moon, P. Skelly, D. Towsley, Estimation and removal of clock skew from network delay
measurements, INFOCOM 1999 (the line); L. Zhang, Z. Liu, C. H. Xia, Clock synchronization algorithms
for network measurements, INFOCOM 2002 (the hull).
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarspec.frames.arrays import split_runs

Times = NDArray[np.int64]

PART_NS = 250_000_000  # the smallest delay of each part is kept
PARTS = 120  # kept parts: half a minute
MIN_PARTS_FOR_SLOPE = 20
MIDDLE_PARTS = 8  # hull edges so far before and after the middle limit the slope
SETTLED_PARTS = 40  # after which the line is reliable
MAX_DRIFT = 0.02  # share of the time, for a microcontroller without a crystal
SLEW_TIME_NS = 1_000_000_000  # in which stamps approach the line
MAX_SLEW = 0.05  # share of the time: 50,000 ppm
# Deviations from the line at which the clock was not set, before it is settled, and after.
UNSETTLED_LIMIT_NS = 1_000_000_000
EARLY_LIMIT_NS = 5_000_000
LATE_LIMIT_NS = 10_000_000
# Consecutive outliers that show that the clock was set.
CERTAIN_OUTLIERS = 3
LATE_OUTLIERS = 5  # if they are only late
LATE_OUTLIERS_NS = 1_000_000_000  # minimum duration if they are only late
MIN_LATE_SPREADS = 4  # minimum of lateness divided by spread, if they are only late


class ClockSample(NamedTuple):
    """The time of a packet by the sensor's clock, and the delay of the packet, ns."""

    device: int
    delay: int

    @property
    def host(self) -> int:
        """The arrival time, ns."""
        return self.device + self.delay


class ClockLine(NamedTuple):
    """The shortest delay of packets as a linear function of the sensor's time.

    Attributes:
        device: the time by the sensor's clock at which `delay` applies, ns.
        delay: the shortest delay at this time, ns.
        slope: the change of the delay divided by the change of the sensor's time.
    """

    device: int
    delay: int
    slope: float

    def delay_at(self, device: int) -> int:
        """Return the delay at a time of the sensor, ns."""
        return self.delay + round(self.slope * (device - self.device))


class ClockJump(NamedTuple):
    """A jump of the sensor's clock, for example because it was set or restarted.

    Attributes:
        change_ns: the sensor's time after the jump minus the time without the jump.
        host_ns: the arrival time of the first packet after the jump.
    """

    change_ns: int
    host_ns: int


class DeviceClock:
    """Converts the times of a sensor to times of the host.

    All results are late by the shortest time that a packet needs to reach the host.

    Args:
        parts: the length of the time range to which the line is fitted, in units of 0.25 s. The
            time range ends at the newest packet.

    Attributes:
        jumps: how often the sensor's clock was set.
        jump: the last jump; None if there was no jump in the last ten seconds.
    """

    def __init__(self, parts: int = PARTS) -> None:
        self._parts = parts
        self._stamp = -(1 << 62)
        self.jumps = 0
        self.jump: ClockJump | None = None
        self._min_delays = deque[ClockSample](maxlen=parts)
        self._outliers = deque[ClockSample](maxlen=LATE_OUTLIERS)
        self._first_outlier_ns = 0
        self._line = ClockLine(0, 0, 0.0)
        self._reliable_slope = 0.0
        self._last_stamped: ClockSample | None = None

    @property
    def offset_ns(self) -> int:
        """The host's time minus the sensor's, at the newest packet."""
        return self._line.delay

    @property
    def drift_ppm(self) -> float:
        """How much faster the sensor's clock runs than the host's, in millionths."""
        return (1 / (1 + self._line.slope) - 1) * 1e6

    @property
    def is_uncertain(self) -> bool:
        """Whether the newest packets suggest that the clock was set."""
        return bool(self._outliers)

    @property
    def is_settled(self) -> bool:
        """Whether ten seconds have passed since the start or a jump of the clock."""
        return len(self._min_delays) >= SETTLED_PARTS

    def delays_above_line(self, device: Times, host: Times) -> NDArray[np.float64]:
        """Return how much later packets arrive than the fastest ones, (n,) ns.

        Args:
            device: the times of the packets by the sensor's clock, (n,) ns.
            host: the arrival times of the packets, (n,) ns.
        """
        line = self._line
        expected = line.delay + line.slope * (device - line.device)
        return host - device - expected

    def observe(self, device_ns: ArrayLike, host_ns: ArrayLike) -> list[ClockJump]:
        """Update the conversion with packets, and return the jumps of the clock.

        Args:
            device_ns, host_ns: the times of the packets by the sensor's clock, and their arrival
                times; int64 ns, shape (n,) or one number each.
        """
        jumps = []
        device = np.atleast_1d(np.asarray(device_ns, np.int64))
        delays = np.asarray(host_ns, np.int64) - device
        for part in split_runs(device // PART_NS):
            fastest = part.start + int(delays[part].argmin())
            jump = self._add_sample(ClockSample(device.item(fastest), delays.item(fastest)))
            if jump is not None:
                jumps.append(jump)
        return jumps

    def forget_offset(self) -> None:
        """Forget the offset of the clock, but not the drift."""
        self._min_delays.clear()
        self._outliers.clear()
        self._last_stamped = None

    def stamp(self, device_ns: int, host_ns: int) -> int:
        """Return the time of a scan by the host's clock, ns.

        Each call returns a later time than the previous call.

        Args:
            device_ns: the time of the scan's first point by the sensor's clock, ns.
            host_ns: the arrival time of the packet with this point, ns.
        """
        self.observe(device_ns, host_ns)
        offset = host_ns - device_ns
        went_back = self._last_stamped is not None and device_ns <= self._last_stamped.device
        if not went_back:
            offset = min(self._find_slewed_delay(device_ns), offset)
        self._last_stamped = ClockSample(device_ns, offset)
        self._stamp = max(device_ns + offset, self._stamp + 1)
        return self._stamp

    def stamp_packets(self, device: Times, host: Times) -> Times:
        """Return the times of packets by the host's clock, (n,) ns.

        Each time is later than the previous time, also from call to call.

        Args:
            device: the times of the packets by the sensor's clock, (n,) ns.
            host: the arrival times of the packets, (n,) ns.
        """
        stamps = np.empty(len(device), np.int64)
        for part in split_runs(device // PART_NS):
            if self._is_regular(device[part], host[part]):
                stamps[part] = self._stamp_part(device[part], host[part])
            else:
                pairs = zip(device[part].tolist(), host[part].tolist(), strict=True)
                stamps[part] = [self.stamp(*pair) for pair in pairs]
        return stamps

    def _is_regular(self, device: Times, host: Times) -> bool:
        """Return whether packets are in order and close to a reliable line."""
        if self._last_stamped is None or self._outliers or not self.is_settled or not len(device):
            return False
        if (np.diff(device, prepend=self._last_stamped.device) <= 0).any():
            return False
        lowest = self.delays_above_line(device, host).min().item()
        return bool(-EARLY_LIMIT_NS < lowest < LATE_LIMIT_NS)

    def _stamp_part(self, device: Times, host: Times) -> Times:
        """Return the times of regular packets by the host's clock, (n,) ns."""
        # The packets are from one quarter of a second, in which the delay changes evenly.
        before = self._last_stamped
        assert before is not None
        self.observe(device, host)
        last = device.item(-1)
        delay_change = self._find_slewed_delay(last) - before.delay
        steps = (device - before.device) / (last - before.device)
        delays = before.delay + np.rint(delay_change * steps).astype(np.int64)
        delays = np.minimum(delays, host - device)
        self._last_stamped = ClockSample(last, delays.item(-1))
        # each stamp is at least 1 ns later than the one before
        numbers = np.arange(len(device))
        stamps = np.maximum(device + delays - numbers, self._stamp + 1)
        stamps = np.maximum.accumulate(stamps) + numbers
        self._stamp = stamps.item(-1)
        return stamps

    def _find_slewed_delay(self, device: int) -> int:
        """Return the delay that is added to a time of the sensor to get a stamp, ns.

        If the line changes, the delay approaches the new line gradually, so that stamps do not
        jump.
        """
        if self._last_stamped is None:
            return self._line.delay_at(device)
        step = device - self._last_stamped.device
        unchanged = self._last_stamped.delay + round(self._line.slope * step)
        correction = (self._line.delay_at(device) - unchanged) * min(step / SLEW_TIME_NS, 1.0)
        limit = MAX_SLEW * step
        return unchanged + round(min(max(correction, -limit), limit))

    def _add_sample(self, sample: ClockSample) -> ClockJump | None:
        """Update the line with a sample; return a jump of the clock if there is one."""
        deviation = self._find_deviation(sample)
        has_paused = (
            bool(self._min_delays)
            and sample.host - self._min_delays[-1].host > self._parts * PART_NS
        )
        if has_paused and abs(deviation) < UNSETTLED_LIMIT_NS:
            self.forget_offset()  # the drift is not known well enough for such a pause
        early_limit = UNSETTLED_LIMIT_NS
        late_limit = UNSETTLED_LIMIT_NS
        if self.is_settled:
            early_limit = EARLY_LIMIT_NS
            late_limit = LATE_LIMIT_NS
        if not self._min_delays or -early_limit < deviation < late_limit:
            self._outliers.clear()
            self._update_line(sample)
            return None
        if not self._outliers:
            self._first_outlier_ns = sample.host
        self._outliers.append(sample)
        if self._was_set(sample.host - self._first_outlier_ns):
            return self._restart_at_outliers()
        return None

    def _find_deviation(self, sample: ClockSample) -> int:
        """Return how much later a sample arrived than a packet on the line, ns."""
        return sample.delay - self._line.delay_at(sample.device)

    def _was_set(self, lasting: int) -> bool:
        """Return whether the outliers show that the clock was set.

        Args:
            lasting: the time since the first outlier, ns.
        """
        newest = self._min_delays[-1].device
        outliers = list(self._outliers)
        are_early = [
            self._find_deviation(sample) < 0 or sample.device < newest
            for sample in outliers[-CERTAIN_OUTLIERS:]
        ]
        if len(are_early) == CERTAIN_OUTLIERS and all(are_early):
            return True
        delays = [sample.delay for sample in outliers]
        spread = sum(delays) / len(delays) - min(delays)
        return (
            len(outliers) == LATE_OUTLIERS
            and lasting >= LATE_OUTLIERS_NS
            and min(map(self._find_deviation, outliers)) > MIN_LATE_SPREADS * spread
        )

    def _restart_at_outliers(self) -> ClockJump:
        """Restart the estimate with the newest outliers, and return the clock's jump."""
        outliers = list(self._outliers)[-CERTAIN_OUTLIERS:]
        self.jumps += 1
        host_ns = outliers[-1].host
        delay_before = self._line.delay_at(host_ns - self._line.delay)
        delay_after = min(sample.delay for sample in outliers)
        jump = ClockJump(delay_before - delay_after, self._first_outlier_ns)
        self.jump = jump
        self.forget_offset()
        for sample in outliers:
            self._update_line(sample)
        return jump

    def _update_line(self, sample: ClockSample) -> None:
        """Fit the line again if the sample is the lowest in its quarter of a second."""
        slope = self._line.slope
        if self._min_delays and sample.device // PART_NS <= self._min_delays[-1].device // PART_NS:
            last = self._min_delays[-1]
            if sample.device < last.device or sample.delay - last.delay > slope * (
                sample.device - last.device
            ):
                return
            self._min_delays.pop()
        self._min_delays.append(sample)
        self._line = fit_line(self._min_delays, self._reliable_slope)
        if self.is_settled:
            self.jump = None
        if len(self._min_delays) == self._parts:
            self._reliable_slope = self._line.slope


def fit_line(samples: Sequence[ClockSample], slope_before: float) -> ClockLine:
    """Fit a line below the samples, as high as possible, and return it.

    Args:
        samples: one or more samples in order.
        slope_before: the slope of the previous line.
    """
    # The slope of the hull just before and just after the middle limits the slope of the line.
    # Between these limits the samples determine no better slope, so the previous one is kept.
    hull = lower_hull(samples)
    last = samples[-1]
    slope = slope_before
    middle = (len(samples) - 1) / 2
    if len(samples) >= MIN_PARTS_FOR_SLOPE:
        slope = min(
            max(slope, slope_at(middle - MIDDLE_PARTS, samples, hull)),
            slope_at(middle + MIDDLE_PARTS, samples, hull),
        )
        slope = min(max(slope, -MAX_DRIFT), MAX_DRIFT)
    height = min(
        samples[index].delay - last.delay - slope * (samples[index].device - last.device)
        for index in hull
    )
    return ClockLine(last.device, last.delay + round(height), slope)


def lower_hull(samples: Sequence[ClockSample]) -> list[int]:
    """Return the indexes of the samples on the lower convex hull, from left to right."""
    hull: list[int] = []
    for index, (device, delay) in enumerate(samples):
        while len(hull) > 1:
            left, low = samples[hull[-2]]
            right, high = samples[hull[-1]]
            if (high - low) * (device - left) < (delay - low) * (right - left):
                break
            hull.pop()
        hull.append(index)
    return hull


def slope_at(index: float, samples: Sequence[ClockSample], hull: Sequence[int]) -> float:
    """Return the slope of the hull's edge at a position in `samples`.

    Args:
        index: the position, which may be between two samples, such as 2.5.
        samples: the samples in order.
        hull: the indices of the samples on the hull.
    """
    end = min(max(bisect_left(hull, index), 1), len(hull) - 1)
    left, low = samples[hull[end - 1]]
    right, high = samples[hull[end]]
    return (high - low) / (right - left)
