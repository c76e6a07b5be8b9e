"""Tests that the output on the page on exports is up to date."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

import lidarspec
from lidarspec.exports import export
from tests.cli.running import EXAMPLE
from tests.docs.pages import blocks
from tests.exports.sharks import needs_tshark, tshark, write_capture, write_dissector

PAGE, NAME = "how-to/export.md", "ldrobot-stl27l"


def first(language: str) -> str:
    """Return the first block of a language on the page."""
    return next(block.text for block in blocks(PAGE) if block.language == language)


@needs_tshark
def test_the_page_shows_the_output_of_tshark(tmp_path: Path) -> None:
    sensor = lidarspec.sensor(NAME)
    printed = tshark(
        write_capture(sensor, [EXAMPLE], tmp_path / "it.pcap"),
        "-V",
        scripts=[write_dissector(sensor, tmp_path)],
    )
    lines = iter(printed.splitlines())
    for line in first("text").splitlines():
        assert line in lines, line  # in this order, some of the points left out


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is not installed")
def test_the_program_on_the_page_runs(tmp_path: Path) -> None:
    (tmp_path / "stl27l.h").write_text(export(lidarspec.sensor(NAME), "c"))
    array = ", ".join(map(str, b"\x54\x2c\x00" + EXAMPLE))
    main = (
        f"int main(void) {{ static const uint8_t bytes[] = {{{array}}}; print_distances(bytes,"
        " sizeof bytes); return 0; }\n"
    )
    (tmp_path / "it.c").write_text(first("c") + main)
    subprocess.run(
        ["gcc", "-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-o", "it", "it.c"],
        cwd=tmp_path,
        check=True,
    )
    printed = subprocess.run(
        [tmp_path / "it"], capture_output=True, text=True, check=True
    ).stdout.split("\n")
    assert printed[:3] == ["324.27 deg", "0.224 m", "0.220 m"]
    assert len(printed) == 14
