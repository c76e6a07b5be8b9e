"""Scans: one revolution or frame period each, cut by the sensor's declared rule."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarspec.display import drawn
from lidarspec.errors import UsageError
from lidarspec.expressions.columns import Carry
from lidarspec.frames.arrays import alike, repeated
from lidarspec.packets.imu import ImuSamples, Waiting
from lidarspec.packets.packets import Packets, joined as joined_packets
from lidarspec.packets.reorder import Reorder
from lidarspec.points.cloud import (
    ColumnSource,
    LazyCloud,
    Mount,
    PointCloud,
    Stretch,
    Stretches,
    source_of,
)
from lidarspec.points.conventions import axes_of
from lidarspec.points.evaluate import guarded
from lidarspec.points.plain import Evaluated
from lidarspec.scans.cutter import Cutter, End, first_points
from lidarspec.scans.masking import Masking, describe
from lidarspec.spec.links import Serial
from lidarspec.spec.sensor import Sensor
from lidarspec.spec.timing import Every, OnFlag, OnRewind, OnWrap, Split

#: seconds that a turn takes at the slowest where no sensor says so; of a scan at least where
#: packets bear the host's time, which may pause.
SLOWEST = 1.0
UNTIMED = 1.0
#: bytes of a scan at the most where neither points nor a line say so, and packets looked at
#: together.
LARGEST = 1 << 26
TOGETHER = 1024
#: the frame that the points are in, by its usual name: x forward, y left, z up (REP-103).
FRAME_ID = "laser"
#: how much longer a scan with a gap may become than the whole one before it.
LONGER = 1.125


@dataclass(frozen=True, eq=False)
class LaserScan:
    """A planar scan with ROS's names.

    `ranges[i]` is at ``angle_min + i * angle_increment``, inf without a return.

    Attributes:
        ranges, intensities: (n,) float32.
        angle_min, angle_max, angle_increment: radians, counter-clockwise; ``angle_max = angle_min +
            (n - 1) * angle_increment``.
        time_increment: seconds from beam to beam, negative where the angle falls with time.
        scan_time: seconds from scan to scan.
        range_min, range_max: metres, the sensor's.
        stamp_ns: when `ranges[0]` was measured; of `ranges[i]` that is ``i * time_increment``
            later.
        host_ns: as in `Scan`.
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
    host_ns: int = 0


class Place(NamedTuple):
    """The frame that a point came from.

    Attributes:
        frame: its type.
        offset: of its first byte in the input.
        host_ns: when it arrived, ns since 1970; 0 where nobody knows it.
        part: which of the frame's parts that have points, from 0; 0 where it has them itself.
        number: which point of the frame, or of that part.
        data: the bytes of the frame; those that its fields stand in, where the wire has another
            form of them (`Frame.wire`).
    """

    frame: str
    offset: int
    host_ns: int
    part: int
    number: int
    data: bytes


class Provenance:
    """The packets that the points of a scan are made of, in stream order."""

    def __init__(self) -> None:
        self._size = 0
        self._batches = list[tuple[int, int, Packets, Evaluated, int]]()

    def add(self, packets: Packets, points: Evaluated, start: int, stop: int, before: int) -> None:
        """Add the points from `start` to `stop` of a batch.

        Args:
            before: the number of parts of the first frame in earlier batches.
        """
        self._batches.append((self._size, start, packets, points, before))
        self._size += stop - start

    def __call__(self, point: int) -> Place:
        """Where a point of the scan, by its index, came from.

        Raises:
            IndexError: for a point that the scan does not have.
        """
        if not 0 <= point < self._size:
            raise IndexError(f"point {point} of {self._size}")
        first, start, packets, points, before = next(
            batch for batch in reversed(self._batches) if batch[0] <= point
        )
        starts = first_points(points)
        local = start + point - first
        row = int(starts.searchsorted(local, side="right")) - 1
        frame = packets.frame.partition(".")[0]
        offset = int(packets.offset[row])
        at = int(packets.host_ns[row])
        table, which = packets.frames
        data = table.frame(row if isinstance(which, slice) else int(which[row]))
        return Place(frame, offset, at, rank(packets, row, before), local - int(starts[row]), data)

    def __reduce__(self) -> Any:
        return Provenance, ()  # packets do not go with a scan to another process


