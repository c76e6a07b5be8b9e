"""Scans: one revolution or frame period each, cut by the sensor's declared rule."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.columns.columns import Carry
from lidarspec.errors import UsageError
from lidarspec.packets.packets import Packets, joined as joined_packets
from lidarspec.packets.sequences import Reorder
from lidarspec.points.cloud import ColumnSource, LazyCloud, Mount, PointCloud, Stretch, Stretches, source_of
from lidarspec.points.evaluate import guarded
from lidarspec.points.plain import Evaluated
from lidarspec.scans.cutter import Cutter, first_points
from lidarspec.spec.description import Spec
from lidarspec.spec.timing import OnFlag


@dataclass(frozen=True, eq=False)
class LaserScan:
    """A planar scan with ROS's names: `ranges[i]` is at ``angle_min + i * angle_increment``, inf where there is no return.

    Attributes:
        ranges, intensities: (n,) float32.
        angle_min, angle_max, angle_increment: radians, counter-clockwise; ``angle_max = angle_min + (n - 1) * angle_increment``.
        time_increment, scan_time: seconds.
        range_min, range_max: metres, the sensor's.
        stamp_ns: of the first point.
    """

    angle_min: float
    angle_max: float
    angle_increment: float
    time_increment: float
    scan_time: float
    range_min: float
    range_max: float
    ranges: NDArray[np.float32]
    intensities: NDArray[np.float32]
    stamp_ns: int = 0


@dataclass(frozen=True, eq=False, repr=False)
class Scan:
    """The points between two cuts.

    Attributes:
        points: in stream order.
        rate_hz: one over the time to the next scan; nan where that is not known.
        complete: whether both ends were seen, and no more is missing between them than is there; the first and the last piece of a stream
            are not complete.
        sensor: whose.
    """

    points: PointCloud
    rate_hz: float
    complete: bool
    sensor: Spec

    @property
    def stamp_ns(self) -> int:
        """Time of the first point, int64 ns."""
        return self.points.stamp_ns

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        ranges = self.points.range[self.points.valid]
        span = f"{ranges.min():.2f}..{ranges.max():.2f} m" if len(ranges) else "no returns"
        rate = f"{self.rate_hz:.1f} Hz, " if np.isfinite(self.rate_hz) else ""
        nominal = ", nominal calibration" if self.points.nominal else ""
        return f"Scan({len(self)} points, {rate}{span}, {'complete' if self.complete else 'partial'}{nominal})"

    def to_bins(self, n: int) -> NDArray[np.float32]:
        """The nearest return in each of n equal sectors from -pi on: (n,) float32 metres, inf where there is none.

        Raises:
            UsageError: for a number of sectors that is none.
        """
        return self._binned(_sectors(n, "to_bins"))[0]

    def to_laserscan(self, n: int | None = None) -> LaserScan:
        """The scan on an even grid of n angles over the whole turn, by default as many as there are points.

        Raises:
            UsageError: for a number of angles that is none.
        """
        count = max(len(self), 1) if n is None else _sectors(n, "to_laserscan")
        ranges, intensities = self._binned(count, centred=True)
        step = 2 * np.pi / count
        period = (
            1 / self.rate_hz if np.isfinite(self.rate_hz) and self.rate_hz > 0 else float(np.ptp(self.points.time)) if len(self) else 0.0
        )
        near, far = self.sensor.range_limits
        return LaserScan(-np.pi, -np.pi + (count - 1) * step, step, period / count, period, near, far, ranges, intensities, self.stamp_ns)

    def _binned(self, n: int, *, centred: bool = False) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        valid = self.points.valid
        turns = (self.points.azimuth[valid].astype(np.float64) + np.pi) / (2 * np.pi) * n
        bins = (np.rint(turns) if centred else np.floor(turns)).astype(np.intp) % n
        ranges = self.points.range[valid]
        nearest = np.lexsort((ranges, bins))
        first = np.ones(len(nearest), np.bool_)
        first[1:] = np.diff(bins[nearest]) > 0
        chosen = nearest[first]
        binned, strength = np.full(n, np.inf, np.float32), np.zeros(n, np.float32)
        binned[bins[chosen]] = ranges[chosen]
        if self.points.intensity is not None:
            strength[bins[chosen]] = self.points.intensity[valid][chosen]
        return binned, strength


def _sectors(number: Any, place: str) -> int:
    if isinstance(number, bool) or not isinstance(number, int | np.integer) or number < 1:
        raise UsageError(f"{place} takes how many sectors the turn has, a whole number from 1 on, not {number!r}")
    return int(number)


class Losses:
    """What is missing of each scan: bytes of a stream that are in no frame, datagrams that are missing by their numbers."""

    def __init__(self, sensor: Spec) -> None:
        self._by_number, self._starts_are_seen = sensor.datagrams, isinstance(sensor.scan, OnFlag)
        self._last: tuple[int, int] | None = None  # where the last packet ends in the input, and its number
        self._there = self._missing = 0.0  # bytes of the scan under way

    def judged(self, packets: Packets, points: Evaluated, cuts: Sequence[int]) -> list[bool]:
        """Whether at least half of each scan is there that ends in these packets: one for each of the `cuts`, which are between points."""
        sizes, firsts = packets.whole_sizes[: points.ready], packets.first_parts
        missing = self._missing_before(packets, sizes)
        sizes = sizes if firsts is None else sizes * firsts[: points.ready]  # the bytes of a frame count once
        first = first_points(points) if len(cuts) else sizes
        judged, start = list[bool](), 0
        for cut in cuts:
            edge = int(np.searchsorted(first, cut, side="right")) - 1  # the packet that the cut is in
            begins = bool(first[edge] == cut)
            edge += not begins
            self._there += float(sizes[start:edge].sum())
            self._missing += float(missing[start : edge + begins].sum())
            judged.append(self._missing <= self._there)
            # of what is missing at the cut nobody knows to which scan it belongs, unless the packet there says that it is the first
            self._there, self._missing = 0.0, float(missing[edge]) if begins and not self._starts_are_seen else 0.0
            missing[edge : edge + begins] = 0
            start = edge
        self._there += float(sizes[start:].sum())
        self._missing += float(missing[start:].sum())
        return judged

    def _missing_before(self, packets: Packets, sizes: NDArray[np.intp]) -> NDArray[np.float64]:
        """The bytes that are missing before each of the packets, (k,)."""
        number, missing, last = len(sizes), np.zeros(len(sizes)), self._last
        if not number:
            return missing
        self._last = int(packets.offset[number - 1] + sizes[-1]), int(packets.index[number - 1])
        spots = np.flatnonzero(packets.breaks[:number])
        if len(spots) and self._by_number:
            before = np.append(packets.index[0] - 1 if last is None else last[1], packets.index[: number - 1])
            missing[spots] = ((packets.index[:number] - before - 1) * sizes)[spots]
        elif len(spots):
            ends = packets.offset[:number] + sizes
            missing[spots] = (packets.offset[:number] - np.append(ends[0] - sizes[0] if last is None else last[0], ends[:-1]))[spots]
        return np.maximum(missing, 0, out=missing)


class ScanStream:
    """Scans out of batches of packets; remembers what the next batch needs.

    Args:
        sensor: whose.
        mount: how it is mounted; the scans come in its carrier's axes.
    """

    def __init__(self, sensor: Spec, mount: Mount | None = None) -> None:
        self._sensor, self._mount = sensor, mount
        self._reorder = Reorder(enabled=sensor.sequence is not None)
        self._cutter = Cutter(sensor.scan)
        self._waiting: Packets | None = None
        self._carry: Carry = {}
        self._parts: list[Stretch] = []
        self._started = False
        self._epoch: int | None = None
        self._losses = Losses(sensor)
        self._begins: int | None = None  # time of the first point of the scan under way, ns, where it is known

    def add(self, packets: Packets) -> list[Scan]:
        """The scans that these packets complete."""
        return [scan for batch in self._reorder.push(packets) for scan in self._push(batch, final=False)]

    def finish(self) -> list[Scan]:
        """The scans that waited for more, and the piece that is left."""
        scans = [scan for batch in self._reorder.finish() for scan in self._push(batch, final=False)]
        if self._waiting is not None and len(self._waiting):
            waiting, self._waiting = self._waiting, None
            scans += self._push(waiting, final=True)
        left = self._close(None, complete=False)
        return scans + ([left] if left else [])

    def _push(self, packets: Packets, *, final: bool) -> list[Scan]:
        packets = packets.with_points
        if self._waiting is not None and len(self._waiting):
            packets = joined_packets([self._waiting, packets])
        self._waiting = None
        if not len(packets):
            return []
        if self._epoch is None:
            self._epoch = int(packets.time_ns[0])  # one for the whole stream, so that batches do not change a bit of any time
        points = guarded(packets, self._carry, final=final, epoch=self._epoch)
        if points is None:
            return []
        self._carry = points.carry
        if points.ready < len(packets):
            self._waiting = packets.take(slice(points.ready, None))
        return list(self._cut(packets, points))

    def _cut(self, packets: Packets, points: Evaluated) -> Iterator[Scan]:
        start, source, cuts = 0, source_of(points.cloud), self._cutter.cuts(packets, points)
        first, *times = _times_ns(source, [0, *cuts])
        self._begins = first if self._begins is None else self._begins
        mostly_there = self._losses.judged(packets, points, cuts)
        for cut, ends, is_there in zip(cuts, times, mostly_there, strict=True):
            self._take(source, start, cut)
            scan = self._close(ends, complete=self._started and is_there)
            self._begins = ends
            if scan is not None:
                self._started = True
                yield scan
            start = cut
        self._take(source, start, source.size)

    def _take(self, source: ColumnSource, start: int, stop: int) -> None:
        if start < stop:
            self._parts.append(Stretch(source, start, stop))

    def _close(self, ends: int | None, *, complete: bool) -> Scan | None:
        """The scan of the points so far; `ends`: the time of the first point after it, ns."""
        parts, self._parts = self._parts, []
        if not parts:
            return None
        begins = self._begins
        assert begins is not None  # since there are points
        period = (ends - begins) * 1e-9 if ends is not None else np.nan
        rate = 1 / period if period > 0 else np.nan
        cloud: PointCloud = LazyCloud.of(Stretches(parts, from_first=True), begins)
        mounted = cloud if self._mount is None else self._mount.applied(cloud)
        return Scan(mounted, float(rate) if complete else np.nan, complete, self._sensor)


def _times_ns(source: ColumnSource, indices: Sequence[int]) -> list[int | None]:
    """The times of some points in order, ns; None for those past the end."""
    known = [index for index in indices if index < source.size]
    times = source.times_at(np.array(known, np.intp)).tolist() if known else []
    return [source.base + round(time * 1e9) for time in times] + [None] * (len(indices) - len(known))


def scans_of(sensor: Spec, batches: Iterable[Packets]) -> Iterator[Scan]:
    """Every scan of batches of one stream."""
    stream = ScanStream(sensor)
    for batch in batches:
        yield from handed_out(stream.add(batch))
    yield from stream.finish()


def handed_out(scans: list[Scan]) -> Iterator[Scan]:
    """Scans one by one, each of which is forgotten then, and with it the columns that are made of it."""
    scans.reverse()
    while scans:
        yield scans.pop()
