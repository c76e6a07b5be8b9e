"""Write the time and the status of a clock into simulated frames.

A clock is a field, a sum of fields, or a function of fields. The fields of a function are found by
changing each field and comparing the time. A date is written into the fields of the date, and the
time of day into the other fields.

If the clock is a single field, the other fields with the same unit, scale and size are changed by
the same difference, because these fields have times of the same clock.

A clock is not supported if a frame does not give the time that was written into the frame.
"""

from __future__ import annotations

import math
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
from lidarspec.packets.clocks import clock_fields, clock_ns, clock_parts, clock_terms, to_exact_ns
from lidarspec.packets.packet_type import find_clock
from lidarspec.sensor_operations import Sensor
from lidarspec.simulation.clock_faults import ClockFaults, ClockTimeline
from lidarspec.simulation.raw_values import PartRows, write_raw
from lidarspec.spec.timing import DAY_S, FIRST_DATE_NS, Clock, ClockState, ClockStatus
from lidarspec.spec.tree import FieldInfo

Times = NDArray[np.int64]
DAY_NS = DAY_S * 10**9
#: Possible numbers of days in a year.
YEAR_DAYS = (365, 366)
#: Possible numbers of days in a month.
MONTH_DAYS = (28, 29, 30, 31)
#: Maximum raw value to write.
MAX_RAW = 2**63 - 1
#: Maximum number of values of one field that are tried to find the values of a calculated status.
MAX_STATUS_VALUES = 16
#: Maximum number of combinations of the values of several fields that are tried.
MAX_STATUS_COMBINATIONS = 256
#: Time difference that is added to test whether a clock can be written, ns. It is more than a
#: second.
TEST_SHIFT_NS = 1_500_000_000
#: The date at power-on, if the sensor has no source of time but sends year, month and day:
#: 2000-01-01, in ns since 1970. Manuals call this time a virtual UTC.
POWER_ON_DATE_NS = 946_684_800 * 10**9


@dataclass(frozen=True)
class _TimeField:
    """A field of a clock.

    Attributes:
        step_ns: ns per step of the raw value; may be a fraction.
    """

    path: str
    step_ns: float


@dataclass(frozen=True)
class _StatusChoice:
    """A possible status of a clock: the raw values of its fields, and its meaning."""

    raw: tuple[int, ...]
    state: ClockState


@dataclass(frozen=True)
class _DateFields:
    """The paths of the fields of a date.

    Attributes:
        date: an example date.
        raw: raw values of the year, the month and the day of the example date.
    """

    year: str
    month: str
    day: str
    date: np.datetime64
    raw: tuple[int, int, int]


