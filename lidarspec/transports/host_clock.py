"""The clock of this computer for arrival times.

Setting the wall clock does not change `HostClock`, so intervals between arrival times are correct.
"""

from __future__ import annotations

import time
from collections.abc import Callable

#: If the wall clock differs by more than this from the expected time, it was set. Smaller
#: differences result from gradual adjustments.
_SET_CLOCK_NS = 50_000_000
#: Maximum number of attempts to read two clocks at the same moment.
_READ_ATTEMPTS = 10
#: If reading both clocks takes longer than this, they are read again.
_MAX_READ_TIME_NS = _SET_CLOCK_NS // _READ_ATTEMPTS
#: If more than this time passes between two readings, the thread was suspended in between. A
#: reading takes less than a thousandth of this time.
_SUSPENDED_NS = 200_000
_CLOCK_BOOTTIME: int | None = getattr(time, "CLOCK_BOOTTIME", None)


class HostClock:
    """A clock that starts at the wall-clock time and never jumps.

    Args:
        wall: returns the time of the wall clock, ns since 1970.
    """

    def __init__(self, wall: Callable[[], int] = time.time_ns) -> None:
        self._wall = wall
        self._offset_ns = 0
        #: How far the wall clock was ahead of this clock when `find_step` last returned a step, ns.
        self.lead_ns = 0
        for _ in range(_READ_ATTEMPTS):
            self._offset_ns, read_time_ns = self._read_offset()
            if read_time_ns < _MAX_READ_TIME_NS:
                break

    def now(self) -> int:
        """Return the time in ns since 1970."""
        return steady_ns() + self._offset_ns

    def now_and_wall(self) -> tuple[int, int]:
        """Return the times of this clock and of the wall clock, ns since 1970.

        Both clocks are read at almost the same moment.
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
        """Return by how much the wall clock was set since the last step that was returned, in ns.

        Returns None if the wall clock was not set. Also returns None if the thread was suspended
        while the clocks were read; a later call then returns the step.
        """
        offset_ns, read_time_ns = self._read_offset()
        lead_ns = offset_ns - self._offset_ns
        step_ns = lead_ns - self.lead_ns
        if abs(step_ns) <= _SET_CLOCK_NS or read_time_ns > _MAX_READ_TIME_NS:
            return None
        self.lead_ns = lead_ns
        return step_ns

    def _read_offset(self) -> tuple[int, int]:
        """Return wall clock minus steady clock, and the duration of the reading, ns."""
        before = steady_ns()
        wall = self._wall()
        return wall - before, steady_ns() - before


def steady_ns() -> int:
    """Return the time of a clock that is never set, in ns."""
    if _CLOCK_BOOTTIME is None:
        return time.monotonic_ns()
    return time.clock_gettime_ns(_CLOCK_BOOTTIME)
