"""The colours of values, the same in every picture.

Low values are blue, medium values green and high values yellow. The scale is a helix in the colour
space OKLab. The lightness increases along the whole scale, so that colour-blind readers can see the
order. Every colour has a contrast of at least 3:1 with the background. The page of ``view --web``
uses the same scale, in ``colours.ts`` of `lidarspec-web`.

Source: Ottosson, A perceptual color space for image processing (2020), for the matrices.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

Rgb = tuple[int, int, int]
Theme = Literal["dark", "light"]

#: The matrices from OKLab to the cube roots of the cone responses, and from the cone responses to
#: linear sRGB.
_CONES = (
    (1.0, 0.3963377774, 0.2158037573),
    (1.0, -0.1055613458, -0.0638541728),
    (1.0, -0.0894841775, -1.291485548),
)
_LINEAR = (
    (4.0767416621, -3.3077115913, 0.2309699292),
    (-1.2684380046, 2.6097574011, -0.3413193965),
    (-0.0041960863, -0.7034186147, 1.707614701),
)


@dataclass(frozen=True)
class Scale:
    """A colour scale in OKLab.

    Attributes:
        lightness: the first and the last lightness, from 0 to 1.
        hue: the first and the last hue, degrees.
        chroma: the chroma of all colours.
    """

    lightness: tuple[float, float]
    hue: tuple[float, float]
    chroma: float


SCALES: dict[Theme, Scale] = {
    "dark": Scale((0.52, 0.92), (285.0, 100.0), 0.125),
    "light": Scale((0.34, 0.66), (285.0, 100.0), 0.11),
}


def colour(share: float, theme: Theme) -> Rgb:
    """Return the colour at a position on the scale, from 0 (first) to 1 (last)."""
    scale = SCALES[theme]
    lightness = _interpolate(scale.lightness, share)
    hue = math.radians(_interpolate(scale.hue, share))
    red, green, blue = _to_srgb(
        lightness, scale.chroma * math.cos(hue), scale.chroma * math.sin(hue)
    )
    return red, green, blue


def make_ramp(theme: Theme, count: int) -> list[Rgb]:
    """Return `count` colours at even distances, from the first to the last of the scale."""
    return [colour(step / (count - 1), theme) for step in range(count)]


def to_hex(rgb: Rgb) -> str:
    """Return a colour as "#rrggbb"."""
    return "#" + "".join(f"{part:02x}" for part in rgb)


def _interpolate(ends: tuple[float, float], share: float) -> float:
    """Return a value between two ends: the first for a `share` of 0, the last for 1."""
    return ends[0] + (ends[1] - ends[0]) * share


def _to_srgb(lightness: float, a: float, b: float) -> list[int]:
    """Return a colour of OKLab as red, green and blue in sRGB, from 0 to 255."""
    cones = [(row[0] * lightness + row[1] * a + row[2] * b) ** 3 for row in _CONES]
    parts = []
    for row in _LINEAR:
        linear = sum(factor * cone for factor, cone in zip(row, cones, strict=True))
        linear = min(max(linear, 0.0), 1.0)
        if linear <= 0.0031308:
            encoded = 12.92 * linear
        else:
            encoded = 1.055 * linear ** (1 / 2.4) - 0.055
        parts.append(round(255 * encoded))
    return parts
