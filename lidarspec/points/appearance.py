"""Choose the extent of a drawn cloud, and the values that its colours show.

All drawings use this module, so that a scan looks the same in every tool.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import UnknownName
from lidarspec.points.cloud import PointCloud

#: A picture extends to this percentile of the ranges, if the farthest point is more than
#: `FAR_BEYOND_FACTOR` times as far.
REACH_PERCENTILE = 99.0
FAR_BEYOND_FACTOR = 1.5
#: The maximum number of range rings between the middle and an edge of a picture.
MAX_RINGS = 4
#: A cloud is flat if all elevations are below this angle, radians.
MAX_FLAT_RAD = 1e-3
#: A reach is rounded up to one of these numbers times a power of ten, so that most scans are drawn
#: at the same scale.
ROUND_NUMBERS = (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
#: The intensity at this percentile has the last colour.
RAMP_PERCENTILE = 98.0
#: The number of colours. It is small, so that noise changes few colours from scan to scan.
RAMP_STEPS = 20
#: The share of the points that are inside a fitted picture.
CENTRAL_SHARE = 0.98
#: The share of the values at each end of an axis that is ignored to find the extent of most points.
#: A point is distant if it is many times this extent away.
TAIL_SHARE = 0.05
#: A fitted picture is larger than the extent of its points by this factor.
MARGIN_FACTOR = 1.08
#: A fitted picture shows the sensor if the points keep at least this share of their size.
MIN_SIZE_SHARE = 0.93


@dataclass(frozen=True)
class CloudAppearance:
    """The extent and the colours of a drawn cloud.

    Attributes:
        ramp: the name of the column that the colours show: "range", "intensity", or a column in
            `PointCloud.extra`.
        reach: the distance from the middle of the picture to its nearer edge, metres.
        full: the highest value of the colour scale, which has the last colour; in metres for
            ranges, else in `unit`.
        middle: the point in the middle of the picture, metres forward and left of the sensor.
        flat: whether all points are in the plane of the sensor.
        low: the lowest value of the colour scale, which has the first colour.
        unit: the unit of the values; "" for ranges and plain numbers.
    """

    ramp: str
    reach: float
    full: float
    middle: tuple[float, float] = (0.0, 0.0)
    flat: bool = True
    low: float = 0.0
    unit: str = ""

    @property
    def ends(self) -> tuple[str, str]:
        """The values with the first and the last colour, as texts with the unit."""
        unit = "m" if self.ramp == "range" else self.unit
        return f"{self.low:g}", f"{self.full:g} {unit}".rstrip()


def list_ramps(cloud: PointCloud) -> list[str]:
    """Return the names of a cloud's columns that can be shown as colours."""
    if cloud.intensity is None:
        return ["range", *cloud.extra]
    return ["range", "intensity", *cloud.extra]


def choose_appearance(
    points: PointCloud, *, ramp: str = "range", reach: float | None = None
) -> CloudAppearance:
    """Return how to draw a cloud so that all of it is visible.

    Args:
        points: the cloud.
        ramp: the column that the colours show. If the cloud has no intensity, "intensity" shows the
            range.
        reach: the distance from the middle to the nearer edge, metres; None to fit the cloud.

    Raises:
        UnknownName: if the cloud does not have the column.
    """
    cloud = points[points.valid]
    shown_reach = reach or find_reach(cloud)
    if ramp not in (known_ramps := list_ramps(cloud)):
        if ramp != "intensity":
            raise UnknownName(ramp, known_ramps, place="colours")
        ramp = "range"
    if ramp == "range":
        return CloudAppearance("range", shown_reach, shown_reach, flat=is_flat(cloud))
    values = _read_column(cloud, ramp)
    values = values[np.isfinite(values)]
    weak, strong = (
        np.percentile(values, (100 - RAMP_PERCENTILE, RAMP_PERCENTILE))
        if len(values)
        else (0.0, 0.0)
    )
    low = -round_up(-float(weak)) if weak < 0 else 0.0
    return CloudAppearance(
        ramp,
        shown_reach,
        round_up(max(float(strong), 1e-3)),
        flat=is_flat(cloud),
        low=low,
        unit=cloud.units.get(ramp, ""),
    )


