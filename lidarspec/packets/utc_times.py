"""Convert the times of one sensor to UTC.

UTC comes from one of three sources: from the sensor's clock, if the clock has a date; from the
clock and the arrival time, if the clock counts from the full hour; from arrival times alone in all
other cases. If the source changes, for example because the clock loses its lock, the change is kept
with its time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import UsageError, suggest
from lidarspec.frames.arrays import split_runs
from lidarspec.leap_seconds import TAI_MINUS_GPS_S, read_leap_seconds
from lidarspec.packets.clock_estimate import DeviceClock
from lidarspec.packets.clock_status import read_clock_status
from lidarspec.packets.packets import Packets
from lidarspec.spec.timing import DATED_EPOCHS, EPOCHS, FIRST_DATE_NS, HOUR_S, Clock, ClockState

Times = NDArray[np.int64]
SECOND_NS = 1_000_000_000
HOUR_NS = HOUR_S * SECOND_NS
#: The maximum number of changes that are described one by one.
MAX_DESCRIBED_CHANGES = 10


@dataclass(frozen=True)
class UtcSource:
    """The source of UTC.

    Attributes:
        kind: "clock" for a clock with a date; "hour" for a clock that counts from the full hour;
            "arrival" if UTC comes from arrival times alone.
        epoch: the declared epoch, a key of `spec.timing.EPOCHS`.
        locked: whether the clock is locked; None if unknown.
        state: the meaning of the clock's status; "" if unknown.
    """

    kind: str
    epoch: str
    locked: bool | None = None
    state: str = ""

    @property
    def is_notable(self) -> bool:
        """Whether a user should know of this source, even if it never changes."""
        return self.kind == "arrival" or self.locked is False

    @property
    def reason(self) -> str:
        """The reason why the clock does not give UTC."""
        if self.kind == "hour":
            return "the sensor's clock counts from the full hour"
        if self.epoch in DATED_EPOCHS:
            return "the sensor's clock was not set"
        if self.epoch:
            return "the sensor's clock counts time since power-up"
        return "the sensor's clock is not declared to count UTC, TAI or GPS time"

    def __str__(self) -> str:
        if self.kind == "arrival":
            text = f"the arrival times, because {self.reason}"
        elif self.kind == "hour":
            text = "the sensor's clock; the date and the hour come from the arrival time"
        elif self.epoch == "utc":
            text = "the sensor's clock"
        else:
            text = f"the sensor's clock, which counts {EPOCHS[self.epoch]}"
        if self.state:
            text += f" ({self.state})"
        return text


@dataclass(frozen=True)
class UtcChange:
    """A source of UTC, and the time at which it begins to apply.

    Attributes:
        utc_ns: the UTC at which the source begins to apply, ns since 1970.
        is_first: whether this is the first source of UTC.
    """

    utc_ns: int
    source: UtcSource
    is_first: bool = False

    def __str__(self) -> str:
        date = datetime.fromtimestamp(self.utc_ns // SECOND_NS, UTC)
        moment = f"{date:%Y-%m-%dT%H:%M:%S}.{self.utc_ns // 1_000_000 % 1000:03}Z"
        if self.is_first:
            return f"UTC comes from {self.source}"
        return f"from {moment} on, UTC comes from {self.source}"


class UtcTimes:
    """Converts the times of one sensor to UTC, in the order of arrival.

    Args:
        sensor: the id of the sensor, for messages.
        clock: the clock of the times; None if they are arrival times.
        name: the name of the source, for messages.

    Attributes:
        changes: the sources of UTC so far.
    """

    def __init__(self, sensor: str, clock: Clock | None, name: object = "the source") -> None:
        self._sensor = sensor
        self._clock = clock
        self._name = name
        self._estimate = DeviceClock()
        self._source: UtcSource | None = None
        self._status = math.nan  # the last known status
        self._expired_path = ""
        self.changes: list[UtcChange] = []

    @property
    def warnings(self) -> list[str]:
        """Sentences about the source of UTC, its changes, and the table of leap seconds."""
        notable = [
            change for change in self.changes if not change.is_first or change.source.is_notable
        ]
        texts = [f"{self._name}: {change}" for change in notable[:MAX_DESCRIBED_CHANGES]]
        if len(notable) > MAX_DESCRIBED_CHANGES:
            count = len(notable) - MAX_DESCRIBED_CHANGES
            texts.append(f"{self._name}: the source of UTC changed {count} more times")
        if self._expired_path:
            texts.append(
                f"the table of leap seconds {self._expired_path} has expired; later leap seconds"
                " are missing: update the time zone data (tzdata)"
            )
        return texts

    def observe(self, times: Times, host: Times) -> None:
        """Update the estimated offset between the clocks of sensor and host.

        Args:
            times: the times of packets by the sensor's clock, (n,) ns.
            host: the arrival times of the packets, (n,) ns; 0 if unknown.
        """
        is_known = host > 0
        if is_known.any():
            self._estimate.observe(times[is_known], host[is_known])

    def to_utc(self, time_ns: int, host_ns: int, status: float = math.nan) -> int:
        """Return the UTC of a time by the sensor's clock, ns since 1970.

        Args:
            time_ns: the time by the sensor's clock.
            host_ns: the arrival time, ns since 1970; 0 if unknown.
            status: the status of the clock (`read_clock_status`); nan if it was not sent.

        Raises:
            UsageError: if neither the sensor's clock nor the arrival times determine UTC.
        """
        utc_ns = self._convert(np.array([time_ns]), np.array([host_ns]), np.array([status]))
        return int(utc_ns.item())

    def convert(self, packets: Packets) -> Times:
        """Return the UTC of packets, (n,) ns."""
        return self._convert(packets.time_ns, packets.host_ns, read_clock_status(packets))

    def _convert(self, times: Times, host: Times, status: NDArray[np.float64]) -> Times:
        """Return the UTC of times by the sensor's clock, (n,) ns since 1970."""
        status = self._fill_status(status)
        utc_ns = np.empty(len(times), np.int64)
        known_status = np.nan_to_num(status)
        for part in split_runs(known_status, np.isnan(status), times >= FIRST_DATE_NS):
            source = self._find_source(times.item(part.start), status.item(part.start))
            if source.kind != "clock" and not host[part].all():
                raise self._explain_unknown(source)
            utc_ns[part] = self._convert_run(source, times[part], host[part])
            if source != self._source:
                first_ns = utc_ns.item(part.start)
                self.changes.append(UtcChange(first_ns, source, is_first=self._source is None))
                self._source = source
        return utc_ns

    def _fill_status(self, status: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the status with the last known value in place of each nan, (n,)."""
        filled = np.concatenate([[self._status], status])
        known = np.where(np.isnan(filled), 0, np.arange(len(filled)))
        filled = filled[np.maximum.accumulate(known)]
        self._status = filled.item(-1)
        return filled[1:]

    def _convert_run(self, source: UtcSource, times: Times, host: Times) -> Times:
        """Return the UTC of times that have the same source, (n,) ns."""
        if source.kind == "arrival":
            return self._estimate.stamp_packets(times, host)
        # The estimate of the arrival has to know all times, also those that do not need it.
        known = np.flatnonzero(host)
        if len(known):
            self._estimate.observe(times[known[:-1]], host[known[:-1]])
            self._estimate.stamp(times.item(known[-1]), host.item(known[-1]))
        if source.kind == "clock":
            return self._subtract_scale(times, source.epoch)
        hours = np.rint((host - times) / HOUR_NS).astype(np.int64)
        return times + hours * HOUR_NS

    def _find_source(self, time_ns: int, status: float) -> UtcSource:
        """Return the source of UTC for a time and a status of the sensor's clock."""
        clock = self._clock
        if clock is None:
            raise self._explain_no_clock()
        state: ClockState | None = None
        if clock.status is not None and not math.isnan(status):
            state = clock.status.state_of(status)
        epoch = clock.epoch_at(time_ns, state)
        if epoch in DATED_EPOCHS and time_ns >= FIRST_DATE_NS:
            kind = "clock"
        elif epoch == "hour":
            kind = "hour"
        else:
            kind = "arrival"
        if state is None:
            return UtcSource(kind, epoch)
        return UtcSource(kind, epoch, state.locked, state.meaning)

    def _subtract_scale(self, times: Times, epoch: str) -> Times:
        """Convert times from the time scale `epoch` to UTC, (n,) ns."""
        if epoch == "utc":
            return times
        table = read_leap_seconds()
        seconds, fractions_ns = np.divmod(times, SECOND_NS)
        if epoch == "gps":
            seconds = seconds + TAI_MINUS_GPS_S
        utc_s = table.utc_from_tai(seconds)
        if table.has_expired(utc_s.max().item()):
            self._expired_path = table.path
        return utc_s * SECOND_NS + fractions_ns

    def _explain_no_clock(self) -> UsageError:
        error = UsageError(
            f"{self._sensor} has no clock, so UTC can only come from the arrival times"
        )
        return suggest(error, "repeat with --time host")

    def _explain_unknown(self, source: UtcSource) -> UsageError:
        """Return the error for times that cannot be converted."""
        error = UsageError(
            f"UTC is unknown, because {self._name} has no arrival times, and {source.reason}"
        )
        return suggest(
            error,
            "repeat with --time sensor to keep the sensor's own times, or record with arrival"
            " times: lidarspec record -o drive.lsr",
        )
