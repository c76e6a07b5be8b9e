"""Test of the wiring of an STL-27L on its page (manual, section 2)."""

from __future__ import annotations

from pathlib import Path

import pytest

import lidarspec_ldrobot

NOTES = Path(lidarspec_ldrobot.__file__).parent / "notes" / "ldrobot-stl27l.md"


@pytest.mark.parametrize(
    "row",
    [
        ["1", "Tx", "output", "0 V", "3.3 V", "3.5 V"],
        ["2", "PWM", "input", "0 V", "", "3.3 V"],
        ["3", "GND", "supply", "", "0 V", ""],
        ["4", "P5V", "supply", "4.5 V", "5 V", "5.5 V"],
    ],
)
def test_the_page_has_the_signals_of_the_connector(row: list[str]) -> None:
    text = NOTES.read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if line.startswith(f"| {row[0]} |")]
    assert len(lines) == 1
    cells = [cell.strip() for cell in lines[0].strip("|").split("|")]
    assert [cells[0], cells[1].partition(":")[0], *cells[2:]] == row
    assert "ZH1.5T-4P" in text
