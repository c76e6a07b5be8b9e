"""Tests of the colour scale that all pictures share: in order and accessible."""

from __future__ import annotations

import numpy as np
import pytest

from lidarspec.points.appearance import RAMP_STEPS, choose_appearance
from lidarspec.points.colours import SCALES, Theme, colour, make_ramp, to_hex
from lidarspec.view.canvas import FIRST_STEP, INKS
from lidarspec.view.svg import svg
from tests.libraries import Library, needs
from tests.view.test_polar import cloud

#: the grounds of an SVG.
PAPERS: dict[Theme, str] = {"dark": "#14161b", "light": "#ffffff"}


def luminance(colours: list[tuple[int, int, int]]) -> np.ndarray:
    """Return the relative luminance of WCAG 2, (n,)."""
    parts = np.array(colours) / 255
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return np.asarray(linear @ (0.2126, 0.7152, 0.0722))


@pytest.mark.parametrize("theme", SCALES)
def test_lightness_rises_and_every_colour_is_readable(theme: Theme) -> None:
    found = luminance(make_ramp(theme, 65))
    assert np.all(np.diff(found) > 0)
    paper = luminance([tuple(bytes.fromhex(PAPERS[theme].lstrip("#")))])  # type: ignore[list-item]
    contrast = (np.maximum(found, paper) + 0.05) / (np.minimum(found, paper) + 0.05)
    assert contrast.min() >= 3


def test_terminal_and_svg_have_the_scale() -> None:
    assert [ink.rgb for ink in INKS[FIRST_STEP:]] == make_ramp("dark", RAMP_STEPS)
    points = cloud(*((x, 0, 0) for x in np.linspace(0.1, 5, 100)))
    picture = svg(points, choose_appearance(points), "title")
    for step, (dark, light) in enumerate(
        zip(make_ramp("dark", RAMP_STEPS), make_ramp("light", RAMP_STEPS), strict=True)
    ):
        assert f".dots{step}{{stroke:{to_hex(dark)}}}" in picture
        assert f'class="ramp{step}"' in picture
        assert f'fill="{to_hex(light)}"' in picture


@needs("matplotlib")
def test_plot_has_the_scale() -> None:
    colours = Library("lidarspec.view.matplotlib_figures").make_colour_map()
    for share in (0.0, 0.5, 1.0):
        assert colours(share, bytes=True)[:3] == pytest.approx(colour(share, "light"), abs=2)
