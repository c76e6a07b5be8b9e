"""What is wanted of the scans of a source: from when to when, which of them, and what of each.

A `Selection` is a value; a `Sieve` carries it out on one stream, scan by scan as they come, and
says when no further one is wanted. Where a source can be moved on, what lies before a slice is
passed over without being read: up to so long before it that the clocks of sensor and host may
differ, and that a whole scan comes first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from shlex import quote
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import UsageError, suggest
from lidarspec.points.cloud import CloudColumns, LazyCloud, PointCloud
from lidarspec.scans.scan import Scan
from lidarspec.transports.protocol import Chunk, Transport

#: a time: seconds from the first scan, or a date.
Moment = float | datetime
Times = tuple[Moment | None, Moment | None]
#: seconds before a slice from which on is read, of its distance the share by which clocks differ,
#: and seconds that passing over is worth.
BEFORE = 5.0
DRIFT = 1e-3
WORTH = 5.0
#: ns since 1970 from which on a time is a date, and not that of a clock that began with the sensor.
DATED = 10**18


@dataclass(frozen=True)
class Selection:
    """Which scans are wanted, and what of each.

    Args:
        times: from which time on, and up to which: seconds from the first scan, or a `datetime`, in
            UTC where it names no zone; None leaves an end open.
        scans: from which scan on, and up to which, counted from 0, pieces among them: (5, 10) has
            five. Both have to be met.
        every: each so manieth of those, from the first of them on.
        ranges: metres, from and up to: a return from elsewhere counts as none; its range is -inf
            where it is nearer, inf where it is farther (REP-117).
        columns: of the points, by name, in this order; all where there are none.
        time: whose clock stamps of scans and `times` are by: the "device"'s, or the "host"'s, when
            the first packet of a scan arrived.
        beams, frame_id: as in `Scan`.

    Raises:
        UsageError: for numbers that can select nothing.
    """

    times: Times = (None, None)
    scans: tuple[int, int | None] = (0, None)
    every: int = 1
    ranges: tuple[float, float] = (0.0, math.inf)
    columns: tuple[str, ...] = ()
    time: Literal["device", "host"] = "device"
    beams: int | None = None
    frame_id: str = ""

    def __post_init__(self) -> None:
        start, stop = self.scans
        if min(start, stop or 0) < 0:
            raise UsageError(
                "a scan is counted from the first one: from the last, all of a source would have to"
                " be read first"
            )
        times = (
            moment.replace(tzinfo=moment.tzinfo or UTC) if isinstance(moment, datetime) else moment
            for moment in self.times
        )
        object.__setattr__(self, "times", tuple(times))
        for low, high in (self.scans, self.times, self.ranges):
            if low is not None and high is not None:
                _check_order(low, high)
        if self.every < 1:
            raise UsageError(f"each {self.every}th scan: the number is 1 or more")

    @property
    def is_timed(self) -> bool:
        """Whether times decide."""
        return self.times != (None, None)

    @property
    def is_counted(self) -> bool:
        """Whether scans are counted from the first scan of the source on.

        This is required if scans are selected by number or time.
        """
        return self.is_timed or self.scans != (0, None) or self.every != 1


def _check_order(low: Any, high: Any) -> None:
    """Raise UsageError unless an interval begins before it ends."""
    if isinstance(low, datetime) != isinstance(high, datetime):
        raise UsageError(f"one end is a date and the other is not: {low} to {high}")
    if low > high:
        raise UsageError(f"end before start: {low} to {high}")
    if low == high:
        raise UsageError(f"start and end are equal: {low}")


#: all of a source.
EVERYTHING = Selection()


class Slice:
    """The times of one stream that are wanted.

    Attributes:
        first, last: of those that came, ns; None before any.
        ended: whether all that follow are behind its end.
    """

    def __init__(self, times: Times) -> None:
        self._times = times
        self.ended = False
        self.first: int | None = None
        self.last: int | None = None

    def holds(self, at: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which of the next times, (n,) ns, are wanted."""
        if len(at):
            self.first = int(at[0]) if self.first is None else self.first
            self.last = int(at[-1])
        begin, end = (self.ns(moment) for moment in self._times)
        self.ended = end is not None and self.last is not None and self.last >= end
        if begin is None:
            wanted = np.ones(len(at), np.bool_)
        else:
            wanted = at >= begin
        if end is None:
            return wanted
        return wanted & (at < end)

    def missed(self, source: object, number: str = "data") -> UsageError:
        """Return the error that no time of a source was selected.

        It gives the times of the source.

        Args:
            number: the items of the source, in words.
        """
        first = self.first or 0
        last = self.last or 0
        if first > DATED:
            dates = f" ({dated(first)} to {dated(last)})"
        else:
            dates = ""
        text = (
            f"{source} has {number} from 0 s to {(last - first) * 1e-9:.3f} s{dates}, and nothing"
            " of that is asked for"
        )
        return suggest(UsageError(text), f"lidarspec info {quote(str(source))}")

    @property
    def ahead(self) -> int:
        """Nanoseconds from the first time to where the slice begins."""
        if self._times[0] is not None:
            return (self.ns(self._times[0]) or 0) - (self.first or 0)
        return 0

    def ns(self, moment: Moment | None) -> int | None:
        """A moment as a time of the stream, of which one has come."""
        if isinstance(moment, datetime):
            return round(moment.timestamp() * 1e6) * 1000
        if moment is None or self.first is None:
            return None
        return self.first + round(moment * 1e9)


