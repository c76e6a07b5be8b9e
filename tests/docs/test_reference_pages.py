"""The pages of the sensors are those that their specs make."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import lidarspec as ls

DOCS = Path(__file__).parents[2] / "docs"


def script(name: str) -> ModuleType:
    """A script of docs/."""
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_reference_pages_are_up_to_date() -> None:
    made = script("reference_pages").pages()
    there = {path.name: path.read_text(encoding="utf-8") for path in (DOCS / "reference" / "sensors").iterdir()}
    stale = sorted(name for name in made.keys() | there.keys() if made.get(name) != there.get(name))
    assert not stale, f"{', '.join(stale)}: not what the specs say; run: make reference"
    assert {f"{name}.md" for name in ls.sensors()} < set(there)


def test_the_pages_of_the_command_line_are_up_to_date() -> None:
    made = script("command_pages").pages()
    there = {path: (DOCS / path).read_text(encoding="utf-8") for path in made if (DOCS / path).is_file()}
    stale = sorted(path for path in made if made[path] != there.get(path))
    assert not stale, f"{', '.join(stale)}: not what the commands say; run: make reference"
    assert {path.name for path in (DOCS / "man").iterdir()} == {Path(path).name for path in made if path.startswith("man/")}
    assert "\\fB\\-\\-scan NUMBER\\fR" in made["man/lidarspec-plot.1"]
    assert "| `--scan NUMBER` |" in made["reference/command-line.md"]
