"""Watch a sensor's clock: its epoch, lock, offset, drift and faults.

`ClockMonitor` measures the offset and the drift of the clock by the arrival times of packets. It
compares the offset with the epoch that the sensor declares.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import PluginError
from lidarspec.frames.arrays import split_runs
from lidarspec.leap_seconds import read_leap_seconds
from lidarspec.packets.clock_estimate import ClockJump, DeviceClock
from lidarspec.packets.clock_findings import ClockFinding
from lidarspec.packets.clock_status import read_clock_status
from lidarspec.packets.clocks import clock_ns
from lidarspec.packets.packet_type import get_packet_type
from lidarspec.packets.packets import Packets
from lidarspec.spec.sensor import SensorDescription
from lidarspec.spec.timing import DAY_S, FIRST_DATE_NS, HOUR_S, Clock, ClockState

Integers = NDArray[np.int64]

DRIFT_LIMIT_PPM = 100.0  # crystals are within 50 ppm
#: A clock is in order if its offset is below this, s. The limit allows for late packets, a host
#: that is set by NTP, and a drift of 0.2 s per hour without a lock.
OFFSET_LIMIT_S = 0.5
SCALE_TOLERANCE_S = 0.25  # of the offset from another time scale
STEP_TOLERANCE_S = 0.05  # of a step by a second
LATE_NS = 50_000_000
JITTER_PERCENTILE = 95  # of the delays of packets
PIECE_NS = 250_000_000  # packets are judged in pieces of this duration
ESTIMATE_PARTS = 360  # 90 s, for a drift within 1 ppm of a clock that counts milliseconds
MIN_PIECES = 4  # after which a clock can be in order
WRONG_DATE_S = DAY_S  # difference from the host from which on the date is wrong
#: The largest time that a clock can show in the first packets after its restart, s.
RESTART_LIMIT_S = 1.0
#: A step by one second is a leap second if it is nearer than this to the end of a month, s.
LEAP_LIMIT_S = 10.0
KEPT_DELAYS = 4096
KEPT_EVENTS = 1000
KEPT_SAMPLES = 600
KEPT_READINGS = 64
SAMPLE_NS = 1_000_000_000


@dataclass(frozen=True)
class OffsetSample:
    """The offset of the clock at one time.

    Attributes:
        host_ns: arrival time, ns since 1970.
        offset_s: the sensor's time minus the host's, s.
        jitter_ms: the 95th percentile of the delays of packets, ms.
    """

    host_ns: int
    offset_s: float
    jitter_ms: float


@dataclass(frozen=True)
class ClockReport:
    """The findings about a clock, and its measured offset, drift and jitter.

    Attributes:
        epoch: the declared epoch of the clock, a key of `spec.timing.EPOCHS`; "" if unknown.
        state: the meaning of the clock's status; "" if the sensor has not sent the status.
        locked: whether the clock is locked; None if unknown.
        offset_s: the sensor's time minus the host's, s; nan if unknown. It is too low by the time
            that the fastest packet needs from the sensor to the host.
        error_s: the offset minus the offset expected for the epoch, s; nan if the clock has no
            date.
        drift_ppm: how much faster the sensor's clock runs than the host's, in millionths; nan if
            unknown.
        jitter_ms: the 95th percentile of the delays of packets, ms. The fastest packets have a
            delay of about 0.
        late: the number of packets with a delay of more than 50 ms.
        jumps: how often the clock was set or restarted.
        findings: the findings, the most serious first; at least one.
        events: the findings that are events, such as steps and restarts, the oldest first. Events
            that are faults are also in `findings`.
    """

    epoch: str
    state: str
    locked: bool | None
    offset_s: float
    error_s: float
    drift_ppm: float
    jitter_ms: float
    packets: int
    late: int
    jumps: int
    findings: tuple[ClockFinding, ...]
    events: tuple[ClockFinding, ...]

    @property
    def verdict(self) -> ClockFinding:
        """The most serious finding."""
        return self.findings[0]

    def to_dict(self) -> dict[str, Any]:
        """Return the report as a JSON object; unknown numbers are null."""
        values: dict[str, Any] = {
            name: None if isinstance(value, float) and math.isnan(value) else value
            for name, value in vars(self).items()
        }
        values["findings"] = [finding.to_dict() for finding in self.findings]
        values["events"] = [event.to_dict() for event in self.events]
        return values


class ClockMonitor:
    """Watches the clock of one sensor by its packets.

    Args:
        drift_limit_ppm: the drift above which the clock is at fault.

    Attributes:
        samples: the offset of the last ten minutes, one sample a second.
    """

    def __init__(
        self, sensor: SensorDescription, *, drift_limit_ppm: float = DRIFT_LIMIT_PPM
    ) -> None:
        self._clock = _find_main_clock(sensor)
        self._drift_limit_ppm = drift_limit_ppm
        self.samples = deque[OffsetSample](maxlen=KEPT_SAMPLES)
        self._estimate = DeviceClock(ESTIMATE_PARTS)
        self._delays: NDArray[np.float64] = np.zeros(0)
        self._events = deque[ClockFinding](maxlen=KEPT_EVENTS)
        self._status = math.nan
        self._state: ClockState | None = None
        self._device_ns = 0
        self._host_ns = 0
        # arrival time and reading of the first packet of each piece, ns
        self._readings = deque[tuple[int, int]](maxlen=KEPT_READINGS)
        self._pieces = 0
        self._packets = 0
        self._late = 0
        self._late_uncertain = 0  # late packets since the clock may have been set

    def add(self, packets: Packets) -> list[ClockFinding]:
        """Add packets, and return the events of the clock that they show."""
        clock = self._clock
        self._packets += len(packets)
        if not len(packets) or clock is None:
            return []
        packet_type = get_packet_type(packets.sensor, packets.frame)
        if packet_type.clock != clock:
            return []
        try:
            events = self._read_status(packets)
            readings = clock_ns(packet_type.timed_sensor, packets.batch())
        except Exception as error:  # the plugin's functions
            packets.stats.count_error(PluginError.of(error, "clock"), len(packets))
            return []
        known = packets.host_ns > 0
        had_date = self._has_date
        self._device_ns = packets.time_ns.item(-1)
        if clock.reference is not None and self._has_date and not had_date:
            # The first date is added to the times by lidarspec; the sensor's clock does not step.
            self._estimate.forget_offset()
            self._forget_delays()
            self.samples.clear()
            known &= packets.time_ns >= FIRST_DATE_NS
        if known.any():
            for piece in split_runs(packets.host_ns[known] // PIECE_NS):
                which = np.flatnonzero(known)[piece]
                jumps = self._observe(
                    packets.time_ns[which], packets.host_ns[which], readings[which]
                )
                events += [self._name_jump(jump) for jump in jumps]
        self._events.extend(events)
        return events

    def report(self) -> ClockReport:
        """Return the findings so far."""
        offset_s = error_s = drift_ppm = jitter_ms = math.nan
        if self._pieces:
            offset_s = self._offset_s
            error_s = self._find_error_s()
        if self._estimate.is_settled:
            drift_ppm = self._estimate.drift_ppm
        if len(self._delays):
            jitter_ms = self._find_jitter_ms()
        state = self._state
        faults = tuple(event for event in self._events if event.is_fault)
        findings = sorted((*self._judge(), *faults), key=_rank)
        if findings[0].is_fault:
            findings = [finding for finding in findings if finding.code != "ok"]
        return ClockReport(
            epoch=self._epoch,
            state="" if state is None else state.meaning,
            locked=None if state is None else state.locked,
            offset_s=offset_s,
            error_s=error_s,
            drift_ppm=drift_ppm,
            jitter_ms=jitter_ms,
            packets=self._packets,
            late=self._late,
            jumps=self._estimate.jumps,
            findings=tuple(findings),
            events=tuple(self._events),
        )

    @property
    def _offset_s(self) -> float:
        """The sensor's time minus the host's, s."""
        return -self._estimate.offset_ns / 1e9

    def _find_jitter_ms(self) -> float:
        """Return the 95th percentile of the delays of the newest packets, ms."""
        return float(np.percentile(self._delays, JITTER_PERCENTILE)) / 1e6

    @property
    def _epoch(self) -> str:
        """The epoch that the sensor declares for the current state of the clock."""
        if self._clock is None:
            return ""
        return self._clock.epoch_at(self._device_ns, self._state)

    @property
    def _has_date(self) -> bool:
        return self._device_ns >= FIRST_DATE_NS

    def _read_status(self, packets: Packets) -> list[ClockFinding]:
        """Return the changes of the clock's status as events, and store the last status."""
        clock = self._clock
        assert clock is not None
        if clock.status is None:
            return []
        values = read_clock_status(packets)
        events = []
        for row in _find_changes(values, self._status):
            before = self._state
            self._status = values.item(row)
            self._state = clock.status.state_of(self._status)
            if before is None:
                continue  # a state from the start is no change
            code = "state_changed"
            if before.locked and not self._state.locked:
                code = "lock_lost"
            elif self._state.locked and not before.locked:
                code = "lock_gained"
            host_ns = packets.host_ns.item(row)
            events.append(ClockFinding(code, host_ns, state=self._state.meaning))
        return events

    def _observe(self, device: Integers, host: Integers, readings: Integers) -> list[ClockJump]:
        """Update the estimate with consecutive packets, and return the clock's jumps."""
        jumps = self._estimate.observe(device, host)
        if jumps:
            self._forget_delays()
        delays = self._estimate.delays_above_line(device, host)
        self._late_uncertain += int(np.count_nonzero(delays > LATE_NS))
        if not self._estimate.is_uncertain:
            self._late += self._late_uncertain
            self._late_uncertain = 0
            self._delays = np.concatenate([self._delays, delays])[-KEPT_DELAYS:]
        self._readings.append((host.item(0), readings.item(0)))
        self._host_ns = host.item(-1)
        self._pieces += 1
        if len(self._delays) and (
            not self.samples or self._host_ns - self.samples[-1].host_ns >= SAMPLE_NS
        ):
            sample = OffsetSample(self._host_ns, self._offset_s, self._find_jitter_ms())
            self.samples.append(sample)
        return jumps

    def _forget_delays(self) -> None:
        """Forget the delays of packets, because the offset of the clock has changed."""
        self._delays = self._delays[:0]
        self._late_uncertain = 0

    def _name_jump(self, jump: ClockJump) -> ClockFinding:
        """Return the event that caused a jump of the clock."""
        change_s = jump.change_ns / 1e9
        event = ClockFinding("jump", jump.host_ns, change_s)
        if self._has_restarted(jump):
            return replace(event, code="restart")
        if abs(abs(change_s) - 1) < STEP_TOLERANCE_S:
            if _is_at_month_end(jump.host_ns):
                return replace(event, code="leap_second")
            return replace(event, code="second_step")
        return event

    def _has_restarted(self, jump: ClockJump) -> bool:
        """Return whether a jump shows a restart of the sensor."""
        # After a restart, the clock begins at about 0, or at an old date.
        if jump.change_ns < -DAY_S * 1e9:
            return True
        around = [
            reading for host, reading in self._readings if abs(host - jump.host_ns) <= 2 * PIECE_NS
        ]
        clock = self._clock
        assert clock is not None
        limit_ns = RESTART_LIMIT_S * 1e9
        wrap_ns = math.inf if clock.wraps_at is None else clock.wraps_at * 1e9 - limit_ns
        return any(
            after < limit_ns and after < before < wrap_ns for before, after in pairwise(around)
        )

    def _find_error_s(self) -> float:
        """Return the offset minus the expected offset, s; nan if the clock has no date."""
        epoch = self._epoch
        if epoch == "hour":
            return (self._offset_s + HOUR_S / 2) % HOUR_S - HOUR_S / 2
        if epoch == "boot" or not self._has_date:
            return math.nan
        return self._offset_s - self._offsets_by_scale.get(epoch, 0)

    @property
    def _offsets_by_scale(self) -> dict[str, int]:
        """The seconds by which each time scale is currently ahead of UTC."""
        return read_leap_seconds().offsets_by_scale(self._host_ns / 1e9)

    def _judge(self) -> Iterator[ClockFinding]:
        """Yield one or more findings about the current state of the clock."""
        if self._clock is None:
            yield ClockFinding("no_clock")
            return
        state = self._state
        epoch = self._epoch
        if state is not None and state.locked is False:
            yield ClockFinding("not_locked", state=state.meaning)
        if self._pieces == 0:
            yield ClockFinding("no_arrival_times" if self._packets else "too_short")
            return
        if self._estimate.is_settled and abs(self._estimate.drift_ppm) > self._drift_limit_ppm:
            yield ClockFinding("drift", value=self._estimate.drift_ppm)
        offset = self._judge_offset(epoch)
        if offset is not None:
            yield offset
        elif epoch == "boot" or (not epoch and not self._has_date):
            yield ClockFinding("free_running")
        elif epoch != "hour" and not self._has_date:
            yield ClockFinding("unsynchronized", epoch=epoch)
        elif self._pieces < MIN_PIECES:
            yield ClockFinding("too_short")
        else:
            yield ClockFinding("ok")

    def _judge_offset(self, epoch: str) -> ClockFinding | None:
        """Return the finding about the offset of the clock; None if there is none."""
        error_s = self._find_error_s()
        if math.isnan(error_s) or abs(error_s) < OFFSET_LIMIT_S:
            return None
        scales = self._offsets_by_scale
        ahead_s = error_s + scales.get(epoch, 0)
        for scale, seconds in scales.items():
            if scale != epoch and abs(ahead_s - seconds) < SCALE_TOLERANCE_S:
                if scale == "utc" and not epoch:
                    return None
                return ClockFinding(scale, value=ahead_s, epoch=epoch)
        if abs(ahead_s + scales["tai"]) < SCALE_TOLERANCE_S:
            return ClockFinding("behind_utc", value=ahead_s)
        if abs(abs(error_s) - 1) < SCALE_TOLERANCE_S:
            return ClockFinding("second_off", value=error_s)
        if abs(error_s) > WRONG_DATE_S:
            return ClockFinding("wrong_date", value=error_s)
        return ClockFinding("offset", value=error_s)


