"""Describe a sensor's clock as text: its epoch, state, drift and offset."""

from __future__ import annotations

import math
from collections.abc import Iterator

from lidarspec.packets.clock_monitor import ClockReport
from lidarspec.scans.selection import format_date
from lidarspec.spec.timing import DATED_EPOCHS, EPOCHS


def iter_clock_rows(report: ClockReport) -> Iterator[tuple[str, str]]:
    """Yield (label, text) for each line about a clock."""
    yield "time", describe_time_source(report)
    if not math.isnan(report.offset_s):
        yield "offset", describe_offset(report)
    if not math.isnan(report.drift_ppm):
        yield "drift", f"{report.drift_ppm:+.1f} ppm"
    if not math.isnan(report.jitter_ms):
        late = f"{report.late} of {report.packets} packets late"
        yield "jitter", f"{report.jitter_ms:.2f} ms, {late}"
    for event in report.events:
        moment = f"{format_date(event.host_ns)} " if event.host_ns else ""
        yield "event", f"{moment}{event.text}"
    yield "verdict", report.verdict.text
    if report.verdict.advice:
        yield "next", report.verdict.advice


def describe_time_source(report: ClockReport) -> str:
    """Return a text with the epoch and the state of a clock."""
    counted = _describe_epoch(report)
    if report.state:
        return f"{counted}; {report.state}"
    return counted


def _describe_epoch(report: ClockReport) -> str:
    if not report.epoch:
        return "the epoch of the clock is not documented"
    return EPOCHS[report.epoch]


def describe_offset(report: ClockReport) -> str:
    """Return a text with the offset from the host's clock."""
    if math.isnan(report.error_s):
        reason = "the sensor's clock starts at an arbitrary time"
        if report.epoch in DATED_EPOCHS:
            reason = "the sensor's clock has no valid date"
        return f"{report.offset_s:+.3f} s from the host's clock; {reason}"
    text = f"{report.error_s * 1e3:+.2f} ms"
    if abs(report.error_s) >= 1:
        text = f"{report.error_s:+.3f} s"
    return f"{text} from the host's clock"


def describe_clock(report: ClockReport) -> str:
    """Return the description of a clock in one line."""
    parts = [describe_time_source(report)]
    if report.verdict.code == "not_locked":
        parts = [_describe_epoch(report)]  # the verdict names the state
    # the texts of these verdicts contain the offset
    if not math.isnan(report.error_s) and report.verdict.code not in ("offset", "second_off"):
        parts.append(describe_offset(report))
    if not math.isnan(report.drift_ppm):
        parts.append(f"{report.drift_ppm:+.1f} ppm")
    if report.verdict.is_fault:
        parts.append(report.verdict.text)
    return ", ".join(parts)
