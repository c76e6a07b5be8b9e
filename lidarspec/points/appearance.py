"""Choose how to draw a cloud: its extent, its colours and the values that they show.

All drawings use this module, so that a scan looks the same in a terminal, on paper and in other
tools.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import UnknownName
from lidarspec.points.cloud import PointCloud

#: the percentile of ranges that a picture reaches to, if the farthest point is more than
#: `FAR_BEYOND_FACTOR` times as far.
REACH_PERCENTILE = 99.0
FAR_BEYOND_FACTOR = 1.5
#: the largest number of rings between the middle and an edge.
MAX_RINGS = 4
#: a cloud is flat if all elevations are below this, radians.
MAX_FLAT_RAD = 1e-3
#: a reach is rounded up to these numbers, so that the picture keeps its scale from scan to scan.
ROUND_NUMBERS = (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
#: the percentile of intensity at the end of the ramp.
RAMP_PERCENTILE = 98.0
#: the number of colours of a ramp: few, so that noise does not change every colour in every scan.
RAMP_STEPS = 20
#: the share of the points that a fitted picture shows.
CENTRAL_SHARE = 0.98
#: the share of the values at each end of an axis that is ignored for its scale. Distant points are
#: found by this scale.
TAIL_SHARE = 0.05
#: the factor by which a fitted picture extends beyond these points.
MARGIN_FACTOR = 1.08
#: the share of their size that points keep at least in a picture that shows the sensor too.
MIN_SIZE_SHARE = 0.93


@dataclass(frozen=True)
class CloudAppearance:
    """The look of a drawn cloud.

    Attributes:
        ramp: the values that colours show: "range", "intensity", or a column in `PointCloud.extra`.
        reach: metres from the middle to the nearer edge.
        full: the value at the end of the ramp: metres for ranges, else in `unit`.
        middle: the point in the middle, metres forward and left of the sensor.
        flat: whether all points are in the plane of the sensor, so that only a view from above is
            useful.
        low: the value at the beginning of the ramp.
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
        """The values at the beginning and end of the ramp, as text."""
        unit = "m" if self.ramp == "range" else self.unit
        return f"{self.low:g}", f"{self.full:g} {unit}".rstrip()


def list_ramps(cloud: PointCloud) -> list[str]:
    """Return the names of the values that colours can show for a cloud."""
    if cloud.intensity is None:
        return ["range", *cloud.extra]
    return ["range", "intensity", *cloud.extra]


def choose_appearance(
    points: PointCloud, *, ramp: str = "range", reach: float | None = None
) -> CloudAppearance:
    """Return how to draw a cloud so that all of it is visible.

    Intensity falls back to range if the cloud has no intensity.

    Args:
        points: the cloud.
        ramp: the values that colours show.
        reach: metres from the middle to the nearer edge; None to fit the cloud.

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
    values = _read_shown(cloud, ramp)
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
    """Return the range to draw for a cloud of valid points, metres, rounded up.

    It is the range of the farthest point, or of most points if a few are far beyond the others.
    """
    if not len(cloud):
        return 1.0
    distance = np.hypot(cloud.x, cloud.y)
    farthest = float(distance.max())
    most = float(np.percentile(distance, REACH_PERCENTILE))
    return round_up(max(farthest if farthest <= FAR_BEYOND_FACTOR * most else most, 1e-3))


def fit_to_points(points: PointCloud, look: CloudAppearance) -> CloudAppearance:
    """Return the look with which the central 98 % of the points fill a top view.

    The sensor is shown too if the points become at most 7 % smaller by that.
    """
    low, high = find_bounds(points[points.valid])
    with_sensor = np.minimum(low, 0.0), np.maximum(high, 0.0)
    if _half_extent(low, high) >= MIN_SIZE_SHARE * _half_extent(*with_sensor):
        low, high = with_sensor
    forward, left = ((low + high) / 2)[:2].tolist()
    return replace(
        look, middle=(forward, left), reach=MARGIN_FACTOR * max(_half_extent(low, high), 1e-3)
    )


def find_bounds(cloud: PointCloud) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lowest and the highest x, y and z of the central points.

    Args:
        cloud: valid points.

    Returns:
        Two arrays (3,) in metres, zeros if there are no points. 2 % of the points, the farthest
        from the others, may be outside.
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


def round_up(value: float, rounds: Sequence[float] = ROUND_NUMBERS) -> float:
    """Return the next larger round number, by default 1, 1.2, 1.5, 2, 2.5 ... 10, 12.

    Args:
        rounds: the round numbers between 1 and 10.
    """
    power = 10.0 ** math.floor(math.log10(value))
    return next((one * power for one in rounds if one * power >= value * 0.999), 10 * power)


def ring_step(reach: float) -> float:
    """Return the metres from ring to ring: 1, 2 or 5 times a power of ten.

    There are at most four rings up to `reach`.
    """
    return round_up(reach / MAX_RINGS, (1, 2, 5, 10))


def ramp_positions(cloud: PointCloud, look: CloudAppearance) -> NDArray[np.float64]:
    """Return the position of each point along the ramp, (n,), from 0 to 1 at its end."""
    if look.ramp == "range":
        return np.hypot(cloud.x, cloud.y).astype(np.float64) / look.full
    return np.nan_to_num((_read_shown(cloud, look.ramp) - look.low) / (look.full - look.low))


def ramp_indices(cloud: PointCloud, look: CloudAppearance) -> NDArray[np.intp]:
    """Return the index of each point's colour in the ramp, (n,).

    Points without a return have the first colour.
    """
    return np.clip(
        np.nan_to_num(ramp_positions(cloud, look)) * RAMP_STEPS, 0, RAMP_STEPS - 1
    ).astype(np.intp)


def _read_shown(cloud: PointCloud, ramp: str) -> NDArray[np.float64]:
    """Return the column that colours show, (n,)."""
    return np.asarray(cloud.intensity if ramp == "intensity" else cloud.extra[ramp], np.float64)