def _find_main_clock(sensor: SensorDescription) -> Clock | None:
    """Return the sensor's clock, or else that of the first frame type with a clock."""
    if sensor.clock is not None:
        return sensor.clock
    clocks = (sensor.frames[name].clock for name in sensor.main_frames)
    return next((clock for clock in clocks if clock is not None), None)


def _find_changes(values: NDArray[np.float64], before: float) -> list[int]:
    """Return the rows whose value differs from the previous value; nan is ignored."""
    known = np.flatnonzero(~np.isnan(values))
    previous = np.concatenate([[before], values[known][:-1]])
    rows: list[int] = known[values[known] != previous].tolist()
    return rows


def _is_at_month_end(host_ns: int) -> bool:
    """Return whether a time is near the end of a month in UTC."""
    # Leap seconds are inserted at the end of a month.
    moment = np.datetime64(host_ns, "ns")
    nearest_day = (moment + np.timedelta64(DAY_S // 2, "s")).astype("datetime64[D]")
    is_first = nearest_day == nearest_day.astype("datetime64[M]")
    distance_s = abs((moment - nearest_day) / np.timedelta64(1, "s"))
    return bool(is_first and distance_s < LEAP_LIMIT_S)


def _rank(finding: ClockFinding) -> tuple[int, int]:
    """Return the key by which findings are sorted: severity, then time."""
    return finding.severity, finding.host_ns
