"""Where a scan ends, what the clock is and how packets are counted: declared rules, carried out by
the engine.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from lidarspec.errors import SpecError

#: times are counted in 64-bit nanoseconds: 292 years.
MAX_CLOCK_S = 2**63 / 1e9
#: a field path, several that add up, or a function of the frame's `Fields` (returning a column or
#: several).
Source = str | tuple[str, ...] | Callable[[Any], Any]


@dataclass(frozen=True)
class OnWrap:
    """Cut where a circular column passes `at`.

    Args:
        name: a field path of an angle ("blocks.azimuth": cut between the rows of that array) or a
            point column ("azimuth": cut between points).
        at: the angle, in the unit of the field; radians for a point column.
    """

    name: str
    at: float = 0.0


@dataclass(frozen=True)
class OnFlag:
    """Cut before every packet (or row of an array) in which the field `name` is not 0, or is
    `value` where that is given.
    """

    name: str
    value: float | None = None


@dataclass(frozen=True)
class OnChange:
    """Cut before every packet (or row) in which the field `name` differs from the one before.

    Args:
        name: a field path.
        angle: the path of a field that grows evenly as a rotating sensor turns, the angle at which
            a packet begins. By it a masked sector is found, in which scans are cut then, and
            `configure(cut=)` cuts. "" if there is none.
        full: how much `angle` grows in a turn, in its unit.
    """

    name: str
    angle: str = ""
    full: float = 360.0


@dataclass(frozen=True)
class OnJump:
    """Cut before every packet (or row) in which the field `name` is farther than `by` from the one
    before, either way.

    Args:
        name: a field path; an angle goes the short way around the circle.
        by: in the unit of the field, more than its largest step within a scan.
    """

    name: str
    by: float


@dataclass(frozen=True)
class OnRewind:
    """Cut before every packet in which the field `name` is lower than in the one before."""

    name: str


@dataclass(frozen=True)
class Every:
    """Cut every so many seconds of the packets' time, for sensors without a physical period."""

    seconds: float


Split = OnWrap | OnFlag | OnChange | OnJump | OnRewind | Every


@dataclass(frozen=True)
class Clock:
    """The sensor's own clock.

    Args:
        source: the field, the fields that add up (seconds and microseconds), or a function of
            `Fields` that returns a column, or several that add up, in seconds. Terms are summed as
            integer nanoseconds.
        wraps_at: seconds after which it starts again at 0; None if it does not.
        pace: a function of `Fields`: by how many seconds it advances from a packet to the next, nan
            if that is unknown. If there is no counter, it shows what is missing. Beside a counter
            it shows how often a short one has wrapped in a gap, and whether a number that jumps is
            damaged: there it has to be right in every mode. Without it the clock counts no loss.
            It tells relatives apart; if it is left out, the pace of a simulation does.
        told: what completes a clock that starts again: another frame type that has the clock's
            field too, and a function of its `Fields` to the seconds since 1970 that it tells, nan
            where it tells none. The turn of the clock is the one closest to what the first frame
            that tells it says: from the start of a file, and of live packets from that frame on.

    Raises:
        SpecError: if `wraps_at` is not positive, or too long to ever be reached.
    """

    source: Source
    wraps_at: float | None = None
    pace: Callable[[Any], Any] | None = None
    told: tuple[str, Callable[[Any], Any]] | None = None

    def __post_init__(self) -> None:
        if self.wraps_at is None:
            return
        if not self.wraps_at > 0:
            raise SpecError(
                f"expected a positive number of seconds, got {self.wraps_at}", path="clock.wraps_at"
            )
        if self.wraps_at >= MAX_CLOCK_S:
            raise SpecError(
                f"{self.wraps_at:.4g} s is longer than 292 years; leave wraps_at out, as this clock"
                " never wraps",
                path="clock.wraps_at",
            )


@dataclass(frozen=True)
class Sequence:
    """A counter of packets; a jump is a loss, unless a clock with a declared pace shows none.

    Args:
        field: path of the counter.
        first, last: its lowest and highest value; `last` may be a function of `Fields`, and is the
            field's largest value where it is left out.
    """

    field: str
    first: int = 0
    last: int | Callable[[Any], Any] | None = None
