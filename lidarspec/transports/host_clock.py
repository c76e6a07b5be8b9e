"""Stamp arrivals with the time of this computer.

`HostClock` reads the wall clock once and continues with a steady clock. The interval between two
stamps is therefore right even if the wall clock is set in between.
"""

from __future__ import annotations

import time
from collections.abc import Callable

#: A wall clock that differs by more was set; by less, it is only adjusted.
_SET_CLOCK_NS = 50_000_000
#: Attempts to read two clocks at one moment.
_READ_ATTEMPTS = 10
#: A reading of both clocks in a longer time is repeated.
_MAX_READ_TIME_NS = _SET_CLOCK_NS // _READ_ATTEMPTS
#: A thread was suspended between two readings that are further apart; one takes less than a
#: thousandth of it.
_SUSPENDED_NS = 200_000
_CLOCK_BOOTTIME: int | None = getattr(time, "CLOCK_BOOTTIME", None)


class HostClock:
    """The wall clock at the start, continued by a steady clock.

    The intervals between its times are right if the wall clock is set or the computer is suspended.

    Args:
        wall: the wall clock, ns since 1970.
    """

    def __init__(self, wall: Callable[[], int] = time.time_ns) -> None:
        self._wall = wall
        self._offset_ns = 0
        #: The lead of the wall clock at the last call of `find_step`.
        self._lead_ns = 0
        for _ in range(_READ_ATTEMPTS):
            self._offset_ns, read_time_ns = self._read_offset()
            if read_time_ns < _MAX_READ_TIME_NS:
                break

    def now(self) -> int:
        """Return the time in ns since 1970."""
        return steady_ns() + self._offset_ns

    def now_and_wall(self) -> tuple[int, int]:
        """Return the times of this clock and of the wall clock at one moment, ns since 1970.

        If the thread is suspended between two readings, both are repeated. The closest pair is
        returned.
        """
        closest: tuple[int, int, int] | None = None
        for _ in range(_READ_ATTEMPTS):
            now = self.now()
            wall = self._wall()
            gap = self.now() - now
            if closest is None or gap < closest[0]:
                closest = gap, now, wall
            if gap < _SUSPENDED_NS:
                break
        assert closest is not None
        return closest[1:]

    def find_step(self) -> int | None:
        """Return the lead of the wall clock in ns if it was set by more than 50 ms, else None.

        A step is returned once.
        """
        offset_ns, read_time_ns = self._read_offset()
        lead_ns = offset_ns - self._offset_ns
        if abs(lead_ns - self._lead_ns) <= _SET_CLOCK_NS or read_time_ns > _MAX_READ_TIME_NS:
            return None
        self._lead_ns = lead_ns
        return lead_ns

    def _read_offset(self) -> tuple[int, int]:
        """Return the offset of the wall clock from the steady one, and the time of the reading."""
        before = steady_ns()
        wall = self._wall()
        return wall - before, steady_ns() - before


def steady_ns() -> int:
    """Return the time of a clock that is never set, in ns.

    If the system has such a clock, it includes the time in which the computer was suspended.
    """
    if _CLOCK_BOOTTIME is None:
        return time.monotonic_ns()
    return time.clock_gettime_ns(_CLOCK_BOOTTIME)
