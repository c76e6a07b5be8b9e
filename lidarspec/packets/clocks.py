"""Read the sensor's clock as integer nanoseconds, unwrap it, and date it."""

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

#: larger readings (over 285 years) are clipped, so that damaged readings do not overflow.
_MAX_READING_NS = 9 * 10**18


class Unwrapper:
    """A clock that starts again after `wraps_at` seconds, unwrapped.

    The result is exact over any number of wraps.

    A step of more than half a wrap period counts as a step backward, so late packets go back in
    time. Arrival times decide in two cases: after a pause of more than three quarters of a period
    they give the number of wraps, and after more than half a period they can show that the step was
    forward.
    """

    def __init__(self, wraps_at: float | None) -> None:
        self._period_ns = _to_exact_ns(wraps_at) if wraps_at else 0
        self._last: tuple[int, int, int] | None = None

    def push(self, ns: Times, host: Times) -> Times:
        """Return the readings of the next packets, unwrapped, (n,) ns.

        Args:
            ns: the readings, (n,) ns.
            host: arrival times, (n,) ns; 0 if unknown.
        """
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
    """A clock reading and the date that a frame reported for it (`Clock.reference`).

    It is found before the packets that it applies to.

    Attributes:
        reading_ns: the reading of the clock in that frame.
        reported_s: the seconds since 1970 that the frame reported.
        host_ns: the arrival time of the frame, ns since 1970; 0 if unknown.
    """

    reading_ns: int
    reported_s: float
    host_ns: int


