"""Clouds in the terminal: seen from above with range rings, forward up and left left; 3D ones from the side as well."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from rich.text import Text

from lidarspec.clouds import PointCloud
from lidarspec.view.canvas import ACROSS, DOWN, Canvas

#: share of the points that the picture's reach takes in, where a few are far beyond all others.
MOST, FAR_BEYOND = 99.0, 1.5
#: rings at most, and dots from one dot of a ring to the next.
RINGS, RING_GAP = 4, 4
#: share of the height that the view from above gets where there are two.
ABOVE = 0.62


def polar(points: PointCloud, *, width: int, height: int, max_range: float | None = None) -> str:
    """The cloud from above as lines of braille characters, `width` by `height` cells; `max_range` metres to the nearer edge."""
    return polar_text(points, width=width, height=height, max_range=max_range).plain


def top_side(points: PointCloud, *, width: int, height: int, max_range: float | None = None) -> str:
    """The cloud from above and, below that, from its right side, to the same scale; forward is up, then right."""
    return top_side_text(points, width=width, height=height, max_range=max_range).plain


def polar_text(points: PointCloud, *, width: int, height: int, max_range: float | None = None) -> Text:
    """The same as `polar`, coloured by range."""
    cloud = points[points.valid]
    reach = max_range or _reach(np.hypot(cloud.x, cloud.y))
    canvas = Canvas(width, height)
    scale = _scale(canvas, reach)
    _from_above(canvas, cloud, reach, scale)
    return canvas.text()


def top_side_text(points: PointCloud, *, width: int, height: int, max_range: float | None = None) -> Text:
    """The same as `top_side`, coloured by range."""
    cloud = points[points.valid]
    reach = max_range or _reach(np.hypot(cloud.x, cloud.y))
    above = Canvas(width, max(round((height - 2) * ABOVE), 1))
    side = Canvas(width, max(height - 2 - above.height, 1))
    scale = _scale(above, reach)
    _from_above(above, cloud, reach, scale)
    _from_side(side, cloud, reach, scale)
    return Text("\n").join([Text("from above, forward is up"), above.text(), Text("from the right, forward is right"), side.text()])


def _scale(canvas: Canvas, reach: float) -> float:
    """Dots per metre, so that `reach` fits into half of the canvas both ways."""
    return float((min(canvas.dots.shape) - 1) / 2 / reach)


def _reach(distance: NDArray[np.float32]) -> float:
    """The range that the picture goes to: the farthest point's, or most points' where a few are far beyond."""
    if not len(distance):
        return 1.0
    farthest, most = float(distance.max()), float(np.percentile(distance, MOST))
    return max(farthest if farthest <= FAR_BEYOND * most else most, 1e-3)


def _from_above(canvas: Canvas, cloud: PointCloud, reach: float, scale: float) -> None:
    centre = _centre(canvas)
    distance = np.hypot(cloud.x, cloud.y).astype(np.float64)
    canvas.plot(centre[0] - cloud.y * scale, centre[1] - cloud.x * scale, np.minimum(distance / reach, 1))
    step = ring_step(reach)
    radii = [step * number for number in range(1, RINGS + 2) if step * number <= reach * 1.001]
    for radius in radii:
        turn = np.linspace(0, 2 * np.pi, max(round(2 * np.pi * radius * scale / RING_GAP), 8), endpoint=False)
        canvas.plot(centre[0] + radius * scale * np.sin(turn), centre[1] - radius * scale * np.cos(turn))
    middle = (int(centre[1]) // DOWN, int(centre[0]) // ACROSS)
    canvas.label(*middle, "^")
    for radius in radii:
        _label_ring(canvas, middle, radius, scale)


def _label_ring(canvas: Canvas, middle: tuple[int, int], radius: float, scale: float) -> None:
    """The range of a ring where it crosses an axis, on the first of its four crossings that is free."""
    text = f"{radius:g} m"
    across, down = round(radius * scale / ACROSS), round(radius * scale / DOWN)
    row, column = middle
    places = [(row, column + across - len(text)), (row - down, column + 1), (row + down, column + 1), (row, column - across + 1)]
    any(canvas.label(*place, text) for place in places)


def _from_side(canvas: Canvas, cloud: PointCloud, reach: float, scale: float) -> None:
    """Forward to the right and up up; the height is centred on the points."""
    heights = cloud.z[np.abs(cloud.x) <= reach]
    middle = float((heights.max() + heights.min()) / 2) if len(heights) else 0.0
    centre = _centre(canvas)
    level = centre[1] + middle * scale
    distance = np.hypot(cloud.x, cloud.y).astype(np.float64)
    canvas.plot(centre[0] + cloud.x * scale, level - cloud.z * scale, np.minimum(distance / reach, 1))
    canvas.plot(np.arange(0, canvas.dots.shape[1], RING_GAP, dtype=np.float64), np.full(-(-canvas.dots.shape[1] // RING_GAP), level))
    canvas.label(int(level) // DOWN, int(centre[0]) // ACROSS, ">")
    canvas.label(int(level) // DOWN, 0, "z 0")


def _centre(canvas: Canvas) -> tuple[float, float]:
    """The middle of a canvas in dots, across and down, on the middle of a cell."""
    return canvas.width // 2 * ACROSS + ACROSS / 2, canvas.height // 2 * DOWN + DOWN / 2


def ring_step(reach: float) -> float:
    """Metres from ring to ring: 1, 2 or 5 times a power of ten, at most four rings."""
    rough = reach / RINGS
    power = 10.0 ** math.floor(math.log10(rough))
    return next(step * power for step in (1, 2, 5, 10) if step * power >= rough * 0.999)
