"""Draw a cloud as SVG, in the light or dark colour scheme of the browser."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from lidarspec.points.appearance import (
    RAMP_STEPS,
    CloudAppearance,
    find_bounds,
    ramp_indices,
    ring_step,
)
from lidarspec.points.cloud import PointCloud
from lidarspec.points.colours import make_ramp, to_hex

#: side of the view from above.
SIDE_PX = 720
#: margin around the picture. The next constant is the height of the picture's header.
MARGIN_PX = 24
HEADER_PX = 58
#: height of the title of a view.
VIEW_TITLE_PX = 18
#: diameter of a dot.
DOT_PX = 1.6
#: maximum height of the side view, as a share of the side of the view from above.
MAX_HEIGHT_SHARE = 0.45
#: margin between the content and the edges of the view from above.
VIEW_MARGIN_PX = 24
#: height of a text above its base line.
FONT_HEIGHT_PX = 11
CHARACTER_WIDTH_PX = 6.7
#: possible distances between dots. The first distance that gives no more dots than allowed is used.
GRIDS_PX = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0)
#: colours of `_PARTS` on light and on dark pages.
_LIGHT, _DARK = ("#fff", "#ddd", "#555", "#222"), ("#14161b", "#34373f", "#9ea3ae", "#e4e6eb")
_PARTS = ("ground", "line", "text", "head")


def svg(
    points: PointCloud,
    look: CloudAppearance,
    title: str,
    *,
    side: int = SIDE_PX,
    max_dots: int | None = None,
) -> str:
    """Return a cloud as an SVG document.

    The cloud is drawn from above and, if it is not flat, from the right side.

    Args:
        look: the extent of the view and the colours of the points, from `choose_appearance`.
        side: width and height of the view from above, in pixels.
        max_dots: maximum number of dots in a view; None for no limit.
    """
    cloud = points[points.valid]
    views = _ViewDrawer(cloud, look, side, max_dots, ramp_indices(cloud, look))
    if look.flat:
        shown = [views.draw_from_above()]
    else:
        shown = [views.draw_from_above(), views.draw_from_side()]
    width = side + 2 * MARGIN_PX
    top = HEADER_PX
    body: list[str] = []
    for view in shown:
        body.append(f'<text x="{MARGIN_PX}" y="{top + 12}" {_style_of("text")}>{view.title}</text>')
        box = f'viewBox="0 {view.top:.0f} {side} {view.height:.0f}"'
        body += [
            f'<svg x="{MARGIN_PX}" y="{top + VIEW_TITLE_PX}" width="{side}"'
            f' height="{view.height:.0f}" {box}>',
            *view.parts,
            "</svg>",
        ]
        top += round(view.height) + VIEW_TITLE_PX + MARGIN_PX
    drawn = " and ".join(f"{view.dots:,}" for view in shown)
    head = [
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {top}" width="{width}"'
            f' height="{top}" font-family="system-ui, sans-serif" font-size="12">'
        ),
        f"<style>{_make_style()}</style>",
        f'<rect width="100%" height="100%" {_style_of("ground")}/>',
        f'<text x="{MARGIN_PX}" y="26" font-size="14" {_style_of("head")}>{escape(title)}</text>',
        f'<text x="{MARGIN_PX}" y="48" {_style_of("text")}>'
        f"{len(cloud):,} returns as {drawn} dots</text>",
        *_iter_legend(look, width - MARGIN_PX),
    ]
    return "\n".join([*head, *body, "</svg>"]) + "\n"


@dataclass(frozen=True)
class _View:
    """One view of a cloud.

    Attributes:
        top: the upper end of the view, in pixels.
        height: the height of the view, in pixels.
    """

    title: str
    parts: list[str]
    top: float
    height: float
    dots: int


@dataclass(frozen=True)
class _ViewDrawer:
    """Draws the views of a cloud.

    Attributes:
        side: width and height of the view from above, in pixels.
        max_dots: maximum number of dots in a view; None for no limit.
        colours: the colour of each point, as a step of the colour ramp, (n,).
    """

    cloud: PointCloud
    look: CloudAppearance
    side: int
    max_dots: int | None
    colours: NDArray[np.intp]

    @property
    def _scale(self) -> float:
        return self.side / 2 / self.look.reach

    def draw_from_above(self) -> _View:
        """Draw range rings, axes, points and the sensor from above, with the front at the top."""
        scale = self._scale
        side = self.side
        forward, left = self.look.middle
        across = side / 2 + left * scale
        down = side / 2 + forward * scale
        step = ring_step(self.look.reach)
        reach = self.look.reach
        nearest = math.hypot(max(abs(forward) - reach, 0.0), max(abs(left) - reach, 0.0))
        farthest = math.hypot(abs(forward) + reach, abs(left) + reach)
        radii = [
            step * number for number in range(max(int(nearest / step), 1), int(farthest / step) + 1)
        ]
        circles = "".join(
            f'<circle cx="{across:.1f}" cy="{down:.1f}" r="{radius * scale:.1f}"/>'
            for radius in radii
        )
        rows = down - self.cloud.x * scale
        dots, paths = self._draw_dots(across - self.cloud.y * scale, rows, side)
        top = max(min(float(rows.min(initial=down)), down) - VIEW_MARGIN_PX, 0)
        bottom = min(max(float(rows.max(initial=down)), down) + VIEW_MARGIN_PX, side)
        labels = _Labels(side, top, bottom)
        labels.write("0°", [(across + 6, top + 12)])
        labels.write("90°", [(2, down - 4)])
        for radius in radii:
            text = f"{radius:g} m"
            away = radius * scale
            width = _estimate_text_width(text)
            right = (across + away - 3 - width, down - 4)
            leftward = (across - away + 3, down - 4)
            ahead = (across + 6, down - away + 14)
            behind = (across + 6, down + away - 4)
            share = away / max(math.hypot(forward, left) * scale, 1e-9)
            towards_middle = (
                across + share * (side / 2 - across),
                down + share * (side / 2 - down),
            )
            labels.write(text, [right, leftward, ahead, behind, towards_middle])
        axes = f'<path d="M{across:.1f} 0V{side}M0 {down:.1f}H{side}"/>'
        parts = [
            f'<g fill="none" {_style_of("line", "stroke")}>{axes}{circles}</g>',
            *paths,
            f"<g {_style_of('text')}>{''.join(labels.parts)}</g>",
            f'<path d="M{across:.1f} {down - 9:.1f}l6 15h-12z" {_style_of("head")}/>',
        ]
        return _View("top view, front at the top", parts, top, bottom - top, dots)

    def draw_from_side(self) -> _View:
        """Draw height lines, points and the sensor from its right, with the front at the right."""
        scale = self._scale
        side = self.side
        lowest, highest = find_bounds(self.cloud)
        low = min(float(lowest[2]), 0.0)
        high = max(float(highest[2]), 0.0)
        span = max(high - low, 1e-3)
        larger = max(
            (n for n in (1, 2, 5, 10) if span * scale * n <= MAX_HEIGHT_SHARE * side), default=1
        )
        steep = scale * larger
        top = high + 0.05 * span
        height = span * 1.1 * scale * larger
        across = side / 2 - self.look.middle[0] * scale
        level = top * steep
        step = ring_step(height / steep)
        marks = [
            number * step
            for number in range(math.ceil((level - height) / steep / step), int(top / step) + 1)
        ]
        lines = "".join(f"M0 {level - mark * steep:.1f}H{side}" for mark in marks)
        labels = _Labels(side, 0, height)
        for mark in marks:
            labels.write(f"z {mark:.4g} m", [(2, level - mark * steep - 3)])
        title = f"side view, front at the right{f', heights x{larger}' if larger > 1 else ''}"
        dots, paths = self._draw_dots(
            across + self.cloud.x * scale, level - self.cloud.z * steep, height
        )
        parts = [
            f'<path d="{lines}" {_style_of("line", "stroke")}/>',
            *paths,
            f"<g {_style_of('text')}>{''.join(labels.parts)}</g>",
            f'<path d="M{across + 9:.1f} {level:.1f}l-15 6v-12z" {_style_of("head")}/>',
        ]
        return _View(title, parts, 0, height, dots)

    def _draw_dots(
        self, across: NDArray[np.float32], down: NDArray[np.float32], height: float
    ) -> tuple[int, list[str]]:
        """Return the number of dots, and SVG elements that draw them, one path per colour.

        Args:
            across: horizontal coordinates of the points, (n,) pixels.
            down: vertical coordinates of the points, (n,) pixels.
            height: height of the view, in pixels.
        """
        inside = np.flatnonzero(
            (across >= 0) & (across <= self.side) & (down >= 0) & (down <= height)
        )
        for grid in GRIDS_PX:
            cells = np.rint(np.stack([down[inside], across[inside]], axis=1) / grid).astype(
                np.int64
            )
            _, first = np.unique(cells @ (1 << 20, 1), return_index=True)
            if self.max_dots is None or len(first) <= self.max_dots:
                break
        cells = cells[first]
        colours = self.colours[inside[first]]
        width = max(DOT_PX, grid * 1.3) / grid
        paths = [
            f'<path class="dots{step}" d="{_make_path(cells[colours == step])}"'
            f' stroke="{_COLOURS[step]}"/>'
            for step in np.unique(colours).tolist()
        ]
        group = (
            f'<g transform="scale({grid:g})" fill="none" stroke-width="{width:.2g}"'
            ' stroke-linecap="round">'
        )
        return len(first), [group, *paths, "</g>"]


class _Labels:
    """Places texts in a view so that they do not overlap or leave the view.

    Args:
        side: width of the view, in pixels.
        top, bottom: vertical limits of the view, in pixels.
    """

    def __init__(self, side: float, top: float, bottom: float) -> None:
        self._side = side
        self._top = top
        self._bottom = bottom
        self._taken: list[tuple[float, float, float, float]] = []
        self.parts: list[str] = []

    def write(self, text: str, positions: Iterable[tuple[float, float]]) -> None:
        """Write a text at the first position at which it fits, if any.

        Args:
            positions: possible positions of the left end of the base line, in pixels.
        """
        for left, base in positions:
            right = left + _estimate_text_width(text)
            top = base - FONT_HEIGHT_PX
            if left < 0 or right > self._side or top < self._top or base > self._bottom:
                continue
            if any(
                left < other[2] and other[0] < right and top < other[3] and other[1] < base
                for other in self._taken
            ):
                continue
            self._taken.append((left, top, right, base))
            self.parts.append(f'<text x="{left:.1f}" y="{base:.1f}">{text}</text>')
            return


def _estimate_text_width(text: str) -> float:
    """Return the approximate width of a text in pixels."""
    return CHARACTER_WIDTH_PX * len(text)


def _make_path(dots: NDArray[np.int64]) -> str:
    """Return an SVG path that draws dots.

    Args:
        dots: row and column of each dot, (n, 2).
    """
    steps = np.diff(dots, axis=0, prepend=0)
    return "".join(f"m{across} {down}h0" for down, across in steps.tolist())


def _iter_legend(look: CloudAppearance, right: int) -> Iterator[str]:
    """Yield the elements of the legend: colours, name of the column, and end values.

    Args:
        right: the right edge of the legend, in pixels.
    """
    low, high = (escape(text) for text in look.ends)
    left = right - 7 * len(high) - 12 - RAMP_STEPS * 6
    yield (
        f'<g {_style_of("text")}><text x="{left - 8}" y="48" text-anchor="end">{escape(look.ramp)},'
        f" {low}</text>"
    )
    yield f'<text x="{right}" y="48" text-anchor="end">{high}</text></g>'
    for step in range(RAMP_STEPS):
        yield (
            f'<rect class="ramp{step}" x="{left + step * 6}" y="40" width="6" height="8"'
            f' fill="{_COLOURS[step]}"/>'
        )


def _style_of(part: str, attribute: str = "fill") -> str:
    """Return the SVG attributes for the colour of a part of the picture."""
    return f'class="{part}" {attribute}="{_LIGHT[_PARTS.index(part)]}"'


def _make_style() -> str:
    """Return the CSS that sets the colours on dark pages."""
    inks = [to_hex(rgb) for rgb in make_ramp("dark", RAMP_STEPS)]
    dots = [
        f".dots{step}{{stroke:{ink}}}.ramp{step}{{fill:{ink}}}" for step, ink in enumerate(inks)
    ]
    parts = [
        f".{part}{{{'stroke' if part == 'line' else 'fill'}:{colour}}}"
        for part, colour in zip(_PARTS, _DARK, strict=True)
    ]
    return f"@media(prefers-color-scheme:dark){{{''.join([*parts, *dots])}}}"


_COLOURS = [to_hex(rgb) for rgb in make_ramp("light", RAMP_STEPS)]
