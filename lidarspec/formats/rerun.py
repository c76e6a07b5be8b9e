"""Recordings of Rerun, .rrd: scans as coloured points on the sensor's and on the host's time,
figures beside them.

A `RerunRecording` is also what `view --rerun` shows in Rerun's viewer. Everything of a sensor
stands under its id, so that the recordings of several can be opened together: its points, where it
is mounted, what is known of it, and under `statistics` how it is doing.
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

from lidarspec.formats.writing import columns_of
from lidarspec.libraries import import_library
from lidarspec.points.cloud import PointCloud
from lidarspec.points.colours import make_ramp
from lidarspec.points.look import STEPS, Look, look, steps
from lidarspec.scans.scan import Scan
from lidarspec.transports.protocol import Format

#: of a point on the screen, in its viewer's pixels; and metres of the axes of a sensor.
RADIUS = 1.5
AXES = 0.3
#: points that are handed over together, which bounds what is held.
HELD = 1 << 13
#: bytes that are taken out of a pipe at once.
PIPED = 1 << 16
#: the names of the timelines: by the sensor's clock, by arrival, by number.
SENSOR = "sensor_time"
HOST = "host_time"
NUMBER = "scan"


class RerunRecording:
    """One recording, a context manager; it goes to a file (`save`), or where its `stream` is told
    to (`spawn`, `connect_grpc`).

    Args:
        ramp: what colours show, "range", "intensity" or a further column; their scale is that of
            the first scan.

    Raises:
        UsageError: where Rerun's SDK is not installed.
    """

    def __init__(self, ramp: str = "range") -> None:
        self._rerun = import_library("rerun", "rerun")
        self.stream = self._rerun.RecordingStream("lidarspec", send_properties=False)
        self.stream.set_log_time_enabled(False)  # when it was logged is not when it was measured
        self.stream.set_log_tick_enabled(False)
        self._ramp = ramp
        self._colours = _Colours()
        self._number = 0
        self._home = ""
        self._waiting = 0
        self._copy: _Copy | None = None

    def __enter__(self) -> RerunRecording:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if not isinstance(error, OSError):  # one that was stopped is whole as well
                self.flush()
        finally:
            self.stream.disconnect()
            if self._copy is not None:
                self._copy.join()
        if self._copy is not None and self._copy.failure is not None and error is None:
            raise self._copy.failure

    def save(self, path: str | Path) -> None:
        """Write it to a file.

        Raises:
            OSError: where that cannot be written.
        """
        if os.name != "posix":
            with _told():
                self.stream.save(path)
            return
        self._copy = _Copy(path)
        self._copy.start()
        with _told(), os.fdopen(self._copy.end, "wb"):
            self.stream.save(f"/dev/fd/{self._copy.end}")

    def scan(self, scan: Scan, *, every_point: bool = False) -> None:
        """Log a scan, and before the first what is known of its sensor.

        Raises:
            OSError: where it cannot be written.
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
        columns = columns_of(scan, names, every_point=every_point)
        places = np.stack([columns.pop(name) for name in "xyz"], axis=-1)
        if every_point:
            shown = scan.points
        else:
            shown = scan.points[scan.points.valid]
        points = self._rerun.Points3D(
            places,
            colors=self._colours(shown, self._ramp),
            radii=self._rerun.Radius.ui_points(RADIUS),
        )
        self.stream.log(f"{self._home}/points", points, self._rerun.AnyValues(**columns))
        self._waiting += len(places)
        if self._waiting >= HELD:
            self.flush()
        self.figures(
            {"points": len(scan), "valid": int(scan.points.valid.sum()), "speed_hz": scan.rate_hz}
        )
        if is_first:  # it names what there has to be by then: a time that runs
            self.stream.send_blueprint(self._layout())

    def figures(self, figures: Mapping[str, float | None]) -> None:
        """Log figures by name at the time of the last scan.

        Figures that are None or not finite are left out.
        """
        for name, value in figures.items():
            if value is not None and np.isfinite(value):
                self.stream.log(
                    f"{self._home}/statistics/{name}", self._rerun.Scalars(float(value))
                )

    def flush(self) -> None:
        """Hand over what was logged.

        Raises:
            OSError: where it cannot be written.
        """
        self._waiting = 0
        with _told():
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
            rerun.TransformAxes3D(AXES),
            static=True,
        )
        facts = {
            "model": f"{scan.sensor.vendor} {scan.sensor.model}",
            **scan.facts,
            "mount": str(mount or "as the sensor stands"),
        }
        units = {f"unit of {name}": unit for name, unit in scan.points.units.items() if unit}
        text = "\n".join(f"{name}: {value}" for name, value in {**facts, **units}.items())
        self.stream.log(f"{self._home}/about", rerun.TextDocument(text), static=True)

    def _set_times(self, scan: Scan) -> None:
        self.stream.set_time(NUMBER, sequence=self._number)
        self._number += 1
        self.stream.set_time(SENSOR, timestamp=np.datetime64(scan.stamp_ns, "ns"))
        if scan.host_ns:
            self.stream.set_time(HOST, timestamp=np.datetime64(scan.host_ns, "ns"))

    def _layout(self) -> Any:
        """The points, and beside them figures and facts; the sensor's time runs."""
        views = import_library("rerun.blueprint", "rerun")
        figures = [
            views.TimeSeriesView(
                origin=f"{self._home}/statistics", contents=f"$origin/{name}", name=name
            )
            for name in ("speed_hz", "valid")
        ]
        facts = views.TextDocumentView(origin=f"{self._home}/about", name="about")
        beside = views.Vertical(*figures, facts)
        whole = views.Horizontal(
            views.Spatial3DView(origin="/", name=self._home[1:]), beside, column_shares=[3, 1]
        )
        return views.Blueprint(
            whole, views.TimePanel(timeline=SENSOR, state="collapsed"), collapse_panels=True
        )


