"""Tests of notebook pictures and tables in a browser, on light and dark pages."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

import lidarspec as ls


@pytest.mark.slow
def test_pictures_and_tables_are_readable_on_light_and_dark_pages(browser: Any) -> None:
    scan = next(ls.sensor("ldrobot-stl27l").scans(ls.sensor("ldrobot-stl27l").example("data")))
    explained = ls.explain(ls.sensor("ldrobot-stl27l").example("data"), ls.sensor("ldrobot-stl27l"))
    for scheme, colours in (
        ("light", "background:#fff;color:#111"),
        ("dark", "background:#111;color:#ddd"),
    ):
        page = browser.new_page(color_scheme=scheme)
        page.set_content(f"<body style='{colours}'>{scan._repr_svg_()}{explained._repr_html_()}")
        seen = page.evaluate(
            """() => Object.fromEntries([
                ["ground", "rect"], ["head", "text"], ["dots", "path[class^=dots]"],
            ].map(([name, what]) => {
                const style = getComputedStyle(document.querySelector("svg " + what));
                return [name, name == "dots" ? style.stroke : style.fill];
            }))"""
        )
        ground, head, dot = (luminance(seen[name]) for name in ("ground", "head", "dots"))
        assert contrast(ground, head) > 7
        assert contrast(ground, dot) > 2.5
        assert page.evaluate(
            "getComputedStyle(document.querySelector('td code')).color"
        ) == page.evaluate("getComputedStyle(document.body).color")


def luminance(colour: str) -> float:
    """Return the relative luminance of "rgb(r, g, b)" as defined by WCAG."""
    channels = np.array([int(number) for number in re.findall(r"\d+", colour)[:3]]) / 255
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def contrast(one: float, other: float) -> float:
    return (max(one, other) + 0.05) / (min(one, other) + 0.05)
