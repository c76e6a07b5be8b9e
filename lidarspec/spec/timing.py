"""Declarations about the clock, the packet counter and the scans of a sensor."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from lidarspec.errors import SpecError

HOUR_S = 3600
DAY_S = 86_400
#: Clock readings before this time, the start of 2001, are not dates, ns since 1970. Clocks that
#: count from power-up, or from a date that was never set, have earlier readings.
FIRST_DATE_NS = 10**18
#: The number of days from 0000-03-01 to 1970-01-01, plus 1 because the days of a month are counted
#: from 1.
_EPOCH_DAYS = 719_469
#: Times in 64-bit nanoseconds are limited to 292 years.
MAX_CLOCK_S = 2**63 / 1e9
#: A field path, several paths of fields to add, or a function of `Fields` that returns one column
#: or several columns to add.
Source = str | tuple[str, ...] | Callable[[Any], Any]
#: The epochs of clocks with a date. They count from 1970 and differ by leap seconds only: in 2017
#: to 2026, TAI is 37 s and GPS time 18 s ahead of UTC.
DATED_EPOCHS = ("utc", "tai", "gps")
#: The epochs from which a clock can count, by the name in `Clock.epoch`.
EPOCHS = MappingProxyType(
    {
        "": "not declared",
        "boot": "time since power-up",
        "utc": "UTC since 1970",
        "tai": "TAI since 1970, as PTP grandmasters distribute it",
        "gps": "GPS time, in seconds since 1970",
        "hour": "UTC since the last full hour",
    }
)


@dataclass(frozen=True)
class OnWrap:
    """End a scan when an angle passes `at`.

    Args:
        name: the path of an angle field, or the name of a point column. With a field in an array,
            such as "blocks.azimuth", scans are cut between the elements of the array. With a
            column, such as "azimuth", they are cut between points.
        at: the angle, in the unit of the field; radians for a point column.
    """

    name: str
    at: float = 0.0


@dataclass(frozen=True)
class OnFlag:
    """End a scan before every packet in which a flag is set.

    Args:
        name: the path of the flag's field. If the field is in an array, scans end before every
            element of the array in which the flag is set.
        value: the value of a set flag; by default every value except 0.
    """

    name: str
    value: float | None = None


@dataclass(frozen=True)
class OnChange:
    """End a scan before every packet in which the value of a field has changed.

    Args:
        name: the path of the field. If the field is in an array, scans end before every element of
            the array with a changed value.
        angle: the path of the field with the angle at which a packet begins; "" if the frame has no
            such field. The angle has to increase evenly as the sensor rotates. The angle is used to
            recognize a sector in which the sensor sends nothing, and to move the start of a scan
            with `configure(cut=)`.
        full: the increase of the angle in one revolution, in the unit of the field.
    """

    name: str
    angle: str = ""
    full: float = 360.0


@dataclass(frozen=True)
class OnJump:
    """End a scan before every packet in which a field makes a large step.

    Args:
        name: the path of the field. If the field is in an array, scans end before every element of
            the array with a large step. Steps of an angle are measured in the shorter direction
            around the circle.
        by: the smallest step, in either direction, that ends a scan, in the unit of the field.
    """

    name: str
    by: float


@dataclass(frozen=True)
class OnRewind:
    """End a scan before every packet in which the field `name` decreases."""

    name: str


@dataclass(frozen=True)
class Every:
    """End a scan after a number of seconds, by the times of packets."""

    seconds: float


Split = OnWrap | OnFlag | OnChange | OnJump | OnRewind | Every


@dataclass(frozen=True)
class ClockState:
    """The meaning of one value of a clock's status.

    Args:
        meaning: a short description, for example "locked to PTP".
        locked: whether the clock follows its source of time; None if the manual does not specify
            it.
        epoch: the epoch from which the clock counts in this state, a key of `EPOCHS`; None for the
            epoch of the clock.

    Raises:
        SpecError: for an unknown epoch.
    """

    meaning: str
    locked: bool | None = None
    epoch: str | None = None

    def __post_init__(self) -> None:
        if self.epoch is not None:
            _check_epoch(self.epoch, "clock.status.states")


@dataclass(frozen=True)
class ClockStatus:
    """The field in which a sensor sends the state of its clock.

    Args:
        source: the path of the field, or a function of `Fields` that returns an integer for each
            frame, or nan if it is unknown.
        states: the meaning of each value.
        frame: the incoming frame type that has the field; "" for the frames with the clock.

    Raises:
        SpecError: if `states` is empty.
    """

    source: str | Callable[[Any], Any]
    states: Mapping[int, ClockState]
    frame: str = ""

    def __post_init__(self) -> None:
        if not self.states:
            raise SpecError(
                "expected the meaning of at least one value, for example"
                " {1: ClockState('locked to PTP', True)}",
                path="clock.status.states",
            )
        object.__setattr__(self, "states", MappingProxyType(dict(self.states)))

    def state_of(self, value: float) -> ClockState:
        """Return the state for a value; `locked` is None if the value is not declared."""
        if value in self.states:
            return self.states[int(value)]
        return ClockState("unknown" if value != value else f"unknown value {value:g}")


@dataclass(frozen=True)
class Clock:
    """The sensor's own clock.

    Args:
        source: the path of a field, the paths of several fields that are added (such as seconds and
            microseconds), or a function of `Fields` that returns one column or several columns that
            are added, in seconds. Terms are added as integer nanoseconds. `unix_time` converts the
            fields of a date.
        wraps_at: the seconds after which the clock starts again at 0; None if it does not.
        pace: a function of `Fields` that returns the seconds that normally pass between the packet
            before and this packet, or nan if they are unknown; None if not declared. The pace must
            be correct in every mode of the sensor, because it is used to find lost packets and to
            distinguish related models.
        reference: the source of the date, for a clock that starts again at 0. It is a pair: the
            name of another frame type that has the same clock, and a function of its `Fields` that
            returns the date in seconds since 1970, or nan if it is unknown. The first frame with a
            date is used: in a file for all packets, and in live data for the packets after this
            frame.
        epoch: the epoch from which the clock counts, a key of `EPOCHS`: "boot", "utc", "tai", "gps"
            or "hour"; "" if the manual does not specify it. If `status` is given, it is the epoch
            of a locked clock. The option `epoch` of every sensor overrides it.
        status: the field that shows whether the clock is locked; None if the sensor does not send
            it.

    Raises:
        SpecError: if `wraps_at` is not positive or longer than 292 years, if `pace` is not a
            function, or if the epoch is unknown.
    """

    source: Source
    wraps_at: float | None = None
    pace: Callable[[Any], Any] | None = None
    reference: tuple[str, Callable[[Any], Any]] | None = None
    epoch: str = ""
    status: ClockStatus | None = None

    def __post_init__(self) -> None:
        _check_epoch(self.epoch, "clock.epoch")
        if self.epoch == "hour" and self.wraps_at != HOUR_S:
            raise SpecError(
                f"a clock that counts from the full hour must wrap at {HOUR_S} s",
                path="clock.wraps_at",
            )
        if self.pace is not None and not callable(self.pace):
            raise SpecError(
                "the pace must be a function of Fields that returns seconds, such as lambda f:"
                f" {self.pace!r}, not {self.pace!r}",
                path="clock.pace",
            )
        if self.wraps_at is None:
            return
        if not self.wraps_at > 0:
            raise SpecError(
                f"expected a positive number of seconds, got {self.wraps_at}", path="clock.wraps_at"
            )
        if self.wraps_at >= MAX_CLOCK_S:
            raise SpecError(
                f"{self.wraps_at:.4g} s is longer than 292 years: leave wraps_at out, as this clock"
                " never wraps",
                path="clock.wraps_at",
            )

    def epoch_in(self, state: ClockState | None) -> str:
        """Return the epoch from which the clock counts in a state, a key of `EPOCHS`.

        Args:
            state: the state of the clock; None if the state is unknown.
        """
        if state is not None and state.epoch is not None:
            return state.epoch
        return self.epoch

    def epoch_at(self, time_ns: int, state: ClockState | None) -> str:
        """Return the epoch of a time that was read from the clock, a key of `EPOCHS`.

        The result is that of `epoch_in`, with one exception: for a clock that counts from the full
        hour, the result is "utc" if the date of another frame was added to the time.

        Args:
            time_ns: the time of the clock, in ns.
            state: the state of the clock; None if the state is unknown.
        """
        epoch = self.epoch_in(state)
        if epoch == "hour" and time_ns >= FIRST_DATE_NS:
            return "utc"
        return epoch


def _check_epoch(epoch: str, path: str) -> None:
    if epoch not in EPOCHS:
        raise SpecError(
            f"unknown epoch {epoch!r}: expected one of {', '.join(filter(None, EPOCHS))}", path=path
        )


@dataclass(frozen=True)
class PacketCounter:
    """A counter of packets. Jumps of the counter show lost packets.

    If a clock with a declared pace shows no gap, a jump is not counted as a loss.

    Args:
        field: the path of the counter.
        first: the lowest value of the counter.
        last: the highest value of the counter, or a function of `Fields` that returns it; by
            default the largest value of the field.
        returns: the number of consecutive packets that contain the returns of the same firings, one
            return in each packet; a number or a function of `Fields`. The counter of the first
            packet of such a group is `first` plus a multiple of `returns`.
    """

    field: str
    first: int = 0
    last: int | Callable[[Any], Any] | None = None
    returns: int | Callable[[Any], Any] = 1


def unix_time(
    year: Any, month: Any, day: Any, hour: Any = 0, minute: Any = 0, second: Any = 0
) -> Any:
    """Return the seconds from 1970-01-01 to a date of the Gregorian calendar, in UTC.

    The function is used in the `source` of a `Clock`. Its arguments are numbers, arrays or columns.
    A source with nanoseconds adds them as a separate term, so that they stay exact.

    Args:
        year: with its century, for example 2026.
        month: 1 to 12.
        day: 1 to 31.
        hour, minute, second: the time of day. A value beyond its usual range, such as a second of
            86400, is allowed.

    Returns:
        float64 values of the shape to which the arguments broadcast. Whole seconds are exact.
    """
    # years begin in March, so that the leap day is the last day of a year
    is_before_march = month <= 2
    years = np.where(is_before_march, year - 1, year)
    months = np.where(is_before_march, month + 9, month - 3)
    leap_days = np.floor(years / 4) - np.floor(years / 100) + np.floor(years / 400)
    days_before_month = np.floor((153 * months + 2) / 5)  # months have 31, 30, 31, 30, 31 days
    days = 365 * years + leap_days + days_before_month + day - _EPOCH_DAYS
    return DAY_S * days + 3600 * hour + 60 * minute + second
