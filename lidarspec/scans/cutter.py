"""Find the ends of scans by the sensor's declared rule.

The value before each batch is kept.
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import SpecError, UnknownField
from lidarspec.expressions.columns import Column
from lidarspec.packets.masked_sector import FULL_TURNS, JITTER, AngleReader, Sector
from lidarspec.packets.packets import Packets
from lidarspec.points.cloud import COLUMNS
from lidarspec.points.plain import Evaluated
from lidarspec.spec.sensor import Sensor
from lidarspec.spec.timing import Every, OnChange, OnFlag, OnJump, OnRewind, OnWrap, Split

#: an angle has to have been this part of a turn away from the cut before it cuts again, so that
#: jitter does not.
AWAY = 1 / 8


class Turning:
    """The direction in which an angle turns.

    It is that of the last half turn, and at the start that of the total so far.

    Each step is judged by those before it alone, so that batches do not change where scans are cut.
    """

    def __init__(self) -> None:
        self._direction = 0
        self._total = 0.0
        self._furthest = 0.0

    def push(self, steps: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the direction at each of the next steps, 1 or -1, (k,).

        Steps are in turns. The length is 1 if the direction is the same for all.
        """
        totals = steps.copy()
        totals[:1] += self._total
        np.cumsum(totals, out=totals)
        first = self._direction
        if len(totals):
            self._total = float(totals[-1])
        else:
            self._total = self._total
        found: NDArray[np.float64] | None = None
        start = 0
        size = 64
        is_new = True
        while start < len(totals):
            if self._direction and is_new:
                is_new = False
                if self._only_ahead(float(totals[start]), steps[start + 1 :]):
                    if found is not None:
                        found[start:] = self._direction
                    break
            part = totals[start : start + size]
            if self._direction == 0:
                found = np.ones(len(totals)) if found is None else found
                found[start : start + len(part)] = np.where(part < 0, -1, 1)
                turned = np.abs(part) >= 0.5
            else:
                if found is not None:
                    found[start : start + len(part)] = self._direction
                ahead = self._direction * part
                furthest = np.maximum(np.maximum.accumulate(ahead), self._furthest)
                turned = furthest - ahead >= 0.5
                self._furthest = float(furthest[-1])
            start = start + len(part)
            size = size * 2
            if turned.any():
                spot = int(turned.argmax())
                start = start - len(part) + spot
                size = 64
                if found is None:
                    found = np.full(len(totals), float(first))
                self._direction = -self._direction or (1 if part[spot] > 0 else -1)
                self._furthest = self._direction * float(part[spot])
        if found is not None and not (found == found[0]).all():
            return found
        if found is None:
            return np.array([float(first or 1)])
        return found[:1]

    def _only_ahead(self, total: float, steps: NDArray[np.float64]) -> bool:
        """Return whether the angle is farther than ever, with no step back afterwards."""
        if (
            self._direction * total < self._furthest
            or float((self._direction * steps).min(initial=0.0)) < 0
        ):
            return False
        self._furthest = self._direction * self._total
        return True


class End(NamedTuple):
    """Where a scan ends.

    Attributes:
        point: the index in its batch of the point before which it ends.
        packet: the one that says so, which may be without points; None where it is the point that
            does.
        leaps: whether the angle leaps by more than `AWAY`, and twice as far as at the end before:
            something is missing there, or no angle.
    """

    point: int
    packet: int | None
    leaps: bool