def dated(ns: int) -> str:
    """A time as a date in UTC, as `--slice` takes it."""
    return f"{datetime.fromtimestamp(ns // 10**9, UTC):%Y-%m-%dT%H:%M:%S}.{ns // 10**6 % 1000:03}Z"


def received(source: Transport, times: Times, name: object) -> Iterator[Chunk]:
    """What a source received, or only at some times, by their arrival.

    Raises:
        UsageError: where nobody knows when it was, or nothing was received then.
    """
    if times == (None, None):
        yield from source.chunks()
        return
    wanted = Slice(times)
    any_came = False
    for chunk in source.chunks():
        if chunk.at is None:
            raise UsageError(f"{name} does not say when its bytes arrived, by which --slice goes")
        is_first = wanted.first is None
        if wanted.holds(np.array([chunk.at]))[0]:
            any_came = True
            yield chunk
        elif is_first and wanted.ahead > WORTH * 1e9:
            source.skip(chunk.at + wanted.ahead)
        if wanted.ended:
            break
    if wanted.first is not None and not any_came:
        raise wanted.missed(name)


def never(at: int) -> bool:
    """No source is moved on."""
    return False


class Sieve:
    """A selection, carried out on the scans of one stream.

    Args:
        source: what it is called in messages.
        skip: moves the source on to what arrived at a time, ns since 1970, where it can: whether it
            did.

    Attributes:
        ended: whether no further scan is wanted.
        slice: the times that are.
    """

    def __init__(
        self,
        selection: Selection,
        source: object = "the source",
        skip: Callable[[int], bool] = never,
    ) -> None:
        self._selection = selection
        self._source = source
        self._skip = skip
        self._seen = self._kept = 0
        self._skipped = False
        self.ended = False
        self.slice = Slice(selection.times)

    def of(self, scans: Iterable[Scan | None]) -> Iterator[Scan | None]:
        """What is wanted of some scans; None, for a turn of the caller's, is handed on.

        Raises:
            UsageError: where there were scans, and none of them was wanted.
        """
        for scan in scans:
            wanted = None if scan is None else self.take(scan)
            if scan is None or wanted is not None:
                del scan  # nobody is to keep it but the caller
                yield wanted
            del wanted
            if self.ended:
                break
        if self.is_empty:
            raise self.missing()

    def take(self, scan: Scan) -> Scan | None:
        """What is wanted of the next scan, None where it is not.

        Raises:
            UsageError: where nobody knows the time that is asked for, or the points have not the
                columns.
        """
        selection = self._selection
        number = self._seen
        start, stop = selection.scans
        self._seen += 1
        wanted = start <= number and (stop is None or number < stop)
        self.ended = stop is not None and self._seen >= stop
        if selection.is_timed:
            wanted &= bool(self.slice.holds(np.array([self._time(scan)]))[0])
            self.ended = self.ended or self.slice.ended
            if not number:
                self._pass_over(scan)
        self._kept += wanted
        if wanted and (self._kept - 1) % selection.every == 0:
            return self._shaped(scan)
        return None

    @property
    def is_empty(self) -> bool:
        """Whether there were scans, and none of them was wanted."""
        return self._seen > 0 and not self._kept

    def missing(self) -> UsageError:
        """That no scan was wanted, and which there are."""
        number = f"{self._seen} scan{'s' * (self._seen != 1)}"
        if self._selection.is_timed:
            return self.slice.missed(self._source, "scans" if self._skipped else f"{number},")
        return UsageError(
            f"{self._source} has {number}, from 0 to {self._seen - 1}, and none of them is"
            " asked for"
        )

    def _time(self, scan: Scan) -> int:
        by_host = self._selection.time == "host"
        if not scan.host_ns and (by_host or scan.sensor.clock is None):
            raise suggest(
                UsageError(f"{self._source} does not say when its bytes arrived"),
                "the same with --scans 5:10",
            )
        if by_host:
            return scan.host_ns
        return scan.stamp_ns

    def _pass_over(self, scan: Scan) -> None:
        """Move the source on to a little before the slice."""
        ahead = self.slice.ahead * 1e-9
        clock = scan.sensor.clock
        near = BEFORE + DRIFT * ahead
        is_followed = (
            clock is None or not clock.wraps_at or clock.wraps_at >= 1
        )  # a quicker one cannot be followed over a gap
        if (
            ahead - near > WORTH
            and scan.host_ns
            and is_followed
            and self._selection.scans == (0, None)
        ):
            self._skipped = self._skip(scan.host_ns + round((ahead - near) * 1e9))

    def _shaped(self, scan: Scan) -> Scan:
        """A scan with what is wanted of it."""
        selection = self._selection
        cloud = scan.points
        if selection.time == "host":
            stamp_ns = self._time(scan)
        else:
            stamp_ns = cloud.stamp_ns
        if selection.ranges != (0.0, math.inf):
            cloud = LazyCloud.of(_Within(cloud, *selection.ranges), stamp_ns)
        elif stamp_ns != cloud.stamp_ns:
            cloud = LazyCloud.of(CloudColumns(cloud), stamp_ns)
        if selection.columns:
            cloud = cloud.only(*selection.columns)
        return replace(
            scan,
            points=cloud,
            beams=selection.beams or scan.beams,
            frame_id=selection.frame_id or scan.frame_id,
        )


class _Within(CloudColumns):
    """The columns of a cloud, of which returns outside some metres count as none."""

    def __init__(self, cloud: PointCloud, near: float, far: float) -> None:
        super().__init__(cloud)
        self._near = near
        self._far = far

    def column(self, name: str) -> NDArray[Any] | None:
        column = super().column(name)
        if name not in ("x", "y", "z", "range", "valid") or column is None:
            return column
        ranges = self._cloud.range
        valid = self._cloud.valid
        too_near = valid & (ranges < self._near)
        too_far = valid & (ranges > self._far)
        if name == "valid":
            return np.asarray(column & ~too_near & ~too_far)
        near, far = (-np.inf, np.inf) if name == "range" else (np.nan, np.nan)
        return np.where(too_near, np.float32(near), np.where(too_far, np.float32(far), column))
