"""The look of a drawn cloud: its extent, its colours and the values that they show.

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

#: share of the points that a picture's reach takes in, where a few are far beyond all others.
MOST = 99.0
FAR_BEYOND = 1.5
#: rings at most between the middle and an edge.
RINGS = 4
#: elevations below this, in radians, make a cloud a flat one.
FLAT = 1e-3
#: what a reach is rounded up to, so that the picture keeps its scale from scan to scan.
ROUND = (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
#: share of the points whose intensity is within the ramp.
WITHIN = 98.0
#: colours of a ramp; few, so that noise in a range does not change every colour with every scan.
STEPS = 20
#: share of the points that a fitted picture shows.
CENTRAL = 0.98
#: share of the values of an axis at each end that does not count for its scale, by which distant
#: points are found.
TAIL = 0.05
#: how much more than these points a fitted picture shows.
MARGIN = 1.08
#: least share of their size that they keep in a picture that shows the sensor too.
WORTH = 0.93


@dataclass(frozen=True)
class CloudAppearance:
    """The look of a drawn cloud.

    Attributes:
        ramp: what colours show: "range", "intensity", or a column in `PointCloud.extra`.
        reach: metres from the middle to the nearer edge.
        full: the range in metres, the intensity, or the value at the end of the ramp.
        middle: what is in the middle, metres forward and left of the sensor.
        flat: from above only.
        low, unit: the value at the beginning of the ramp, and what values are in, where they are no
            ranges.
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
        """The values at the beginning and end of the ramp, in words."""
        unit = "m" if self.ramp == "range" else self.unit
        return f"{self.low:g}", f"{self.full:g} {unit}".rstrip()


def list_ramps(cloud: PointCloud) -> list[str]:
    """Return the values that colours can show of a cloud."""
    return ["range", *["intensity"] * (cloud.intensity is not None), *cloud.extra]


def choose_appearance(
    points: PointCloud, *, ramp: str = "range", reach: float | None = None
) -> CloudAppearance:
    """Return how to draw a cloud so that all of it is visible.

    Intensity is shown only if the cloud has any.

    Raises:
        UnknownName: for a column that the cloud does not have.
    """
    cloud = points[points.valid]
    shown_reach = reach or find_reach(cloud)
    if ramp not in (known_ramps := list_ramps(cloud)):
        if ramp != "intensity":
            raise UnknownName(ramp, known_ramps, place="colours")
        ramp = "range"
    if ramp == "range":
        return CloudAppearance("range", shown_reach, shown_reach, flat=is_flat(cloud))
    values = _shown(cloud, ramp)
    values = values[np.isfinite(values)]
    weak, strong = np.percentile(values, (100 - WITHIN, WITHIN)) if len(values) else (0.0, 0.0)
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
    return not len(cloud) or float(np.nanmax(np.abs(cloud.elevation))) < FLAT


def find_reach(cloud: PointCloud) -> float:
    """Return the range to draw for a cloud of valid points, rounded up.

    It is that of the farthest point, or of most points if a few are far beyond.
    """
    if not len(cloud):
        return 1.0
    distance = np.hypot(cloud.x, cloud.y)
    farthest = float(distance.max())
    most = float(np.percentile(distance, MOST))
    return round_up(max(farthest if farthest <= FAR_BEYOND * most else most, 1e-3))


def fit_to_points(points: PointCloud, look: CloudAppearance) -> CloudAppearance:
    """Return the look whose view from above the central 98 % of the points fill.

    The sensor is shown as well if the points are not much smaller for it.
    """
    low, high = find_bounds(points[points.valid])
    with_sensor = np.minimum(low, 0.0), np.maximum(high, 0.0)
    if _half_extent(low, high) >= WORTH * _half_extent(*with_sensor):
        low, high = with_sensor
    forward, left = ((low + high) / 2)[:2].tolist()
    return replace(look, middle=(forward, left), reach=MARGIN * max(_half_extent(low, high), 1e-3))


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
    low, high = np.quantile(xyz, (TAIL, 1 - TAIL), axis=0)
    extent = np.maximum(high - low, max(TAIL * float((high - low).max()), 1e-3))
    beyond = (np.maximum(low - xyz, xyz - high) / extent).max(axis=1)
    central = xyz[beyond <= np.quantile(beyond, CENTRAL, method="inverted_cdf")]
    return central.min(axis=0), central.max(axis=0)


def _half_extent(low: NDArray[np.float64], high: NDArray[np.float64]) -> float:
    """Return half of the larger side of a box seen from above, in metres."""
    return float((high - low)[:2].max()) / 2


def round_up(value: float, rounds: Sequence[float] = ROUND) -> float:
    """The next of a few round numbers, by default such as 1.2, 1.5, 2, 2.5, 3, 4 ... 10, 12."""
    power = 10.0 ** math.floor(math.log10(value))
    return next((one * power for one in rounds if one * power >= value * 0.999), 10 * power)


def ring_step(reach: float) -> float:
    """Metres from ring to ring: 1, 2 or 5 times a power of ten, at most four rings."""
    return round_up(reach / RINGS, (1, 2, 5, 10))


def ramp_positions(cloud: PointCloud, look: CloudAppearance) -> NDArray[np.float64]:
    """Return the position of each point along the ramp, (n,), from 0."""
    if look.ramp == "range":
        return np.hypot(cloud.x, cloud.y).astype(np.float64) / look.full
    return np.nan_to_num((_shown(cloud, look.ramp) - look.low) / (look.full - look.low))


def ramp_indices(cloud: PointCloud, look: CloudAppearance) -> NDArray[np.intp]:
    """Return the index of each point's colour in the ramp, (n,).

    Points without a return have the first colour.
    """
    return np.clip(np.nan_to_num(ramp_positions(cloud, look)) * STEPS, 0, STEPS - 1).astype(np.intp)


def _shown(cloud: PointCloud, ramp: str) -> NDArray[np.float64]:
    """Return the column that colours show, (n,)."""
    return np.asarray(cloud.intensity if ramp == "intensity" else cloud.extra[ramp], np.float64)