class ClockEpoch:
    """The offset from unwrapped times to times since 1970.

    Frames of another type report the date (see `Clock.reference`).

    Args:
        sensor: the sensor that declares the clock.
        clock: that clock.
        reference: applies from the first packet on; None if the offset is unknown until a frame
            reports the date.

    Attributes:
        frame: the type of the frames that report the date.
        ns: the offset, ns, to add to the times of an `Unwrapper`; None while it is unknown.
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
        self._period_ns = _to_exact_ns(clock.wraps_at)
        self._reference = reference

    def push(
        self, batch: Batch, readings: Times, times: Times, host: Times, *, whole: bool = False
    ) -> Times:
        """Return the offset to add to the times of packets, (n,) ns.

        It is 0 for packets before the first frame that reports the date, unless that date applies
        to all packets.

        Args:
            batch: the packets.
            readings: the readings of the clock, (n,) ns.
            times: the same readings, unwrapped, (n,) ns.
            host: arrival times, (n,) ns; 0 if unknown.
            whole: whether the packets are a whole input: the first date then applies to all
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
        """Return the offset that follows from the reference and one packet.

        Args:
            reading, time, host: the reading, the unwrapped time and the arrival time of the packet.
        """
        passed = self._fold_step(reference.reading_ns - reading)
        if host and reference.host_ns:
            passed += round((reference.host_ns - host - passed) / self._period_ns) * self._period_ns
        return self._find_nearest_time(reference.reading_ns, reference.reported_s) - time - passed

    def _find_nearest_time(self, reading: int, seconds: float) -> int:
        """Return the time that has a reading and is nearest to some seconds since 1970."""
        return reading + round((round(seconds * 1e9) - reading) / self._period_ns) * self._period_ns

    def _fold_step(self, step: int) -> int:
        """Return a step of the clock, folded to at most half a wrap period."""
        return (step + self._period_ns // 2) % self._period_ns - self._period_ns // 2


def reported_seconds(clock: Clock, table: Table) -> NDArray[np.float64]:
    """Return the seconds since 1970 that frames report, (n,); nan if not reported."""
    assert clock.reference is not None
    frames = Batch(table, np.zeros(len(table), np.bool_))
    seconds = np.asarray(clock.reference[1](Fields(frames)), np.float64)
    return np.broadcast_to(seconds.reshape(-1), (len(table),))


def reference_readings(sensor: SensorDescription, table: Table) -> Times:
    """Return the readings of the clock in frames that report the date, (n,) ns."""
    return clock_ns(sensor, Batch(table, np.zeros(len(table), np.bool_)))


def clock_ns(sensor: SensorDescription, batch: Batch) -> Times:
    """Return the clock reading of each packet, (n,) int64 ns, not unwrapped.

    If the clock is in the parts of a frame, the reading of the first part counts. A frame without
    parts has the reading of the frame before.
    """
    which, readings = read_clock(sensor, batch)
    if which is None:
        return readings
    return hold_values(which, readings, np.zeros(len(batch), np.int64))


def read_clock(sensor: SensorDescription, batch: Batch) -> tuple[NDArray[np.intp] | None, Times]:
    """Return the packets that have a clock reading (None: all), and the readings.

    If the clock is in parts, the first part counts.
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
    return None, _sum_fields(fields, batch.table, sensor.id)


def hold_values(which: NDArray[np.intp], times: Times, before: Times) -> Times:
    """Return the times of some packets, each held until the next of them, (n,).

    Args:
        which: the packets that have a time, ascending, (k,).
        times: their times, (k,).
        before: the times of packets before the first of them, (n,).
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
    """Return the axis and the kind of the parts that have the fields of a clock.

    Returns None if the frame itself has them.
    """
    places = set[tuple[str, str]]()
    for path in fields:
        if path in schema.fields:
            continue
        place = schema.within(path)
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
    """Return the times of parts, (k,); each has its own time if parts have the clock.

    Args:
        place: the axis and the kind of the parts.
        table: the parts.
        which: the row of the frame of each part, (k,).
        times: the time of the frame of each part, (k,). If parts have the clock, it is the time of
            the first part.
    """
    if not len(which) or sensor.clock is None or not _is_in_parts(sensor.clock, place):
        return times
    readings = _read_parts(sensor, place, table)
    first = np.searchsorted(which, which)
    steps = readings - readings[first]
    if sensor.clock.wraps_at:
        period_ns = _to_exact_ns(sensor.clock.wraps_at)
    else:
        period_ns = 0
    return times + ((steps + period_ns // 2) % period_ns - period_ns // 2 if period_ns else steps)


def _is_in_parts(clock: Clock, place: tuple[str, str]) -> bool:
    return any(path.startswith(f"{_prefix(place)}.") for path in clock_fields(clock))


def _prefix(place: tuple[str, str]) -> str:
    return ".".join(filter(None, place))


def _read_parts(sensor: SensorDescription, place: tuple[str, str], table: Table) -> Times:
    """Return the reading of the clock in each part, (k,) ns."""
    assert sensor.clock is not None
    own = tuple(path.removeprefix(f"{_prefix(place)}.") for path in clock_fields(sensor.clock))
    return _sum_fields(own, table, sensor.id)


@lru_cache(maxsize=256)
def _to_exact_ns(seconds: float) -> int:
    """Return seconds as nanoseconds, exact for the decimal number as written."""
    return int(to_exact(seconds) * 10**9)


def clock_fields(clock: Clock) -> tuple[str, ...]:
    """Return the fields that add up to a clock; none if a function computes it."""
    if isinstance(clock.source, str):
        return (clock.source,)
    if callable(clock.source):
        return ()
    return tuple(clock.source)


@lru_cache(maxsize=256)
def clock_terms(
    fields: tuple[str, ...], schema: Schema, sensor: str
) -> list[tuple[str, Any, Any, int]]:
    """Return the fields that add up to a clock.

    Each is a tuple: the path, the nanoseconds of one step, the nanoseconds at 0, and the largest
    raw value that cannot overflow (0 if the nanoseconds are fractions).

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
                reason if info else "no data frame has this field for the clock",
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
    """Return the nanoseconds of one step of a field, and at its zero.

    They are integers if both are whole, else fractions. Returns None if the unit is not a unit of
    time.
    """
    per_unit = factor(unit, "s")
    if per_unit is None:
        return None
    step, zero = (to_exact(part) * per_unit * 10**9 for part in (scale, offset))
    if step.denominator == 1 and zero.denominator == 1 and step < 2**62:
        return int(step), int(zero)
    return step, zero


def _compute_steps(values: NDArray[np.int64], before: int) -> NDArray[np.int64]:
    """Return the difference of each value from the value before it, (n,).

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
        raise SpecError("a clock must have one time per packet")
    return np.rint(np.clip(np.nan_to_num(flat), -9e9, 9e9) * 1e9).astype(np.int64)
