"""How a cloud is looked at: what a picture of it takes in, what colours show, and the values that they stand for.

Whatever draws points asks here, so that a scan looks alike in a terminal, on paper and in other tools.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import UnknownName
from lidarspec.points.cloud import PointCloud

Rgb = tuple[int, int, int]

#: share of the points that a picture's reach takes in, where a few are far beyond all others.
MOST, FAR_BEYOND = 99.0, 1.5
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
#: the stops of the ramps, hues that stay bright on a dark ground: near to far, and weak to strong.
BRIGHT: dict[str, tuple[Rgb, ...]] = {
    "range": ((255, 92, 87), (255, 170, 60), (236, 220, 72), (96, 216, 110), (64, 208, 220), (92, 150, 255), (186, 128, 255)),
    "intensity": ((92, 78, 190), (160, 70, 190), (226, 84, 140), (255, 138, 84), (255, 204, 92), (255, 250, 190)),
}


@dataclass(frozen=True)
class Look:
    """How a cloud is drawn.

    Attributes:
        ramp: what colours show: "range", "intensity", or a column in `PointCloud.extra`.
        reach: metres from the middle to the nearer edge.
        full: the range in metres, the intensity, or the value at the end of the ramp.
        middle: what is in the middle, metres forward and left of the sensor.
        flat: from above only.
        low, unit: the value at the beginning of the ramp, and what values are in, where they are no ranges.
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


def ramps(cloud: PointCloud) -> list[str]:
    """What colours can show of a cloud."""
    return ["range", *["intensity"] * (cloud.intensity is not None), *cloud.extra]


def look(points: PointCloud, *, ramp: str = "range", reach: float | None = None) -> Look:
    """How to draw a cloud so that all of it is seen; intensity is shown only where the cloud has some.

    Raises:
        UnknownName: for a column that the cloud does not have.
    """
    cloud = points[points.valid]
    found = reach or reach_of(cloud)
    if ramp not in (known := ramps(cloud)):
        if ramp != "intensity":
            raise UnknownName(ramp, known, place="colours")
        ramp = "range"
    if ramp == "range":
        return Look("range", found, found, flat=is_flat(cloud))
    values = _shown(cloud, ramp)
    values = values[np.isfinite(values)]
    weak, strong = np.percentile(values, (100 - WITHIN, WITHIN)) if len(values) else (0.0, 0.0)
    low = -rounded_up(-float(weak)) if weak < 0 else 0.0
    return Look(ramp, found, rounded_up(max(float(strong), 1e-3)), flat=is_flat(cloud), low=low, unit=cloud.units.get(ramp, ""))


def is_flat(cloud: PointCloud) -> bool:
    """Whether all points are in the sensor's plane."""
    return not len(cloud) or float(np.nanmax(np.abs(cloud.elevation))) < FLAT


def reach_of(cloud: PointCloud) -> float:
    """The range that shows a cloud of valid points: the farthest one's, or most points' where a few are far beyond; rounded up."""
    if not len(cloud):
        return 1.0
    distance = np.hypot(cloud.x, cloud.y)
    farthest, most = float(distance.max()), float(np.percentile(distance, MOST))
    return rounded_up(max(farthest if farthest <= FAR_BEYOND * most else most, 1e-3))


def rounded_up(value: float, rounds: Sequence[float] = ROUND) -> float:
    """The next of a few round numbers, by default such as 1.2, 1.5, 2, 2.5, 3, 4 ... 10, 12."""
    power = 10.0 ** math.floor(math.log10(value))
    return next((one * power for one in rounds if one * power >= value * 0.999), 10 * power)


def ring_step(reach: float) -> float:
    """Metres from ring to ring: 1, 2 or 5 times a power of ten, at most four rings."""
    return rounded_up(reach / RINGS, (1, 2, 5, 10))


def shade(cloud: PointCloud, look: Look) -> NDArray[np.float64]:
    """How far along the ramp each point is, (n,), from 0."""
    if look.ramp == "range":
        return np.hypot(cloud.x, cloud.y).astype(np.float64) / look.full
    return np.nan_to_num((_shown(cloud, look.ramp) - look.low) / (look.full - look.low))


def steps(cloud: PointCloud, look: Look) -> NDArray[np.intp]:
    """The colour of each point by its number in the ramp, (n,); the first where nothing came back."""
    return np.clip(np.nan_to_num(shade(cloud, look)) * STEPS, 0, STEPS - 1).astype(np.intp)


def blended(stops: Sequence[Rgb]) -> list[Rgb]:
    """The colours of a ramp, from its stops."""
    places = np.linspace(0, len(stops) - 1, STEPS)
    channels = [np.interp(places, range(len(stops)), channel).round().astype(int).tolist() for channel in zip(*stops, strict=True)]
    return list(zip(*channels, strict=True))


def _shown(cloud: PointCloud, ramp: str) -> NDArray[np.float64]:
    """The column that colours show, (n,)."""
    return np.asarray(cloud.intensity if ramp == "intensity" else cloud.extra[ramp], np.float64)
