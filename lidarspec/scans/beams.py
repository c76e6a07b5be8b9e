"""Project planar scans onto one grid of angles.

A planar scan is a scan of a planar sensor, or the points of another sensor that are in one ring or
between two heights. The first complete scan determines the grid: the number of beams, the first
angle and the last angle.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidarspec.errors import UsageError
from lidarspec.points.cloud import PointCloud
from lidarspec.scans.laserscan import FULL_TURN, LaserScan, unwrap_azimuths
from lidarspec.scans.scan import Scan

#: The largest elevation, radians, of points in the plane of a sensor. Rotating points to a mount
#: causes rounding errors of up to this size.
MAX_LEVEL_RAD = 1e-5
#: A scan over at least this share of a turn counts as a whole turn.
MIN_TURN_SHARE = 0.98

Field = tuple[float, float]


class PlanarScans:
    """Projects the scans of one sensor onto one grid of angles.

    Args:
        beams: the number of beams; by default the number that the scan or the sensor declares, or
            the number of points of the first complete scan.
        field: the first and the last angle, radians; by default the angles of the first complete
            scan, or a whole turn if this scan covers nearly a turn.
        ring: the number of the ring to use, for a sensor with several rings.
        heights: (low, high) in metres, to use only the points with low <= z < high, for a sensor
            with several rings.
    """

    def __init__(
        self,
        beams: int | None = None,
        field: Field | None = None,
        *,
        ring: int | None = None,
        heights: tuple[float, float] | None = None,
    ) -> None:
        self._beams = beams
        self._field = field
        self._ring = ring
        self._heights = heights
        self._is_flat: bool | None = None
        self._grid: tuple[int, Field] | None = None

    def project(self, scan: Scan) -> LaserScan | None:
        """Return the scan on the grid; None if the points are not in one plane.

        Raises:
            UsageError: if the points do not have the chosen ring.
        """
        level = self._take_level(scan)
        if level is None:
            return None
        if self._grid is None and level.complete and len(level) > 1:
            self._grid = self._make_grid(level)
        if self._grid is None:
            return level.to_laserscan(self._beams, self._field)
        return level.to_laserscan(*self._grid)

    def _take_level(self, scan: Scan) -> Scan | None:
        """Return the scan with only the points of the chosen ring or heights.

        Returns None if neither is chosen and the points are not in one plane.
        """
        cloud = scan.points
        if self._ring is None and self._heights is None:
            if self._is_flat is None and cloud.valid.any():
                elevations = cloud.elevation[cloud.valid]
                self._is_flat = bool((np.abs(elevations) < MAX_LEVEL_RAD).all())
            if self._is_flat:
                return scan
            return None
        wanted = np.ones(len(cloud), np.bool_)
        if self._ring is not None:
            if cloud.ring is None:
                raise self._make_ring_error(scan, "none")
            wanted = cloud.ring == self._ring
            if self._grid is None and not wanted.any():
                raise self._make_ring_error(scan, f"{cloud.ring.min()} to {cloud.ring.max()}")
        if self._heights is not None:
            low, high = self._heights
            wanted = wanted & (cloud.z >= low) & (cloud.z < high)
        return replace(scan, points=_project(cloud[wanted]))

    def _make_ring_error(self, scan: Scan, rings: str) -> UsageError:
        return UsageError(
            f"{scan.sensor.id}: ring {self._ring} does not exist; the rings are {rings}"
        )

    def _make_grid(self, scan: Scan) -> tuple[int, Field]:
        """Return the number of beams, and the first and the last angle, radians."""
        azimuths, _ = unwrap_azimuths(scan.points)
        low = float(azimuths.min())
        high = float(azimuths.max())
        if low == high:  # all beams have one direction
            return 1, (low, high)
        count = self._beams or scan.beams or scan.sensor.beams or len(scan)
        step = (high - low) / (len(azimuths) - 1)
        if high - low > MIN_TURN_SHARE * FULL_TURN:
            step = FULL_TURN / count
            low = _find_grid_start(float(azimuths[0]), float(azimuths[-1]), step)
            high = low + FULL_TURN - step
        if self._field is not None:
            low, high = self._field
            count = self._beams or scan.beams or round((high - low) / step) + 1
        return count, (low, high)


def _find_grid_start(begin: float, end: float, step: float) -> float:
    """Return the first angle of a grid over the whole turn, radians from -pi to pi.

    Args:
        begin: the first measured angle, radians.
        end: the last measured angle, radians.
        step: the step of the grid, radians.
    """
    # The grid begins at the first point if angles increase with time, else at the last point, so
    # that times are linear over all beams.
    steps = round((begin + np.pi) / step)
    if end < begin:
        steps += 1
    return steps * step % FULL_TURN - np.pi


def _project(cloud: PointCloud) -> PointCloud:
    """Return points that are moved vertically into the plane of the sensor."""
    ranges = np.where(cloud.valid, np.hypot(cloud.x, cloud.y), cloud.range)
    return replace(cloud, range=ranges, elevation=np.zeros_like(cloud.elevation))
