"""Tests that the terminal screens on the pages are the output of the verbs.

Screens that depend on the time are compared by their headings, all others word for word.
"""

from __future__ import annotations

import doctest
import re
from pathlib import Path

import pytest

from lidarspec.testing.fixtures import virtual_port
from tests.cli.running import ran

PAGES = Path(__file__).parents[2] / "docs" / "how-to"
SHOWING = ("find.md", "troubleshoot.md", "explain.md", "stats.md")


def screens() -> dict[str, str]:
    """Return the output below each command on the pages."""
    pages = [(PAGES / name).read_text(encoding="utf-8") for name in SHOWING]
    return {
        command: text
        for page in pages
        for command, text in re.findall(r"```text\n\$ lidarspec (.*)\n((?:.*\n)*?)```", page)
    }


def test_every_verb_that_shows_something_has_its_screen() -> None:
    assert {command.split()[0] for command in screens()} == {"detect", "doctor", "explain", "stats"}
    for name in ("view-2d.svg", "view-3d.svg"):
        assert f"screens/{name}" in (PAGES / "view.md").read_text(encoding="utf-8")
        assert (PAGES / "screens" / name).read_text(encoding="utf-8").startswith("<svg")


def test_explain_prints_the_listing_of_the_page() -> None:
    explained = {
        command: text for command, text in screens().items() if command.startswith("explain")
    }
    assert len(explained) == 2
    for command, text in explained.items():
        printed = ran(*command.split()).stdout
        assert doctest.OutputChecker().check_output(text, printed, doctest.ELLIPSIS), command


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["detect", "doctor", "stats"])
def test_the_columns_are_those_of_the_page(verb: str, tmp_path: Path) -> None:
    command, text = next(
        (command, text)
        for command, text in screens().items()
        if command.startswith(f"{verb} /dev/ttyUSB0")
    )
    words = [word for word in command.split() if word not in ("-t", "3")]
    with virtual_port("ldrobot-stl27l", link=tmp_path / "port") as port:
        place = str(tmp_path / "port")
        assert port.path == place
        printed = ran(
            *(place if word == "/dev/ttyUSB0" else word for word in words),
            "-t",
            "600ms",
            code=int(verb == "doctor"),
        ).stdout
    heading = next(line.split() for line in text.splitlines() if not line.startswith("listening"))
    assert printed.replace(place, "/dev/ttyUSB0").splitlines()[0].split() == heading
