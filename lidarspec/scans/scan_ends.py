"""Find the ends of scans by the sensor's declared rule.

A rule reads a column of the points, a field of the packets, a field in an array of the packets, or
the time. `EndFinder` returns the first point after each end.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import SpecError, UnknownField
from lidarspec.expressions.columns import Column
from lidarspec.packets.masked_sector import FULL_TURNS, AngleReader, Sector
from lidarspec.packets.packets import Packets
from lidarspec.points.cloud import COLUMNS
from lidarspec.points.column_sources import LazyColumns
from lidarspec.points.reference_evaluator import EvaluatedPoints
from lidarspec.scans.rotation import (
    MIN_TURNS_AWAY,
    Floats,
    PassDetector,
    WrapDetector,
    previous_values,
)
from lidarspec.spec.sensor import SensorDescription
from lidarspec.spec.timing import Every, OnChange, OnFlag, OnJump, OnRewind, OnWrap

Indices = NDArray[np.intp]


class ScanEnd(NamedTuple):
    """A place in the stream at which the sensor's rule ends a scan.

    Attributes:
        point: the index of the first point after the end.
        packet: the row of the packet that shows the end; None if a point shows the end.
        is_leap: whether the angle advances much more at this end than at the previous end, which
            means that packets are probably missing.
    """

    point: int
    packet: int | None
    is_leap: bool


class EndFinder:
    """Finds the ends of scans in one stream of points."""

    def __init__(self, sensor: SensorDescription) -> None:
        assert sensor.scan is not None  # every sensor with points declares it
        self._rule = sensor.scan
        self._reader = AngleReader(sensor)
        self._wraps = WrapDetector()
        # if scans are cut at an angle that packets may skip
        self._passes: PassDetector | None = None
        self._cut: float | None = None  # the angle that the user has configured, in turns
        if "cut" in sensor.options:
            self._cut = sensor.options["cut"] / 360 % 1
            if isinstance(self._rule, OnChange):
                self._passes = PassDetector(self._cut, direction=1)
        self._value: float | None = None  # of the row before the next one
        self._start_ns: int | None = None  # the start of the first period
        self._last_step = 0.0  # turns by which the angle advanced at the end before

    def use_sector(self, sector: Sector, angle: float | None) -> None:
        """Cut scans in a masked sector, unless the user has configured an angle for cuts.

        Args:
            angle: the angle of the last packet before the sector was found, in turns; None if there
                was no packet.
        """
        at = sector.middle
        if self._cut is not None:
            at = self._cut
        if self._passes is None:
            self._passes = PassDetector(at, sector.direction)
        self._passes.restart(at, sector.direction, angle)

    def find(self, packets: Packets, points: EvaluatedPoints) -> list[ScanEnd]:
        """Return the ends of scans in a batch of packets, in order."""
        rule = self._rule
        if self._passes is not None:
            return self._find_passes(self._passes, packets, points)
        if isinstance(rule, Every):
            rows = self._find_periods(rule, packets, points)
            return _make_ends(first_points(points)[rows], rows)
        if isinstance(rule, OnWrap):
            return self._find_wraps(rule, packets, points)
        path = _make_own_path(packets, rule.name)
        column = _read_field(points, path)
        values, starts = _read_rows(column, points)
        rows = self._find_changes(rule, values, _find_full_turn(packets, path))
        if _is_per_packet(column):
            return _make_ends(starts[rows], rows)
        return _make_ends(starts[rows])

    def _find_wraps(self, rule: OnWrap, packets: Packets, points: EvaluatedPoints) -> list[ScanEnd]:
        """Return the scan ends at which a column or a field passes an angle."""
        rows: Indices | None = None
        if rule.name in COLUMNS:
            values = np.asarray(LazyColumns(points.source).read(rule.name), np.float64)
            full = 2 * np.pi
            ends, steps = self._wraps.push(values, full, self._find_cut_angle(rule, full))
        else:
            path = _make_own_path(packets, rule.name)
            column = _read_field(points, path)
            values, starts = _read_rows(column, points)
            full = _find_full_turn(packets, path) or 2 * np.pi
            wrap_rows, steps = self._wraps.push(values, full, self._find_cut_angle(rule, full))
            ends = starts[wrap_rows]
            if _is_per_packet(column):
                rows = wrap_rows
        return _make_ends(ends, rows, map(self._is_leap, steps.tolist()))

    def _find_cut_angle(self, rule: OnWrap, full: float) -> float:
        """Return the angle at which scans are cut.

        Args:
            full: a whole turn in the unit of the angle.
        """
        if self._cut is None:
            return rule.at
        return self._cut * full

    def _is_leap(self, step: float) -> bool:
        """Return whether the step at a scan end is much larger than at the previous end."""
        last = self._last_step
        self._last_step = step
        return last > 0 and step > max(MIN_TURNS_AWAY, 2 * last)

    def _find_passes(
        self, passes: PassDetector, packets: Packets, points: EvaluatedPoints
    ) -> list[ScanEnd]:
        """Return the scan ends at which the angle in a field passes the cut angle."""
        if isinstance(self._rule, OnWrap):
            path = _make_own_path(packets, self._rule.name)
            column = _read_field(points, path)
            values, starts = _read_rows(column, points)
            rows = passes.push(values / (_find_full_turn(packets, path) or 2 * np.pi))
            if _is_per_packet(column):
                return _make_ends(starts[rows], rows)
            return _make_ends(starts[rows])
        angles = self._reader.angles(packets.table)
        if angles is None:
            return []
        rows = passes.push(angles[: points.ready])
        return _make_ends(first_points(points)[rows], rows)

    def _find_changes(
        self,
        rule: OnFlag | OnChange | OnJump | OnRewind,
        values: Floats,
        full: float | None,
    ) -> Indices:
        """Return the rows at which a scan begins.

        Args:
            values: the values of the rows.
            full: a whole turn in the unit of the values; None if they are not angles.
        """
        if isinstance(rule, OnFlag):
            if rule.value is None:
                return np.flatnonzero(values != 0)
            return np.flatnonzero(values == rule.value)
        if not len(values):
            return np.empty(0, np.intp)
        before = previous_values(values, self._value)
        self._value = values.item(-1)
        if isinstance(rule, OnRewind):
            return np.flatnonzero(values < before)
        if isinstance(rule, OnChange):
            return np.flatnonzero(values != before)
        steps = values - before
        if full is not None:
            steps = np.mod(steps + full / 2, full) - full / 2
        return np.flatnonzero(np.abs(steps) > rule.by)

    def _find_periods(self, rule: Every, packets: Packets, points: EvaluatedPoints) -> Indices:
        """Return the row of the first packet of each period."""
        times = packets.time_ns[: points.ready]
        if not len(times):
            return np.empty(0, np.intp)
        if self._start_ns is None:
            self._start_ns = times.item(0)
        periods = (times - self._start_ns) // int(rule.seconds * 1e9)
        before = previous_values(periods.astype(np.float64), self._value)
        self._value = float(periods[-1])
        return np.flatnonzero(periods > before)


def _make_ends(
    points: Indices, packets: Indices | None = None, leaps: Iterable[bool] | None = None
) -> list[ScanEnd]:
    rows: Iterable[int | None] = itertools.repeat(None)
    if packets is not None:
        rows = packets.tolist()
    if leaps is None:
        leaps = itertools.repeat(False)
    return list(map(ScanEnd, points.tolist(), rows, leaps))


def _find_full_turn(packets: Packets, path: str) -> float | None:
    """Return a whole turn in the unit of a field; None if it is not an angle."""
    if path.startswith("frame."):
        table, _ = packets.frames
    else:
        table = packets.table
    return FULL_TURNS.get(table.schema.fields[path.removeprefix("frame.")].unit)


def _make_own_path(packets: Packets, path: str) -> str:
    """Return the path of a field in the packets, given its path in the frame."""
    # The paths differ if the packets are parts of a frame.
    _, _, parts = packets.frame.partition(".")
    if not parts:
        return path
    if path.startswith(f"{parts}."):
        return path.removeprefix(f"{parts}.")
    return f"frame.{path}"


def _read_field(points: EvaluatedPoints, path: str) -> Column:
    column: Any = points.fields
    for name in path.split("."):
        try:
            column = getattr(column, name)
        except UnknownField as error:
            raise SpecError(str(error), path="scan", rule="LS216") from None
    if not isinstance(column, Column):
        raise SpecError("expected a field that ends scans, got a struct", path=path)
    return column


def _is_per_packet(column: Column) -> bool:
    """Return whether a field has one value in each packet, outside of arrays."""
    return all(name is None for name in column.axes)


def _read_rows(column: Column, points: EvaluatedPoints) -> tuple[Floats, Indices]:
    """Return the values of a field, and for each value the index of its first point."""
    levels = 1 + max(
        (index for index, name in enumerate(column.axes) if name is not None), default=-1
    )
    counts = points.counts
    array = column.array[: points.ready]
    if not levels and len(array) == len(counts):
        return array.reshape(-1), first_points(points)
    shape = np.broadcast_shapes(
        (points.ready, *array.shape[1 : 1 + levels]), counts.shape[: 1 + levels]
    )
    sums = _sum_axes(np.broadcast_to(counts, (*shape, *counts.shape[1 + levels :])), 1 + levels)
    values = np.broadcast_to(
        array.reshape(len(array), *array.shape[1 : 1 + levels]), shape
    ).reshape(-1)
    if sums.size and not any(sums.strides) and sums.flat[0]:
        return values, np.arange(len(values)) * int(sums.flat[0])
    points_per_row = sums.reshape(-1)
    starts = np.cumsum(points_per_row) - points_per_row
    if levels:
        has_points = points_per_row > 0
        return values[has_points], starts[has_points]
    return values, starts


def first_points(points: EvaluatedPoints) -> Indices:
    """Return the index of the first point of each packet, (n,).

    `points.ready` is n. The points of the other packets are computed with the next batch.
    """
    points_per_packet = _sum_axes(points.counts, 1)
    return np.cumsum(points_per_packet) - points_per_packet


def _sum_axes(counts: NDArray[Any], axis_count: int) -> Indices:
    """Return counts, summed over all axes after the first `axis_count` axes."""
    # Along an axis with zero stride, a product is faster than a sum.
    times = 1
    while counts.ndim > axis_count:
        if counts.strides[-1] == 0 and counts.shape[-1] > 0:
            times *= counts.shape[-1]
            counts = counts[..., 0]
        else:
            counts = counts.sum(axis=-1)
    if counts.size and not any(counts.strides):
        return np.broadcast_to(counts.flat[0] * times, counts.shape)
    return counts * times
