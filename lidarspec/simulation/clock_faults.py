"""Faults of a simulated sensor's clock.

`ClockFaults` describes the faults; a user can give them as text, ``drift=50ppm,step=0.2s@10s``. A
`ClockTimeline` applies the faults to the readings of a clock. These texts are supported:

| text | fault |
|---|---|
| `utc`, `tai`, `gps` | the clock follows the time of the computer in this time scale |
| `drift=50ppm` | the clock is fast by 50 millionths of the time since power-on |
| `step=0.2s@10s` | the clock jumps forward by 0.2 s, 10 s after power-on; if negative, back |
| `pps@10s` | the clock counts a pulse twice, and is one second ahead afterwards |
| `leap@10s` | the clock repeats a second, as UTC does in a leap second |
| `unlock=5s@10s` | the status is "not locked" for 5 s, or for ever if no duration is given |
| `restart@10s` | the clock starts again as after power-on, without a date and not locked |
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import UsageError, did_you_mean
from lidarspec.leap_seconds import read_leap_seconds
from lidarspec.spec.fields import parse_duration
from lidarspec.spec.timing import DATED_EPOCHS

Times = NDArray[np.int64]
SECOND_NS = 1_000_000_000
#: States of a clock: it is locked to its source, it has lost its source and continues, or it has
#: restarted.
LOCKED = 0
LOST = 1
RESTARTED = 2
#: Maximum drift, 2 %. The drift of every real clock is smaller.
MAX_DRIFT_PPM = 20_000.0


@dataclass(frozen=True)
class ClockFaults:
    """The faults of a clock; all times are seconds since power-on.

    Args:
        follows: "utc", "tai" or "gps" to set the clock to the time of the computer in this time
            scale; "" to use the times that the simulated sensor declares.
        drift_ppm: how much too fast the clock runs, in millionths; negative if it runs too slow.
        steps: (time, size) of each jump forward, in seconds; negative sizes are jumps back.
        unlocked: (start, end) of each time range in which the clock is not locked.
        restarts: the times at which the clock starts again as after power-on.

    Raises:
        UsageError: for an unknown time scale, or a drift of more than 2 %.
    """

    follows: str = ""
    drift_ppm: float = 0.0
    steps: tuple[tuple[float, float], ...] = ()
    unlocked: tuple[tuple[float, float], ...] = ()
    restarts: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.follows not in ("", *DATED_EPOCHS):
            raise UsageError(
                f"a clock cannot count {self.follows!r}: expected one of {', '.join(DATED_EPOCHS)}"
            )
        if not abs(self.drift_ppm) <= MAX_DRIFT_PPM:
            raise UsageError(f"drift must be at most {MAX_DRIFT_PPM:g} ppm, not {self.drift_ppm:g}")

    def __bool__(self) -> bool:
        return self != ClockFaults()

    @property
    def sets_status(self) -> bool:
        """Whether these faults change the status of the clock that the sensor reports."""
        return bool(self.follows or self.unlocked or self.restarts)


def parse_clock_faults(text: str) -> ClockFaults:
    """Return the faults in a text, for example "utc,drift=50ppm,step=0.2s@10s".

    Raises:
        UsageError: for an unknown fault, or a value that cannot be parsed.
    """
    faults = ClockFaults()
    for part in text.split(","):
        fault, mark, when = part.strip().partition("@")
        name, _, value = fault.partition("=")
        start_s = parse_duration(when) if mark else 0.0
        if name in DATED_EPOCHS and part.strip() == name:
            faults = replace(faults, follows=name)
        elif name in _READERS:
            faults = _READERS[name](faults, value, start_s)
        else:
            names = (*DATED_EPOCHS, *_READERS)
            raise UsageError(
                f"invalid clock fault {part.strip()!r}: expected one of"
                f" {', '.join(names)}{did_you_mean(name, names)}"
            )
    return faults


def _add_drift(faults: ClockFaults, value: str, start_s: float) -> ClockFaults:
    try:
        drift_ppm = float(value.removesuffix("ppm"))
    except ValueError:
        drift_ppm = math.nan
    if not math.isfinite(drift_ppm) or start_s:
        raise UsageError(
            f"invalid drift {value!r}: expected parts per million without a time, such as 50ppm"
        )
    return replace(faults, drift_ppm=drift_ppm)


def _add_step(faults: ClockFaults, value: str, start_s: float) -> ClockFaults:
    size = parse_duration(value.lstrip("+-"))
    if value.startswith("-"):
        size = -size
    return replace(faults, steps=(*faults.steps, (start_s, size)))


def _add_double_pulse(faults: ClockFaults, value: str, start_s: float) -> ClockFaults:
    return _add_step(faults, value or "1s", start_s)


def _add_leap_second(faults: ClockFaults, value: str, start_s: float) -> ClockFaults:
    return _add_step(faults, value or "-1s", start_s)


def _add_unlocked_time(faults: ClockFaults, value: str, start_s: float) -> ClockFaults:
    end_s = start_s + parse_duration(value) if value else math.inf
    return replace(faults, unlocked=(*faults.unlocked, (start_s, end_s)))


def _add_restart(faults: ClockFaults, value: str, start_s: float) -> ClockFaults:
    if value:
        raise UsageError(f"invalid restart={value}: expected only a time, as in restart@10s")
    return replace(faults, restarts=(*faults.restarts, start_s))


_READERS: dict[str, Callable[[ClockFaults, str, float], ClockFaults]] = {
    "drift": _add_drift,
    "step": _add_step,
    "pps": _add_double_pulse,
    "leap": _add_leap_second,
    "unlock": _add_unlocked_time,
    "restart": _add_restart,
}


class ClockTimeline:
    """The readings of a faulty clock since power-on.

    Args:
        power_on_ns: the time of the computer when the sensor was switched on, ns since 1970 in UTC.

    Attributes:
        jump_ns: the sum of the jumps that `jump_clock` of the device has caused, ns.
    """

    def __init__(self, faults: ClockFaults, power_on_ns: int = 0) -> None:
        self.faults = faults
        self.jump_ns = 0
        self._power_on_ns = power_on_ns

    @property
    def is_perfect(self) -> bool:
        """Whether the clock has no faults and has not jumped."""
        return not self.faults and not self.jump_ns

    def delay_power_on(self, delay_ns: int) -> None:
        """Move the time of power-on to a later time."""
        self._power_on_ns += delay_ns

    def apply_faults(self, readings: Times, times: Times, power_on_reading: int) -> Times:
        """Return the readings of the clock with the faults, (n,) ns.

        The readings are not wrapped: they may exceed the time at which the clock wraps.

        Args:
            readings: the readings without faults, (n,) ns.
            times: the time of each reading since power-on, (n,) ns.
            power_on_reading: the reading with which the clock starts after a restart, ns.
        """
        faults = self.faults
        shifted: Times = readings
        if faults.follows:
            shifted = times + (self._power_on_ns + self._scale_offset_ns())
        start = np.zeros(len(times), np.int64)
        for restart in sorted(faults.restarts):
            restart_ns = round(restart * SECOND_NS)
            has_restarted = times >= restart_ns
            start[has_restarted] = restart_ns
            shifted = np.where(has_restarted, power_on_reading + times - restart_ns, shifted)
        drifted = np.rint(faults.drift_ppm * 1e-6 * (times - start)).astype(np.int64)
        shifted = shifted + drifted + self.jump_ns
        for step_s, size in faults.steps:
            at_ns = round(step_s * SECOND_NS)
            has_jumped = (times >= at_ns) & (at_ns >= start)
            shifted = shifted + np.where(has_jumped, round(size * SECOND_NS), 0)
        return shifted

    def lock_states(self, times: Times) -> NDArray[np.int64]:
        """Return LOCKED, LOST or RESTARTED for each time since power-on, (n,).

        Args:
            times: the times, (n,) ns.
        """
        states = np.full(len(times), LOCKED)
        for begin, end in self.faults.unlocked:
            is_lost = times >= round(begin * SECOND_NS)
            if math.isfinite(end):
                is_lost &= times < round(end * SECOND_NS)
            states[is_lost] = LOST
        if self.faults.restarts:
            states[times >= round(min(self.faults.restarts) * SECOND_NS)] = RESTARTED
        return states

    def _scale_offset_ns(self) -> int:
        """Return the offset from UTC of the time scale that the clock follows, ns."""
        offsets_s = read_leap_seconds().offsets_by_scale(self._power_on_ns / SECOND_NS)
        return offsets_s[self.faults.follows] * SECOND_NS
