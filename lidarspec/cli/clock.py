"""`clock`: diagnose the clocks of sensors."""

from __future__ import annotations

import contextlib
import json
import math
import time
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import click

from lidarspec.cli.failures import FINDINGS
from lidarspec.cli.inputs import FirstFrameTimeout, make_no_scan_error, report_outcome
from lidarspec.cli.options import DURATION, sensor_option
from lidarspec.cli.terminal import say
from lidarspec.detect.doctor import Diagnosis
from lidarspec.device.device import Device, open as open_device
from lidarspec.errors import LidarSpecError
from lidarspec.explaining.clock_text import describe_clock, iter_clock_rows
from lidarspec.packets.clock_monitor import DRIFT_LIMIT_PPM, ClockMonitor, ClockReport
from lidarspec.packets.packets import Packets
from lidarspec.sensor_operations import Sensor
from lidarspec.view.live_scans import LOOK_S

#: Codes of findings that say that nothing synchronizes a clock.
UNSYNCHRONIZED_CODES = ("not_locked", "unsynchronized", "wrong_date")
DEFAULT_DURATION_S = 12.0  # the drift is known after ten seconds


class SourceClock:
    """The clock of one open source.

    Args:
        device: the open device; it is not closed.
        source: the SOURCE, as the user has written it.
        drift_limit_ppm: the drift above which the clock is reported as faulty.

    Attributes:
        ended: whether the input has ended.
    """

    def __init__(self, device: Device, source: str, drift_limit_ppm: float) -> None:
        self.device = device
        self.source = source
        self.ended = False
        self._monitor = ClockMonitor(device.sensor, drift_limit_ppm=drift_limit_ppm)
        self._timeout = FirstFrameTimeout(device, source)
        self._batches = _iter_batches(device)

    def read(self) -> None:
        """Read the data that has arrived, or the next part of a file.

        Raises:
            LidarSpecError: if the source fails, or sends no frame for too long.
        """
        batch = next(self._batches, None)
        if batch is None:
            self.ended = True
            return
        for packets in batch:
            self._monitor.add(packets)
        self._timeout.check()

    def report(self) -> ClockReport:
        """Return the findings about the clock so far.

        Raises:
            LidarSpecError: if no packet has arrived.
        """
        report = self._monitor.report()
        if not report.packets:
            raise make_no_scan_error(self.device, self.source)
        return report


@click.command()
@click.argument("sources", metavar="SOURCE...", nargs=-1, required=True)
@sensor_option
@click.option(
    "-t",
    "--duration",
    type=DURATION,
    help=f"Stop after this time. [default: {DEFAULT_DURATION_S:g}s; for a file, at its end]",
)
@click.option(
    "--max-drift",
    type=click.FloatRange(min=0),
    default=DRIFT_LIMIT_PPM,
    show_default=True,
    metavar="PPM",
    help="Largest drift, in ppm, that is not reported as a fault.",
)
@click.option("--json", "as_json", is_flag=True, help="Print a JSON object for each source.")
def clock(
    sources: Sequence[str],
    sensor_id: str | Sensor | None,
    duration: float | None,
    max_drift: float,
    as_json: bool,
) -> None:
    """Diagnose sensor clocks: time source, synchronization, offset, drift, jumps.

    The times in the packets are compared with their arrival times. Arrival times are measured by
    the clock of this computer, or of the computer that recorded the file. Several sources are read
    at the same time, and compared with each other. The exit code is 1 if a clock is at fault.
    """
    with contextlib.ExitStack() as stack:
        clocks = [
            SourceClock(
                stack.enter_context(open_device(source, sensor_id, period=LOOK_S)),
                source,
                max_drift,
            )
            for source in sources
        ]
        with contextlib.suppress(KeyboardInterrupt):
            _read_all(clocks, duration)
        reports = [source_clock.report() for source_clock in clocks]
        for source_clock, report in zip(clocks, reports, strict=True):
            _print_report(source_clock, report, reports[0], as_json=as_json)
        for source_clock in clocks:
            report_outcome(source_clock.device)
    if any(finding.is_fault for report in reports for finding in report.findings):
        raise click.exceptions.Exit(FINDINGS)


def diagnose_clock(source: str, sensor_id: str | Sensor | None, seconds: float) -> Diagnosis | None:
    """Open a source again, and return the finding of `doctor` about its clock.

    `doctor` calls this function after it has received valid data from the source.

    Returns:
        None if the sensor sends no time, or if the source cannot be opened or read.
    """
    try:
        with open_device(source, sensor_id, start=False, period=LOOK_S) as device:
            source_clock = SourceClock(device, source, DRIFT_LIMIT_PPM)
            _read_all([source_clock], seconds)
            report = source_clock.report()
    except LidarSpecError:
        return None
    verdict = report.verdict
    if verdict.code == "no_clock":
        return None
    is_ok = not verdict.is_fault or verdict.code in UNSYNCHRONIZED_CODES
    return Diagnosis(is_ok, f"clock: {describe_clock(report)}", "" if is_ok else verdict.advice)


def _read_all(clocks: Sequence[SourceClock], duration: float | None) -> None:
    """Read all sources in turn, until the duration has passed or the input has ended."""
    began = time.monotonic()
    running = list(clocks)
    while running:
        for source_clock in running:
            source_clock.read()
        passed_s = time.monotonic() - began
        running = [
            source_clock
            for source_clock in running
            if not source_clock.ended and passed_s < _find_limit_s(source_clock, duration)
        ]


def _find_limit_s(source_clock: SourceClock, duration: float | None) -> float:
    """Return how long a source is read, in seconds."""
    if duration is not None:
        return duration
    if source_clock.device.is_live:
        return DEFAULT_DURATION_S
    return math.inf


def _iter_batches(device: Device) -> Iterator[Iterable[Packets]]:
    """Yield the packets that have a time, in batches."""
    if device.sensor.has_points:
        for packets in device.packets(wait=LOOK_S):
            yield [packets]
    else:
        for batch in device.packets_by_frame(device.sensor.main_frames, wait=LOOK_S):
            yield batch.values()


def _print_report(
    source_clock: SourceClock, report: ClockReport, first: ClockReport, *, as_json: bool
) -> None:
    """Print the findings about one clock, and its offset from the first clock."""
    mutual_s = math.nan
    if report is not first:
        mutual_s = report.error_s - first.error_s
    if as_json:
        facts: dict[str, Any] = {
            "source": source_clock.source,
            "sensor": source_clock.device.sensor.id,
            "to_first_s": None if math.isnan(mutual_s) else mutual_s,
        }
        say(json.dumps({**facts, **report.to_dict()}, allow_nan=False))
        return
    say(f"{source_clock.source}: {source_clock.device.sensor.id}")
    for label, text in iter_clock_rows(report):
        say(f"  {label:<8}  {text}")
        if label == "offset" and not math.isnan(mutual_s):
            say(f"  {'':<8}  {mutual_s * 1e3:+.2f} ms from the first source")