def rank(packets: Packets, row: int, before: int) -> int:
    """Return the index of a packet among the parts of its frame, from 0.

    Args:
        before: the number of parts of the first frame in earlier batches.
    """
    _, which = packets.frames
    if isinstance(which, slice):
        return 0
    return row - int(which.searchsorted(which[row])) + before * bool(which[row] == which[0])


@dataclass(frozen=True, eq=False, repr=False)
class Scan:
    """The points between two cuts.

    Attributes:
        points: in stream order.
        rate_hz: one over the time to the next scan; nan where that is not known, or the scan is not
            whole.
        complete: whether both ends were seen, and nothing is missing between them; the first and
            the last piece of a stream are not complete.
        sensor: whose.
        whole: whether both ends were seen, and no more is missing between them than is there.
        imu: what the IMU felt from the first point up to that of the next scan; None without an
            IMU, or where it has another clock.
        host_ns: when the packet of the first point arrived, int64 ns since 1970 by the computer's
            clock; 0 where nobody knows it.
        beams: how many `to_laserscan` gives where it is not told; None: as many as the sensor
            declares, else as there are points.
        frame_id: what ROS's messages call the frame of the points.
        number: which of its file it is, where that is read in pieces.
        mount: how the sensor is mounted: the points are in its carrier's axes; None where they are
            in its own.
        provenance: the frame that each point came from.
    """

    points: PointCloud
    rate_hz: float
    complete: bool
    sensor: Sensor
    whole: bool = False
    imu: ImuSamples | None = None
    host_ns: int = 0
    beams: int | None = None
    frame_id: str = FRAME_ID
    number: int | None = None
    mount: Mount | None = None
    provenance: Provenance = field(default_factory=Provenance)

    @property
    def stamp_ns(self) -> int:
        """Time of the first point, int64 ns."""
        return self.points.stamp_ns

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        ranges = self.points.range[self.points.valid]
        if len(ranges):
            span = f"{ranges.min():.2f}..{ranges.max():.2f} m"
        else:
            span = "no returns"
        if np.isfinite(self.rate_hz):
            rate = f"{self.rate_hz:.1f} Hz, "
        else:
            rate = ""
        if self.points.nominal:
            nominal = ", nominal calibration"
        else:
            nominal = ""
        if self.complete:
            state = "complete"
        elif self.whole:
            state = "with gaps"
        else:
            state = "partial"
        return f"Scan({len(self)} points, {rate}{span}, {state}{nominal})"

    _repr_svg_ = drawn("scan")

    @property
    def facts(self) -> dict[str, str]:
        """The origin of the points, as stored in files.

        `sensor`; `source`, the source of its format; `frame`, the directions of x, y and z;
        `calibration`, "nominal" or "own".
        """
        frame = ", ".join(
            f"{name} {way}" for name, way in zip("xyz", axes_of(self.sensor), strict=True)
        )
        return {
            "sensor": self.sensor.id,
            "source": self.sensor.source,
            "frame": frame,
            "calibration": self.points.calibration,
        }

    def to_arrow(self) -> Any:
        """Return the `pyarrow.Table` of the points, with `facts` in its metadata.

        See `PointCloud.to_arrow`.

        Raises:
            UsageError: where pyarrow is not installed.
        """
        return self.points.to_arrow(self.facts)

    def __arrow_c_stream__(self, requested_schema: object = None) -> object:
        """The table of `to_arrow`, as DuckDB, Polars and pandas take it from the object itself."""
        return self.to_arrow().__arrow_c_stream__(requested_schema)

    def to_bins(self, n: int) -> NDArray[np.float32]:
        """Return the nearest return in each of n equal sectors from -pi on.

        The result is (n,) float32, metres, inf without a return.

        Raises:
            UsageError: for a number of sectors that is none.
        """
        step = 2 * np.pi / _sectors(n, "to_bins")
        return self._binned(n, step / 2 - np.pi, step)[0]

    def to_laserscan(
        self, beams: int | None = None, field: tuple[float, float] | None = None
    ) -> LaserScan:
        """The scan on an even grid of so many angles, by default as `beams` says.

        Args:
            field: where the first and the last of them look, radians; by default they go round the
                whole turn from -pi on. The times of the beams are right where no scan begins within
                it: `Planes` finds such a field.

        Raises:
            UsageError: for a number of angles that is none.
        """
        if beams is not None:
            count = _sectors(beams, "to_laserscan")
        else:
            count = self.beams or self.sensor.beams or max(len(self), 1)
        first, last = field or (-np.pi, np.pi - 2 * np.pi / count)
        if count > 1:
            step = (last - first) / (count - 1)
        else:
            step = 2 * np.pi
        ranges, intensities = self._binned(count, first, step)
        begin, slope = self._times(first, last)
        if np.isfinite(self.rate_hz) and self.rate_hz > 0:
            period = 1 / self.rate_hz
        else:
            period = abs(slope) * 2 * np.pi
        near, far = self.sensor.range_limits
        stamp_ns = self.stamp_ns + round(begin * 1e9)
        return LaserScan(
            first,
            last,
            step,
            slope * step,
            period,
            near,
            far,
            ranges,
            intensities,
            stamp_ns,
            self.host_ns,
        )

    def swept(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the azimuths and times of the points with a direction.

        Azimuths are unwrapped, radians. Times are in seconds since the stamp.
        """
        azimuth = self.points.azimuth.astype(np.float64)
        known = np.isfinite(azimuth)
        return np.unwrap(azimuth[known]), self.points.time[known]

    def _times(self, first: float, last: float) -> tuple[float, float]:
        """Return the time of a beam at azimuth `first`, and the seconds per radian.

        The time is in seconds since the stamp. Both follow from a straight line fitted to the
        points, in the turn of most points up to `last`.
        """
        azimuth, time = self.swept()
        if len(azimuth) < 2 or not (spread := azimuth - azimuth.mean()).any():
            return 0.0, 0.0
        slope = float(spread @ time / (spread @ spread))
        turns = round((float(np.median(azimuth)) - (first + last) / 2) / (2 * np.pi))
        return float(time.mean() + slope * (first + turns * 2 * np.pi - azimuth.mean())), slope

    def _binned(
        self, n: int, first: float, step: float
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the nearest return at each of n angles, and its intensity.

        The angles begin at `first`. A return belongs to an angle if it is within half a step.
        """
        points = self.points
        turn = 2 * np.pi
        ahead = (points.azimuth[points.valid].astype(np.float64) - first + step / 2) % turn
        bins = (ahead % turn / step).astype(
            np.intp
        )  # a second time: of what is just below 0 the first is the whole turn
        inside = bins < n
        valid = np.flatnonzero(points.valid)[inside]
        bins = bins[inside]
        ranges = points.range[valid]
        nearest = np.lexsort((ranges, bins))
        is_first = np.ones(len(nearest), np.bool_)
        is_first[1:] = np.diff(bins[nearest]) > 0
        chosen = nearest[is_first]
        binned = np.full(n, np.inf, np.float32)
        strength = np.zeros(n, np.float32)
        binned[bins[chosen]] = ranges[chosen]
        if points.intensity is not None:
            strength[bins[chosen]] = points.intensity[valid][chosen]
        return binned, strength


def _sectors(number: Any, place: str) -> int:
    if isinstance(number, bool) or not isinstance(number, int | np.integer) or number < 1:
        raise UsageError(
            f"{place} takes how many sectors the turn has, a whole number from 1 on, not {number!r}"
        )
    return int(number)


class Cut(NamedTuple):
    """The end of one scan and the start of the next.

    `point` is the first point of the next scan. The flags describe the scan that ends (see `Scan`).
    """

    point: int
    whole: bool
    complete: bool


@dataclass
class Underway:
    """What there is of the scan under way.

    Attributes:
        begun: whether its start was seen.
        since: the time of its first packet, ns.
        packets, size: how many packets, and how many bytes, or points.
        lost, broken: how many packets are missing, and whether there is any break.
    """

    begun: bool = False
    since: int = 0
    packets: int = 0
    size: float = 0
    lost: int = 0
    broken: bool = False


class Progress:
    """The progress of the current scan: its end, completeness and size limits.

    A scan becomes no longer than twice the slowest turn, by the packets' time; and no larger than
    twice the points of a scan where their number is constant, else the bytes that a serial line
    carries in that time, else `LARGEST`. Where packets are missing, and with them maybe the end, it
    becomes little longer than the scan before. What is missing follows from the index of the
    packets, and their breaks.
    """

    def __init__(self, sensor: Sensor) -> None:
        rule = sensor.scan
        link = sensor.links.get("data")
        counter = sensor.sequence
        turn: float = SLOWEST
        if isinstance(rule, Every):
            turn = rule.seconds
        elif sensor.turn:
            turn = 1 / sensor.turn[0]
        if sensor.clock is not None:
            self.seconds = 2 * turn
        else:
            self.seconds = max(2 * turn, UNTIMED)
        self._longest = int(self.seconds * 1e9)
        self._by_points = sensor.beams is not None
        if sensor.beams:
            self._most: float = 2 * sensor.beams
        elif isinstance(link, Serial):
            self._most = self.seconds * link.baud / 10
        else:
            self._most = LARGEST
        self._reason = _without_end(rule)
        self._starts_are_seen = isinstance(rule, OnFlag)
        self._may_pass = isinstance(
            rule, OnWrap | OnFlag
        )  # whether an end that is missing leaves no trace
        self._counter = (
            counter
            if counter is not None and isinstance(rule, OnRewind) and rule.name == counter.field
            else None
        )
        self._scan = Underway()
        self._has_ended = False
        self._last: tuple[int, int] | None = None  # time and index of the last packet
        self._turn = math.inf  # packets of the last whole scan, at first of the first piece

    def cuts(self, packets: Packets, points: Evaluated, ends: Sequence[End]) -> list[Cut]:
        """Return the cuts of a batch in order.

        They are at the ends, and at the limits if no end came in time. An end at which the angle
        leaps may be no cut.
        """
        number = points.ready
        found = list[Cut]()
        start = 0
        if not number:
            return found
        if len(ends) or self._by_points:
            first = first_points(points)
        else:
            first = np.empty(0, np.intp)
        batch = self._batch(
            packets,
            number,
            np.diff(first, append=source_of(points.cloud).size) if self._by_points else None,
        )
        for end, packet, leaps in ends:
            if packet is None:
                edge = int(np.searchsorted(first, end, side="right")) - 1
            else:
                edge = packet
            begins = bool(first[edge] == end)
            found += self._without_end(packets, batch, start, edge + (not begins), points)
            is_shared = begins and not self._shows_start(packets, edge)
            found.append(
                self._ended(batch, edge, end, begins=begins, is_shared=is_shared, is_seen=not leaps)
            )
            if not self._has_ended:  # a rotor that spun up
                packets.stats.unended = ""
                self._has_ended = True
            start = edge
        found += self._without_end(packets, batch, start, number, points)
        self._last = int(batch.times[-1]), int(packets.index[number - 1])
        return found

    def _batch(self, packets: Packets, number: int, points: NDArray[np.intp] | None) -> Batch:
        """Return the properties of the first packets that `Progress` reads.

        Sizes are the points of each packet, (n,), or its bytes. A frame of parts counts once.
        """
        times = packets.time_ns[:number]
        index = packets.index[:number]
        broken = packets.breaks[:number]
        before, (frames, which) = (
            int(index[0]) - 1 if self._last is None else self._last[1],
            packets.frames,
        )
        if frames is packets.table and int(index[-1]) - before == number and packets.masked is None:
            sizes = frames.sizes[:number] if points is None else points
            return Batch(
                times,
                repeated(1, number),
                sizes,
                repeated(0, number),
                broken.copy() if broken.any() else broken,
            )
        steps = np.diff(index, prepend=before)
        if frames is not packets.table:
            counts = (steps != 0).astype(np.int64)
        else:
            counts = repeated(1, number)
        missing = np.maximum(steps - 1, 0)
        if packets.masked is not None:
            masked = packets.masked[:number]
            missing = np.maximum(missing - masked, 0)
            broken = broken & (masked == 0)
        return Batch(
            times,
            counts,
            counts * frames.sizes[which][:number] if points is None else points,
            missing,
            broken | (missing > 0),
        )

    def _shows_start(self, packets: Packets, edge: int) -> bool:
        """Whether a packet says that it is the first of a scan."""
        frames, which = packets.frames
        return self._starts_are_seen or (
            self._counter is not None
            and int(frames.raw(self._counter.field)[which][edge]) == self._counter.first
        )

    def _ended(
        self, batch: Batch, edge: int, end: int, *, begins: bool, is_shared: bool, is_seen: bool
    ) -> Cut:
        """A scan ends at a point of a packet, and the next one begins.

        Args:
            begins: whether it is the first point of the packet.
            is_shared: whether nobody knows to which of the two belongs what is missing before that
                packet.
        """
        if begins:
            self._add(batch, slice(edge, edge + 1), gap_only=True)
        scan = self._scan
        missing = batch.missing.item(edge)
        is_broken = bool(batch.broken[edge])
        whole = scan.begun and is_seen and scan.lost <= scan.packets
        if whole or (self._turn == math.inf and scan.packets and self._may_pass):
            self._turn = scan.packets + scan.lost
        self._scan = Underway(
            is_seen and (scan.begun or scan.packets > 0),
            lost=missing * is_shared,
            broken=is_broken and is_shared,
        )
        batch.forget(edge)
        return Cut(end, whole, whole and not scan.lost and not scan.broken)

    def _without_end(
        self, packets: Packets, batch: Batch, start: int, stop: int, points: Evaluated
    ) -> list[Cut]:
        """The cuts in a part of one scan where it has become too long, or too large."""
        found = list[int]()
        if start < stop and not self._within(batch, slice(start, stop)):
            while start < stop:
                part = slice(start, min(start + TOGETHER, stop))
                spot, is_endless = self._over(batch, part)
                if spot is None:
                    self._add(batch, part)
                    start = part.stop
                    continue
                self._add(batch, slice(start, start + spot))
                start += spot
                found.append(start)
                step = batch.times.item(start) - (
                    batch.times.item(start - 1) if start or self._last is None else self._last[0]
                )
                if is_endless and abs(step) < self._longest / 2:  # else nothing came for so long
                    packets.stats.unended = f"{self._reason} within {self.seconds:.3g} s"
                self._scan = Underway()
                self._turn = self._turn * (1 if is_endless else 2)  # lest it be wrong for ever
                batch.forget(start)
        if found:
            return [
                Cut(point, whole=False, complete=False)
                for point in first_points(points)[found].tolist()
            ]
        return []

    def _within(self, batch: Batch, part: slice) -> bool:
        """Whether the scan may go on over all of these packets, which are then counted."""
        times = batch.times[part]
        before = dataclasses.replace(self._scan)
        self._add(batch, part)
        scan = self._scan
        farthest = max(int(times.max()) - scan.since, scan.since - int(times.min()))
        too_many = scan.lost > 0 and scan.packets - 1 + scan.lost > LONGER * self._turn
        if farthest <= self._longest and scan.size <= self._most and not too_many:
            return True
        self._scan = before
        return False

    def _over(self, batch: Batch, part: slice) -> tuple[int | None, bool]:
        """Return the packet before which the scan is over, None if it is not.

        Returns:
            The packet, and whether an end is missing; otherwise there is a gap.
        """
        scan = self._scan
        times = batch.times[part]
        since = scan.since if scan.packets else times.item(0)
        endless = (np.abs(times - since) > self._longest) | (
            scan.size + np.cumsum(batch.sizes[part]) > self._most
        )
        lost = scan.lost + np.cumsum(batch.missing[part])
        over = endless | (
            (lost > 0)
            & (scan.packets + np.cumsum(batch.counts[part]) - 1 + lost > LONGER * self._turn)
        )
        over[0] &= bool(scan.packets)
        spot = int(over.argmax())
        if over[spot]:
            return (spot, bool(endless[spot]))
        return (None, False)

    def _add(self, batch: Batch, part: slice, *, gap_only: bool = False) -> None:
        """Count packets as parts of the scan, or only what is missing before them."""
        number = part.stop - part.start
        scan = self._scan
        if not number:
            return
        if not gap_only:
            if scan.packets:
                scan.since = scan.since
            else:
                scan.since = batch.times.item(part.start)
            scan.packets, scan.size = (
                scan.packets + _sum(batch.counts[part]),
                scan.size + _sum(batch.sizes[part]),
            )
        scan.lost, scan.broken = (
            scan.lost + _sum(batch.missing[part]),
            scan.broken or bool(batch.broken[part].any()),
        )


@dataclass(frozen=True, eq=False)
class Batch:
    """The properties of some packets that `Progress` reads, (n,) each.

    They are times in ns, counts (the first part counts for its frame), sizes, packets missing
    before each, and breaks.
    """

    times: NDArray[np.int64]
    counts: NDArray[np.int64]
    sizes: NDArray[np.intp]
    missing: NDArray[np.int64]
    broken: NDArray[np.bool_]

    def forget(self, place: int) -> None:
        """Reset the packets missing before a packet, which have been counted.

        The packet, or the frame that it is part of, counts in the next scan as well.
        """
        if not self.counts[place]:
            self.counts[place] = 1
        if self.broken[place]:
            self.broken[place] = False
        if self.missing[place]:
            self.missing[place] = 0


def _sum(values: NDArray[np.int64]) -> int:
    each = alike(values)
    if each is None:
        return int(values.sum())
    return each * len(values)


def _without_end(rule: Split) -> str:
    """What did not come where a scan has no end."""
    if isinstance(rule, OnWrap):
        return (
            f"the angle does not pass {rule.at:g} ({rule.name}): is the rotor blocked? No scan has"
            " ended"
        )
    return f"no scan has begun or ended by {'time' if isinstance(rule, Every) else rule.name}"


class ScanStream:
    """Scans out of batches of packets; remembers what the next batch needs.

    Args:
        sensor: whose.
        mount: how it is mounted; the scans come in its carrier's axes.
        imu: what its IMU felt, added to before the packets that came with it.
    """

    def __init__(
        self, sensor: Sensor, mount: Mount | None = None, imu: Waiting | None = None
    ) -> None:
        self._sensor = sensor
        self._mount = mount
        self._imu = imu
        self._reorder = Reorder(
            enabled=sensor.sequence is not None or (sensor.clock is not None and sensor.datagrams)
        )
        self._masking = Masking(sensor)
        self._cutter = Cutter(sensor)
        self._waiting: Packets | None = None
        self._carry: Carry = {}
        self._parts: list[Stretch] = []
        self._provenance = Provenance()
        self._split = 0  # parts of a frame that were ready before others of it
        self._epoch: int | None = None
        self._progress = Progress(sensor)
        self._empty, self._broken = (
            0,
            False,
            # frames without parts that have points,
            # and whether there is a break before those at the end
        )
        self._begins: int | None = (
            None  # time of the first point of the scan under way, ns, where it is known
        )
        self._host: int | None = None  # when its packet arrived
        self._left_out = False  # whether the scan under way is another's

    @property
    def is_under_way(self) -> bool:
        """Whether there are points of a scan that has not ended, and is not another's."""
        return bool(self._parts) and not self._left_out

    def __getstate__(self) -> dict[str, Any]:
        """What is pickled goes on behind the scan under way, whose points it does not have."""
        return {
            **vars(self),
            "_parts": [],
            "_provenance": Provenance(),
            "_left_out": self._left_out or bool(self._parts),
        }

    def add(self, packets: Packets) -> list[Scan]:
        """The scans that these packets complete."""
        return [
            scan
            for batch in self._reorder.push(packets)
            for scan in self._push_ordered(self._masking.push(batch))
        ]

    def finish(self) -> list[Scan]:
        """The scans that waited for more, and the piece that is left."""
        held = [
            batch for ordered in self._reorder.finish() for batch in self._masking.push(ordered)
        ]
        scans = [*self._push_ordered(held), *self._push_ordered(self._masking.finish())]
        if self._waiting is not None and len(self._waiting):
            waiting = self._waiting
            self._waiting = None
            scans += self._push(waiting, final=True)
        left = self._close(None)
        return scans + ([left] if left else [])

    def _push_ordered(self, batches: list[Packets]) -> list[Scan]:
        """Return the scans that packets in order complete."""
        scans = list[Scan]()
        for packets in batches:
            sector = self._masking.sector
            if packets.masked is not None and sector is not None and self._cutter.sector is None:
                self._cutter.use_sector(sector, self._masking.angle_before_sector)
                packets.stats.masked = describe(sector)
            scans += self._push(packets, final=False)
        return scans

    def _push(self, packets: Packets, *, final: bool) -> list[Scan]:
        packets = self._with_points(packets)
        if self._waiting is not None and len(self._waiting):
            packets = joined_packets([self._waiting, packets])
        self._waiting = None
        if not len(packets):
            return []
        if self._epoch is None:
            self._epoch = int(
                packets.time_ns[0]
            )  # one for the whole stream, so that batches do not change a bit of any time
        points = guarded(packets, self._carry, final=final, epoch=self._epoch)
        if points is None:
            return []
        self._carry = points.carry
        before = self._split
        if points.ready < len(packets):
            self._waiting = packets.take(slice(points.ready, None))
            self._split = rank(packets, points.ready, before)
        else:
            self._split = 0
        return list(self._cut(packets, points, before))

    def _with_points(self, packets: Packets) -> Packets:
        """Return the packets with points: these, or the parts in them.

        A frame without any part leaves no gap.
        """
        parts = packets.with_points
        if parts is not packets:
            spots = np.searchsorted(packets.index, parts.index)
            empty = self._empty + np.cumsum(~np.isin(np.arange(len(packets)), spots))
            parts.index = parts.index - empty[spots]
            self._empty = int(empty[-1])
            parts.breaks[:1] |= self._broken
            left = packets.breaks[spots[-1] + 1 if len(spots) else 0 :]
            self._broken = bool(left.any()) or (self._broken and not len(spots))
        return parts

    def _cut(self, packets: Packets, points: Evaluated, before: int) -> Iterator[Scan]:
        start = 0
        source = source_of(points.cloud)
        cuts = self._progress.cuts(packets, points, self._cutter.ends(packets, points))
        starts = [0, *(cut.point for cut in cuts)]
        first, *times = _times_ns(source, starts)
        if cuts or self._host is None:
            arrived, *hosts = _hosts_ns(packets, points, starts)
        else:
            arrived, *hosts = [None]
        if self._begins is None:
            self._begins = first
        else:
            self._begins = self._begins
        self._host = arrived if self._host is None else self._host
        for cut, time, host in zip(cuts, times, hosts, strict=True):
            self._take(packets, points, start, cut.point, before)
            scan = self._close(time, whole=cut.whole, complete=cut.complete)
            self._begins = time
            self._host = host
            start = cut.point
            if scan is not None:
                yield scan
        self._take(packets, points, start, source.size, before)

    def _take(
        self, packets: Packets, points: Evaluated, start: int, stop: int, before: int
    ) -> None:
        if start < stop:
            self._parts.append(Stretch(source_of(points.cloud), start, stop))
            self._provenance.add(packets, points, start, stop, before)

    def _close(
        self, ends: int | None, *, whole: bool = False, complete: bool = False
    ) -> Scan | None:
        """The scan of the points so far; `ends`: the time of the first point after it, ns."""
        parts = self._parts
        self._parts = []
        provenance = self._provenance
        self._provenance = Provenance()
        if self._left_out:
            self._left_out = False
            parts = []
            if self._imu is not None:
                self._imu.until(ends)
        if not parts:
            return None
        begins = self._begins
        assert begins is not None  # since there are points
        if ends is not None:
            period = (ends - begins) * 1e-9
        else:
            period = np.nan
        rate = 1 / period if whole and period > 0 else np.nan
        cloud: PointCloud = LazyCloud.of(Stretches(parts, from_first=True), begins)
        if self._imu is None:
            samples = None
        else:
            samples = self._imu.until(ends)
        if self._mount is not None:
            cloud = self._mount.applied(cloud)
            if samples is None:
                samples = None
            else:
                samples = samples.turned(self._mount.rotation)
        rate = float(rate) if whole else np.nan
        return Scan(
            cloud,
            rate,
            complete,
            self._sensor,
            whole,
            samples,
            self._host or 0,
            mount=self._mount,
            provenance=provenance,
        )


def _times_ns(source: ColumnSource, indices: Sequence[int]) -> list[int | None]:
    """The times of some points in order, ns; None for those past the end."""
    known = [index for index in indices if index < source.size]
    if known:
        times = source.times_at(np.array(known, np.intp)).tolist()
    else:
        times = []
    return [source.base + round(time * 1e9) for time in times] + [None] * (
        len(indices) - len(known)
    )


def _hosts_ns(packets: Packets, points: Evaluated, indices: Sequence[int]) -> list[int | None]:
    """When the packets of some points arrived, ns; None for points past the end."""
    first = first_points(points)
    size = source_of(points.cloud).size
    known = first.searchsorted([index for index in indices if index < size], side="right") - 1
    return [*packets.host_ns[known].tolist(), *[None] * (len(indices) - len(known))]


def scans_of(
    sensor: Sensor, batches: Iterable[Packets], imu: Waiting | None = None
) -> Iterator[Scan]:
    """Every scan of batches of one stream; `imu`: the samples that go with them."""
    stream = ScanStream(sensor, imu=imu)
    for batch in batches:
        yield from handed_out(stream.add(batch))
    yield from stream.finish()


def handed_out(scans: list[Scan]) -> Iterator[Scan]:
    """Yield scans one by one, and release each with its columns."""
    scans.reverse()
    while scans:
        yield scans.pop()
