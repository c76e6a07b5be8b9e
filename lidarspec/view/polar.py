"""Draw clouds in character cells.

A cloud is drawn from above, with range rings; the front of the sensor is at the top of the picture.
A 3D cloud is also drawn from its right side; the front is then at the right of the picture.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lidarspec.points.appearance import REACH_PERCENTILE, CloudAppearance, ramp_positions, ring_step
from lidarspec.points.cloud import PointCloud
from lidarspec.view.canvas import DOTS_ACROSS, DOTS_DOWN, FAINT, LABEL, STRONG, Canvas, CellGrid

#: distance between two drawn dots of a ring, in units of dots.
RING_GAP_DOTS = 4
#: share of the window's height that the view from above gets if there are two views.
TOP_VIEW_SHARE = 0.62
#: factors by which heights can be enlarged in the side view.
HEIGHT_FACTORS = (1, 2, 5, 10)
#: maximum share of the side view's height that the points fill.
MAX_FILLED_SHARE = 0.9


def draw_cloud(points: PointCloud, *, width: int, height: int, look: CloudAppearance) -> CellGrid:
    """Draw a cloud from above and, if it is not flat, from the right side.

    Args:
        width: number of columns of cells.
        height: number of rows of cells.
        look: the extent of the view and the colours of the points, from `choose_appearance`.
    """
    cloud = points[points.valid]
    if look.flat:
        return _draw_from_above(cloud, width, height, look)
    above = max(round((height - 1) * TOP_VIEW_SHARE), 1)
    whole = CellGrid.blank(width, height)
    whole.paste(0, 0, _draw_from_above(cloud, width, above, look))
    side, scale = _draw_from_side(
        cloud, width, max(height - 1 - above, 1), look, _find_scale(width, above, look.reach)
    )
    title = "─ side view, front at the right" + (f", heights x{scale} " if scale > 1 else " ")
    whole.write(above, 0, title.ljust(width, "─"), FAINT)
    whole.write(above, 2, title[2:].rstrip("─ "), LABEL)
    whole.paste(above + 1, 0, side)
    return whole


def _find_scale(width: int, height: int, reach: float) -> float:
    """Return the scale in dots per metre at which half a canvas shows `reach` metres."""
    return (min(width * DOTS_ACROSS, height * DOTS_DOWN) - 1) / 2 / reach


def _draw_from_above(cloud: PointCloud, width: int, height: int, look: CloudAppearance) -> CellGrid:
    canvas = Canvas(width, height, look.ramp)
    scale = _find_scale(width, height, look.reach)
    middle = _find_middle(canvas)
    across = middle[0] + look.middle[1] * scale
    down = middle[1] + look.middle[0] * scale
    canvas.plot(across - cloud.y * scale, down - cloud.x * scale, ramp_positions(cloud, look))
    step = ring_step(look.reach)
    radii = [
        step * number
        for number in range(1, int((look.reach + math.hypot(*look.middle)) / step * 1.001) + 1)
    ]
    for radius in radii:
        turn = np.linspace(
            0, 2 * np.pi, max(round(2 * np.pi * radius * scale / RING_GAP_DOTS), 8), endpoint=False
        )
        canvas.draw_line(
            across + radius * scale * np.sin(turn), down - radius * scale * np.cos(turn)
        )
    home = (math.floor(down) // DOTS_DOWN, math.floor(across) // DOTS_ACROSS)
    canvas.label(*home, "▲", STRONG, over=True)
    _label_directions(canvas, home)
    for radius in radii:
        _label_ring(canvas, home, radius, scale)
    return canvas.cells()


def _label_directions(canvas: Canvas, home: tuple[int, int]) -> None:
    """Write the azimuths of the four directions at the edges."""
    row, column = home
    canvas.label(0, column, "0° forward") or canvas.label(0, column, "0°")
    canvas.label(row, 0, "90° ")
    canvas.label(row, canvas.width - 5, " -90°")
    canvas.label(canvas.height - 1, column, "180°")


def _label_ring(canvas: Canvas, home: tuple[int, int], radius: float, scale: float) -> None:
    """Write the range of a ring where the ring crosses an axis and there is space."""
    text = f"{radius:g} m"
    across = round(radius * scale / DOTS_ACROSS)
    down = round(radius * scale / DOTS_DOWN)
    row, column = home
    places = [
        (row, column + across - len(text)),
        (row - down, column + 1),
        (row + down, column + 1),
        (row, column - across + 1),
    ]
    for label_row, label_column in places:
        if canvas.label(label_row, label_column, text):
            return


def _draw_from_side(
    cloud: PointCloud, width: int, height: int, look: CloudAppearance, scale: float
) -> tuple[CellGrid, int]:
    """Return the view from the right side, and the magnification of heights."""
    canvas = Canvas(width, height, look.ramp)
    inside = np.abs(cloud.x - look.middle[0]) <= canvas.dots.shape[1] / 2 / scale
    low, high = _find_heights(cloud.z[inside])
    larger = max(
        (
            n
            for n in HEIGHT_FACTORS
            if (high - low) * scale * n <= canvas.dots.shape[0] * MAX_FILLED_SHARE
        ),
        default=1,
    )
    middle = _find_middle(canvas)
    across = middle[0] - look.middle[0] * scale
    level = middle[1] + (low + high) / 2 * scale * larger
    canvas.plot(
        across + cloud.x * scale, level - cloud.z * scale * larger, ramp_positions(cloud, look)
    )
    step = ring_step(canvas.dots.shape[0] / scale / larger)
    half = canvas.dots.shape[0] / scale / larger / 2
    first, last = (math.ceil(((low + high) / 2 + end * half) / step) for end in (-1, 1))
    for number in range(first, last + 1):
        line = level - number * step * scale * larger
        gap = RING_GAP_DOTS if number == 0 else 4 * RING_GAP_DOTS
        columns = np.arange(0, canvas.dots.shape[1], gap, dtype=np.float64)
        canvas.draw_line(columns, np.full(len(columns), line))
        canvas.label(
            math.floor(line) // DOTS_DOWN, 0, "z 0 m" if number == 0 else f"{number * step:+.4g} m"
        )
    canvas.label(
        math.floor(level) // DOTS_DOWN, math.floor(across) // DOTS_ACROSS, "▶", STRONG, over=True
    )
    return canvas.cells(), larger


def _find_heights(z: NDArray[np.float32]) -> tuple[float, float]:
    """Return the lowest and the highest z of the side view, in metres."""
    if not len(z):
        return 0.0, 0.0
    low, high = (
        float(value) for value in np.percentile(z, (100 - REACH_PERCENTILE, REACH_PERCENTILE))
    )
    return min(low, 0.0), max(high, 0.0)


def _find_middle(canvas: Canvas) -> tuple[float, float]:
    """Return the column and row of the centre of the middle cell, in dots."""
    return (
        canvas.width // 2 * DOTS_ACROSS + DOTS_ACROSS / 2,
        canvas.height // 2 * DOTS_DOWN + DOTS_DOWN / 2,
    )
