"""Tests that texts of other authors' plugins are escaped in every export.

They are never code, markup or control characters.
"""

from __future__ import annotations

import ast
import dataclasses
import json
import shutil
import subprocess
import xml.dom.minidom
from pathlib import Path

import pytest

import lidarspec as ls
from lidarspec.errors import escape_controls
from lidarspec.exports import EXPORTS
from lidarspec.spec import Sensor

EVIL = 'X1*/ int f(; /* "\n]] """ <script>a|b</script> \\ \x1b[31m\u202e{x} %s '


NEEDS_GCC = pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is not installed")


@pytest.fixture(scope="module")
def evil() -> Sensor:
    return dataclasses.replace(ls.sensor("ldrobot-stl27l"), vendor=EVIL, model=EVIL, source=EVIL)


@pytest.mark.parametrize("kind", EXPORTS)
def test_control_characters_and_line_breaks_are_escaped(evil: Sensor, kind: str) -> None:
    text = ls.export(evil, kind)
    assert text == escape_controls(text)
    assert not any(line.startswith("]]") for line in text.splitlines())


def test_each_language_still_reads_it(evil: Sensor) -> None:
    ast.parse(ls.export(evil, "pyi"))
    xml.dom.minidom.parseString(ls.export(evil, "svg"))
    assert json.loads(ls.export(evil, "json"))["vendor"].startswith("X1*/")
    assert "<script>" not in ls.export(evil, "md")
    title = next(
        line for line in ls.export(evil, "ksy").splitlines() if line.startswith("  title: ")
    )
    assert "X1*/" in json.loads(title.removeprefix("  title: "))
    lua = ls.export(evil, "wireshark").splitlines()
    assert all(line.startswith("--") for line in lua[: lua.index("")])


@pytest.mark.slow
@NEEDS_GCC
def test_a_compiler_still_reads_it(evil: Sensor, tmp_path: Path) -> None:
    (tmp_path / "x.h").write_text(ls.export(evil, "c"), encoding="utf-8")
    command = ["gcc", "-fsyntax-only", "-Wcomment", "-Werror", "-x", "c", "x.h"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, check=False)
    assert not done.returncode, done.stderr.decode()
