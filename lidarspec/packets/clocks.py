"""Read the sensor's clock as integer nanoseconds, unwrap it, and add its date."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import SpecError
from lidarspec.expressions.columns import Batch, Fields
from lidarspec.expressions.graph import header_function
from lidarspec.frames.arrays import broadcast_value, repeat
from lidarspec.frames.frame_table import Table
from lidarspec.frames.schema import Schema
from lidarspec.spec.fields import factor
from lidarspec.spec.sensor import SensorDescription
from lidarspec.spec.timing import Clock
from lidarspec.spec.tree import to_exact

Times = NDArray[np.int64]

#: The largest reading, ns (about 285 years). Larger, corrupt readings are set to it to avoid
#: overflow.
_MAX_READING_NS = 9 * 10**18


class Unwrapper:
    """Unwraps the readings of a clock that starts again after `wraps_at` seconds."""

    def __init__(self, wraps_at: float | None) -> None:
        self._period_ns = to_exact_ns(wraps_at) if wraps_at else 0
        self._last: tuple[int, int, int] | None = None

    def push(self, ns: Times, host: Times) -> Times:
        """Return the readings of the next packets, unwrapped, (n,) ns."""
        # A reading that is ahead by more than half a period is the step back of a late packet,
        # unless the arrival times show a pause of more than half a period.
        if not self._period_ns or not len(ns):
            return ns
        raw, time, at = self._last or (int(ns[0]), int(ns[0]), int(host[0]))
        half = self._period_ns // 2
        steps = _compute_steps(ns, raw)
        over = np.flatnonzero((steps < -half) | (steps >= self._period_ns - half))
        if not len(over) and broadcast_value(host) == 0:
            times = ns if time == raw else ns + (time - raw)
            self._last = (ns.item(-1), times.item(-1), 0)
            return times
        if len(over):
            steps[over] = (steps[over] + half) % self._period_ns - half
        if (
            self._period_ns >= 10**9
            and int(host.max()) - min(int(host.min()), at or int(host.max())) > half
        ):
            before = np.concatenate([[at], host[:-1]])
            passed = np.where((host > 0) & (before > 0), host - before, 0)
            forward = (passed > half) & (
                np.abs(steps + self._period_ns - passed) < self._period_ns // 4
            )
            late = forward | (passed > self._period_ns * 3 // 4)
            if late.any():
                steps += (
                    np.where(late, (passed - steps + half) // self._period_ns, 0) * self._period_ns
                )
        steps[0] += time
        times = np.cumsum(steps)
        self._last = (int(ns[-1]), int(times[-1]), int(host[-1]))
        return times


@dataclass(frozen=True)
class ClockReference:
    """The date that a frame reported for a clock reading (see `Clock.reference`).

    Attributes:
        reading_ns: the reading of the clock in the frame, ns.
        reported_s: the seconds since 1970 that the frame reported.
        host_ns: the arrival time of the frame, ns since 1970; 0 if unknown.
    """

    reading_ns: int
    reported_s: float
    host_ns: int


class ClockEpoch:
    """Finds the offset from the times of a clock to times since 1970.

    The date comes from frames of another type (`Clock.reference`).

    Args:
        sensor: the sensor that declares the clock.
        reference: a date that applies from the first packet on; None if unknown.

    Attributes:
        frame: the type of the frames that report the date.
        ns: the offset, ns; None while it is unknown.
    """

    def __init__(
        self, sensor: SensorDescription, clock: Clock, reference: ClockReference | None = None
    ) -> None:
        assert clock.reference is not None
        assert clock.wraps_at is not None
        self.frame = clock.reference[0]
        self.ns: int | None = None
        self._sensor = sensor
        self._clock = clock
        self._period_ns = to_exact_ns(clock.wraps_at)
        self._reference = reference

    def push(
        self, batch: Batch, readings: Times, times: Times, host: Times, *, whole: bool = False
    ) -> Times:
        """Return the offset to add to the times of packets, (n,) ns; 0 if unknown.

        Args:
            readings: the readings of the clock, (n,) ns.
            times: the same readings, unwrapped, (n,) ns.
            host: arrival times, (n,) ns; 0 if unknown.
            whole: whether the packets are the whole input. If so, the first date applies to all
                packets.
        """
        if self.ns is None and self._reference is not None:
            self.ns = self._find_offset(
                self._reference, readings.item(0), times.item(0), host.item(0)
            )
        if self.ns is not None:
            return repeat(self.ns, len(times))
        table, which = batch.state[self.frame]
        rows = np.unique(which[which >= 0])
        if table is None or not len(rows):
            return repeat(0, len(times))
        frames = table.take(rows)
        seconds = reported_seconds(self._clock, frames)
        if not np.isfinite(seconds).any():
            return repeat(0, len(times))
        row = int(np.isfinite(seconds).argmax())
        first = int(np.searchsorted(which, rows[row]))
        reading = reference_readings(self._sensor, frames).item(row)
        time_ns = self._find_nearest_time(reading, seconds.item(row))
        self.ns = time_ns - times.item(first) - self._fold_step(reading - readings.item(first))
        if whole or not first:
            return repeat(self.ns, len(times))
        return np.where(np.arange(len(times)) < first, 0, self.ns)

    def _find_offset(self, reference: ClockReference, reading: int, time: int, host: int) -> int:
        """Return the offset from unwrapped times to times since 1970, ns.

        Args:
            reading: the clock reading of any packet, ns.
            time: the unwrapped time of this packet, ns.
            host: the arrival time of this packet, ns; 0 if unknown.
        """
        passed = self._fold_step(reference.reading_ns - reading)
        if host and reference.host_ns:
            passed += round((reference.host_ns - host - passed) / self._period_ns) * self._period_ns
        return self._find_nearest_time(reference.reading_ns, reference.reported_s) - time - passed

    def _find_nearest_time(self, reading: int, seconds: float) -> int:
        """Return the time at which the clock shows a reading, ns since 1970.

        Args:
            reading: the reading, ns.
            seconds: the approximate date, seconds since 1970.
        """
        return reading + round((round(seconds * 1e9) - reading) / self._period_ns) * self._period_ns

    def _fold_step(self, step: int) -> int:
        """Return a step modulo the wrap period, from minus to plus half a period, ns."""
        return (step + self._period_ns // 2) % self._period_ns - self._period_ns // 2


def reported_seconds(clock: Clock, table: Table) -> NDArray[np.float64]:
    """Return the date that each frame reports, (n,) s since 1970; nan if not reported."""
    assert clock.reference is not None
    frames = Batch(table, np.zeros(len(table), np.bool_))
    seconds = np.asarray(clock.reference[1](Fields(frames)), np.float64)
    return np.broadcast_to(seconds.reshape(-1), (len(table),))


def reference_readings(sensor: SensorDescription, table: Table) -> Times:
    """Return the readings of the clock in frames that report the date, (n,) ns."""
    return clock_ns(sensor, Batch(table, np.zeros(len(table), np.bool_)))


def clock_ns(sensor: SensorDescription, batch: Batch) -> Times:
    """Return the clock reading of each packet, (n,) int64 ns, not unwrapped.

    A frame without a reading gets the reading of the previous frame.
    """
    which, readings = read_clock(sensor, batch)
    if which is None:
        return readings
    return hold_times(which, readings, np.zeros(len(batch), np.int64))


def read_clock(sensor: SensorDescription, batch: Batch) -> tuple[NDArray[np.intp] | None, Times]:
    """Return the rows of packets that have a clock reading, and the readings in ns.

    The rows are None if all packets have a reading.
    """
    assert sensor.clock is not None
    fields = clock_fields(sensor.clock)
    place = clock_parts(fields, batch.table.schema)
    source = sensor.clock.source
    if place is not None:
        table, which = batch.table.parts(*place)
        frames, first = np.unique(which, return_index=True)
        return frames, _read_parts(sensor, place, table.take(first))
    if callable(source):
        terms = header_function(source, batch.table.schema, _to_ns)(batch)
        return None, sum(terms, np.zeros(len(batch), np.int64))
    readings = _sum_fields(fields, batch.table, sensor.id)
    presences = [batch.table.present(path) for path in fields]
    optional = [presence for presence in presences if presence is not None]
    if not optional:
        return None, readings
    rows = np.flatnonzero(np.all(optional, axis=0))
    if len(rows) == len(batch):
        return None, readings
    return rows, readings[rows]


def hold_times(which: NDArray[np.intp], times: Times, before: Times) -> Times:
    """Return a time for each packet, (n,): its own, or else that of the packet before.

    Args:
        which: the rows of the packets that have a time, ascending, (k,).
        times: the times of these packets, (k,).
        before: the times to use before the first row of `which`, (n,).
    """
    positions = np.searchsorted(which, np.arange(len(before)), side="right") - 1
    if len(times):
        return np.where(positions < 0, before, times[np.maximum(positions, 0)])
    return before


def _sum_fields(fields: tuple[str, ...], table: Table, sensor: str) -> Times:
    """Return the sum of some fields in nanoseconds, (n,)."""
    total: Times | None = None
    for path, step, zero, max_raw in clock_terms(fields, table.schema, sensor):
        raw = table.raw(path)
        if max_raw and raw.dtype.kind in "ui":
            part = _clip(raw, max_raw)
            part *= step
            if zero:
                part += zero
        else:
            part = _to_ns(
                raw.astype(np.float64) * float(step / 10**9) + float(zero / 10**9), len(table)
            )
        if total is None:
            total = part
        else:
            total = np.add(total, part, out=total)
    if total is None:
        return np.zeros(len(table), np.int64)
    return total


@lru_cache(maxsize=256)
def clock_parts(fields: tuple[str, ...], schema: Schema) -> tuple[str, str] | None:
    """Return the path and the kind of the parts (`lidarspec.spec.Parts`) with a clock.

    Returns None if the clock is not in parts, or is in parts of several kinds.
    """
    places = set[tuple[str, str]]()
    for path in fields:
        if path in schema.fields:
            continue
        place = schema.split_part_path(path)
        if place is not None:
            axis, kind, _ = place
            places.add((axis, kind))
    if len(places) == 1:
        return places.pop()
    return None


def part_times(
    sensor: SensorDescription,
    place: tuple[str, str],
    table: Table,
    which: NDArray[np.intp],
    times: Times,
) -> Times:
    """Return the times of the parts of frames, (k,) ns.

    Args:
        place: the axis and the kind of the parts.
        which: the row of the frame of each part, (k,).
        times: for each part, the time of its frame, (k,).
    """
    if not len(which) or sensor.clock is None or not _has_fields_in_parts(sensor.clock, place):
        return times
    readings = _read_parts(sensor, place, table)
    first = np.searchsorted(which, which)
    steps = readings - readings[first]
    if sensor.clock.wraps_at:
        period_ns = to_exact_ns(sensor.clock.wraps_at)
    else:
        period_ns = 0
    return times + ((steps + period_ns // 2) % period_ns - period_ns // 2 if period_ns else steps)


def _has_fields_in_parts(clock: Clock, place: tuple[str, str]) -> bool:
    return any(path.startswith(f"{_get_prefix(place)}.") for path in clock_fields(clock))


def _get_prefix(place: tuple[str, str]) -> str:
    return ".".join(filter(None, place))


def _read_parts(sensor: SensorDescription, place: tuple[str, str], table: Table) -> Times:
    """Return the reading of the clock in each part, (k,) ns."""
    assert sensor.clock is not None
    own = tuple(path.removeprefix(f"{_get_prefix(place)}.") for path in clock_fields(sensor.clock))
    return _sum_fields(own, table, sensor.id)


@lru_cache(maxsize=256)
def to_exact_ns(seconds: float) -> int:
    """Return seconds in whole ns; 0.1 gives exactly 100,000,000."""
    return int(to_exact(seconds) * 10**9)


def clock_fields(clock: Clock) -> tuple[str, ...]:
    """Return the paths of the fields whose sum is a clock; () if it is a function."""
    if isinstance(clock.source, str):
        return (clock.source,)
    if callable(clock.source):
        return ()
    return tuple(clock.source)


@lru_cache(maxsize=256)
def clock_terms(
    fields: tuple[str, ...], schema: Schema, sensor: str
) -> list[tuple[str, Any, Any, int]]:
    """Return (path, step, zero, limit) of the fields that add up to a clock.

    Returns:
        path: the path of the field.
        step: the ns per raw step, an integer or a fraction.
        zero: the ns at the raw value 0, an integer or a fraction.
        limit: the largest raw value that int64 arithmetic can convert; 0 for fractions.

    Raises:
        SpecError: if a field has no unit of time, or does not have one value in each packet.
    """
    terms = []
    for path in fields:
        info = schema.fields.get(path)
        if info:
            scaling = _find_scaling(info.unit, info.scale, info.offset)
        else:
            scaling = None
        if info is None or scaling is None or info.axes:
            reason = "a clock must be a field with a unit of time, outside of arrays"
            raise SpecError(
                reason if info else "the clock uses this field, but no data frame has this field",
                path=path,
                sensor=sensor,
            )
        step, zero = scaling
        whole = isinstance(step, int) and isinstance(zero, int)
        terms.append(
            (path, step, zero, _MAX_READING_NS // len(fields) // max(step, 1) if whole else 0)
        )
    return terms


def _find_scaling(unit: str, scale: float, offset: float) -> tuple[Any, Any] | None:
    """Return the ns per raw step and the ns at raw 0; None if the unit is not a time."""
    per_unit = factor(unit, "s")
    if per_unit is None:
        return None
    step, zero = (to_exact(part) * per_unit * 10**9 for part in (scale, offset))
    if step.denominator == 1 and zero.denominator == 1 and step < 2**62:
        return int(step), int(zero)
    return step, zero


def _compute_steps(values: NDArray[np.int64], before: int) -> NDArray[np.int64]:
    """Return the difference of each value from the previous value, (n,).

    Args:
        before: the value before the first.
    """
    steps = np.empty(len(values), np.int64)
    steps[0] = values[0] - before
    np.subtract(values[1:], values[:-1], out=steps[1:])
    return steps


def _clip(raw: NDArray[Any], max_raw: int) -> Times:
    if raw.dtype.itemsize * 8 - (raw.dtype.kind == "i") < max_raw.bit_length():
        return raw.astype(np.int64)
    edges = np.iinfo(raw.dtype)
    return np.asarray(
        np.clip(raw, max(int(edges.min), -max_raw), min(int(edges.max), max_raw)), np.int64
    )


def _to_ns(seconds: Any, count: int) -> Times:
    if np.size(seconds) in (1, count):
        flat = np.broadcast_to(np.asarray(seconds, np.float64).reshape(-1), (count,))
    else:
        flat = None
    if flat is None:
        raise SpecError("a clock function must return one time per packet")
    return np.rint(np.clip(np.nan_to_num(flat), -9e9, 9e9) * 1e9).astype(np.int64)
