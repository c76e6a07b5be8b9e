"""Make scans from batches of packets as they arrive.

`ScanStream` sorts the packets, calculates their points and divides the points into scans. It keeps
the points of the scan that has not ended.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from lidarspec.expressions.columns import Carry
from lidarspec.packets.imu import ImuSamples, WaitingSamples
from lidarspec.packets.masked_sector import AngleReader
from lidarspec.packets.packets import Packets, join_packets
from lidarspec.packets.reorder import Reorder
from lidarspec.points.cloud import LazyCloud, PointCloud
from lidarspec.points.column_sources import JoinedColumns, SourcePart
from lidarspec.points.evaluate import evaluate_guarded
from lidarspec.points.mount import Mount
from lidarspec.points.reference_evaluator import EvaluatedPoints
from lidarspec.scans.cutter import ScanCutter
from lidarspec.scans.masking import Masking, describe_sector
from lidarspec.scans.provenance import PointRun, Provenance, find_part
from lidarspec.scans.scan import Scan
from lidarspec.scans.scan_ends import first_points
from lidarspec.spec.sensor import SensorDescription


class ScanStart(NamedTuple):
    """The start of a scan.

    Attributes:
        time_ns: the time of the first point of the scan, ns.
        host_ns: the arrival time of the packet with the first point, ns; 0 if unknown.
    """

    time_ns: int
    host_ns: int


class ScanStream:
    """Makes scans from the packets of one stream.

    Args:
        mount: the mount of the sensor; the scans are then in the axes of its carrier.
        imu: the buffer with the IMU samples. The caller adds the samples of each batch to this
            buffer, and then calls `add` with the packets of the batch.
    """

    def __init__(
        self,
        sensor: SensorDescription,
        mount: Mount | None = None,
        imu: WaitingSamples | None = None,
    ) -> None:
        self._sensor = sensor
        self._mount = mount
        self._imu = imu
        self._reorder: Reorder | None = None
        if sensor.sequence is not None or (sensor.clock is not None and sensor.datagrams):
            self._reorder = Reorder()
        self._masking: Masking | None = None
        if AngleReader(sensor).is_available:
            self._masking = Masking(sensor)
        self._uses_sector = False
        self._cutter = ScanCutter(sensor)
        self._waiting: Packets | None = None  # packets with points that depend on the next packets
        self._waiting_parts = 0  # the number of parts of their first frame that were ready
        self._carry: Carry = {}
        self._epoch: int | None = None  # one for all batches: times must not depend on them
        self._empty_frames = 0  # the number of frames without parts that have points
        self._is_broken = False  # whether there is a break before the last of these frames
        self._runs: list[PointRun] = []  # of the scan that has not ended
        self._start: ScanStart | None = None  # of that scan; None without points
        self._is_foreign = False  # whether another stream makes that scan, after unpickling

    @property
    def is_under_way(self) -> bool:
        """Whether this stream has points of a scan that has not ended."""
        return bool(self._runs) and not self._is_foreign

    def __getstate__(self) -> dict[str, Any]:
        """Return the state to pickle, without the points of the scan that has not ended."""
        is_foreign = self._is_foreign or bool(self._runs)
        return {**vars(self), "_runs": [], "_is_foreign": is_foreign}

    def add(self, packets: Packets) -> list[Scan]:
        """Add packets, and return the scans that they complete."""
        if not len(packets):
            return []
        ordered = [packets]
        if self._reorder is not None:
            ordered = self._reorder.push(packets)
        return self._add_ordered(ordered)

    def finish(self) -> list[Scan]:
        """Return the remaining scans; the last of them is incomplete."""
        scans = list[Scan]()
        if self._reorder is not None:
            scans += self._add_ordered(self._reorder.finish())
        if self._masking is not None:
            scans += self._add_marked(self._masking.finish())
        if self._waiting is not None:
            scans += self._evaluate(self._waiting, final=True)
        scans += self._end_scan(None)
        return scans

    def _add_ordered(self, batches: list[Packets]) -> list[Scan]:
        """Add sorted packets, and return the scans that they complete."""
        if self._masking is not None:
            batches = [marked for packets in batches for marked in self._masking.push(packets)]
        return self._add_marked(batches)

    def _add_marked(self, batches: list[Packets]) -> list[Scan]:
        """Add sorted packets with marked sectors, and return the scans that they complete."""
        scans = list[Scan]()
        for packets in batches:
            if packets.masked is not None and not self._uses_sector:
                self._use_sector(packets)
            ready = self._take_parts_with_points(packets)
            if self._waiting is not None:
                ready = join_packets([self._waiting, ready])
            if len(ready):
                scans += self._evaluate(ready, final=False)
        return scans

    def _use_sector(self, packets: Packets) -> None:
        """Cut scans in the masked sector from now on, and store a warning about it."""
        assert self._masking is not None
        sector = self._masking.sector
        assert sector is not None
        self._cutter.use_sector(sector, self._masking.angle_before_sector)
        packets.stats.masked = describe_sector(sector)
        self._uses_sector = True

    def _take_parts_with_points(self, packets: Packets) -> Packets:
        """Return the packets, or the parts of their frames if the parts contain the points."""
        # The index of the parts has no gap for a frame without parts: no packet is missing.
        parts = packets.with_points
        if parts is not packets:
            rows = np.searchsorted(packets.index, parts.index)
            is_empty = ~np.isin(np.arange(len(packets)), rows)
            empty = self._empty_frames + np.cumsum(is_empty)
            parts.index = parts.index - empty[rows]
            self._empty_frames = int(empty[-1])
            parts.breaks[:1] |= self._is_broken
            if len(rows):
                self._is_broken = bool(packets.breaks[rows[-1] + 1 :].any())
            else:
                self._is_broken = self._is_broken or bool(packets.breaks.any())
        return parts

    def _evaluate(self, packets: Packets, *, final: bool) -> list[Scan]:
        """Calculate the points of sorted packets, and return the scans that they complete.

        Args:
            final: whether no packets follow.
        """
        self._waiting = None
        if self._epoch is None:
            self._epoch = packets.time_ns.item(0)
        points = evaluate_guarded(packets, self._carry, final=final, stamp_ns=self._epoch)
        if points is None:
            return []
        self._carry = points.carry
        parts_before = self._waiting_parts
        self._waiting_parts = 0
        if points.ready < len(packets):
            self._waiting = packets.take(slice(points.ready, None))
            self._waiting_parts = find_part(packets, points.ready, parts_before)
        return self._cut(packets, points, parts_before)

    def _cut(self, packets: Packets, points: EvaluatedPoints, parts_before: int) -> list[Scan]:
        """Divide points into scans, return these scans, and keep the remaining points."""
        cuts = self._cutter.cut(packets, points)
        indices = [cut.point for cut in cuts]
        if self._start is None:
            self._start, *starts = _read_starts(packets, points, [0, *indices])
        else:
            starts = _read_starts(packets, points, indices)
        scans = list[Scan]()
        first = 0
        for cut, start in zip(cuts, starts, strict=True):
            self._add_run(PointRun(packets, points, first, cut.point, parts_before))
            scans += self._end_scan(start, whole=cut.whole, complete=cut.complete)
            self._start = start
            first = cut.point
        self._add_run(PointRun(packets, points, first, points.source.size, parts_before))
        return scans

    def _add_run(self, run: PointRun) -> None:
        """Add points to the scan that has not ended."""
        if run.start < run.stop:
            self._runs.append(run)

    def _end_scan(
        self, following: ScanStart | None, *, whole: bool = False, complete: bool = False
    ) -> list[Scan]:
        """End the current scan, and return it in a list, which is empty without points.

        Args:
            following: the start of the next scan; None if unknown.
            whole: the value for `Scan.whole`.
            complete: the value for `Scan.complete`.
        """
        runs = self._runs
        start = self._start
        is_foreign = self._is_foreign
        self._runs = []
        self._is_foreign = False
        end_ns: int | None = None
        if following is not None:
            end_ns = following.time_ns
        if is_foreign and self._imu is not None:
            # these samples belong to the scan that another stream makes
            self._imu.take_until(end_ns)
        if is_foreign or not runs:
            return []
        assert start is not None  # since there are points
        parts = [SourcePart(run.points.source, run.start, run.stop) for run in runs]
        cloud: PointCloud = LazyCloud.of(JoinedColumns(parts, from_first=True), start.time_ns)
        samples: ImuSamples | None = None
        if self._imu is not None:
            samples = self._imu.take_until(end_ns)
        if self._mount is not None:
            cloud = self._mount.apply(cloud)
            if samples is not None:
                samples = samples.turn(self._mount.rotation)
        rate_hz = np.nan
        if whole and end_ns is not None and end_ns > start.time_ns:
            rate_hz = 1 / ((end_ns - start.time_ns) * 1e-9)
        scan = Scan(
            cloud,
            rate_hz,
            complete,
            self._sensor,
            whole,
            samples,
            start.host_ns,
            mount=self._mount,
            provenance=Provenance(runs),
        )
        return [scan]


def _read_starts(
    packets: Packets, points: EvaluatedPoints, indices: Sequence[int]
) -> list[ScanStart | None]:
    """Return the start of each scan, given the index of its first point.

    Args:
        indices: the index of the first point of each scan, ascending.

    Returns:
        A `ScanStart` for each index; None for an index after the last point.
    """
    source = points.source
    known = [index for index in indices if index < source.size]
    starts: list[ScanStart | None] = [None] * len(indices)
    if known:
        rows = first_points(points).searchsorted(known, side="right") - 1
        hosts = packets.host_ns[rows].tolist()
        times = source.times_at(np.array(known, np.intp)).tolist()
        for number, (time, host) in enumerate(zip(times, hosts, strict=True)):
            starts[number] = ScanStart(source.base + round(time * 1e9), host)
    return starts


def iter_scans(
    sensor: SensorDescription, batches: Iterable[Packets], imu: WaitingSamples | None = None
) -> Iterator[Scan]:
    """Yield all scans of one stream."""
    stream = ScanStream(sensor, imu=imu)
    for batch in batches:
        yield from pop_scans(stream.add(batch))
    yield from stream.finish()


def pop_scans(scans: list[Scan]) -> Iterator[Scan]:
    """Yield the scans of a list, and remove each of them from the list.

    The memory of a scan can then be freed while the next scan is processed.
    """
    scans.reverse()
    while scans:
        yield scans.pop()
