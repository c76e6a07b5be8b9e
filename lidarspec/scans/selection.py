"""Select scans of a source by time or index, and parts of each scan.

A `Selection` describes the selected scans, and a `ScanSelector` applies it to the scans of one
stream. `iter_received` selects bytes by their arrival time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from shlex import quote
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import UsageError, suggest
from lidarspec.packets.clock_status import read_clock_status
from lidarspec.packets.packet_type import find_clock
from lidarspec.packets.packets import Packets
from lidarspec.packets.utc_times import UtcTimes
from lidarspec.points.cloud import CloudColumns, LazyCloud, PointCloud
from lidarspec.points.firings import RETURNS, Returns, choose_returns, take_returns
from lidarspec.scans.scan import Scan
from lidarspec.spec.timing import FIRST_DATE_NS
from lidarspec.transports.protocol import Chunk, Transport

#: A time, as seconds from the first scan or as a date.
Moment = float | datetime
Times = tuple[Moment | None, Moment | None]
#: The clocks of `Selection.time`.
CLOCKS = ("sensor", "utc", "host")
#: Reading starts this time before the first selected time.
LEAD_S = 5.0
#: The maximum drift between the clocks of sensor and host, as a share of the elapsed time.
MAX_CLOCK_DRIFT = 1e-3
#: The shortest time that is skipped by seeking.
MIN_SKIP_S = 5.0


@dataclass(frozen=True)
class Selection:
    """The selected scans, and the selected parts of them.

    A scan is selected if `times`, `scans` and `every` all select it.

    Args:
        times: a pair (start, end) of times; scans with start <= time < end are selected. A time is
            a number of seconds from the first scan, or a `datetime`, in UTC if it has no zone. None
            means no limit.
        scans: a pair (start, end) of indices; scans with start <= index < end are selected. Indices
            count from 0 and include incomplete scans. An end of None means no limit.
        every: the step between selected scans; 1 for all.
        ranges: the lowest and the greatest range, metres. Points outside become invalid, with the
            range -inf if they are nearer, and inf if they are farther (REP-117).
        returns: the return of each firing to keep: "first", "last", "strongest", or "all". It is
            chosen among the returns inside `ranges`.
        columns: the names of the columns of the points, in this order; () for all columns.
        time: the clock of the stamps and of `times`: "sensor" for the clock of the sensor; "utc"
            for UTC, from the clock of the sensor if possible, otherwise from the arrival times;
            "host" for the arrival time of the first packet of a scan.
        beams: the default number of beams, see `Scan`.
        frame_id: the name of the frame of reference, see `Scan`.

    Raises:
        UsageError: if a limit is negative, or if no scan can be within the limits.
    """

    times: Times = (None, None)
    scans: tuple[int, int | None] = (0, None)
    every: int = 1
    ranges: tuple[float, float] = (0.0, math.inf)
    columns: tuple[str, ...] = ()
    returns: Returns = "all"
    time: Literal["sensor", "utc", "host"] = "sensor"
    beams: int | None = None
    frame_id: str = ""

    def __post_init__(self) -> None:
        start, stop = self.scans
        if min(start, stop or 0) < 0:
            raise UsageError(
                f"the indices of scans must be at least 0, not {min(start, stop or 0)}: the first"
                " scan has the index 0"
            )
        begin, end = self.times
        object.__setattr__(self, "times", (_add_zone(begin), _add_zone(end)))
        for low, high in (self.scans, self.times, self.ranges):
            if low is not None and high is not None:
                _check_order(low, high)
        if self.every < 1:
            raise UsageError(f"every must be at least 1, not {self.every}")
        if self.time not in CLOCKS:
            raise UsageError(f"time must be one of {', '.join(CLOCKS)}, not {self.time!r}")
        if self.returns not in RETURNS:
            raise UsageError(f"returns must be one of {', '.join(RETURNS)}, not {self.returns!r}")

    @property
    def has_time_limits(self) -> bool:
        """Whether `times` limits the selected scans."""
        return self.times != (None, None)

    @property
    def is_partial(self) -> bool:
        """Whether only some scans are selected, by `times`, `scans` or `every`."""
        return self.has_time_limits or self.scans != (0, None) or self.every != 1

    @property
    def needs_all_scans(self) -> bool:
        """Whether all earlier scans are needed to select a scan or to find its time."""
        return self.is_partial or self.time == "utc"


def _add_zone(moment: Moment | None) -> Moment | None:
    """Return a time, with the zone UTC if it is a `datetime` without a zone."""
    if isinstance(moment, datetime) and moment.tzinfo is None:
        return moment.replace(tzinfo=UTC)
    return moment


def _check_order(low: Any, high: Any) -> None:
    """Raise UsageError unless `low` is less than `high`."""
    if isinstance(low, datetime) != isinstance(high, datetime):
        raise UsageError(f"expected two dates or two numbers of seconds, got {low} to {high}")
    if low > high:
        raise UsageError(f"the end is before the start: {low} to {high}")
    if low == high:
        raise UsageError(f"start and end are equal: {low}")


#: The selection of all scans of a source.
EVERYTHING = Selection()


class TimeSlice:
    """The selected times of one stream.

    Attributes:
        first: the first time of the stream, ns; None before it is known.
        last: the newest time of the stream, ns; None before it is known.
        ended: whether the end of the slice has passed, so that no later time is selected.
    """

    def __init__(self, times: Times) -> None:
        self._times = times
        self.ended = False
        self.first: int | None = None
        self.last: int | None = None

    def select_times(self, at: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return whether each of the next times is selected, (n,); update the attributes.

        Args:
            at: the next times of the stream, (n,) ns.
        """
        if len(at):
            if self.first is None:
                self.first = int(at[0])
            self.last = int(at[-1])
        begin = self.to_ns(self._times[0])
        end = self.to_ns(self._times[1])
        self.ended = end is not None and self.last is not None and self.last >= end
        if begin is None:
            wanted = np.ones(len(at), np.bool_)
        else:
            wanted = at >= begin
        if end is None:
            return wanted
        return wanted & (at < end)

    def make_no_data_error(self, source: object, content: str = "data") -> UsageError:
        """Return the error to raise if a source has no data at the selected times.

        Args:
            source: the name of the source.
            content: the data of the source in words, for example "frames". A comma follows a
                number, as in "12 scans,", because the message continues with the times.
        """
        first = self.first or 0
        last = self.last or 0
        dates = ""
        if first > FIRST_DATE_NS:
            dates = f" ({format_date(first)} to {format_date(last)})"
        text = (
            f"{source} has {content} from 0 s to {(last - first) * 1e-9:.3f} s{dates}; the"
            " selection is outside this range"
        )
        return suggest(UsageError(text), f"lidarspec info {quote(str(source))}")

    @property
    def time_until_start(self) -> int:
        """The time from the first time of the stream to the start of the slice, ns."""
        if self._times[0] is None:
            return 0
        return (self.to_ns(self._times[0]) or 0) - (self.first or 0)

    def to_ns(self, moment: Moment | None) -> int | None:
        """Return a limit of the slice in ns; None without a limit."""
        # A limit in seconds is unknown until the stream has a first time.
        if isinstance(moment, datetime):
            return round(moment.timestamp() * 1e6) * 1000
        if moment is None or self.first is None:
            return None
        return self.first + round(moment * 1e9)


