"""Tests that the page uses the colour scale of all other pictures."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lidarspec.points.colours import SCALES, Theme, make_ramp, to_hex

#: The tests of the TypeScript sources compare the page's scale with this file.
PAGE_RAMPS = Path(__file__).parents[1] / "page" / "tests" / "ramp.json"


@pytest.mark.parametrize("theme", SCALES)
def test_the_page_has_the_same_scale(theme: Theme) -> None:
    ramp = json.loads(PAGE_RAMPS.read_text(encoding="utf-8"))[theme]
    assert [to_hex(rgb) for rgb in make_ramp(theme, len(ramp))] == ramp
