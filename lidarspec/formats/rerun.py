"""Write Rerun recordings, .rrd: scans as coloured points, with statistics.

The data is on two timelines: the sensor's clock and the host's clock. The entity paths of a sensor
begin with its id, so that recordings of several sensors can be opened together.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.formats.common import select_columns
from lidarspec.optional_libraries import import_library
from lidarspec.points.appearance import RAMP_STEPS, CloudAppearance, choose_appearance, ramp_indices
from lidarspec.points.cloud import PointCloud
from lidarspec.points.colours import make_ramp
from lidarspec.scans.scan import Scan
from lidarspec.transports.protocol import Format

#: The radius of a point in the viewer, pixels.
POINT_RADIUS_PX = 1.5
#: The length of the drawn axes of a sensor, metres.
AXIS_LENGTH_M = 0.3
#: The number of points after which the data is flushed, to limit the memory use.
FLUSH_POINTS = 1 << 13
#: The maximum number of bytes per read of a pipe.
MAX_PIPE_READ_BYTES = 1 << 16
#: The names of the timelines: for the time of the sensor's clock, the arrival time, and the number
#: of the scan.
SENSOR_TIMELINE = "sensor_time"
HOST_TIMELINE = "host_time"
NUMBER_TIMELINE = "scan"


class RerunRecording:
    """One Rerun recording, a context manager.

    `save` writes the data to a file. `spawn` and `connect_grpc` of the attribute `stream` send the
    data to a viewer.

    Args:
        ramp: the column whose values the colours show: "range", "intensity" or an additional
            column.

    Raises:
        UsageError: if the Rerun SDK is not installed.
    """

    def __init__(self, ramp: str = "range") -> None:
        self._rerun = import_library("rerun", "rerun")
        self.stream = self._rerun.RecordingStream("lidarspec", send_properties=False)
        self.stream.set_log_time_enabled(False)  # the log time is not the time of measurement
        self.stream.set_log_tick_enabled(False)
        self._ramp = ramp
        self._colours = _Colours()
        self._number = 0
        self._home = ""
        self._waiting = 0
        self._copy: _PipeCopy | None = None

    def __enter__(self) -> RerunRecording:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if not isinstance(error, OSError):  # an interrupted recording has to be complete
                self.flush()
        finally:
            self.stream.disconnect()
            if self._copy is not None:
                self._copy.join()
        if self._copy is not None and self._copy.failure is not None and error is None:
            raise self._copy.failure

    def save(self, path: str | Path) -> None:
        """Write the recording to a file.

        Raises:
            OSError: if the file cannot be written.
        """
        if os.name != "posix":
            with _translate_errors():
                self.stream.save(path)
            return
        self._copy = _PipeCopy(path)
        self._copy.start()
        with _translate_errors(), os.fdopen(self._copy.end, "wb"):
            self.stream.save(f"/dev/fd/{self._copy.end}")

    def log_scan(self, scan: Scan, *, every_point: bool = False) -> None:
        """Log a scan, and before the first scan the facts about its sensor.

        Raises:
            OSError: if the recording cannot be written.
        """
        is_first = not self._home
        if is_first:
            self._begin(scan)
        self._set_times(scan)
        names = (
            "x",
            "y",
            "z",
            "intensity",
            "ring",
            "return_index",
            "range",
            "time",
            *scan.points.extra,
        )
        columns = select_columns(scan, names, every_point=every_point)
        positions = np.stack([columns.pop(name) for name in "xyz"], axis=-1)
        if every_point:
            shown = scan.points
        else:
            shown = scan.points[scan.points.valid]
        points = self._rerun.Points3D(
            positions,
            colors=self._colours(shown, self._ramp),
            radii=self._rerun.Radius.ui_points(POINT_RADIUS_PX),
        )
        self.stream.log(f"{self._home}/points", points, self._rerun.AnyValues(**columns))
        self._waiting += len(positions)
        if self._waiting >= FLUSH_POINTS:
            self.flush()
        self.log_statistics(
            {"points": len(scan), "valid": int(scan.points.valid.sum()), "speed_hz": scan.rate_hz}
        )
        if is_first:  # the layout refers to a timeline, which has to exist
            self.stream.send_blueprint(self._make_layout())

    def log_statistics(self, statistics: Mapping[str, float | None]) -> None:
        """Log statistics by name at the time of the last scan.

        Values that are None or not finite are omitted.
        """
        for name, value in statistics.items():
            if value is not None and np.isfinite(value):
                self.stream.log(
                    f"{self._home}/statistics/{name}", self._rerun.Scalars(float(value))
                )

    def flush(self) -> None:
        """Wait until the logged data is written.

        Raises:
            OSError: if the recording cannot be written.
        """
        self._waiting = 0
        with _translate_errors():
            self.stream.flush()
        if self._copy is not None and self._copy.failure is not None:
            raise self._copy.failure

    def _begin(self, scan: Scan) -> None:
        self._home = f"/{scan.sensor.id}"
        rerun = self._rerun
        self.stream.send_recording_name(scan.sensor.id)
        self.stream.log("/", rerun.ViewCoordinates.FLU, static=True)
        mount = scan.mount
        if mount:
            turn = {"translation": (mount.x, mount.y, mount.z), "mat3x3": mount.rotation}
        else:
            turn = {"translation": (0, 0, 0)}
        self.stream.log(
            f"{self._home}/sensor",
            rerun.Transform3D(**turn),
            rerun.TransformAxes3D(AXIS_LENGTH_M),
            static=True,
        )
        facts = {
            "model": f"{scan.sensor.vendor} {scan.sensor.model}",
            **scan.facts,
            "mount": str(mount or "none"),
        }
        units = {f"unit of {name}": unit for name, unit in scan.points.units.items() if unit}
        text = "\n".join(f"{name}: {value}" for name, value in {**facts, **units}.items())
        self.stream.log(f"{self._home}/about", rerun.TextDocument(text), static=True)

    def _set_times(self, scan: Scan) -> None:
        self.stream.set_time(NUMBER_TIMELINE, sequence=self._number)
        self._number += 1
        self.stream.set_time(SENSOR_TIMELINE, timestamp=np.datetime64(scan.stamp_ns, "ns"))
        if scan.host_ns:
            self.stream.set_time(HOST_TIMELINE, timestamp=np.datetime64(scan.host_ns, "ns"))

    def _make_layout(self) -> Any:
        """Return the layout of the viewer: points, statistics and facts."""
        views = import_library("rerun.blueprint", "rerun")
        plots = [
            views.TimeSeriesView(
                origin=f"{self._home}/statistics", contents=f"$origin/{name}", name=name
            )
            for name in ("speed_hz", "valid")
        ]
        facts = views.TextDocumentView(origin=f"{self._home}/about", name="about")
        side = views.Vertical(*plots, facts)
        window = views.Horizontal(
            views.Spatial3DView(origin="/", name=self._home[1:]), side, column_shares=[3, 1]
        )
        return views.Blueprint(
            window,
            views.TimePanel(timeline=SENSOR_TIMELINE, state="collapsed"),
            collapse_panels=True,
        )


class _PipeCopy(threading.Thread):
    """Copies the output of the Rerun SDK from a pipe to a file.

    The SDK may wait forever if it writes the file itself and the disk is full.

    Attributes:
        end: the file descriptor to which the SDK writes.
        failure: the error that ended the writing of the file, or None.
    """

    def __init__(self, path: str | Path) -> None:
        super().__init__(name="rerun", daemon=True)
        self._file = open(path, "wb")  # noqa: SIM115 -- `run` closes it
        self._begin, self.end = os.pipe()
        self.failure: OSError | None = None

    def run(self) -> None:
        """Copy data until the other end of the pipe is closed."""
        with open(self._begin, "rb", buffering=0) as pipe:
            try:
                with self._file:
                    while data := pipe.read(MAX_PIPE_READ_BYTES):
                        self._file.write(data)
            except OSError as error:
                self.failure = error
            while pipe.read(MAX_PIPE_READ_BYTES):  # the SDK must not block
                pass


@contextlib.contextmanager
def _translate_errors() -> Iterator[None]:
    """Convert errors of the Rerun SDK to OSError."""
    try:
        yield
    except RuntimeError as error:
        raise OSError(f"Rerun: {error}") from error


class _Colours:
    """The colours of points; the first cloud with points sets the scale for all."""

    def __init__(self) -> None:
        self._look: CloudAppearance | None = None

    def __call__(self, cloud: PointCloud, ramp: str) -> NDArray[np.uint8]:
        """Return the red, green and blue of points, (n, 3)."""
        shown = self._look or choose_appearance(cloud, ramp=ramp)
        if len(cloud):  # an empty cloud has no scale
            self._look = shown
        colours = np.array(make_ramp("dark", RAMP_STEPS), np.uint8)  # the viewer is dark
        return colours[ramp_indices(cloud, shown)]


def write_rerun(path: Path, scans: Iterable[Scan], *, every_point: bool) -> None:
    """Write a Rerun recording."""
    with RerunRecording() as log:
        log.save(path)
        for scan in scans:
            log.log_scan(scan, every_point=every_point)


RERUN = Format(".rrd", "a recording for Rerun's viewer", write_rerun)