def is_flat(cloud: PointCloud) -> bool:
    """Return whether all points are in the sensor's plane."""
    return not len(cloud) or float(np.nanmax(np.abs(cloud.elevation))) < MAX_FLAT_RAD


def find_reach(cloud: PointCloud) -> float:
    """Return the range to draw for a cloud of valid points, metres, rounded up."""
    # A few points that are much farther away than all others do not count.
    if not len(cloud):
        return 1.0
    distance = np.hypot(cloud.x, cloud.y)
    farthest = float(distance.max())
    most = float(np.percentile(distance, REACH_PERCENTILE))
    return round_up(max(farthest if farthest <= FAR_BEYOND_FACTOR * most else most, 1e-3))


def fit_to_points(points: PointCloud, look: CloudAppearance) -> CloudAppearance:
    """Return a copy of `look` in which the central 98 % of the points fill a top view."""
    # The sensor is included if this makes the points at most 7 % smaller.
    low, high = find_bounds(points[points.valid])
    with_sensor = np.minimum(low, 0.0), np.maximum(high, 0.0)
    if _half_extent(low, high) >= MIN_SIZE_SHARE * _half_extent(*with_sensor):
        low, high = with_sensor
    forward, left = ((low + high) / 2)[:2].tolist()
    return replace(
        look, middle=(forward, left), reach=MARGIN_FACTOR * max(_half_extent(low, high), 1e-3)
    )


def find_bounds(cloud: PointCloud) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lowest and the highest x, y and z of the central 98 % of the points.

    Args:
        cloud: valid points.

    Returns:
        Two arrays (3,) in metres, zeros if there are no points.
    """
    if not len(cloud):
        return np.zeros(3), np.zeros(3)
    xyz = np.stack([cloud.x, cloud.y, cloud.z], axis=1).astype(np.float64)
    low, high = np.quantile(xyz, (TAIL_SHARE, 1 - TAIL_SHARE), axis=0)
    extent = np.maximum(high - low, max(TAIL_SHARE * float((high - low).max()), 1e-3))
    beyond = (np.maximum(low - xyz, xyz - high) / extent).max(axis=1)
    central = xyz[beyond <= np.quantile(beyond, CENTRAL_SHARE, method="inverted_cdf")]
    return central.min(axis=0), central.max(axis=0)


def _half_extent(low: NDArray[np.float64], high: NDArray[np.float64]) -> float:
    """Return half of the larger side of a box seen from above, in metres."""
    return float((high - low)[:2].max()) / 2


def round_up(value: float, round_numbers: Sequence[float] = ROUND_NUMBERS) -> float:
    """Return the smallest round number that is at least 99.9 % of a value.

    Args:
        round_numbers: the round numbers from 1 to 10. Their products with powers of ten are round,
            too.
    """
    power = 10.0 ** math.floor(math.log10(value))
    return next(
        (number * power for number in round_numbers if number * power >= value * 0.999), 10 * power
    )


def ring_step(reach: float) -> float:
    """Return the distance between range rings, metres: 1, 2 or 5 times a power of ten."""
    return round_up(reach / MAX_RINGS, (1, 2, 5, 10))


def ramp_positions(cloud: PointCloud, look: CloudAppearance) -> NDArray[np.float64]:
    """Return the position of each point on the colour scale, (n,).

    The first colour is at 0, and the last colour at 1. Values outside of the scale have positions
    below 0 or above 1.
    """
    if look.ramp == "range":
        return np.hypot(cloud.x, cloud.y).astype(np.float64) / look.full
    return np.nan_to_num((_read_column(cloud, look.ramp) - look.low) / (look.full - look.low))


def ramp_indices(cloud: PointCloud, look: CloudAppearance) -> NDArray[np.intp]:
    """Return the index of the colour of each point, (n,)."""
    return np.clip(
        np.nan_to_num(ramp_positions(cloud, look)) * RAMP_STEPS, 0, RAMP_STEPS - 1
    ).astype(np.intp)


def _read_column(cloud: PointCloud, ramp: str) -> NDArray[np.float64]:
    """Return the column that the colours show, (n,)."""
    return np.asarray(cloud.intensity if ramp == "intensity" else cloud.extra[ramp], np.float64)
