"""Tests that the pictures of the front page are up to date, small and shown."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.docs.pages import DOCS

NAMES = ("cloud.svg", "packet.svg", "terminal.svg")
#: the dots of points: the steps from one to the next, and how many are told.
DOTS, TOLD = re.compile(r' d="[^"]*h0"'), re.compile(r"(?<= as )[\d, and]+ dots")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pictures") / "made"
    subprocess.run([sys.executable, str(DOCS / "pictures.py"), "--into", str(folder)], check=True)
    return folder


@pytest.mark.slow
def test_the_script_makes_the_same_pictures_again(made: Path) -> None:
    assert sorted(path.name for path in made.iterdir()) == sorted(NAMES)
    for name in NAMES:
        kept, fresh = (
            (folder / name).read_text(encoding="utf-8") for folder in (DOCS / "pictures", made)
        )
        # another processor may round a coordinate of a dot the other way
        assert TOLD.sub("", DOTS.sub("", kept)) == TOLD.sub("", DOTS.sub("", fresh)), name
        assert fresh.count("h0") == pytest.approx(kept.count("h0"), rel=0.01), name


def test_pictures_are_small_and_all_of_them_are_shown() -> None:
    start, readme = (
        (folder).read_text(encoding="utf-8")
        for folder in (DOCS / "index.md", DOCS.parent / "README.md")
    )
    for path in (DOCS / "pictures").iterdir():
        assert path.stat().st_size < 100_000, path.name
        assert f"(pictures/{path.name})" in start
    shown = re.findall(r"/raw/main/docs/(pictures/[\w.]+)\)", readme)
    assert shown
    assert all((DOCS / name).is_file() for name in shown)


def test_pictures_have_descriptions() -> None:
    for page in (DOCS / "index.md", DOCS.parent / "README.md"):
        alts = re.findall(r"!\[([^\]]*)\]", page.read_text(encoding="utf-8"))
        assert alts
        assert all(len(alt) > 30 for alt in alts)
