"""Show live scans in the Rerun viewer, or write them to a Rerun recording."""

from __future__ import annotations

import os
import sys
import time

from lidarspec.errors import UsageError, suggest, system_errors
from lidarspec.formats.rerun import RerunRecording
from lidarspec.view.live_scans import LOOK_S, LiveScans

#: time between two readings of the statistics, by the stamps of the scans.
STATISTICS_PERIOD_S = 1.0
#: attributes of `MeterReading` to send. Statistics of a scan are sent with the scan.
STATISTICS = (
    "packet_rate_hz",
    "error_rate",
    "skipped_rate",
    "loss_rate",
    "jitter_s",
    "bytes_per_s",
)
#: URL schemes of a running viewer.
SCHEMES = ("rerun://", "rerun+http://", "rerun+https://")


def show(live: LiveScans, target: str, *, ramp: str = "range", until: float) -> None:
    """Send scans and statistics to a Rerun viewer or file as soon as they arrive.

    Returns at the end of the input, or at the time `until`.

    Args:
        live: the scans of the open device.
        target: a file to write, the URL of a running viewer, or "" to open a viewer.
        ramp: the column of the points that determines their colours.
        until: a time of `time.monotonic` at which to return.

    Raises:
        UsageError: if no viewer can be opened, or the Rerun SDK is not installed.
        SourceError: if the file cannot be written.
    """
    with system_errors(target or "Rerun's viewer"), RerunRecording(ramp) as log:
        _open(log, target)
        read_at = time.monotonic()
        last = None
        while not live.ended and time.monotonic() < until:
            live.read(time.monotonic() + LOOK_S)
            for scan in live.scans:
                log.log_scan(scan)
                if last is None or not 0 <= scan.stamp_ns - last < STATISTICS_PERIOD_S * 1e9:
                    now = time.monotonic()
                    is_live = live.device.is_live
                    reading = live.meter.take_reading(
                        live.device.stats, now - read_at if is_live else None
                    )
                    log.log_statistics({name: getattr(reading, name) for name in STATISTICS})
                    read_at = now
                    last = scan.stamp_ns


def _open(log: RerunRecording, target: str) -> None:
    if target.startswith(SCHEMES):
        log.stream.connect_grpc(target)
    elif target:
        log.save(target)
    elif sys.platform == "linux" and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        raise suggest(
            UsageError("Rerun's viewer requires a display"),
            "lidarspec view SOURCE --rerun -o scans.rrd",
        )
    else:
        try:
            log.stream.spawn(hide_welcome_screen=True)
        except Exception as error:
            raise suggest(
                UsageError(f"Rerun's viewer cannot be opened: {error}"),
                "lidarspec view SOURCE --rerun -o scans.rrd",
            ) from error