class _Copy(threading.Thread):
    """Writes to a file what Rerun's SDK writes into a pipe: where a disk is full, the SDK may wait
    for ever for its own file.

    Attributes:
        end: of the pipe, to write to.
        failure: what the system said of the file; what comes then is read, and lost.

    Raises:
        OSError: where the file cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        super().__init__(name="rerun", daemon=True)
        self._file = open(path, "wb")  # noqa: SIM115 -- `run` closes it
        self._begin, self.end = os.pipe()
        self.failure: OSError | None = None

    def run(self) -> None:
        """Copy until the other end is closed."""
        with open(self._begin, "rb", buffering=0) as pipe:
            try:
                with self._file:
                    while data := pipe.read(PIPED):
                        self._file.write(data)
            except OSError as error:
                self.failure = error
            while pipe.read(PIPED):  # the SDK is not to wait for it
                pass


@contextlib.contextmanager
def _told() -> Iterator[None]:
    """What Rerun's SDK says of a file as an OSError."""
    try:
        yield
    except RuntimeError as error:
        raise OSError(f"Rerun: {error}") from error


class _Colours:
    """The colours of points, on the scale of the first cloud."""

    def __init__(self) -> None:
        self._look: Look | None = None

    def __call__(self, cloud: PointCloud, ramp: str) -> NDArray[np.uint8]:
        """(n, 3), red, green and blue."""
        shown = self._look or look(cloud, ramp=ramp)
        if len(cloud):  # an empty one tells nothing of the scale
            self._look = shown
        colours = np.array(make_ramp("dark", STEPS), np.uint8)  # the viewer is dark
        return colours[steps(cloud, shown)]


def write_rerun(path: Path, scans: Iterable[Scan], *, every_point: bool) -> None:
    """Write a recording."""
    with RerunRecording() as log:
        log.save(path)
        for scan in scans:
            log.scan(scan, every_point=every_point)


RERUN = Format(".rrd", "a recording for Rerun's viewer", write_rerun)
