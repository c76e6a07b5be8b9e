"""Read the sensor's clock as integer nanoseconds, and unwrap it."""

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

#: no clock reads more nanoseconds than this (285 years): damaged readings must not overflow.
_FURTHEST = 9 * 10**18


class Unwrapper:
    """Unwrap a clock that starts again at `wraps_at` seconds.

    The result is exact over any number of wraps.

    The shorter way round decides between forward and backward, so late packets go back in time.
    Where the host's times say that more than most of a turn has passed, they decide how many turns
    it was; from half a turn on, whether it was forward.
    """

    def __init__(self, wraps_at: float | None) -> None:
        self._turn = _turn(wraps_at) if wraps_at else 0
        self._last: tuple[int, int, int] | None = None

    def push(self, ns: Times, host: Times) -> Times:
        """Return the readings of the next packets, (n,), as times that run on from those before."""
        if not self._turn or not len(ns):
            return ns
        raw, time, at = self._last or (int(ns[0]), int(ns[0]), int(host[0]))
        half = self._turn // 2
        steps = _steps(ns, raw)
        over = np.flatnonzero((steps < -half) | (steps >= self._turn - half))
        if not len(over) and broadcast_value(host) == 0:
            times = ns if time == raw else ns + (time - raw)
            self._last = (ns.item(-1), times.item(-1), 0)
            return times
        if len(over):
            steps[over] = (steps[over] + half) % self._turn - half
        if (
            self._turn >= 10**9
            and int(host.max()) - min(int(host.min()), at or int(host.max())) > half
        ):
            before = np.concatenate([[at], host[:-1]])
            passed = np.where((host > 0) & (before > 0), host - before, 0)
            forward = (passed > half) & (np.abs(steps + self._turn - passed) < self._turn // 4)
            late = forward | (passed > self._turn * 3 // 4)
            if late.any():
                steps += np.where(late, (passed - steps + half) // self._turn, 0) * self._turn
        steps[0] += time
        times = np.cumsum(steps)
        self._last = (int(ns[-1]), int(times[-1]), int(host[-1]))
        return times


@dataclass(frozen=True)
class ClockReference:
    """The turn of a clock as a frame told it (`Clock.reference`).

    It is found before the packets that it applies to.

    Attributes:
        reading_ns: what the clock read in the frame.
        reported_s: the seconds since 1970 that the frame told.
        host_ns: when it arrived, ns since 1970; 0 if unknown.
    """

    reading_ns: int
    reported_s: float
    host_ns: int


class ClockEpoch:
    """The turn of a clock, by what other frames tell, see `Clock.reference`.

    Args:
        sensor: with the clock of the packets.
        reference: applies from the first packet on; None if the turn is unknown until a frame tells
            it.

    Attributes:
        frame: the type of the frames that tell it.
        ns: nanoseconds that make the times of an `Unwrapper` complete; None before it was told.
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
        self._turn = _turn(clock.wraps_at)
        self._reference = reference

    def push(
        self, batch: Batch, readings: Times, times: Times, host: Times, *, whole: bool = False
    ) -> Times:
        """Return what completes the times of packets, (n,).

        It is 0 for packets before the first frame that tells the turn, unless that one applies from
        the start.

        Args:
            readings, times: (n,), what the clock reads in the packets, and as times that run on.
            host: (n,), when the packets arrived, ns; 0 if unknown.
            whole: the packets are a whole input: the first frame that tells the turn applies to
                those before it too.
        """
        if self.ns is None and self._reference is not None:
            self.ns = self._ns_by_reference(
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
        complete = self._complete(reading, seconds.item(row))
        self.ns = complete - times.item(first) - self._short(reading - readings.item(first))
        if whole or not first:
            return repeat(self.ns, len(times))
        return np.where(np.arange(len(times)) < first, 0, self.ns)

    def _ns_by_reference(
        self, reference: ClockReference, reading: int, time: int, host: int
    ) -> int:
        """Return the offset of times, from readings in a packet and the reference."""
        passed = self._short(reference.reading_ns - reading)
        if host and reference.host_ns:
            passed += round((reference.host_ns - host - passed) / self._turn) * self._turn
        return self._complete(reference.reading_ns, reference.reported_s) - time - passed

    def _complete(self, reading: int, seconds: float) -> int:
        """Return the reading in the turn that is nearest to the seconds told."""
        return reading + round((round(seconds * 1e9) - reading) / self._turn) * self._turn

    def _short(self, step: int) -> int:
        """Return a step of the clock, the shorter way round."""
        return (step + self._turn // 2) % self._turn - self._turn // 2


def reported_seconds(clock: Clock, table: Table) -> NDArray[np.float64]:
    """Return the seconds since 1970 that frames tell, (n,); nan where they tell none."""
    assert clock.reference is not None
    frames = Batch(table, np.zeros(len(table), np.bool_))
    seconds = np.asarray(clock.reference[1](Fields(frames)), np.float64)
    return np.broadcast_to(seconds.reshape(-1), (len(table),))


def reference_readings(sensor: SensorDescription, table: Table) -> Times:
    """Return what the clock reads in frames that tell its turn, (n,) ns."""
    return clock_ns(sensor, Batch(table, np.zeros(len(table), np.bool_)))


def clock_ns(sensor: SensorDescription, batch: Batch) -> Times:
    """The sensor's own clock in each packet, (n,) int64 nanoseconds, as it stands on the wire.

    Where it stands in the parts of a frame, it is that of the first one; in a frame without any
    that of the frame before.
    """
    which, readings = read_clock(sensor, batch)
    if which is None:
        return readings
    return hold_values(which, readings, np.zeros(len(batch), np.int64))


def read_clock(sensor: SensorDescription, batch: Batch) -> tuple[NDArray[np.intp] | None, Times]:
    """Return the packets that have the clock (None: all), and its readings.

    If the clock is in parts, the first part counts.
    """
    assert sensor.clock is not None
    fields = paths(sensor.clock)
    place = clock_parts(fields, batch.table.schema)
    source = sensor.clock.source
    if place is not None:
        table, which = batch.table.parts(*place)
        frames, first = np.unique(which, return_index=True)
        return frames, _in_parts(sensor, place, table.take(first))
    if callable(source):
        terms = header_function(source, batch.table.schema, _nanoseconds)(batch)
        return None, sum(terms, np.zeros(len(batch), np.int64))
    return None, _sum_fields(fields, batch.table, sensor.id)


def hold_values(which: NDArray[np.intp], times: Times, before: Times) -> Times:
    """Return the times of some packets, each held until the next of them, (n,).

    Packets before the first of them have the times `before`, (n,).
    """
    positions = np.searchsorted(which, np.arange(len(before)), side="right") - 1
    if len(times):
        return np.where(positions < 0, before, times[np.maximum(positions, 0)])
    return before


def _sum_fields(fields: tuple[str, ...], table: Table, sensor: str) -> Times:
    """Return the nanoseconds that some fields add up to, (n,)."""
    total: Times | None = None
    for path, step, zero, furthest in clock_terms(fields, table.schema, sensor):
        raw = table.raw(path)
        if furthest and raw.dtype.kind in "ui":
            part = _within(raw, furthest)
            part *= step
            if zero:
                part += zero
        else:
            part = _nanoseconds(
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
    """Return the parts of a frame that have the fields of a clock, and their kind.

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
    """Return the times of parts, (k,), where they have a clock of their own.

    Args:
        place: where they stand.
        which: the frame of each.
        times: of these frames, for each part: that of their first part, where the clock stands in
            it.
    """
    if not len(which) or sensor.clock is None or not _stands_in(sensor.clock, place):
        return times
    readings = _in_parts(sensor, place, table)
    first = np.searchsorted(which, which)
    steps = readings - readings[first]
    if sensor.clock.wraps_at:
        turn = _turn(sensor.clock.wraps_at)
    else:
        turn = 0
    return times + ((steps + turn // 2) % turn - turn // 2 if turn else steps)


def _stands_in(clock: Clock, place: tuple[str, str]) -> bool:
    return any(path.startswith(f"{_prefix(place)}.") for path in paths(clock))


def _prefix(place: tuple[str, str]) -> str:
    return ".".join(filter(None, place))


def _in_parts(sensor: SensorDescription, place: tuple[str, str], table: Table) -> Times:
    """Return the clock that stands in parts, in each of them."""
    assert sensor.clock is not None
    own = tuple(path.removeprefix(f"{_prefix(place)}.") for path in paths(sensor.clock))
    return _sum_fields(own, table, sensor.id)


@lru_cache(maxsize=256)
def _turn(seconds: float) -> int:
    """Return seconds as nanoseconds, rounded as the number is written."""
    return int(to_exact(seconds) * 10**9)


def paths(clock: Clock) -> tuple[str, ...]:
    """Return the fields that add up to a clock; none where a function computes it."""
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

    Each has path, nanoseconds in one step and at zero, and furthest reading (0 if these are
    fractions).

    Raises:
        SpecError: for one that is no time, or not one of each packet.
    """
    terms = []
    for path in fields:
        info = schema.fields.get(path)
        if info:
            scaling = _scaling(info.unit, info.scale, info.offset)
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
        terms.append((path, step, zero, _FURTHEST // len(fields) // max(step, 1) if whole else 0))
    return terms


def _scaling(unit: str, scale: float, offset: float) -> tuple[Any, Any] | None:
    """Return the nanoseconds in one step of a field and at its zero.

    They are integers if both are whole, else fractions. Returns None if the unit is no time.
    """
    per_unit = factor(unit, "s")
    if per_unit is None:
        return None
    step, zero = (to_exact(part) * per_unit * 10**9 for part in (scale, offset))
    if step.denominator == 1 and zero.denominator == 1 and step < 2**62:
        return int(step), int(zero)
    return step, zero


def _steps(values: NDArray[np.int64], before: int) -> NDArray[np.int64]:
    """Differences from one to the next, (n,), the first one to `before`."""
    steps = np.empty(len(values), np.int64)
    steps[0] = values[0] - before
    np.subtract(values[1:], values[:-1], out=steps[1:])
    return steps


def _within(raw: NDArray[Any], furthest: int) -> Times:
    if raw.dtype.itemsize * 8 - (raw.dtype.kind == "i") < furthest.bit_length():
        return raw.astype(np.int64)
    edges = np.iinfo(raw.dtype)
    return np.asarray(
        np.clip(raw, max(int(edges.min), -furthest), min(int(edges.max), furthest)), np.int64
    )


def _nanoseconds(seconds: Any, number: int) -> Times:
    if np.size(seconds) in (1, number):
        flat = np.broadcast_to(np.asarray(seconds, np.float64).reshape(-1), (number,))
    else:
        flat = None
    if flat is None:
        raise SpecError("a clock must have one time per packet")
    return np.rint(np.clip(np.nan_to_num(flat), -9e9, 9e9) * 1e9).astype(np.int64)
