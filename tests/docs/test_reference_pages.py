"""The pages of the sensors are those that their specs make."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import lidarspec as ls

DOCS = Path(__file__).parents[2] / "docs"


def test_reference_pages_are_up_to_date() -> None:
    spec = importlib.util.spec_from_file_location("reference_pages", DOCS / "reference_pages.py")
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    made = script.pages()
    there = {path.name: path.read_text(encoding="utf-8") for path in (DOCS / "reference" / "sensors").iterdir()}
    stale = sorted(name for name in made.keys() | there.keys() if made.get(name) != there.get(name))
    assert not stale, f"{', '.join(stale)}: not what the specs say; run: make reference"
    assert {f"{name}.md" for name in ls.sensors()} < set(there)
