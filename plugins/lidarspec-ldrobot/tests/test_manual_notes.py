"""Tests that the page of the STL-27L describes its wiring and its speed control.

Source: manual, sections 1 and 2.
"""

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


@pytest.mark.parametrize(
    "sentence",
    [
        "**Internal control**: connect PWM to GND. An open pin is not allowed.",
        "The speed is 10 +- 0.1 Hz, at the latest 3 s after power-up.",
        "20 to 50 kHz (30 kHz recommended)",
        "a duty cycle above 45 % and below 55 % for at least 100 ms",
        "until the power is switched off, the duty cycle starts and stops the motor and sets its",
        "The speed at a given duty cycle differs between units",
    ],
)
def test_the_page_has_the_rules_of_the_speed_control(sentence: str) -> None:
    assert sentence in " ".join(NOTES.read_text(encoding="utf-8").split())