class Cutter:
    """Finds where the scans of one stream of points end."""

    def __init__(self, sensor: Sensor) -> None:
        self._rule: Split = sensor.scan
        self._reader = AngleReader(sensor)
        self._cut: float | None = None  # where the user wants scans to be cut, in turns
        if "cut" in sensor.options:
            self._cut = sensor.options["cut"] / 360 % 1
        self.sector: Sector | None = None
        self._angle: float | None = None  # of the row before, in turns
        self._direction = 0
        self._turned = 1.0  # turns since the last end in a sector
        self._before: float | None = None
        self._armed = True
        self._turning = Turning()
        self._start: int | None = None
        self._leap = 0.0  # by how much of a turn the angle went on at the last cut

    def ends(self, packets: Packets, found: Evaluated) -> list[End]:
        """The ends in this batch, ascending."""
        rule = self._rule
        steps = None
        if self.sector is not None:
            return self._ends_at(
                packets, found, self.sector.middle if self._cut is None else self._cut
            )
        if self._cut is not None and isinstance(rule, OnChange):
            return self._ends_at(packets, found, self._cut)
        if isinstance(rule, Every):
            which = self._periods(rule, packets, found)
            return self._ends(first_points(found)[which], which)
        if isinstance(rule, OnWrap) and rule.name in COLUMNS:
            points, steps = self._wraps(
                np.asarray(getattr(found.cloud, rule.name), np.float64),
                2 * np.pi,
                self._at(rule, 2 * np.pi),
            )
            return self._ends(points, steps=steps)
        path = _own_path(packets, rule.name)
        column = _field(found, path)
        values, starts = _rows(column, found)
        if isinstance(rule, OnWrap):
            full = _turn(packets, path) or 2 * np.pi
            rows, steps = self._wraps(values, full, self._at(rule, full))
        else:
            rows = self._changes(
                rule, values, _turn(packets, path) if isinstance(rule, OnJump) else None
            )
        return self._ends(
            starts[rows], rows if all(name is None for name in column.axes) else None, steps
        )

    def _at(self, rule: OnWrap, full: float) -> float:
        """Return the angle at which scans are cut, in the unit in which a turn is `full`."""
        if self._cut is None:
            return rule.at
        return self._cut * full

    def use_sector(self, sector: Sector, angle: float | None) -> None:
        """Cut scans in a masked sector from now on.

        Args:
            angle: of the last packet before, in turns; None if there is none.
        """
        self.sector = sector
        self._direction = sector.direction
        self._angle = angle

    def _ends_at(self, packets: Packets, found: Evaluated, at: float) -> list[End]:
        """Return the ends of scans at which the angle passes `at`, in turns.

        The angles of the sensor may skip over `at`.
        """
        rows_are_packets = True
        if isinstance(self._rule, OnWrap):
            path = _own_path(packets, self._rule.name)
            column = _field(found, path)
            values, starts = _rows(column, found)
            angles = values / (_turn(packets, path) or 2 * np.pi)
            rows_are_packets = all(name is None for name in column.axes)
        else:
            read = self._reader.angles(packets.table)
            if read is None:
                angles = np.empty(0)
            else:
                angles = read[: found.ready]
            starts = first_points(found)
        self._direction = self._direction or self._reader.direction(packets.table)
        if not len(angles):
            return []
        before = _before(angles, self._angle)
        self._angle = float(angles[-1])
        steps = (self._direction * (angles - before)) % 1
        steps[steps > 1 - JITTER] = 0
        behind = (self._direction * (before - at)) % 1
        turned = self._turned + np.cumsum(steps)
        rows = list[int]()
        for row in np.flatnonzero(behind + steps >= 1).tolist():
            if turned[row] >= AWAY:
                rows.append(row)
                turned -= turned[row]
        self._turned = float(turned[-1])
        picked = np.array(rows, np.intp)
        return self._ends(starts[picked], picked if rows_are_packets else None)

    def _ends(
        self,
        points: NDArray[np.intp],
        packets: NDArray[np.intp] | None = None,
        steps: NDArray[np.float64] | None = None,
    ) -> list[End]:
        """The ends at some points; `steps`: by how much of a turn the angle goes on at each."""
        if packets is None:
            which = itertools.repeat(None)
        else:
            which = packets.tolist()
        leaps = itertools.repeat(False) if steps is None else map(self._is_leap, steps.tolist())
        return list(map(End, points.tolist(), which, leaps))

    def _is_leap(self, step: float) -> bool:
        before = self._leap
        self._leap = step
        return before > 0 and step > max(AWAY, 2 * before)

    def _changes(
        self,
        rule: OnFlag | OnChange | OnJump | OnRewind,
        values: NDArray[np.float64],
        full: float | None,
    ) -> NDArray[np.intp]:
        if isinstance(rule, OnFlag):
            return np.flatnonzero(values != 0 if rule.value is None else values == rule.value)
        if not len(values):
            return np.empty(0, np.intp)
        before = _before(values, self._before)
        self._before = float(values[-1])
        if isinstance(rule, OnJump):
            if full is None:
                steps = values - before
            else:
                steps = _folded(values - before + full / 2, full) - full / 2
            return np.flatnonzero(np.abs(steps) > rule.by)
        return np.flatnonzero(values < before if isinstance(rule, OnRewind) else values != before)

    def _wraps(
        self, angles: NDArray[np.float64], full: float, at: float
    ) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """Return the indices at which the angle passes `at`, and by how much.

        Either direction of rotation is possible. Amounts are in turns.
        """
        finite = np.isfinite(angles)
        known = None if finite.all() else np.flatnonzero(finite)
        values = angles if known is None else angles[known]
        if not len(values):
            return np.empty(0, np.intp), np.empty(0)
        before = _before(values, self._before)
        self._before = float(values[-1])
        direction = self._turning.push(
            (_folded(values - before + full / 2, full) - full / 2) / full
        )
        if len(direction) == 1:
            turned = _folded(direction * (values - at), full)
            earlier = _before(turned, float(_folded(direction * (before[:1] - at), full)[0]))
        else:
            turned, earlier = (_folded(direction * (some - at), full) for some in (values, before))
        passed = np.flatnonzero(earlier - turned > full / 2)
        found = np.array(self._armed_at(passed, turned, full), np.intp)
        return found if known is None else known[found], 1 - (earlier[found] - turned[found]) / full

    def _armed_at(
        self, passed: NDArray[np.intp], turned: NDArray[np.float64], full: float
    ) -> list[int]:
        """The places, of those where an angle passes, that come after it was far away."""
        found: list[int] = []
        since = 0
        for spot in passed.tolist():
            if self._armed or _was_far(turned[since:spot], full):
                found.append(spot)
                self._armed = False
                since = spot
        self._armed = self._armed or _was_far(turned[since:], full)
        return found

    def _periods(self, rule: Every, packets: Packets, found: Evaluated) -> NDArray[np.intp]:
        """The packets with which a period begins."""
        times = packets.time_ns[: found.ready]
        if not len(times):
            return np.empty(0, np.intp)
        if self._start is None:
            self._start = int(times[0])
        else:
            self._start = self._start
        period = (times - self._start) // int(rule.seconds * 1e9)
        before = _before(period.astype(np.float64), self._before)
        self._before = float(period[-1])
        return np.flatnonzero(period > before)


