"""The time of a sensor's clock by the clock of the host, from when its packets arrived.

The sensor says when it measured, by a clock that began anywhere, runs fast or slow by some
millionths, and may start again. The host says when a packet arrived: by the right clock, but late,
by milliseconds that differ from packet to packet, as the line and the operating system please. A
packet is never early. So the differences, arrival less sensor's time, lie above a line, that of
packets without delay, and many lie close to it: its height is the offset between the clocks, its
slope the drift.

Of the last half minute the least difference of each quarter of a second is kept, and the lower
convex hull of these is taken. The line is
under all of them and as near as can be, which is the edge of the hull at their middle. Two seconds
to either side it may have turned round: then the points are not sure of a slope, and the one that
was known before stands. What comes out follows the line smoothly. A clock that was set is one from
which several packets in a row come too early, or, for a second, later than they differ among
themselves.

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

from lidarspec.transports.host_clock import HostClock
from lidarspec_ros2.parameters import Settings

Times = NDArray[np.int64]

#: ns of which the least difference is kept, and how many of them: half a minute.
PART, PARTS = 250_000_000, 120
#: parts that tell a slope, those to either side of the middle over which it may not turn round, and
#: parts after which it is relied on.
SLOPED, SURE, SETTLED = 20, 8, 40
#: the share by which a sensor's clock may be fast or slow: that of a microcontroller without a
#: crystal.
FASTEST = 0.02
#: ns in which what comes out follows the line, and the share of its own pace, 50,000 ppm, by which
#: it does so at most.
FOLLOWS, SLEW = 1_000_000_000, 0.05
#: ns by which a packet is off the line at most, below and above, where its clock was not set; and
#: before the line holds.
EARLY, LATE, UNSETTLED = 5_000_000, 10_000_000, 1_000_000_000
#: packets in a row that tell that the clock was set; where they are only late, how many, for how
#: many ns.
SURELY, PROBABLY, FOR = 3, 5, 1_000_000_000


class ClockSample(NamedTuple):
    """A time of the sensor, and the difference to when it arrived, ns."""

    device: int
    delay: int


class ClockLine(NamedTuple):
    """The difference of a packet without delay: at a time of the sensor, and its slope."""

    device: int
    delay: int
    slope: float

    def at(self, device: int) -> int:
        """Return the difference at a time of the sensor, ns."""
        return self.delay + round(self.slope * (device - self.device))


class MessageStamps:
    """The stamps of one sensor's messages, in ROS's time.

    Args:
        wall: the computer's clock, of a live sensor: arrival times go on evenly where it is set,
            and ROS's time does not. None where a recording is played.

    Attributes:
        clock: the sensor's clock by the host's.
    """

    def __init__(self, wall: HostClock | None) -> None:
        self.clock, self._wall, self._ahead = DeviceClock(), wall, 0

    def learn(self, device_ns: Times, host_ns: Times) -> None:
        """Learn from packets how the sensor's clock goes, and look whether the computer's was set.

        Args:
            device_ns, host_ns: as of `DeviceClock.observe`; a packet of whose arrival nobody knows
                has 0 and tells nothing.
        """
        is_known = host_ns > 0
        self.clock.observe(device_ns[is_known], host_ns[is_known])
        ahead = None if self._wall is None else self._wall.find_step()
        self._ahead = self._ahead if ahead is None else ahead

    def of(self, device_ns: int, host_ns: int, settings: Settings) -> int:
        """Return the stamp of the next scan, ns.

        It follows from the sensor's time and the arrival time of the first point.
        """
        return self._choose_stamp(
            device_ns, self.clock.stamp(device_ns, host_ns), host_ns, settings
        )

    def at(self, time_ns: int, settings: Settings, *, by_clock: bool) -> int:
        """Return the stamp of something that is not a scan, ns.

        Args:
            time_ns: between those of packets.
            by_clock: whether it is by the sensor's clock; else it is when it arrived.
        """
        estimated = time_ns + self.clock.offset_ns * by_clock
        return self._choose_stamp(time_ns, estimated, estimated, settings)

    def _choose_stamp(self, own: int, estimated: int, arrival: int, settings: Settings) -> int:
        """What the parameters want of the three: the sensor's time, what is made of it, and the
        arrival.
        """
        if settings["use_device_time"] and settings["device_time_is_ros_time"]:
            at = own
        else:
            at = (estimated if settings["use_device_time"] else arrival) + self._ahead
        offset: float = settings["time_offset"]
        return at + round(offset * 1e9)


class DeviceClock:
    """Times of a sensor as those of the host.

    A delay that never changes cannot be told from an offset: the time on the line, and what the
    sensor needs before it sends, stay in the times that come out.

    Attributes:
        jumps: how often the sensor's clock was set.
        jump: by how much, in a sentence, for ten seconds after it; else empty.
    """

    def __init__(self) -> None:
        self._stamp = -(1 << 62)
        self.jumps, self.jump = 0, ""
        self._least, self._strays, self._since = (
            deque[ClockSample](maxlen=PARTS),
            deque[ClockSample](maxlen=PROBABLY),
            0,
        )
        self._line, self._known = ClockLine(0, 0, 0.0), 0.0
        self._shown: ClockSample | None = None

    @property
    def offset_ns(self) -> int:
        """What the host's clock is ahead of the sensor's, at the newest packet."""
        return self._line.delay

    @property
    def drift_ppm(self) -> float:
        """By how much the sensor's clock is fast, in millionths."""
        return (1 / (1 + self._line.slope) - 1) * 1e6

    def observe(self, device_ns: ArrayLike, host_ns: ArrayLike) -> None:
        """Learn from packets.

        Args:
            device_ns, host_ns: when they were sent by the sensor's clock, and when they arrived,
                int64 ns, shape (n,) or a number each.
        """
        device = np.atleast_1d(np.asarray(device_ns, np.int64))
        delays = np.asarray(host_ns, np.int64) - device
        edges = np.flatnonzero(np.diff(device // PART)) + 1
        for times, late in zip(np.split(device, edges), np.split(delays, edges), strict=True):
            if len(late):
                self._take(ClockSample(times.item(late.argmin()), late.item(late.argmin())))

    def stamp(self, device_ns: int, host_ns: int) -> int:
        """The host's time of a time of the sensor, later than all that were given before; learns
        from it, too.

        Args:
            device_ns: the time of the first point of the next scan.
            host_ns: when its packet arrived, ns.
        """
        self.observe(device_ns, host_ns)
        went_back = self._shown is not None and device_ns <= self._shown.device
        offset = (
            host_ns - device_ns if went_back else min(self._slew(device_ns), host_ns - device_ns)
        )
        self._shown = ClockSample(device_ns, offset)
        self._stamp = max(device_ns + offset, self._stamp + 1)
        return self._stamp

    def _slew(self, device: int) -> int:
        """Return the offset that follows the line."""
        if self._shown is None:
            return self._line.at(device)
        step = device - self._shown.device
        steady = self._shown.delay + round(self._line.slope * step)
        wanted, limit = (self._line.at(device) - steady) * min(step / FOLLOWS, 1.0), SLEW * step
        return steady + round(min(max(wanted, -limit), limit))

    def _take(self, sample: ClockSample) -> None:
        """Learn from the least delayed of some packets."""
        off, has_paused = (
            self._off(sample),
            bool(self._least) and sum(sample) - sum(self._least[-1]) > PARTS * PART,
        )
        if has_paused and abs(off) < UNSETTLED:  # over so long the drift is not known well enough
            self._begin()
        early, late = (EARLY, LATE) if len(self._least) >= SETTLED else (UNSETTLED, UNSETTLED)
        if not self._least or -early < off < late:
            self._strays.clear()
            self._learn(sample)
            return
        if not self._strays:
            self._since = sum(sample)
        self._strays.append(sample)
        if self._was_set(sum(sample) - self._since):
            self._follow()

    def _begin(self) -> None:
        """Forget all but the drift."""
        self._least.clear()
        self._strays.clear()
        self._shown = None

    def _off(self, sample: ClockSample) -> int:
        """By how much a sample is above the line, ns."""
        return sample.delay - self._line.at(sample.device)

    def _was_set(self, lasting: int) -> bool:
        """Whether the clock was set before the strays came, for so many ns, and they are not only
        late.
        """
        newest, strays = self._least[-1].device, list(self._strays)
        surely = [self._off(sample) < 0 or sample.device < newest for sample in strays[-SURELY:]]
        if len(surely) == SURELY and all(surely):
            return True
        delays = [sample.delay for sample in strays]
        spread = sum(delays) / len(delays) - min(delays)
        return (
            len(strays) == PROBABLY and lasting >= FOR and min(map(self._off, strays)) > 4 * spread
        )

    def _follow(self) -> None:
        """Begin again with the newest strays, as the clock was set before they came; the drift
        stays.
        """
        strays = list(self._strays)[-SURELY:]
        self.jumps += 1
        self.jump = (
            "the sensor's clock was changed by"
            f" {(self._line.delay - min(sample.delay for sample in strays)) / 1e9:+.3f} s"
        )
        self._begin()
        for sample in strays:
            self._learn(sample)

    def _learn(self, sample: ClockSample) -> None:
        """Keep a sample where it is the least of its part, and draw the line anew."""
        slope = self._line.slope
        if self._least and sample.device // PART <= self._least[-1].device // PART:
            last = self._least[-1]
            if sample.device < last.device or sample.delay - last.delay > slope * (
                sample.device - last.device
            ):
                return
            self._least.pop()
        self._least.append(sample)
        self._line = fit_line(self._least, self._known)
        if len(self._least) >= SETTLED:
            self.jump = ""
        if len(self._least) == PARTS:
            self._known = self._line.slope


def fit_line(least: Sequence[ClockSample], slope_before: float) -> ClockLine:
    """The line under some samples that is as near to them as can be, of a slope that they are sure
    of.

    Args:
        least: in order, one or more.
        slope_before: the slope before; the result's is the nearest to it of those that they allow.
    """
    hull, last = lower_hull(least), least[-1]
    slope, middle = slope_before, (len(least) - 1) / 2
    if len(least) >= SLOPED:
        slope = min(
            max(slope, slope_over(middle - SURE, least, hull)),
            slope_over(middle + SURE, least, hull),
        )
        slope = min(max(slope, -FASTEST), FASTEST)
    height = min(
        least[place].delay - last.delay - slope * (least[place].device - last.device)
        for place in hull
    )
    return ClockLine(last.device, last.delay + round(height), slope)


def lower_hull(samples: Sequence[ClockSample]) -> list[int]:
    """Return the places of those samples that lie on the lower convex hull, from left to right."""
    hull: list[int] = []
    for place, (device, delay) in enumerate(samples):
        while len(hull) > 1:
            (left, low), (right, high) = samples[hull[-2]], samples[hull[-1]]
            if (high - low) * (device - left) < (delay - low) * (right - left):
                break
            hull.pop()
        hull.append(place)
    return hull


def slope_over(place: float, samples: Sequence[ClockSample], hull: Sequence[int]) -> float:
    """Return the slope of the edge of a hull over a place among the samples."""
    end = min(max(bisect_left(hull, place), 1), len(hull) - 1)
    (left, low), (right, high) = samples[hull[end - 1]], samples[hull[end]]
    return (high - low) / (right - left)
