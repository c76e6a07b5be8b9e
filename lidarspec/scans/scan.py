"""`Scan`: the points of one revolution or frame period."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import UsageError
from lidarspec.notebook_display import make_display_method
from lidarspec.packets.imu import ImuSamples
from lidarspec.points.cloud import PointCloud
from lidarspec.points.conventions import find_axes
from lidarspec.points.mount import Mount
from lidarspec.scans.laserscan import FULL_TURN, LaserScan, find_nearest_returns, fit_times
from lidarspec.scans.provenance import Provenance
from lidarspec.spec.sensor import SensorDescription

#: The default name of the frame of reference, with x forward, y left and z up (REP-103).
FRAME_ID = "laser"


@dataclass(frozen=True, eq=False, repr=False)
class Scan:
    """The points of one revolution or frame period.

    Attributes:
        points: the points, in stream order.
        rate_hz: scans per second, computed from the time between this scan and the next one; nan if
            unknown, or if the scan is not whole.
        complete: whether the scan has a start and an end, and no packet is missing. The first and
            the last scan of a stream are not complete.
        sensor: the sensor that measured the points.
        whole: whether the scan has a start, an end and at least half of its packets. A whole scan
            may have missing packets; a complete scan is always whole.
        imu: the samples of the IMU from the first point up to the first point of the next scan;
            None without an IMU, or if its clock differs from the clock of the points.
        host_ns: the arrival time of the packet with the first point, int64 ns since 1970; 0 if
            unknown.
        beams: the default number of beams of `to_laserscan`; None to use the number that the sensor
            declares, or the number of points.
        frame_id: the name of the frame of reference in ROS messages.
        number: the index of the scan in its file, if the file is read in separate pieces; or the
            index among all written scans, if they are written to several files; else None.
        mount: the position and orientation of the sensor on its carrier (such as a vehicle), if the
            points are in the axes of the carrier; None if they are in the axes of the sensor.
        provenance: finds the frame that a point came from.
    """

    points: PointCloud
    rate_hz: float
    complete: bool
    sensor: SensorDescription
    whole: bool = False
    imu: ImuSamples | None = None
    host_ns: int = 0
    beams: int | None = None
    frame_id: str = FRAME_ID
    number: int | None = None
    mount: Mount | None = None
    provenance: Provenance = field(default_factory=Provenance)

    @property
    def stamp_ns(self) -> int:
        """The time of the first point, int64 ns."""
        return self.points.stamp_ns

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        ranges = self.points.range[self.points.valid]
        if len(ranges):
            span = f"{ranges.min():.2f}..{ranges.max():.2f} m"
        else:
            span = "no returns"
        rate = ""
        if np.isfinite(self.rate_hz):
            rate = f"{self.rate_hz:.1f} Hz, "
        nominal = ""
        if self.points.nominal:
            nominal = ", nominal calibration"
        if self.complete:
            state = "complete"
        elif self.whole:
            state = "with gaps"
        else:
            state = "partial"
        return f"Scan({len(self)} points, {rate}{span}, {state}{nominal})"

    _repr_svg_ = make_display_method("scan")

    @property
    def facts(self) -> dict[str, str]:
        """The origin of the points, as stored in files.

        The keys are "sensor", the id of the sensor; "source", the documents that define its format;
        "frame", the directions of x, y and z; and "calibration", which is "nominal" or "own".
        """
        directions = zip("xyz", find_axes(self.sensor), strict=True)
        return {
            "sensor": self.sensor.id,
            "source": self.sensor.source,
            "frame": ", ".join(f"{axis} {direction}" for axis, direction in directions),
            "calibration": self.points.calibration,
        }

    def to_arrow(self) -> Any:
        """Return the `pyarrow.Table` of the points, with `facts` in its metadata.

        Raises:
            UsageError: if pyarrow is not installed.
        """
        return self.points.to_arrow(self.facts)

    def __arrow_c_stream__(self, requested_schema: object = None) -> object:
        """Return the Arrow stream through which DuckDB, Polars and pandas read the points."""
        return self.to_arrow().__arrow_c_stream__(requested_schema)

    def to_bins(self, n: int) -> NDArray[np.float32]:
        """Return the range of the nearest return in each of n equal sectors.

        The first sector begins at -pi. The result is (n,) float32, metres, inf without a return.

        Raises:
            UsageError: if `n` is not a positive whole number.
        """
        step = FULL_TURN / _check_count(n, "to_bins")
        ranges, _ = find_nearest_returns(self.points, n, step / 2 - np.pi, step)
        return ranges

    def to_laserscan(
        self, beams: int | None = None, field: tuple[float, float] | None = None
    ) -> LaserScan:
        """Return the scan on an even grid of angles.

        Args:
            beams: the number of angles; by default the attribute `beams`.
            field: the first and the last angle, radians; by default a whole turn from -pi on. If
                scans begin at an angle between these two, the times of some beams are wrong by one
                revolution.

        Raises:
            UsageError: if `beams` is not a positive whole number.
        """
        if beams is not None:
            count = _check_count(beams, "to_laserscan")
        else:
            count = self.beams or self.sensor.beams or max(len(self), 1)
        first, last = field or (-np.pi, np.pi - FULL_TURN / count)
        step = FULL_TURN
        if count > 1:
            step = (last - first) / (count - 1)
        ranges, intensities = find_nearest_returns(self.points, count, first, step)
        start, slope = fit_times(self.points, first, last)
        if np.isfinite(self.rate_hz) and self.rate_hz > 0:
            period = 1 / self.rate_hz
        else:
            period = abs(slope) * FULL_TURN
        assert self.sensor.range_limits is not None  # every sensor with points declares them
        range_min, range_max = self.sensor.range_limits
        return LaserScan(
            angle_min=first,
            angle_max=last,
            angle_increment=step,
            time_increment=slope * step,
            scan_time=period,
            range_min=range_min,
            range_max=range_max,
            ranges=ranges,
            intensities=intensities,
            stamp_ns=self.stamp_ns + round(start * 1e9),
            host_ns=self.host_ns,
        )


def _check_count(count: Any, method: str) -> int:
    """Return a number of sectors or beams as an int.

    Raises:
        UsageError: if the number is not a positive whole number.
    """
    is_whole = isinstance(count, int | np.integer) and not isinstance(count, bool)
    if not is_whole or count < 1:
        raise UsageError(
            f"{method} requires the number of sectors, an integer of at least 1, not {count!r}"
        )
    return int(count)