def format_date(ns: int) -> str:
    """Return a time as a date in UTC, in the form that `--slice` accepts."""
    return f"{datetime.fromtimestamp(ns // 10**9, UTC):%Y-%m-%dT%H:%M:%S}.{ns // 10**6 % 1000:03}Z"


class PacketTimes:
    """Reads the times of packets of one type by the clock of a selection.

    Args:
        time: the clock, as in `Selection`.
        source: the name of the source, for messages.
    """

    def __init__(self, time: str, source: object) -> None:
        self._time = time
        self._source = source
        self._utc: UtcTimes | None = None  # made with the first packets

    @property
    def warnings(self) -> list[str]:
        """Sentences about the source of UTC, if the clock is UTC."""
        return self._utc.warnings if self._utc is not None else []

    def read(self, packets: Packets) -> NDArray[np.int64]:
        """Return the times of the next packets, (n,) ns.

        Raises:
            UsageError: if the UTC or the arrival times of the packets are unknown.
        """
        if self._time == "host":
            if len(packets) and not packets.host_ns.any():
                error = UsageError(f"{self._source} has no arrival times")
                raise suggest(error, "repeat with --time sensor")
            return packets.host_ns
        if self._time == "sensor":
            return packets.time_ns
        if self._utc is None:
            clock = find_clock(packets.sensor, packets.frame)
            self._utc = UtcTimes(packets.sensor.id, clock, self._source)
        return self._utc.convert(packets)


