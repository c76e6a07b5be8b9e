"""Decide where the scans of a stream end, and whether each of them is complete.

A scan ends where the sensor's rule finds an end (`scan_ends`), or when it reaches its limits
(`limits`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarspec.packets.masked_sector import Sector
from lidarspec.packets.packets import Packets
from lidarspec.points.reference_evaluator import EvaluatedPoints
from lidarspec.scans.completeness import OpenScan, PacketCounts
from lidarspec.scans.limits import ScanLimits
from lidarspec.scans.scan_ends import EndFinder, ScanEnd, first_points
from lidarspec.spec.sensor import SensorDescription
from lidarspec.spec.timing import Every, OnFlag, OnRewind, OnWrap, Split

#: The number of packets that are searched together for one with which the scan exceeds its limits.
SEARCHED_PACKETS = 1024


class ScanCut(NamedTuple):
    """The end of one scan and the start of the next.

    `point` is the index of the first point of the next scan.
    """

    point: int
    whole: bool
    complete: bool


class ScanCutter:
    """Finds the cuts between the scans of one stream."""

    def __init__(self, sensor: SensorDescription) -> None:
        rule = sensor.scan
        assert rule is not None  # as of every sensor with points
        self._ends = EndFinder(sensor)
        self._limits = ScanLimits(sensor)
        self._warning = _describe_missing_end(rule, self._limits.seconds)
        self._has_start_flag = isinstance(rule, OnFlag)
        # with these rules, two scans without the end between them look like one long scan
        self._may_miss_ends = isinstance(rule, OnWrap | OnFlag)
        # the field whose first value marks the first packet of a scan, and that value
        self._start_value: tuple[str, int] | None = None
        counter = sensor.sequence
        if counter is not None and isinstance(rule, OnRewind) and rule.name == counter.field:
            self._start_value = (counter.field, counter.first)
        self._scan = OpenScan()
        # packets of the last whole scan; with rules that may miss ends, of the first scan at first
        self._usual_packets = math.inf
        self._has_ended = False
        self._last_ns: int | None = None  # the time of the last packet
        self._last_index: int | None = None

    def use_sector(self, sector: Sector, angle: float | None) -> None:
        """From now on, let scans end and begin in a masked sector.

        Args:
            angle: the angle of the last packet before the sector was found, in turns; None if there
                was no packet.
        """
        self._ends.use_sector(sector, angle)

    def cut(self, packets: Packets, points: EvaluatedPoints) -> list[ScanCut]:
        """Return the cuts in a batch of packets, in order."""
        ends = self._ends.find(packets, points)
        number = points.ready
        if not number:
            return []
        first = np.empty(0, np.intp)
        if ends or self._limits.has_point_limit:
            first = first_points(points)
        sizes = None
        if self._limits.has_point_limit:
            sizes = np.diff(first, append=points.source.size)
        counts = PacketCounts.of(packets, number, sizes, self._last_index)
        cuts = list[ScanCut]()
        start = 0
        for end in ends:
            row = _find_packet(end, first)
            begins_packet = bool(first[row] == end.point)
            stop = row if begins_packet else row + 1
            cuts += self._add(packets, counts, start, stop, points)
            if begins_packet:
                self._scan = self._scan.add_gap(counts.part(row, row + 1))
            # packets missing before this packet may belong to either of the two scans
            is_gap_shared = begins_packet and not self._shows_start(packets, row)
            cuts.append(self._end_scan(counts, row, end, is_gap_shared=is_gap_shared))
            if not self._has_ended:  # a warning while the rotor spun up no longer applies
                packets.stats.unended = ""
                self._has_ended = True
            start = row
        cuts += self._add(packets, counts, start, number, points)
        self._last_ns = counts.times.item(-1)
        self._last_index = packets.index.item(number - 1)
        return cuts

    def _shows_start(self, packets: Packets, row: int) -> bool:
        """Return whether a packet shows that it is the first one of a scan."""
        if self._start_value is None:
            return self._has_start_flag
        field, first = self._start_value
        frames, rows = packets.frames
        return int(frames.raw(field)[rows][row]) == first

    def _end_scan(
        self, counts: PacketCounts, row: int, end: ScanEnd, *, is_gap_shared: bool
    ) -> ScanCut:
        """End the scan where the rule has found an end, and begin the next scan."""
        scan = self._scan
        is_whole = scan.is_whole and not end.is_leap
        is_first = self._usual_packets == math.inf and scan.packets > 0
        if is_whole or (is_first and self._may_miss_ends):
            self._usual_packets = scan.packets + scan.lost
        has_start = not end.is_leap and (scan.has_start or scan.packets > 0)
        self._scan = OpenScan(has_start)
        if is_gap_shared:
            self._scan = self._scan.add_gap(counts.part(row, row + 1))
        counts.share_with_next_scan(row)
        return ScanCut(end.point, is_whole, is_whole and not scan.has_gap)

    def _add(
        self, packets: Packets, counts: PacketCounts, start: int, stop: int, points: EvaluatedPoints
    ) -> list[ScanCut]:
        """Add packets in which no scan ends; return cuts if the scan reaches its limits."""
        if start >= stop:
            return []
        part = counts.part(start, stop)
        scan = self._scan.add(part)
        if self._limits.allows(scan, part, self._usual_packets):
            self._scan = scan
            return []
        rows = self._cut_at_limits(packets, counts, start, stop)
        return [ScanCut(point, False, False) for point in first_points(points)[rows].tolist()]

    def _cut_at_limits(
        self, packets: Packets, counts: PacketCounts, start: int, stop: int
    ) -> NDArray[np.intp]:
        """Add packets; return the rows before which scans are cut to keep the limits."""
        cuts = list[int]()
        while start < stop:
            part_stop = min(start + SEARCHED_PACKETS, stop)
            part = counts.part(start, part_stop)
            row, exceeds_maximum = self._limits.find_excess(self._scan, part, self._usual_packets)
            if row is None:
                self._scan = self._scan.add(part)
                start = part_stop
                continue
            start += row
            cuts.append(start)
            if (
                exceeds_maximum
                and abs(self._find_step_ns(counts, start)) < self._limits.longest_ns / 2
            ):
                packets.stats.unended = self._warning
            elif not exceeds_maximum:
                self._usual_packets *= 2  # in case the number was wrong
            self._scan = OpenScan()
            counts.share_with_next_scan(start)
        return np.array(cuts, np.intp)

    def _find_step_ns(self, counts: PacketCounts, row: int) -> int:
        """Return the time from the previous packet to the packet of a row, ns."""
        if row:
            return counts.times.item(row) - counts.times.item(row - 1)
        assert self._last_ns is not None  # since the scan had packets
        return counts.times.item(0) - self._last_ns


def _find_packet(end: ScanEnd, first: NDArray[np.intp]) -> int:
    """Return the row of the packet in which a scan ends.

    Args:
        first: the index of the first point of each packet.
    """
    if end.packet is not None:
        return end.packet
    return int(np.searchsorted(first, end.point, side="right")) - 1


def _describe_missing_end(rule: Split, limit_s: float) -> str:
    """Return the warning that no scan has ended within a time limit, in seconds."""
    if isinstance(rule, OnWrap):
        return (
            f"the angle {rule.name!r} did not pass {rule.at:g} within {limit_s:.3g} s, so no scan"
            " was completed: is the rotor blocked?"
        )
    if isinstance(rule, Every):
        return f"no scan was completed within {limit_s:.3g} s"
    return f"{rule.name!r} did not mark the end of a scan within {limit_s:.3g} s"
