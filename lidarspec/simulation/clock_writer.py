"""Write times and the status of a clock into simulated frames: the inverse of reading them.

A clock is a field, fields that add up, or a function of fields. The fields that a function depends
on are found by raising each by one and by two. Equal steps make a field linear, such as the
microseconds or the hour. A field with steps of 28 to 31 days is the month, and one with steps of
365 or 366 days the year.

To write a time, the fields of the date get the date. Then the linear fields share the rest, from
the coarsest to the finest. A clock that is a single field is shifted instead, with all elements of
its array, the other parts of its frame, and all fields of the same unit, scale and size: they carry
times by the same clock, such as the start and the end of a measurement. If the time cannot be read
back from a frame, the clock cannot be written.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import UsageError, plugin_errors
from lidarspec.expressions.columns import Batch
from lidarspec.frames.frame_table import CompiledTable, LayoutRows
from lidarspec.frames.schema import without_indices
from lidarspec.framing.frame_engine import get_codec
from lidarspec.packets.clock_status import frame_status
from lidarspec.packets.clocks import clock_fields, clock_ns, clock_parts, clock_terms
from lidarspec.packets.packet_type import find_clock
from lidarspec.sensor_operations import Sensor
from lidarspec.simulation.clock_faults import ClockFaults, ClockTimeline
from lidarspec.simulation.raw_values import PartRows, write_raw
from lidarspec.spec.timing import Clock, ClockState
from lidarspec.spec.tree import FieldInfo, to_exact

Times = NDArray[np.int64]
DAY_NS = 86_400_000_000_000
#: The days of years and of months.
YEAR_DAYS = (365, 366)
MONTH_DAYS = (28, 29, 30, 31)
#: The largest raw value that is written.
MAX_RAW = 2**63 - 1
#: How many values of a field are tried, to find those of a calculated status, and of how many
#: fields together.
MAX_STATUS_VALUES = 16
MAX_STATUS_FIELDS = 2
#: The shift that tests whether a clock can be written, ns. It is larger than a second.
TEST_SHIFT_NS = 1_500_000_000


@dataclass(frozen=True)
class _TimeField:
    """A field of a clock, and the nanoseconds of one raw step: whole, or a fraction."""

    path: str
    step_ns: float


@dataclass(frozen=True)
class _StatusChoice:
    """Raw values of the fields of a status, and their meaning."""

    raw: tuple[int, ...]
    state: ClockState


@dataclass(frozen=True)
class _DateFields:
    """The fields of a date, with the raw values of one date."""

    year: str
    month: str
    day: str
    date: np.datetime64
    raw: tuple[int, int, int]


class ClockWriter:
    """Writes readings into the clock of one frame type.

    Args:
        sensor: the sensor.
        clock: the clock of these frames.
        table: frames as they are simulated; the fields of the clock are found with the first.

    Attributes:
        resolution_ns: the smallest step of the clock, ns.
        period_ns: the time after which it wraps, ns; 0 if it does not.

    Raises:
        UsageError: if the clock cannot be written.
    """

    def __init__(self, sensor: Sensor, clock: Clock, table: CompiledTable) -> None:
        self._sensor = replace(sensor, clock=clock) if clock is not sensor.clock else sensor
        self.period_ns = 0
        if clock.wraps_at is not None:
            self.period_ns = int(to_exact(clock.wraps_at) * 10**9)
        self._date: _DateFields | None = None
        self._parts = ""
        self._is_shifted = isinstance(clock.source, str)
        self._fields: list[_TimeField] = []
        if isinstance(clock.source, str):
            self._find_fields_to_shift(clock.source, table)
        elif callable(clock.source):
            self._find_function_fields(_copy_first(table))
        else:
            terms = clock_terms(clock_fields(clock), table.schema, sensor.id)
            self._set_fields([_TimeField(path, _to_step(step)) for path, step, _, _ in terms])
        self.resolution_ns = min((field.step_ns for field in self._fields), default=1.0)
        self._check(_copy_first(table))

    @property
    def can_follow_dates(self) -> bool:
        """Whether the reading at a date is defined: it wraps never, or at shares of a day."""
        return not self.period_ns or DAY_NS % self.period_ns == 0

    def read(self, table: CompiledTable) -> Times:
        """Return the readings of the clock, (n,) ns."""
        return clock_ns(self._sensor, Batch(table, np.zeros(len(table), np.bool_)))

    def write(self, table: CompiledTable, readings: Times) -> None:
        """Write readings, (n,) ns; a clock that wraps is wrapped."""
        readings = self._round(readings)
        if self.period_ns:
            readings = readings % self.period_ns
        if self._is_shifted:
            self._shift_fields(table, readings - self.read(table))
            return
        if self._date is not None:
            self._write_date(table, self._date, readings)
        for field in self._fields:
            write_raw(table, field.path, np.array(0))
        rest: NDArray[Any] = readings - self.read(table)
        *coarse, finest = self._fields
        for field in coarse:
            raw = np.floor_divide(rest, field.step_ns).astype(np.int64)
            raw = _clip(table.schema.fields[field.path], raw)
            write_raw(table, field.path, raw)
            rest = rest - raw * field.step_ns
        finest_raw = rest / finest.step_ns
        info = table.schema.fields[finest.path]
        if info.kind == "int":
            finest_raw = np.rint(finest_raw)
        write_raw(table, finest.path, _clip(info, finest_raw))

    def _round(self, readings: Times) -> Times:
        """Return readings rounded to the resolution, if that is a whole number of ns."""
        step = round(self.resolution_ns)
        if step != self.resolution_ns or step < 2:
            return readings
        return (readings + step // 2) // step * step

    def _shift_fields(self, table: CompiledTable, shifts: Times) -> None:
        """Add nanoseconds, (n,), to all elements of the clock's fields."""
        rows = table
        if self._parts:
            rows = PartRows(table, self._parts)
            shifts = shifts[rows.which]
        for field in self._fields:
            info = rows.schema.fields[field.path]
            before = rows.raw(field.path)
            by_element = shifts.reshape(-1, *(1,) * (before.ndim - 1))
            raw = _shift_raw(info, before, by_element, field.step_ns, self.period_ns)
            write_raw(rows, field.path, _clip(info, raw))
        if isinstance(rows, PartRows):
            rows.put_back()

    def _write_date(self, table: CompiledTable, date: _DateFields, readings: Times) -> None:
        """Write the fields of a date."""
        days = np.floor_divide(readings, DAY_NS).astype("datetime64[D]")
        here = _split_date(days)
        base = _split_date(np.array([date.date]))
        paths = (date.year, date.month, date.day)
        for path, raw, value, known in zip(paths, date.raw, here, base, strict=True):
            write_raw(table, path, _clip(table.schema.fields[path], raw + value - known))

    def _find_fields_to_shift(self, source: str, table: CompiledTable) -> None:
        """Find the field of the clock, and those that carry times by the same clock."""
        place = clock_parts((source,), table.schema)
        rows = table
        if place is not None:
            self._parts = ".".join(filter(None, place))
            source = source.removeprefix(f"{self._parts}.")
            rows, _ = table.parts(*place)
        ((_, step, _, _),) = clock_terms((source,), rows.schema, self._sensor.id)
        path = without_indices(source)[0]
        fields = rows.schema.fields
        form = _describe_form(fields[path])
        same = [other for other, info in fields.items() if _describe_form(info) == form]
        self._fields = [_TimeField(other, _to_step(step)) for other in same]

    def _find_function_fields(self, table: CompiledTable) -> None:
        """Find the fields that the function of the clock depends on.

        Args:
            table: one frame, which is changed and restored.
        """
        linear = list[_TimeField]()
        date = dict[str, str]()
        for path, info in table.schema.fields.items():
            if info.axes or info.const is not None or info.kind not in ("int", "float"):
                continue
            steps = self._probe(table, path, info)
            days = {step / DAY_NS for step in steps}
            if days <= set(YEAR_DAYS):
                date["year"] = path
            elif days <= set(MONTH_DAYS):
                date["month"] = path
            elif steps[0] > 0 and abs(steps[1] - steps[0]) <= 1:
                linear.append(_TimeField(path, steps[0]))
        days_field = next((field for field in linear if field.step_ns == DAY_NS), None)
        if len(date) == 2 and days_field is not None:
            linear.remove(days_field)
            paths = (date["year"], date["month"], days_field.path)
            year, month, day = (int(table.raw(path).item()) for path in paths)
            base = np.datetime64(self.read(table).item() // DAY_NS, "D")
            self._date = _DateFields(*paths, base, (year, month, day))
        elif date:
            raise self._refuse("the fields of its date were not all found")
        self._set_fields(linear)

    def _set_fields(self, fields: list[_TimeField]) -> None:
        if not fields:
            raise self._refuse("no field outside of arrays determines it")
        self._fields = sorted(fields, key=lambda field: -field.step_ns)

    def _probe(self, table: CompiledTable, path: str, info: FieldInfo) -> tuple[int, int]:
        """Return the steps of the reading, ns, if a field is raised by one and once more."""
        before = table.raw(path)
        start = 0  # a float with a date is too coarse for a step
        if info.kind == "int":
            start = max(min(before.item(), info.limits[1] - 2), 0)
        readings = list[int]()
        for step in range(3):
            write_raw(table, path, np.array([start + step]))
            readings.append(self.read(table).item())
        write_raw(table, path, before)
        return readings[1] - readings[0], readings[2] - readings[1]

    def _check(self, table: CompiledTable) -> None:
        """Raise UsageError unless a reading that is written can be read back."""
        wanted = self.read(table) + TEST_SHIFT_NS
        if self.period_ns:
            wanted = wanted % self.period_ns
        self.write(table, wanted)
        if abs(self.read(table) - wanted).item() > max(self.resolution_ns, 1000):
            raise self._refuse("its function cannot be inverted")

    def _refuse(self, reason: str) -> UsageError:
        return UsageError(f"the clock of {self._sensor.id} cannot be written: {reason}")


class FrameClock:
    """The clock of one frame type, to which a timeline can be applied.

    Args:
        sensor: the sensor.
        frame: the frame type.
        table: frames of this type from number 0 on.

    Attributes:
        has_clock: whether the frames have a clock that can be written.

    Raises:
        UsageError: if the clock of a data frame cannot be written.
    """

    def __init__(self, sensor: Sensor, frame: str, table: CompiledTable) -> None:
        self._sensor = sensor
        self._frame = frame
        self._first = _copy_first(table)
        clock = _find_written_clock(sensor, frame)
        self._writer: ClockWriter | None = None
        if clock is not None:
            try:
                self._writer = ClockWriter(sensor, clock, table)
            except UsageError:
                if sensor.frames[frame].data:
                    raise
        self.has_clock = self._writer is not None
        if self._writer is not None:
            self._first_reading = self._writer.read(self._first).item()

    @cached_property
    def _status(self) -> StatusWriter | None:
        """The writer of the status; None if these frames do not have it.

        Raises:
            UsageError: if the status cannot be written.
        """
        clock = self._sensor.clock
        if clock is None or clock.status is None:
            return None
        frames = [clock.status.frame] if clock.status.frame else self._sensor.data_frames
        if self._frame not in frames:
            return None
        read = self._writer.read if self._writer is not None else None
        return StatusWriter(self._sensor, self._first, read)

    def check(self, faults: ClockFaults) -> None:
        """Raise UsageError unless these frames can show the faults, except those of the status."""
        if self._writer is None:
            raise UsageError(
                f"{self._sensor.id} has no clock in {self._frame!r} frames, so that the clock"
                " cannot have faults"
            )
        if faults.follows and not self._writer.can_follow_dates:
            raise UsageError(
                f"the clock of {self._sensor.id} cannot follow {faults.follows.upper()}: it wraps"
                f" at {self._writer.period_ns / 1e9:g} s, which is no share of a day"
            )

    def check_status(self) -> None:
        """Raise UsageError unless these frames can show that the clock is not locked."""
        if self._status is None:
            raise UsageError(
                f"{self._sensor.id} does not declare the status of its clock in {self._frame!r}"
                " frames, so that the clock cannot lose its lock"
            )

    def apply(self, table: CompiledTable, timeline: ClockTimeline, times: Times) -> None:
        """Write the faults of a timeline into frames.

        Args:
            times: the times of the frames since power-on, (n,) ns.
        """
        if timeline.is_perfect:
            return
        if self._writer is not None:
            readings = timeline.shift(self._writer.read(table), times, self._first_reading)
            self._writer.write(table, readings)
        if timeline.faults.sets_status:
            try:
                status = self._status
            except UsageError:  # only faults of the lock require it, and they were checked
                status = None
            if status is not None:
                status.write(table, timeline.lock_states(times), timeline.faults.follows)


def _find_written_clock(sensor: Sensor, frame: str) -> Clock | None:
    """Return the clock of frames, also of those that complete the clock of the data frames."""
    clock = find_clock(sensor, frame)
    shared = sensor.clock
    if clock is not None or shared is None:
        return clock
    fields = get_codec(sensor.frames[frame]).schema.fields
    paths = clock_fields(shared)
    completes = shared.reference is not None and shared.reference[0] == frame
    if completes and paths and all(path in fields for path in paths):
        return shared
    return None


class StatusWriter:
    """Writes into frames whether the clock is locked.

    Args:
        sensor: the sensor, whose clock declares a status.
        table: frames of the type that has the status.
        read: reads the clock of these frames, (n,) ns; None if they have no clock. A status that
            changes the reading is not used: the fields of the clock then have another form.

    Raises:
        UsageError: if no values of the fields give a locked and an unlocked status.
    """

    def __init__(
        self,
        sensor: Sensor,
        table: CompiledTable,
        read: Callable[[CompiledTable], Times] | None = None,
    ) -> None:
        assert sensor.clock is not None
        assert sensor.clock.status is not None
        self._sensor = sensor
        self._clock = sensor.clock
        self._status = sensor.clock.status
        self._paths: list[str] = []
        self._choices: list[_StatusChoice] = []
        if callable(self._status.source):
            self._find_choices(_copy_first(table))
        else:
            self._paths = [without_indices(self._status.source)[0]]
            info = table.schema.fields[self._paths[0]]
            for value, state in self._status.states.items():
                self._choices.append(_StatusChoice((int(info.raw(value)),), state))
        if read is not None:
            self._choices = [one for one in self._choices if self._keeps_clock(table, one, read)]
        known = {choice.state.locked for choice in self._choices}
        if not known >= {True, False}:
            raise UsageError(
                f"{sensor.id} cannot lose its lock: its status does not distinguish a locked clock"
            )

    def write(self, table: CompiledTable, states: NDArray[np.int64], follows: str) -> None:
        """Write the status of frames.

        Args:
            states: LOCKED, LOST or RESTARTED for each frame, (n,).
            follows: the time scale that the clock follows, if several states are locked.
        """
        raw = np.array(self.choose(follows))[states]
        for path, column in zip(self._paths, raw.T, strict=True):
            axes = table.raw(path).shape[1:]
            shaped = column.reshape(-1, *(1,) * len(axes))
            write_raw(table, path, np.broadcast_to(shaped, (len(states), *axes)))

    def choose(self, follows: str) -> tuple[tuple[int, ...], ...]:
        """Return the raw values of the fields for a locked, a lost and a restarted clock.

        A lost clock counts the same as the locked one, if there is such a status; a restarted clock
        counts from power-on.
        """

        def rank(choice: _StatusChoice, epoch: str, raw: tuple[int, ...]) -> tuple[Any, ...]:
            changes = [a != b for a, b in zip(choice.raw, raw, strict=True)]
            differs = self._clock.epoch_in(choice.state) != epoch
            return differs, sum(changes), sum(choice.raw), changes  # a mode comes before its status

        locked = min(
            (one for one in self._choices if one.state.locked),
            key=lambda one: (self._clock.epoch_in(one.state) != follows, sum(one.raw)),
        )
        unlocked = [one for one in self._choices if one.state.locked is False]
        epoch = self._clock.epoch_in(locked.state)
        lost = min(unlocked, key=lambda one: rank(one, epoch, locked.raw))
        restarted = min(unlocked, key=lambda one: rank(one, "boot", locked.raw))
        return locked.raw, lost.raw, restarted.raw

    def _keeps_clock(
        self, table: CompiledTable, choice: _StatusChoice, read: Callable[[CompiledTable], Times]
    ) -> bool:
        """Return whether the clock of a frame reads the same with a status."""
        frame = _copy_first(table)
        reading = read(frame).item()
        for path, raw in zip(self._paths, choice.raw, strict=True):
            write_raw(frame, path, np.array(raw))
        return bool(read(frame).item() == reading)

    def _find_choices(self, table: CompiledTable) -> None:
        """Find the fields of a calculated status, and the values that have a meaning."""
        for path, info in table.schema.fields.items():
            if info.kind != "int" or info.axes or info.const is not None:
                continue
            raw = np.arange(min(1 << info.bits, MAX_STATUS_VALUES))
            status = self._calculate(table, [path], [raw])
            if len(np.unique(status)) > 1:
                self._paths.append(path)
        if not self._paths or len(self._paths) > MAX_STATUS_FIELDS:
            return
        sizes = [1 << table.schema.fields[path].bits for path in self._paths]
        ranges = [np.arange(min(size, MAX_STATUS_VALUES)) for size in sizes]
        raws = [grid.reshape(-1) for grid in np.meshgrid(*ranges, indexing="ij")]
        status = self._calculate(table, self._paths, raws)
        for value, raw in zip(status.tolist(), np.stack(raws, axis=1).tolist(), strict=True):
            if value in self._status.states:
                self._choices.append(_StatusChoice(tuple(raw), self._status.states[value]))

    def _calculate(
        self, table: CompiledTable, paths: Sequence[str], raws: Sequence[NDArray[np.int64]]
    ) -> NDArray[np.float64]:
        """Return the status for raw values of some fields of a frame, (n,)."""
        source = self._status.source
        assert callable(source)
        frames = _repeat_first(table, len(raws[0]))
        for path, raw in zip(paths, raws, strict=True):
            write_raw(frames, path, raw)
        with (
            np.errstate(all="ignore"),
            plugin_errors("clock.status", self._sensor.id, source),
        ):
            return np.asarray(frame_status(self._status, frames))


def _shift_raw(
    info: FieldInfo, raw: NDArray[Any], shifts: Times, step_ns: float, period_ns: int
) -> NDArray[Any]:
    """Return raw values of a clock, shifted by nanoseconds and wrapped."""
    if info.kind == "int" and isinstance(step_ns, int):
        # exact, also for a shift of years
        whole: NDArray[Any] = raw.astype(np.int64) + shifts // step_ns
        return whole % (period_ns // step_ns) if period_ns else whole
    shifted: NDArray[Any] = raw + shifts / step_ns
    if info.kind == "int":
        shifted = np.rint(shifted)
    return shifted % (period_ns / step_ns) if period_ns else shifted


def _describe_form(info: FieldInfo) -> tuple[str, float, float, int, str]:
    """Return the properties that two fields with times by one clock share."""
    return info.unit, info.scale, info.offset, info.bits, info.kind


def _to_step(step: Any) -> float:
    """Return a step in ns as an int if it is whole."""
    if step == int(step):
        return int(step)
    return float(step)


def _clip(info: FieldInfo, raw: NDArray[Any]) -> NDArray[Any]:
    """Return the values that a field can hold."""
    if info.kind != "int":
        return raw
    low, high = info.limits
    clipped: NDArray[Any] = np.clip(raw, low, min(high, MAX_RAW))
    return clipped


def _split_date(days: NDArray[np.datetime64]) -> tuple[NDArray[np.int64], ...]:
    """Return the years, months and days of dates, (n,) each."""
    months = days.astype("datetime64[M]")
    years = days.astype("datetime64[Y]")
    return (
        years.astype(np.int64) + 1970,
        months.astype(np.int64) % 12 + 1,
        (days - months).astype(np.int64) + 1,
    )


def _copy_first(table: CompiledTable) -> CompiledTable:
    """Return a copy of the first frame."""
    return _repeat_first(table, 1)


def _repeat_first(table: CompiledTable, count: int) -> CompiledTable:
    """Return copies of the first frame."""
    (group,) = table.take(np.zeros(1, np.intp)).groups
    rows = np.repeat(group.rows, count, axis=0)
    return CompiledTable(table.schema, [LayoutRows(group.layout, np.arange(count), rows)])
