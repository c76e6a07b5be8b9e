"""Assertions about point clouds: the conventions of a cloud, and the equality of two clouds."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.points.cloud import PointCloud

#: Tolerance of coordinates and angles, in units in the last place at the size of the range.
ULPS = 4
#: Tolerance of times of points in seconds. It is needed because the times in two batches may count
#: from different packets.
TIME_TOLERANCE_S = 1e-6
#: Tolerance of the stamp of a cloud in nanoseconds.
STAMP_TOLERANCE_NS = 1000


def assert_well_formed(cloud: PointCloud) -> None:
    """Fail unless the cloud keeps the conventions of types, angles and REP-117."""
    valid = cloud.valid
    lengths = (cloud.x, cloud.y, cloud.z, cloud.range)
    assert all(column.dtype == np.float32 for column in lengths), "x, y, z or range is not float32"
    assert cloud.time.dtype == np.float64, "time is not float64"
    assert all(len(column) == len(cloud) for column in cloud.columns.values()), (
        "a column has another length than the cloud"
    )
    assert np.isfinite(cloud.xyz[valid]).all(), "x, y or z of a valid point is not finite"
    assert np.isfinite(cloud.range[valid]).all(), "the range of a valid point is not finite"
    assert np.isnan(cloud.xyz[~valid]).all(), "x, y or z of an invalid point is not nan"
    assert (cloud.range[valid] >= 0).all(), "the range of a valid point is negative"
    finite = cloud.azimuth[np.isfinite(cloud.azimuth)]
    assert ((finite >= -np.pi) & (finite < np.pi)).all(), "an azimuth is not in [-pi, pi)"


def assert_same_places(cloud: PointCloud, other: PointCloud, *, ulps: int = ULPS) -> None:
    """Fail unless both clouds have the same columns, masks, positions and times.

    The tolerance of coordinates grows with the range. The tolerance of times is a microsecond. All
    other columns have to be equal.

    Args:
        ulps: tolerance of coordinates and angles in units in the last place.
    """
    assert cloud.columns.keys() == other.columns.keys()
    assert are_equal(cloud.valid, other.valid)
    reach = _find_extents(cloud)
    range_tolerance = ulps * np.spacing(np.minimum(reach, np.abs(cloud.range)))
    tolerances: dict[str, tuple[Any, float]] = {
        **dict.fromkeys("xyz", (ulps * np.spacing(reach), 0.0)),
        "range": (range_tolerance, 0.0),
        **dict.fromkeys(
            ("azimuth", "elevation"), (ulps * np.spacing(np.float32(np.pi)), 2 * np.pi)
        ),
    }
    for name in cloud.columns.keys() - {"time"}:
        first = cloud.columns[name]
        second = other.columns[name]
        if name in tolerances:
            tolerance, full_circle = tolerances[name]
            assert _is_close(first, second, tolerance, full_circle), f"{name} differs"
        else:
            assert are_equal(first, second), f"{name} differs"
    assert cloud.time.shape == other.time.shape
    assert np.allclose(cloud.time, other.time, rtol=1e-12, atol=TIME_TOLERANCE_S, equal_nan=True)
    assert abs(cloud.stamp_ns - other.stamp_ns) <= STAMP_TOLERANCE_NS
    assert cloud.shape == other.shape


def _find_extents(cloud: PointCloud) -> NDArray[np.float32]:
    """Return the largest of range, x, y and z of each point, at least 1 m."""
    lengths = np.stack([cloud.range, cloud.x, cloud.y, cloud.z, np.ones(len(cloud))])
    with np.errstate(invalid="ignore"):
        size = np.nanmax(np.abs(lengths), axis=0, initial=0).astype(np.float32)
    return np.where(np.isfinite(size), size, 1).astype(np.float32)


def _is_close(
    first: NDArray[Any], second: NDArray[Any], tolerance: Any, full_circle: float = 0.0
) -> bool:
    """Return whether two arrays differ by no more than a tolerance.

    Args:
        full_circle: the period of angles; 0 compares plain numbers.
    """
    if first.dtype != second.dtype or first.shape != second.shape:
        return False
    with np.errstate(invalid="ignore"):
        apart = np.abs(first.astype(np.float64) - second.astype(np.float64))
        if full_circle:
            apart = np.minimum(apart, np.abs(full_circle - apart))
        both_nan = np.isnan(first) & np.isnan(second)
        return bool(((apart <= tolerance) | (first == second) | both_nan).all())


def are_equal(first: NDArray[Any], second: NDArray[Any]) -> bool:
    """Return whether two arrays are equal in shape, type and value; NaN equals NaN."""
    return (
        first.dtype == second.dtype
        and first.shape == second.shape
        and np.array_equal(first, second, equal_nan=first.dtype.kind == "f")
    )
