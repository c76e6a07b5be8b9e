"""Where one scan ends and the next begins, by the sensor's declared rule; remembers the value before each batch."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.clouds import COLUMNS
from lidarspec.columns import Column
from lidarspec.errors import SpecError
from lidarspec.packets import Packets
from lidarspec.points import Evaluated
from lidarspec.splits import Every, OnChange, OnFlag, OnRewind, OnWrap, Split

#: an angle has to have been this part of a turn away from the cut before it cuts again, so that jitter does not.
AWAY = 1 / 8


class Turning:
    """Which way an angle turns: the way of the last half turn, and at the start of what it has turned so far.

    Each step is judged by those before it alone, so that batches do not change where scans are cut.
    """

    def __init__(self) -> None:
        self._direction, self._total, self._furthest = 0, 0.0, 0.0

    def push(self, steps: NDArray[np.float64]) -> NDArray[np.float64]:
        """1 or -1 for each of the next steps, (k,), given in turns."""
        totals = np.cumsum(np.concatenate([[self._total], steps]))[1:]
        self._total = float(totals[-1]) if len(totals) else self._total
        found, start, size = np.ones(len(totals)), 0, 64
        while start < len(totals):
            part = totals[start : start + size]
            if self._direction == 0:
                found[start : start + len(part)] = np.where(part < 0, -1, 1)
                turned = np.flatnonzero(np.abs(part) >= 0.5)
            else:
                found[start : start + len(part)] = self._direction
                ahead = self._direction * part
                furthest = np.maximum(np.maximum.accumulate(ahead), self._furthest)
                turned = np.flatnonzero(furthest - ahead >= 0.5)
                self._furthest = float(furthest[-1])
            start, size = start + len(part), size * 2
            if len(turned):
                start, size = start - len(part) + int(turned[0]), 64
                self._direction = -self._direction or (1 if part[turned[0]] > 0 else -1)
                self._furthest = self._direction * float(part[turned[0]])
        return found


class Cutter:
    """The cuts of one stream of points."""

    def __init__(self, rule: Split) -> None:
        self._rule = rule
        self._before: float | None = None
        self._armed, self._turning = True, Turning()
        self._start: int | None = None

    def cuts(self, packets: Packets, found: Evaluated) -> list[int]:
        """Indices of the points of this batch before which to cut, ascending."""
        rule = self._rule
        if isinstance(rule, Every):
            return self._periods(rule, packets, found)
        if isinstance(rule, OnWrap) and rule.name in COLUMNS:
            angles = np.asarray(getattr(found.cloud, rule.name), np.float64)
            return self._wraps(angles, 2 * np.pi, rule.at).tolist()  # type: ignore[no-any-return]
        column = _field(found, rule.name)
        values, starts = _rows(column, found)
        if isinstance(rule, OnWrap):
            unit = packets.table.schema.fields[column.source].unit
            rows = self._wraps(values, 360.0 if unit == "deg" else 2 * np.pi, rule.at)
        else:
            rows = self._changes(rule, values)
        return starts[rows].tolist()  # type: ignore[no-any-return]

    def _changes(self, rule: OnFlag | OnChange | OnRewind, values: NDArray[np.float64]) -> NDArray[np.intp]:
        if isinstance(rule, OnFlag):
            return np.flatnonzero(values != 0)
        if not len(values):
            return np.empty(0, np.intp)
        before = np.concatenate([[values[0] if self._before is None else self._before], values[:-1]])
        self._before = float(values[-1])
        return np.flatnonzero(values < before if isinstance(rule, OnRewind) else values != before)

    def _wraps(self, angles: NDArray[np.float64], full: float, at: float) -> NDArray[np.intp]:
        """Places where the angle has gone on past `at`, in whichever direction the sensor turns."""
        known = np.flatnonzero(np.isfinite(angles))
        if not len(known):
            return np.empty(0, np.intp)
        values = angles[known]
        before = np.concatenate([[values[0] if self._before is None else self._before], values[:-1]])
        self._before = float(values[-1])
        steps = np.mod(values - before + full / 2, full) - full / 2
        direction = self._turning.push(steps / full)
        turned, earlier = np.mod(direction * (values - at), full), np.mod(direction * (before - at), full)
        away = np.flatnonzero((turned > full * AWAY) & (turned < full * (1 - AWAY)))
        found, since = [], 0
        for spot in np.flatnonzero(earlier - turned > full / 2).tolist():
            if self._armed or np.searchsorted(away, since) < np.searchsorted(away, spot):
                found.append(spot)
                self._armed, since = False, spot
        self._armed = self._armed or bool(len(away) and away[-1] >= since)
        return known[np.array(found, np.intp)]

    def _periods(self, rule: Every, packets: Packets, found: Evaluated) -> list[int]:
        times = packets.time_ns[: found.ready]
        if not len(times):
            return []
        self._start = int(times[0]) if self._start is None else self._start
        period = (times - self._start) // int(rule.seconds * 1e9)
        before = np.concatenate([[period[0] if self._before is None else self._before], period[:-1]])
        self._before = float(period[-1])
        starts = _starts(found.counts.sum(axis=tuple(range(1, found.counts.ndim))))
        return starts[np.flatnonzero(period > before)].tolist()  # type: ignore[no-any-return]


def _field(found: Evaluated, path: str) -> Column:
    column: Any = found.fields
    for name in path.split("."):
        column = getattr(column, name)
    if not isinstance(column, Column):
        raise SpecError("scans are cut by a field, and this is a struct", path=path)
    return column


def _rows(column: Column, found: Evaluated) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """The values of a field row by row in stream order, and the index of the first point of each row."""
    levels = 1 + max((index for index, name in enumerate(column.axes) if name is not None), default=-1)
    counts = found.counts
    shape = np.broadcast_shapes((found.ready, *column.shape[1 : 1 + levels]), counts.shape[: 1 + levels])
    wide = np.broadcast_to(counts, (*shape, *counts.shape[1 + levels :]))
    points = wide.sum(axis=tuple(range(1 + levels, wide.ndim))).reshape(-1)
    values = np.broadcast_to(
        column.array[: found.ready].reshape(len(column.array[: found.ready]), *column.shape[1 : 1 + levels]), shape
    ).reshape(-1)
    starts = _starts(points)
    kept = points > 0 if levels else np.ones(len(points), np.bool_)
    return values[kept], starts[kept]


def _starts(points: NDArray[np.intp]) -> NDArray[np.intp]:
    return np.cumsum(points) - points
