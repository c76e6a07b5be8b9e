"""Tests of keys, and of the program that draws the screens of the docs."""

from __future__ import annotations

import importlib.util
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from lidarspec.view.canvas import STRONG, Canvas
from lidarspec.view.terminal_screen import decode_keys
from lidarspec.view.terminal_window import ViewSettings


@pytest.mark.parametrize(
    ("text", "keys"),
    [
        ("q", ["q"]),
        ("+-", ["+", "-"]),
        ("\x1b[A\x1b[B\x1bOC\x1b[D", ["up", "down", "right", "left"]),
        ("\x1b", ["escape"]),
        ("\x1b[5~q", ["q"]),
        ("\x1b[1;5Cq", ["q"]),
        ("\x1b[", []),
        ("", []),
    ],
)
def test_keys_of_a_terminal(text: str, keys: list[str]) -> None:
    assert decode_keys(text) == keys


def test_keys_change_the_view() -> None:
    begin = ViewSettings()
    assert begin.after_key("c", 6).ramp == "intensity"
    assert begin.after_key("c", 6).after_key("c", 6) == begin
    assert begin.after_key("+", 6).after_key("-", 6) == begin
    assert begin.after_key("+", 6).zoom > 1
    assert begin.after_key("up", 5).middle == (1.0, 0.0)
    assert begin.after_key("left", 5).middle == (0.0, 1.0)
    assert (
        begin.after_key("down", 5).after_key("right", 5).after_key("+", 5).after_key("0", 5)
        == begin
    )
    assert begin.after_key(" ", 6).paused
    assert begin.after_key("q", 6).is_closing
    assert begin.after_key("?", 6).shows_keys
    assert not begin.after_key("?", 6).after_key("escape", 6).shows_keys
    assert begin.after_key("x", 6) is begin


def test_screens_of_the_docs_are_complete() -> None:
    path = Path(__file__).parents[2] / "docs" / "screens.py"
    spec = importlib.util.spec_from_file_location("screens", path)
    assert spec is not None
    assert spec.loader is not None
    screens = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(screens)
    canvas = Canvas(12, 4)
    canvas.plot(np.arange(0.5, 8), np.full(8, 3.5), np.linspace(0, 0.99, 8))
    canvas.label(2, 3, "a < b", STRONG)
    root = ET.fromstring(screens.svg(canvas.cells()))
    assert sum(path.get("d", "").count("M") for path in root.findall(".//{*}path")) == 8
    assert [text.text for text in root.findall(".//{*}text")] == ["a", "<", "b"]


def test_the_key_c_cycles_through_all_columns() -> None:
    shown, settings = ["range", "velocity", "snr"], ViewSettings()
    seen = [(settings := settings.after_key("c", 6, shown)).ramp for _ in range(3)]
    assert seen == ["velocity", "snr", "range"]