def _turn(packets: Packets, path: str) -> float | None:
    """The whole turn in the unit of a field, None where it is no angle."""
    if path.startswith("frame."):
        table = packets.frames[0]
    else:
        table = packets.table
    return FULL_TURNS.get(table.schema.fields[path.removeprefix("frame.")].unit)


def _own_path(packets: Packets, path: str) -> str:
    """The path of a field of the frame as packets that are parts of it have it."""
    _, _, parts = packets.frame.partition(".")
    if not parts:
        return path
    if path.startswith(f"{parts}."):
        return path.removeprefix(f"{parts}.")
    return f"frame.{path}"


def _field(found: Evaluated, path: str) -> Column:
    column: Any = found.fields
    for name in path.split("."):
        try:
            column = getattr(column, name)
        except UnknownField as error:
            raise SpecError(str(error), path="scan", rule="LS216") from None
    if not isinstance(column, Column):
        raise SpecError("scans are cut by a field, and this is a struct", path=path)
    return column


def _rows(column: Column, found: Evaluated) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Return the values of a field row by row, and the index of each first point.

    Rows are in stream order.
    """
    levels = 1 + max(
        (index for index, name in enumerate(column.axes) if name is not None), default=-1
    )
    counts = found.counts
    array = column.array[: found.ready]
    if not levels and len(array) == len(counts):
        return array.reshape(-1), _starts(_sums(counts, 1))
    shape = np.broadcast_shapes(
        (found.ready, *array.shape[1 : 1 + levels]), counts.shape[: 1 + levels]
    )
    numbers = _sums(np.broadcast_to(counts, (*shape, *counts.shape[1 + levels :])), 1 + levels)
    values = np.broadcast_to(
        array.reshape(len(array), *array.shape[1 : 1 + levels]), shape
    ).reshape(-1)
    if numbers.size and not any(numbers.strides) and (each := int(numbers.flat[0])):
        return values, np.arange(len(values)) * each
    points = numbers.reshape(-1)
    starts = _starts(points)
    if levels:
        kept = points > 0
    else:
        kept = np.ones(len(points), np.bool_)
    return values[kept], starts[kept]


def first_points(found: Evaluated) -> NDArray[np.intp]:
    """The index of the first point of each packet, (ready,)."""
    return _starts(_sums(found.counts, 1))


def _sums(counts: NDArray[Any], kept: int) -> NDArray[np.intp]:
    """Return the sums over all axes but the first `kept`.

    Along axes that repeat one number, sums are computed as products.
    """
    times = 1
    while counts.ndim > kept:
        repeats = counts.strides[-1] == 0 and counts.shape[-1] > 0
        times *= counts.shape[-1] if repeats else 1
        if repeats:
            counts = counts[..., 0]
        else:
            counts = counts.sum(axis=-1)
    if counts.size and not any(counts.strides):
        return np.broadcast_to(counts.flat[0] * times, counts.shape)
    return counts * times


def _was_far(angles: NDArray[np.float64], full: float) -> bool:
    """Whether any of these angles is far from the cut at 0."""
    least = full * AWAY
    most = full * (1 - AWAY)
    if len(angles) and least < angles[len(angles) // 2] < most:
        return True
    return bool(((angles > least) & (angles < most)).any())


def _folded(angles: NDArray[np.float64], full: float) -> NDArray[np.float64]:
    """Return angles in [0, full), read-only.

    The results equal `np.mod`, in a fraction of its time.
    """
    outside = np.flatnonzero((angles < 0) | (angles >= full))
    if not len(outside):
        return angles
    if 8 * len(outside) < len(angles):
        found = angles.copy()
        found[outside] = _folded(angles[outside], full)
        return found
    turns = angles / full
    np.floor(turns, out=turns)
    turns *= full
    return np.subtract(angles, turns, out=turns)


def _before(values: NDArray[np.float64], first: float | None) -> NDArray[np.float64]:
    """The value before each; before the first one `first`, or itself."""
    found = np.empty_like(values)
    found[:1] = values[:1] if first is None else first
    found[1:] = values[:-1]
    return found


def _starts(points: NDArray[np.intp]) -> NDArray[np.intp]:
    return np.cumsum(points) - points