class ClockWriter:
    """Writes readings into the fields of the clock in one frame type.

    Args:
        table: simulated frames; a copy of the first frame is changed to find the fields of the
            clock.

    Attributes:
        resolution_ns: the smallest step of the clock, ns.
        period_ns: the time after which the clock wraps, ns; 0 if it does not wrap.

    Raises:
        UsageError: if the clock cannot be written.
    """

    def __init__(self, sensor: Sensor, clock: Clock, table: CompiledTable) -> None:
        self._sensor = replace(sensor, clock=clock) if clock is not sensor.clock else sensor
        self.period_ns = 0
        if clock.wraps_at is not None:
            self.period_ns = to_exact_ns(clock.wraps_at)
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
        """Whether the clock can follow a time scale such as UTC.

        This is possible if a date determines the reading of the clock.
        """
        return not self.period_ns or DAY_NS % self.period_ns == 0

    def read(self, table: CompiledTable) -> Times:
        """Return the readings of the clock, (n,) ns."""
        return clock_ns(self._sensor, Batch(table, np.zeros(len(table), np.bool_)))

    def find_power_on_reading(self, frame: CompiledTable) -> int:
        """Return the reading with which an unsynchronized clock starts at power-on, ns.

        Args:
            frame: a table of one frame; the fields of its clock are overwritten.
        """
        if self._date is not None:
            return POWER_ON_DATE_NS
        for field in self._fields:
            write_raw(frame, field.path, np.array(0))
        return int(self.read(frame).item())

    def write(self, table: CompiledTable, readings: Times) -> None:
        """Write readings, (n,) ns, into the frames; wrap them if the clock wraps."""
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
        """Round readings to the resolution, if this is a whole number of ns."""
        step = round(self.resolution_ns)
        if step != self.resolution_ns or step < 2:
            return readings
        return (readings + step // 2) // step * step

    def _shift_fields(self, table: CompiledTable, shifts: Times) -> None:
        """Add time differences, (n,) ns, to all elements of the clock's fields."""
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
        """Write the dates of readings, (n,) ns, into the fields of the date."""
        days = np.floor_divide(readings, DAY_NS).astype("datetime64[D]")
        here = _split_date(days)
        base = _split_date(np.array([date.date]))
        paths = (date.year, date.month, date.day)
        for path, raw, value, base_value in zip(paths, date.raw, here, base, strict=True):
            write_raw(table, path, _clip(table.schema.fields[path], raw + value - base_value))

    def _find_fields_to_shift(self, source: str, table: CompiledTable) -> None:
        """Find the field of the clock, and all fields with times of the same clock."""
        place = clock_parts((source,), table.schema)
        rows = table
        if place is not None:
            self._parts = ".".join(filter(None, place))
            source = source.removeprefix(f"{self._parts}.")
            rows, _ = table.parts(*place)
        ((_, step, _, _),) = clock_terms((source,), rows.schema, self._sensor.id)
        path = without_indices(source)[0]
        fields = rows.schema.fields
        form = _get_encoding(fields[path])
        same = [other for other, info in fields.items() if _get_encoding(info) == form]
        self._fields = [_TimeField(other, _to_step(step)) for other in same]

    def _find_function_fields(self, table: CompiledTable) -> None:
        """Find the fields that the function of the clock depends on.

        Args:
            table: a table of one frame, which is changed and restored.
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
            raise self._make_error("some fields of the date were not found")
        self._set_fields(linear)

    def _set_fields(self, fields: list[_TimeField]) -> None:
        if not fields:
            raise self._make_error("no field outside of arrays determines the time")
        self._fields = sorted(fields, key=lambda field: -field.step_ns)

    def _probe(self, table: CompiledTable, path: str, info: FieldInfo) -> tuple[int, int]:
        """Increase a field by 1 twice; return both changes of the reading, ns."""
        before = table.raw(path)
        start = 0  # a float cannot represent a date and a step of one raw value
        if info.kind == "int":
            start = max(min(before.item(), info.limits[1] - 2), 0)
        readings = list[int]()
        for step in range(3):
            write_raw(table, path, np.array([start + step]))
            readings.append(self.read(table).item())
        write_raw(table, path, before)
        return readings[1] - readings[0], readings[2] - readings[1]

    def _check(self, table: CompiledTable) -> None:
        """Raise UsageError if a reading that was written cannot be read back."""
        wanted = self.read(table) + TEST_SHIFT_NS
        if self.period_ns:
            wanted = wanted % self.period_ns
        self.write(table, wanted)
        if abs(self.read(table) - wanted).item() > max(self.resolution_ns, 1000):
            raise self._make_error("the function that reads the clock cannot be inverted")

    def _make_error(self, reason: str) -> UsageError:
        return UsageError(f"the clock of {self._sensor.id} cannot be written: {reason}")


class FrameClock:
    """The clock of one frame type, to which a timeline can be applied.

    Args:
        table: frames of this type; the first has the number 0.

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
            self._power_on_reading = self._writer.read(self._first).item()
            if self._power_on_reading >= FIRST_DATE_NS:
                # The simulated sensor begins at a date as if it were set. A restart loses it.
                first = _copy_first(self._first)
                self._power_on_reading = self._writer.find_power_on_reading(first)

    @property
    def can_follow_dates(self) -> bool:
        """Whether the clock can follow a time scale, such as UTC."""
        return self._writer is not None and self._writer.can_follow_dates

    def read_state(self, status: ClockStatus) -> ClockState:
        """Return the state of the clock at power-on, which the first frame contains."""
        return status.state_of(frame_status(status, self._first)[0])

    @cached_property
    def _status(self) -> StatusWriter | None:
        """The writer of the status; None if these frames do not contain the status.

        Raises:
            UsageError: if the status cannot be written.
        """
        clock = find_status_clocks(self._sensor).get(self._frame)
        if clock is None:
            return None
        read = self._writer.read if self._writer is not None else None
        return StatusWriter(replace(self._sensor, clock=clock), self._first, read)

    def check(self, faults: ClockFaults) -> None:
        """Raise UsageError if faults of the clock cannot be written into the frames."""
        if self._writer is None:
            raise UsageError(
                f"{self._sensor.id} has no clock in {self._frame!r} frames, so clock faults"
                " cannot be simulated"
            )
        if faults.follows and not self._writer.can_follow_dates:
            raise UsageError(
                f"the clock of {self._sensor.id} cannot follow {faults.follows.upper()}: it wraps"
                f" at {self._writer.period_ns / 1e9:g} s, and a day is not a multiple of this"
                " time, so a date does not determine the reading of the clock"
            )

    def check_status(self) -> None:
        """Raise UsageError if the status in these frames cannot report a lost lock."""
        status = self._status  # raises UsageError
        assert status is not None, self._frame

    def apply(self, table: CompiledTable, timeline: ClockTimeline, times: Times) -> None:
        """Apply the faults of a timeline to the clock of frames.

        Args:
            times: the time of each frame since power-on, (n,) ns.
        """
        if timeline.is_perfect:
            return
        if self._writer is not None:
            readings = timeline.apply_faults(
                self._writer.read(table), times, self._power_on_reading
            )
            self._writer.write(table, readings)
            if timeline.faults.follows:
                self._write_dates(table, readings)
        if timeline.faults.sets_status:
            try:
                status = self._status
            except UsageError:
                status = None  # `check_status` has checked the faults that require the status
            if status is not None:
                status.write(table, timeline.lock_states(times), timeline.faults.follows)

    def _write_dates(self, table: CompiledTable, readings: Times) -> None:
        """Write dates into fields that do not belong to the clock.

        Args:
            readings: the dates, (n,) ns since 1970.
        """
        date = self._sensor.frames[self._frame].simulation.date
        if date is None:
            return
        dated = np.flatnonzero(readings >= FIRST_DATE_NS)
        with plugin_errors(f"date of {self._frame}", self._sensor.id, date):
            values = {row: date(readings.item(row) / 1e9) for row in dated.tolist()}
        for group in table.groups:
            rows = [row for row in range(len(group.where)) if group.where[row] in values]
            own = [values[group.where.item(row)] for row in rows]
            part = group.rows[rows]
            for path in own[0] if own else ():
                leaf = group.layout.leaves[path]
                leaf.store(part, leaf.raw([one[path] for one in own]))
            group.rows[rows] = part


def _find_written_clock(sensor: Sensor, frame: str) -> Clock | None:
    """Return the clock to write into frames of a type; None if they have no clock."""
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


def find_status_clocks(sensor: Sensor) -> dict[str, Clock]:
    """Return {frame type: clock} for the frame types that contain a clock status."""
    clocks = dict[str, Clock]()
    for name in sensor.main_frames:
        clock = find_clock(sensor, name)
        if clock is None or clock.status is None:
            continue
        frame = clock.status.frame or name
        source = clock.status.source
        if callable(source) or source in get_codec(sensor.frames[frame]).schema.columns:
            clocks.setdefault(frame, clock)
    return clocks


class StatusWriter:
    """Writes into frames whether the clock is locked.

    Args:
        sensor: the sensor; its clock declares a status.
        table: frames of the type that has the status.
        read: returns the readings of the clock in frames, (n,) ns; None if they have no clock.

    Raises:
        UsageError: if the fields have no value for a locked clock, or none for an unlocked clock.
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
            self._choices = [
                choice for choice in self._choices if self._keeps_clock(table, choice, read)
            ]
        locked_states = {choice.state.locked for choice in self._choices}
        if not locked_states >= {True, False}:
            raise UsageError(
                f"the clock of {sensor.id} cannot lose its lock: its status must have values for"
                " both a locked clock and an unlocked clock"
            )

    def write(self, table: CompiledTable, states: NDArray[np.int64], follows: str) -> None:
        """Write the status of the clock into frames.

        Args:
            states: LOCKED, LOST or RESTARTED for each frame, (n,).
            follows: the time scale that the clock follows.
        """
        raw = np.array(self.choose(follows))[states]
        for path, column in zip(self._paths, raw.T, strict=True):
            axes = table.raw(path).shape[1:]
            shaped = column.reshape(-1, *(1,) * len(axes))
            write_raw(table, path, np.broadcast_to(shaped, (len(states), *axes)))

    def choose(self, follows: str) -> tuple[tuple[int, ...], ...]:
        """Return the raw values of the status fields: locked, lost and restarted."""

        def rank(choice: _StatusChoice, epoch: str, raw: tuple[int, ...]) -> tuple[Any, ...]:
            # The field with the mode comes before the field with its status, which is changed
            # rather than the mode.
            changes = [a != b for a, b in zip(choice.raw, raw, strict=True)]
            differs = self._clock.epoch_in(choice.state) != epoch
            return differs, sum(changes), sum(choice.raw), changes

        locked = min(
            (choice for choice in self._choices if choice.state.locked),
            key=lambda choice: (self._clock.epoch_in(choice.state) != follows, sum(choice.raw)),
        )
        unlocked = [choice for choice in self._choices if choice.state.locked is False]
        epoch = self._clock.epoch_in(locked.state)
        lost = min(unlocked, key=lambda choice: rank(choice, epoch, locked.raw))
        restarted = min(unlocked, key=lambda choice: rank(choice, "boot", locked.raw))
        return locked.raw, lost.raw, restarted.raw

    def _keeps_clock(
        self, table: CompiledTable, choice: _StatusChoice, read: Callable[[CompiledTable], Times]
    ) -> bool:
        """Return whether a status leaves the reading of the clock unchanged."""
        frame = _copy_first(table)
        reading = read(frame).item()
        for path, raw in zip(self._paths, choice.raw, strict=True):
            write_raw(frame, path, np.array(raw))
        return bool(read(frame).item() == reading)

    def _find_choices(self, table: CompiledTable) -> None:
        """Find the fields that the status is calculated from, and their valid values."""
        for path, info in table.schema.fields.items():
            if info.kind != "int" or info.axes or info.const is not None:
                continue
            raw = np.arange(min(1 << info.bits, MAX_STATUS_VALUES))
            status = self._calculate(table, [path], [raw])
            if len(np.unique(status)) > 1:
                self._paths.append(path)
        sizes = [
            min(1 << table.schema.fields[path].bits, MAX_STATUS_VALUES) for path in self._paths
        ]
        if not self._paths or math.prod(sizes) > MAX_STATUS_COMBINATIONS:
            return
        ranges = [np.arange(size) for size in sizes]
        raws = [grid.reshape(-1) for grid in np.meshgrid(*ranges, indexing="ij")]
        status = self._calculate(table, self._paths, raws)
        for value, raw in zip(status.tolist(), np.stack(raws, axis=1).tolist(), strict=True):
            if value in self._status.states:
                self._choices.append(_StatusChoice(tuple(raw), self._status.states[value]))

    def _calculate(
        self, table: CompiledTable, paths: Sequence[str], raws: Sequence[NDArray[np.int64]]
    ) -> NDArray[np.float64]:
        """Return the status for n combinations of field values, (n,).

        Args:
            table: a table; its first frame has the values of all other fields.
            paths: paths of the fields.
            raws: the raw values of each field, (n,) each.
        """
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
    """Return raw values of a clock, shifted by time differences and wrapped."""
    if info.kind == "int" and isinstance(step_ns, int):
        # exact, also for a shift of years
        whole: NDArray[Any] = raw.astype(np.int64) + shifts // step_ns
        return whole % (period_ns // step_ns) if period_ns else whole
    shifted: NDArray[Any] = raw + shifts / step_ns
    if info.kind == "int":
        shifted = np.rint(shifted)
    return shifted % (period_ns / step_ns) if period_ns else shifted


def _get_encoding(info: FieldInfo) -> tuple[str, float, float, int, str]:
    """Return (unit, scale, offset, bits, kind) of a field.

    Two fields with the same tuple are assumed to contain times of the same clock.
    """
    return info.unit, info.scale, info.offset, info.bits, info.kind


def _to_step(step: Any) -> float:
    """Return a step in ns as an int if it is whole, else as a float."""
    if step == int(step):
        return int(step)
    return float(step)


def _clip(info: FieldInfo, raw: NDArray[Any]) -> NDArray[Any]:
    """Return raw values, limited to the range of the field."""
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
    """Return a table with a copy of the first frame."""
    return _repeat_first(table, 1)


def _repeat_first(table: CompiledTable, count: int) -> CompiledTable:
    """Return a table with `count` copies of the first frame."""
    (group,) = table.take(np.zeros(1, np.intp)).groups
    rows = np.repeat(group.rows, count, axis=0)
    return CompiledTable(table.schema, [LayoutRows(group.layout, np.arange(count), rows)])
