"""Planar scans as in ROS: the nearest return at each angle of an even grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarspec.points.cloud import PointCloud

FULL_TURN = 2 * np.pi

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class LaserScan:
    """A planar scan with the attributes of the ROS message LaserScan.

    Attributes:
        ranges: (n,) float32 metres; `ranges[i]` is the nearest return at the angle ``angle_min + i
            * angle_increment``, inf without a return.
        intensities: (n,) float32, 0 without a return.
        angle_min: the first angle, radians, counter-clockwise.
        angle_max: the last angle, ``angle_min + (n - 1) * angle_increment``.
        angle_increment: the step between angles, radians.
        time_increment: seconds from beam to beam; negative if the angle decreases with time.
        scan_time: seconds from scan to scan.
        range_min: the lowest range that the sensor measures, metres.
        range_max: the greatest range that the sensor measures, metres.
        stamp_ns: the time at which `ranges[0]` was measured; `ranges[i]` was measured ``i *
            time_increment`` later.
        host_ns: the arrival time of the first packet, as in `Scan`.
    """

    angle_min: float
    angle_max: float
    angle_increment: float
    time_increment: float
    scan_time: float
    range_min: float
    range_max: float
    ranges: Floats
    intensities: Floats
    stamp_ns: int = 0
    host_ns: int = 0


def find_nearest_returns(
    points: PointCloud, count: int, first: float, step: float
) -> tuple[Floats, Floats]:
    """Return the nearest return at each of `count` angles, and its intensity.

    Args:
        count: the number of angles.
        first: the first angle, radians.
        step: the step between angles, radians.

    Returns:
        Ranges, (count,) metres, inf without a return; intensities, (count,), 0 without a return.
    """
    azimuths = points.azimuth[points.valid].astype(np.float64)
    ahead = (azimuths - first + step / 2) % FULL_TURN
    ahead %= FULL_TURN  # again, since the first remainder of a tiny negative number is a whole turn
    bins = (ahead / step).astype(np.intp)
    is_inside = bins < count
    valid = np.flatnonzero(points.valid)[is_inside]
    bins = bins[is_inside]
    ranges = points.range[valid]
    nearest_first = np.lexsort((ranges, bins))
    is_first = np.ones(len(nearest_first), np.bool_)
    is_first[1:] = np.diff(bins[nearest_first]) > 0
    chosen = nearest_first[is_first]
    nearest = np.full(count, np.inf, np.float32)
    nearest[bins[chosen]] = ranges[chosen]
    intensities = np.zeros(count, np.float32)
    if points.intensity is not None:
        intensities[bins[chosen]] = points.intensity[valid][chosen]
    return nearest, intensities


def unwrap_azimuths(points: PointCloud) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the azimuths and times of the points with a finite azimuth, (k,) each.

    Azimuths are in radians, unwrapped. Times are in seconds since the stamp.
    """
    azimuths = points.azimuth.astype(np.float64)
    is_known = np.isfinite(azimuths)
    return np.unwrap(azimuths[is_known]), points.time[is_known]


def fit_times(points: PointCloud, first: float, last: float) -> tuple[float, float]:
    """Return the time at the azimuth `first`, and the time per radian, in seconds.

    Times count from the stamp of the points.
    """
    # Unwrapped azimuths may be whole turns away from `first` and `last`.
    azimuths, times = unwrap_azimuths(points)
    if len(azimuths) < 2:
        return 0.0, 0.0
    spread = azimuths - azimuths.mean()
    if not spread.any():
        return 0.0, 0.0
    slope = float(spread @ times / (spread @ spread))
    turns = round((float(np.median(azimuths)) - (first + last) / 2) / FULL_TURN)
    start = float(times.mean() + slope * (first + turns * FULL_TURN - azimuths.mean()))
    return start, slope
