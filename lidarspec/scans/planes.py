"""Planar scans on one grid of angles.

They are the scans of a planar sensor, or of one ring or layer of another sensor.

The first complete scan shows the grid: how many beams, and from where to where they look, which is
where the sensor's scans begin, so that one line of times fits all beams. Of a sensor that sees less
than a turn it is what it sees.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidarspec.errors import UsageError
from lidarspec.points.cloud import PointCloud
from lidarspec.scans.scans import LaserScan, Scan

#: radians from the horizon up to which points are in its plane: what rounding leaves of a mount's
#: turns.
LEVEL = 1e-5
#: share of a turn from which on a scan is one of the whole turn.
TURN = 0.98


class Planes:
    """Makes planar scans of one sensor's.

    Args:
        beams: of each; by default as many as the scans or the sensor say, else as the first
            complete scan has points.
        field: where the first and the last beam look, radians, in the place of what the sensor
            sees.
        ring: the one that is taken of a sensor of several.
        heights: from and up to which z, metres, points are taken of a sensor of several rings.
    """

    def __init__(
        self,
        beams: int | None = None,
        field: tuple[float, float] | None = None,
        *,
        ring: int | None = None,
        heights: tuple[float, float] | None = None,
    ) -> None:
        self._beams = beams
        self._wanted = field
        self._ring = ring
        self._heights = heights
        self._is_flat: bool | None = None
        self._grid: tuple[int, tuple[float, float]] | None = None

    def scan(self, scan: Scan) -> LaserScan | None:
        """The scan on the grid; None of a sensor of several planes, where none is chosen.

        Raises:
            UsageError: where a ring is asked for that the points have not.
        """
        level = self._level(scan)
        if level is None:
            return None
        if self._grid is None and level.complete and len(level) > 1:
            self._grid = self._grid_of(level)
        return level.to_laserscan(*(self._grid or (self._beams, self._wanted)))

    def _level(self, scan: Scan) -> Scan | None:
        """What of a scan is in the plane."""
        cloud = scan.points
        if self._ring is None and self._heights is None:
            if self._is_flat is None and (valid := cloud.valid).any():
                self._is_flat = bool((np.abs(cloud.elevation[valid]) < LEVEL).all())
            if self._is_flat:
                return scan
            return None
        if self._ring is not None and (
            cloud.ring is None or (self._grid is None and not (cloud.ring == self._ring).any())
        ):
            if cloud.ring is None:
                rings = "none"
            else:
                rings = f"{cloud.ring.min()} to {cloud.ring.max()}"
            raise UsageError(
                f"{scan.sensor.id}: ring {self._ring} is asked for, and its points have {rings}"
            )
        if self._ring is None:
            wanted = np.ones(len(cloud), np.bool_)
        else:
            wanted = np.asarray(cloud.ring == self._ring)
        if self._heights is not None:
            wanted &= (cloud.z >= self._heights[0]) & (cloud.z < self._heights[1])
        return replace(scan, points=_level_with(cloud[wanted]))

    def _grid_of(self, scan: Scan) -> tuple[int, tuple[float, float]]:
        """How many beams, and where the first and the last one look."""
        azimuth, _ = scan.swept()
        begin, end, low, high = (
            float(angle) for angle in (azimuth[0], azimuth[-1], azimuth.min(), azimuth.max())
        )
        if low == high:  # it looks one way
            return 1, (low, high)
        count = self._beams or scan.beams or scan.sensor.beams or len(scan)
        turn = 2 * np.pi
        step = (high - low) / (len(azimuth) - 1)
        if high - low > TURN * turn:
            step = turn / count
            # what is measured first stands first in the order of the angles, or last, in front of
            # what is measured last
            low = (round((begin + np.pi) / step) + (end < begin)) * step % turn - np.pi
            high = low + turn - step
        if self._wanted is not None:
            low, high = self._wanted
            count = self._beams or scan.beams or round((high - low) / step) + 1
        return count, (low, high)


def _level_with(cloud: PointCloud) -> PointCloud:
    """Points in the plane below or above which they are, as far away as there."""
    away = np.where(cloud.valid, np.hypot(cloud.x, cloud.y), cloud.range)
    return replace(cloud, range=away, elevation=np.zeros_like(cloud.elevation))
