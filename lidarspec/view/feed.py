"""What a device delivers, taken in between two pictures or two lines of figures: the newest scan
kept, and everything counted.

`Meter` says how the sensor is doing: speed, rates, losses and jitter over the last moments, and
over everything.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.device.arrivals import BATCH_BYTES
from lidarspec.device.device import Device
from lidarspec.framing.results import Counters
from lidarspec.packets.packets import Packets
from lidarspec.scans.scans import Scan, ScanStream
from lidarspec.scans.selection import Selection, Sieve, Slice

#: scans kept for means and medians.
KEPT = 1 << 12
Seconds = NDArray[np.float64]
#: seconds from scan to scan of a file where their times do not say it, and the longest pause that
#: is kept.
STEP, LONGEST = 0.1, 2.0
#: seconds that one look at a live source waits for data.
LOOK = 0.04
#: seconds of a file that is played that are read at once, and bytes of it at first.
AHEAD, PORTION = 0.1, 1 << 12


@dataclass(frozen=True)
class Reading:
    """Figures over some time; None where they are not known.

    Attributes:
        seconds: how long that was.
        speed_hz: scans a second, by their own times.
        scans, packets: how many there were; scans are whole ones.
        packet_rate_hz: packets a second.
        points, valid: points per scan, and those with a return among them.
        error_rate: frames whose checksum, length or values were wrong, of all, from 0 to 1.
        skipped_rate: bytes that are in no frame and no declared filler, of all.
        loss_rate: packets that are missing by the sensor's counter or clock, of all; None where it
            has neither.
        jitter_s: standard deviation of the time between packets' arrivals.
        longest_gap_s: the longest time between two arrivals.
        bytes_per_s: of input.
    """

    seconds: float | None
    speed_hz: float | None
    scans: int
    packets: int
    packet_rate_hz: float | None
    points: float | None
    valid: float | None
    error_rate: float
    skipped_rate: float
    loss_rate: float | None
    jitter_s: float | None
    longest_gap_s: float | None
    bytes_per_s: float | None

    def to_dict(self) -> dict[str, Any]:
        """The figures by name."""
        return asdict(self)


NOTHING = Reading(None, None, 0, 0, None, None, None, 0.0, 0.0, None, None, None, None)


class Tally:
    """What came since some moment."""

    def __init__(self, counters: Counters) -> None:
        self._before = totals(counters)
        self.scans = self.packets = 0
        self._rates: deque[float] = deque(maxlen=KEPT)
        self._sizes: deque[tuple[int, int]] = deque(maxlen=KEPT)
        self._gaps, self._spanned, self._squares, self._longest = 0, 0.0, 0.0, 0.0
        self._by_host = True

    def arrived(self, number: int, gaps: Seconds, *, by_host: bool) -> None:
        """Count packets, and the seconds from each to the next, (n,), by their arrival or else by
        the sensor's clock.
        """
        self.packets += number
        self._by_host = by_host
        if len(gaps):
            self._gaps += len(gaps)
            self._spanned += float(gaps.sum())
            self._squares += float(np.square(gaps).sum())
            self._longest = max(self._longest, float(gaps.max()))

    def turned(self, points: int, valid: int, rate_hz: float) -> None:
        """Count a whole scan."""
        self.scans += 1
        self._sizes.append((points, valid))
        if np.isfinite(rate_hz):
            self._rates.append(rate_hz)

    def reading(self, counters: Counters, *, seconds: float | None, counts_losses: bool) -> Reading:
        """The figures up to now.

        Args:
            counters: now.
            seconds: how long it was by the caller's clock; taken from the arrivals where it is left
                out.
            counts_losses: whether lost packets are counted (`Sensor.counts_losses`).
        """
        spanned = self._spanned or None
        lasted = seconds or spanned
        change = {name: value - self._before[name] for name, value in totals(counters).items()}
        mean = self._spanned / self._gaps if self._gaps else 0.0
        return Reading(
            seconds=lasted,
            speed_hz=float(np.median(self._rates)) if self._rates else None,
            scans=self.scans,
            packets=self.packets,
            packet_rate_hz=self._gaps / spanned
            if spanned
            else self.packets / lasted
            if lasted
            else None,
            points=_mean([size for size, _ in self._sizes]),
            valid=_mean([valid for _, valid in self._sizes]),
            error_rate=_share(change["rejected"], change["frames"]),
            skipped_rate=_share(change["skipped"], change["bytes_in"] - change["skipped"]),
            loss_rate=_share(change["lost"], self.packets) if counts_losses else None,
            jitter_s=math.sqrt(max(self._squares / self._gaps - mean * mean, 0.0))
            if spanned and self._by_host
            else None,
            longest_gap_s=self._longest if spanned and self._by_host else None,
            bytes_per_s=change["bytes_in"] / lasted if lasted else None,
        )


class Meter:
    """Counts packets and scans as they come: since the last reading, and all of them."""

    def __init__(self, counters: Counters, *, counts_losses: bool) -> None:
        self._counts_losses = counts_losses
        self._last: int | None = None
        self._recent, self._all = Tally(counters), Tally(counters)

    def packets(self, packets: Packets) -> None:
        """Count a batch."""
        known = packets.host_ns[packets.host_ns > 0]
        times = known if len(known) else packets.time_ns
        edge = [] if self._last is None else [self._last]
        gaps = np.diff(np.concatenate([np.array(edge, np.int64), times])) * 1e-9
        self._last = int(times[-1]) if len(times) else self._last
        for tally in (self._recent, self._all):
            tally.arrived(len(packets), gaps, by_host=len(known) > 0)

    def scan(self, scan: Scan) -> None:
        """Count a whole scan; a piece of one says nothing of speed and points."""
        if scan.whole:
            valid = int(scan.points.valid.sum())
            for tally in (self._recent, self._all):
                tally.turned(len(scan), valid, scan.rate_hz)

    def reading(self, counters: Counters, seconds: float | None = None) -> Reading:
        """The figures since the reading before this; then it starts anew."""
        found = self._recent.reading(counters, seconds=seconds, counts_losses=self._counts_losses)
        self._recent = Tally(counters)
        return found

    def summary(self, counters: Counters, seconds: float | None = None) -> Reading:
        """The figures of everything."""
        return self._all.reading(counters, seconds=seconds, counts_losses=self._counts_losses)


def totals(counters: Counters) -> dict[str, int]:
    """What the rates of a reading are made of."""
    return {
        "bytes_in": counters.bytes_in,
        "frames": sum(counters.frames.values()),
        "rejected": counters.bad_checksum
        + counters.bad_length
        + counters.bad_constant
        + counters.implausible,
        "skipped": counters.bytes_skipped - counters.bytes_filler,
        "lost": counters.lost,
    }


def told(value: float | None, form: str, times: float = 1) -> str:
    """A figure as text, times a factor; "-" where it is not known."""
    return "-" if value is None or not math.isfinite(value) else form.format(value * times)


def _share(some: int, others: int) -> float:
    return some / (some + others) if some + others > 0 else 0.0


def _mean(values: Sequence[int]) -> float | None:
    return float(np.mean(values)) if values else None


class Feed:
    """The scans of an open device.

    Args:
        device: open; stays so.
        played: scans of a file come at the times that they bear; else as fast as they are read.
        speed: how many times faster than that; may be set while it plays.
        select: which scans, and what of each; packets at these times.
        ahead: seconds of a file that is played that are read at once, so that figures and bytes are
            those of what is seen; None: as much as is decoded quickest.

    Attributes:
        packets: the batch that the last look took in, None where it took none.
        scans: the scans, and pieces of one, that the last `pump` gave.
        scan: the newest one; the first piece stands in until there is a whole one.
        number: how many scans have come.
        ended: whether the input has.
        meter: the figures.
    """

    def __init__(
        self,
        device: Device,
        *,
        played: bool = False,
        speed: float = 1.0,
        select: Selection | None = None,
        ahead: float | None = AHEAD,
    ) -> None:
        self.device, self.number, self.speed = device, 0, speed
        self._select = select or Selection()
        self._sieve, self._slice = (
            Sieve(self._select, device.source, device.skip),
            Slice(self._select.times),
        )
        self.scan: Scan | None = None
        self.packets: Packets | None = None
        self.scans: list[Scan] = []
        self.meter = self._meter()
        self._played = played and not device.is_live
        self._batches, self._stream = (
            device.packets(wait=LOOK),
            ScanStream(device.sensor, device.mount),
        )
        self._waiting: deque[Scan] = deque()
        self._disconnects, self._read_out, self._metered = 0, False, False
        self._due: float | None = None
        self._stamp, self._portion, self._ahead = 0, PORTION, ahead if self._played else None
        if self._ahead is not None:
            device.read_ahead(PORTION)

    @property
    def ended(self) -> bool:
        """Whether everything was taken in."""
        return self._read_out and not self._waiting

    def pump(self, until: float) -> None:
        """Take in what comes until a time of `time.monotonic`, or the end; at least one look.

        Raises:
            LidarSpecError: where the source fails.
        """
        self.scans = []
        while not self.ended:
            if self._waiting:
                self._show_due(until)
            else:
                self._take()
            if time.monotonic() >= until:
                return

    def step(self) -> None:
        """Show the next scan of a file that is played, whenever it is due; none where that has
        ended.

        Raises:
            LidarSpecError: where the source fails.
        """
        self.scans, number = [], self.number
        while self.number == number and not self.ended:
            if self._waiting:
                self._stamp = self._waiting[0].stamp_ns
                self._show(self._waiting.popleft())
            else:
                self._take()
        self.rest()

    def rest(self) -> None:
        """Let the time of a file stand still; call it while the picture does."""
        self._due = None

    def _take(self) -> None:
        """The next batch, or the end."""
        before = self._meter() if not self._metered else self.meter
        self.packets = packets = None if self._sieve.ended else next(self._batches, None)
        if packets is None:
            self._read_out = True
            self._keep([] if self._sieve.ended else self._stream.finish())
            if self._sieve.is_empty:
                raise self._sieve.missing()
            return
        if self.device.stats.disconnects != self._disconnects:
            self._disconnects = self.device.stats.disconnects
            self._keep(self._stream.finish())
            self._stream = ScanStream(self.device.sensor, self.device.mount)
        if len(packets):
            self.packets = counted = self._within(packets)
            if len(counted):
                self.meter, self._metered = before, True
                self.meter.packets(counted)
            self._keep(self._stream.add(packets))
            if self._ahead is not None:
                self._pace((int(packets.time_ns[-1]) - int(packets.time_ns[0])) * 1e-9, self._ahead)

    def _pace(self, seconds: float, ahead: float) -> None:
        """Read about as much of a file at once as is shown in a moment; `seconds`: what was read
        lasted so long.
        """
        portion = self._portion
        if seconds < ahead / 2 and portion < BATCH_BYTES:
            self._portion *= 2
        elif seconds > ahead and portion > PORTION:
            self._portion //= 2
        if self._portion != portion:
            self.device.read_ahead(self._portion)

    def _meter(self) -> Meter:
        """One that counts from here on."""
        sensor = self.device.sensor
        return Meter(self.device.stats, counts_losses=sensor.counts_losses)

    def _within(self, packets: Packets) -> Packets:
        """Those of some packets that are wanted by their times."""
        if not self._select.is_timed:
            return packets
        which = self._slice.holds(
            packets.host_ns if self._select.time == "host" else packets.time_ns
        )
        return packets if which.all() else packets.take(which)

    def _keep(self, scans: list[Scan]) -> None:
        scans = [
            wanted
            for scan in scans
            if not self._sieve.ended and (wanted := self._sieve.take(scan)) is not None
        ]
        if self._played:
            self._waiting += scans
        else:
            for scan in scans:
                self._show(scan)

    def _show(self, scan: Scan) -> None:
        self.meter.scan(scan)
        self.scans.append(scan)
        if scan.whole or self.scan is None or not self.scan.whole:
            self.scan = scan
            self.number += 1

    def _show_due(self, until: float) -> None:
        """The next scan of a file when it is due: as long after the one before as its time says."""
        scan = self._waiting[0]
        if self._due is None:
            self._due = time.monotonic()
        else:
            step = (scan.stamp_ns - self._stamp) * 1e-9
            due = max(
                self._due + (step if 0 < step <= LONGEST else STEP) / self.speed,
                time.monotonic() - LONGEST,
            )
            if due > until:
                time.sleep(max(until - time.monotonic(), 0.0))
                return
            time.sleep(max(due - time.monotonic(), 0.0))
            self._due = due
        self._stamp = scan.stamp_ns
        self._show(self._waiting.popleft())