def iter_received(source: Transport, times: Times, name: object) -> Iterator[Chunk]:
    """Yield the chunks of a source that arrived in a time slice.

    Args:
        times: the start and the end of the slice, as in `Selection`.
        name: the name of the source, for messages.

    Raises:
        UsageError: if arrival times are unknown, or if no chunk arrived in the slice.
    """
    if times == (None, None):
        yield from source.chunks()
        return
    wanted = TimeSlice(times)
    any_came = False
    for chunk in source.chunks():
        if chunk.at is None:
            raise UsageError(f"{name} has no arrival times, which --slice requires")
        is_first = wanted.first is None
        if wanted.select_times(np.array([chunk.at]))[0]:
            any_came = True
            yield chunk
        elif is_first and wanted.time_until_start > MIN_SKIP_S * 1e9:
            source.skip_until(chunk.at + wanted.time_until_start)
        if wanted.ended:
            break
    if wanted.first is not None and not any_came:
        raise wanted.make_no_data_error(name)


class ScanSelector:
    """Applies a selection to the scans of one stream.

    Args:
        source: the name of the source, for messages.
        skip: a function that skips the data before an arrival time, in ns since 1970, and returns
            whether it skipped data; None if the source cannot seek.

    Attributes:
        ended: whether no later scan can be selected.
        slice: the selected times.
    """

    def __init__(
        self,
        selection: Selection,
        source: object = "the source",
        skip: Callable[[int], bool] | None = None,
    ) -> None:
        self._selection = selection
        self._source = source
        self._skip = skip
        self._seen = 0
        self._selected = 0  # selected by time and index, before `every` is applied
        self._has_skipped = False
        self.ended = False
        self.slice = TimeSlice(selection.times)
        self._utc: UtcTimes | None = None  # made with the first scan

    @property
    def warnings(self) -> list[str]:
        """Sentences about the source of UTC, if times are selected in UTC."""
        return self._utc.warnings if self._utc is not None else []

    def iter_selected(self, scans: Iterable[Scan | None]) -> Iterator[Scan | None]:
        """Yield the selected parts of the selected scans.

        Args:
            scans: the scans of the stream. A None means that no scan has arrived for some time; it
                is yielded too.

        Raises:
            UsageError: if there were scans, but none was selected.
        """
        for scan in scans:
            selected = None
            if scan is not None:
                selected = self.select(scan)
            if scan is None or selected is not None:
                del scan  # only the caller may keep it alive
                yield selected
            del selected
            if self.ended:
                break
        if self.is_empty:
            raise self.make_no_scan_error()

    def select(self, scan: Scan) -> Scan | None:
        """Return the selected parts of the next scan; None if it is not selected.

        Raises:
            UsageError: if a required time is unknown, or if the points lack a selected column.
        """
        selection = self._selection
        number = self._seen
        start, stop = selection.scans
        self._seen += 1
        is_selected = start <= number and (stop is None or number < stop)
        self.ended = stop is not None and self._seen >= stop
        stamp_ns = scan.stamp_ns
        if selection.has_time_limits or selection.time != "sensor":
            stamp_ns = self._find_time(scan)
        if selection.has_time_limits:
            is_in_slice = bool(self.slice.select_times(np.array([stamp_ns]))[0])
            is_selected = is_selected and is_in_slice
            self.ended = self.ended or self.slice.ended
            if not number:
                self._skip_to_slice(scan)
        if not is_selected:
            return None
        self._selected += 1
        if (self._selected - 1) % selection.every:
            return None
        return self._select_parts(scan, stamp_ns)

    @property
    def is_empty(self) -> bool:
        """Whether there were scans, but none was selected."""
        return self._seen > 0 and not self._selected

    def make_no_scan_error(self) -> UsageError:
        """Return the error to raise if the selection contains no scan."""
        if self._seen == 1:
            number = "1 scan"
        else:
            number = f"{self._seen} scans"
        if self._selection.has_time_limits and self._has_skipped:
            return self.slice.make_no_data_error(self._source, "scans")
        if self._selection.has_time_limits:
            return self.slice.make_no_data_error(self._source, f"{number},")
        return UsageError(
            f"{self._source} has {number}, from 0 to {self._seen - 1}; the selection is outside"
            " this range"
        )

    def _find_time(self, scan: Scan) -> int:
        """Return the time of a scan by the selected clock, ns."""
        if self._selection.time == "utc":
            return self._find_utc(scan)
        by_host = self._selection.time == "host"
        if not scan.host_ns and (by_host or scan.sensor.clock is None):
            error = UsageError(f"{self._source} has no arrival times")
            if self._selection.has_time_limits and scan.sensor.clock is None:
                raise suggest(error, "repeat with indices of scans, such as --scans 5:10")
            raise suggest(error, "repeat with --time sensor")
        if by_host:
            return scan.host_ns
        return scan.stamp_ns

    def _find_utc(self, scan: Scan) -> int:
        """Return the UTC of the first point of a scan, ns."""
        if self._utc is None:
            self._utc = UtcTimes(scan.sensor.id, scan.sensor.clock, self._source)
        status = math.nan
        for number, packets in enumerate(scan.provenance.iter_packets()):
            self._utc.observe(packets.time_ns, packets.host_ns)
            if not number:
                status = read_clock_status(packets).item(0)
        return self._utc.to_utc(scan.stamp_ns, scan.host_ns, status)

    def _skip_to_slice(self, scan: Scan) -> None:
        """Skip the data of the source up to shortly before the slice, if possible."""
        if self._skip is None or not scan.host_ns or self._selection.scans != (0, None):
            return
        clock = scan.sensor.clock
        if clock is not None and clock.wraps_at and clock.wraps_at < 1:
            return  # wraps of its clock cannot be counted over a gap
        distance_s = self.slice.time_until_start * 1e-9
        skipped_s = distance_s - LEAD_S - MAX_CLOCK_DRIFT * distance_s
        if skipped_s > MIN_SKIP_S:
            self._has_skipped = self._skip(scan.host_ns + round(skipped_s * 1e9))

    def _select_parts(self, scan: Scan, stamp_ns: int) -> Scan:
        """Return the selected parts of a scan.

        Args:
            stamp_ns: the time of the scan's first point by the selected clock, ns.
        """
        selection = self._selection
        cloud = scan.points
        imu = scan.imu
        if imu is not None and stamp_ns != cloud.stamp_ns:
            imu = imu.shift(stamp_ns - cloud.stamp_ns)
        if selection.ranges != (0.0, math.inf):
            cloud = LazyCloud.of(_LimitedRanges(cloud, *selection.ranges), stamp_ns)
        elif stamp_ns != cloud.stamp_ns:
            cloud = LazyCloud.of(CloudColumns(cloud), stamp_ns)
        provenance = scan.provenance
        if selection.returns != "all" and cloud.return_index is not None:
            indices = choose_returns(cloud, selection.returns, scan.sensor.returns)
            cloud = take_returns(cloud, indices)
            provenance = provenance.select(indices)
        if selection.columns:
            cloud = cloud.select_columns(*selection.columns)
        return replace(
            scan,
            points=cloud,
            imu=imu,
            provenance=provenance,
            beams=selection.beams or scan.beams,
            frame_id=selection.frame_id or scan.frame_id,
        )


class _LimitedRanges(CloudColumns):
    """The columns of a cloud in which too near and too far points are invalid."""

    def __init__(self, cloud: PointCloud, near: float, far: float) -> None:
        super().__init__(cloud)
        self._near = near
        self._far = far

    def columns(self, names: Sequence[str], start: int, stop: int) -> dict[str, NDArray[Any]]:
        columns = super().columns((*names, "range", "valid"), start, stop)
        ranges = columns["range"]
        valid = columns["valid"]
        too_near = valid & (ranges < self._near)
        too_far = valid & (ranges > self._far)
        columns["valid"] = valid & ~too_near & ~too_far
        near_range = np.where(too_near, np.float32(-np.inf), ranges)
        columns["range"] = np.where(too_far, np.float32(np.inf), near_range)
        for name in columns.keys() & {"x", "y", "z"}:
            columns[name] = np.where(too_near | too_far, np.float32(np.nan), columns[name])
        return columns
