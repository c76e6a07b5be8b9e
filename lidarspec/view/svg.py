"""A cloud as an SVG picture: the same views as in the terminal, for a page."""

from __future__ import annotations

import math
from collections.abc import Iterator
from html import escape

import numpy as np
from numpy.typing import NDArray

from lidarspec.points.cloud import PointCloud
from lidarspec.view.canvas import STEPS, Rgb
from lidarspec.view.polar import Look, ring_step, shade

#: pixels: of each side of the view from above, of the margins, of a dot, and of the highest view from the side.
SIDE, MARGIN, DOT, HIGHEST = 720, 40, 1.6, 320
#: near to far, or weak to strong: hues that can be told apart on white.
_INK: tuple[Rgb, ...] = ((205, 40, 45), (214, 116, 0), (140, 138, 0), (24, 138, 62), (0, 128, 150), (44, 84, 200), (118, 48, 176))


def svg(points: PointCloud, look: Look, title: str) -> str:
    """The cloud from above and, unless the look is flat, from its right side, as an SVG document."""
    cloud = points[points.valid]
    scale = SIDE / 2 / look.reach
    colours = np.clip(shade(cloud, look) * STEPS, 0, STEPS - 1).astype(np.intp)
    above = list(_above(cloud, colours, look, scale))
    side, height = (list(_side(cloud, colours, look, scale)), _heights(cloud, scale)[1]) if not look.flat else ([], 0.0)
    width, total = SIDE + 2 * MARGIN, SIDE + 3 * MARGIN + (height + MARGIN if side else 0)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {total:.0f}" width="{width}" height="{total:.0f}" '
        'font-family="sans-serif" font-size="12" fill="#555">',
        f'<rect width="100%" height="100%" fill="#fff"/><text x="{MARGIN}" y="24" font-size="14" fill="#222">{escape(title)}</text>',
        *_legend(look),
        f'<svg x="{MARGIN}" y="{MARGIN * 1.5}" width="{SIDE}" height="{SIDE}">',
        *above,
        "</svg>",
    ]
    if side:
        parts += [f'<svg x="{MARGIN}" y="{SIDE + MARGIN * 2.5}" width="{SIDE}" height="{height:.0f}">', *side, "</svg>"]
    return "\n".join([*parts, "</svg>"]) + "\n"


def _above(cloud: PointCloud, colours: NDArray[np.intp], look: Look, scale: float) -> Iterator[str]:
    """Rings with their ranges, axes, points, and the sensor; forward is up."""
    across, down = SIDE / 2 + look.middle[1] * scale, SIDE / 2 + look.middle[0] * scale
    yield f'<g fill="none" stroke="#ddd"><path d="M{across:.1f} 0V{SIDE}M0 {down:.1f}H{SIDE}"/>'
    step = ring_step(look.reach)
    radii = [step * number for number in range(1, int(look.reach * math.sqrt(2) / step) + 1)]
    for radius in radii:
        yield f'<circle cx="{across:.1f}" cy="{down:.1f}" r="{radius * scale:.1f}"/>'
    yield "</g>"
    yield from _dots(across - cloud.y * scale, down - cloud.x * scale, colours)
    for radius in radii:
        yield f'<text x="{across + radius * scale - 3:.1f}" y="{down - 4:.1f}" text-anchor="end">{radius:g} m</text>'
    yield f'<path d="M{across:.1f} {down - 9:.1f}l6 15h-12z" fill="#222"/>'
    yield f'<text x="{across + 6:.1f}" y="12">0° forward</text><text x="2" y="{down - 4:.1f}">90°</text>'


def _side(cloud: PointCloud, colours: NDArray[np.intp], look: Look, scale: float) -> Iterator[str]:
    """Heights with their labels, and points; forward is right."""
    top, height, larger = _heights(cloud, scale)
    across, level = SIDE / 2 - look.middle[0] * scale, top * scale * larger
    step = ring_step(height / scale / larger)
    marks = [number * step for number in range(math.ceil((level - height) / scale / larger / step), int(top / step) + 1)]
    for mark in marks:
        at = level - mark * scale * larger
        yield f'<path d="M0 {at:.1f}H{SIDE}" stroke="#ddd"/><text x="2" y="{at - 3:.1f}">z {mark:.4g} m</text>'
    yield from _dots(across + cloud.x * scale, level - cloud.z * scale * larger, colours)
    told = f"from the right, forward is right{f', heights x{larger}' if larger > 1 else ''}"
    yield f'<path d="M{across + 9:.1f} {level:.1f}l-15 6v-12z" fill="#222"/><text x="{SIDE}" y="12" text-anchor="end">{told}</text>'


def _heights(cloud: PointCloud, scale: float) -> tuple[float, float, int]:
    """The highest z, the height of the view in pixels, and by how much heights are drawn larger."""
    low, high = min(float(cloud.z.min(initial=0)), 0.0), max(float(cloud.z.max(initial=0)), 0.0)
    span = max(high - low, 1e-3)
    larger = max((n for n in (1, 2, 5, 10) if span * scale * n <= HIGHEST), default=1)
    return high + 0.05 * span, span * 1.1 * scale * larger, larger


def _dots(across: NDArray[np.float32], down: NDArray[np.float32], colours: NDArray[np.intp]) -> Iterator[str]:
    """Points as round dots, one path for each colour; of several in half a pixel the first."""
    places = np.rint(np.stack([across, down], axis=1) * 2).astype(np.int64)
    _, kept = np.unique(places, axis=0, return_index=True)
    for step in range(STEPS):
        mine = kept[colours[kept] == step]
        if len(mine):
            data = "".join(f"M{x / 2:g} {y / 2:g}h0" for x, y in places[np.sort(mine)].tolist())
            yield f'<path d="{data}" stroke="{_colour(step)}" stroke-width="{DOT}" stroke-linecap="round" fill="none"/>'


def _legend(look: Look) -> Iterator[str]:
    left, width = SIDE + MARGIN - STEPS * 8, 8
    for step in range(STEPS):
        yield f'<rect x="{left + step * width}" y="16" width="{width}" height="8" fill="{_colour(step)}"/>'
    begin, end = (escape(text) for text in look.ends)
    yield f'<text x="{left}" y="38">{begin}</text><text x="{left + STEPS * width}" y="38" text-anchor="end">{end}</text>'
    yield f'<text x="{left + STEPS * width / 2}" y="38" text-anchor="middle">{look.ramp}</text>'


def _colour(step: int) -> str:
    place = step / (STEPS - 1) * (len(_INK) - 1)
    return "#" + "".join(f"{round(float(np.interp(place, range(len(_INK)), [ink[part] for ink in _INK]))):02x}" for part in range(3))
