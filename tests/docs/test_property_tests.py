"""Tests of the examples on the page about tests.

The property test finds its bug and prints the failure of the page. The test with a simulated port
passes.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.docs import pages

PAGE = "how-to/test-a-sensor.md"


def test_the_property_test_of_the_page_prints_its_smallest_failure(tmp_path: Path) -> None:
    written = {block.title: block.text for block in pages.blocks(PAGE) if block.title}
    for name in ("acme_x2.py", "test_acme_x2.py"):
        (tmp_path / name).write_text(written[name], encoding="utf-8")
    printed = next(
        block.text
        for block in pages.blocks(PAGE)
        if "test_error_codes_are_no_points(" in block.text and block.language == "text"
    )
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "."]
    done = subprocess.run(
        [*command, "--hypothesis-seed=0"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
        env={**os.environ, "COLUMNS": "100"},
    )
    assert "1 failed" in done.stdout, done.stdout
    lines = [line.removeprefix("E").strip() for line in done.stdout.splitlines()]
    expected = [line.strip() for line in printed.splitlines()]
    # Hypothesis writes the kind of failure, whose wording varies, before the first line.
    start = next(index for index, line in enumerate(lines) if line.endswith(expected[0]))
    assert lines[start + 1 : start + len(expected)] == expected[1:]


@pytest.mark.skipif(os.name != "posix", reason="pseudo terminals are POSIX")
def test_the_test_with_a_port_passes(tmp_path: Path) -> None:
    (text,) = [block.text for block in pages.blocks(PAGE) if block.title == "test_my_program.py"]
    (tmp_path / "test_my_program.py").write_text(text, encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "."]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=300
    )
    assert "1 passed" in done.stdout, done.stdout
