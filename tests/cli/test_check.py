"""`lidarspec check` as a user runs it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from lidarspec.testing.findings import RULES
from tests.cli.running import ran

ROOT = Path(__file__).resolve().parents[2]
STRANGER = ROOT / "tests" / "shapes" / "stranger" / "acme_lidars.py"


def test_a_clean_file_says_so() -> None:
    done = ran("check", STRANGER, "--max-examples", "8", "-v")
    assert "acme-x1: clean" in done.output
    assert re.search(r"measured  data, under a checksum: single-bit errors that pass: 0 %", done.output)
    assert "skipped   vectors_hold: there is no file of golden vectors" in done.output


def test_a_finding_says_what_where_why_and_what_to_write(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    text = STRANGER.read_text(encoding="utf-8")
    bare = text.replace('"distance" / Scaled(BitsInteger(16), 0.001, "m")', '"distance" / BitsInteger(16)')
    assert bare != text
    file.write_text(bare, encoding="utf-8")
    done = ran("check", file, "--max-examples", "8", code=1)
    line = next(number for number, row in enumerate(bare.splitlines(), 1) if '"distance" /' in row)
    assert f"LS201 {RULES['LS201'].title}\n  where  acme-x1 data.samples.distance ({file}:{line})\n  what   " in done.output
    assert f"  why    {RULES['LS201'].why}\n  write  {RULES['LS201'].write}" in done.output
    assert done.output.rstrip().splitlines()[-1].startswith("acme-x1: 1 finding, ")


def test_json_has_the_same(tmp_path: Path) -> None:
    file = tmp_path / "broken.py"
    file.write_text("import a_library_that_nobody_has\n", encoding="utf-8")
    (report,) = json.loads(ran("check", file, "--json", code=1).stdout)
    (finding,) = report["findings"]
    assert (finding["code"], finding["file"], finding["line"]) == ("LS001", str(file), 1)
    assert finding["why"] == RULES["LS001"].why


def test_a_distribution_is_checked_with_all_of_its_sensors() -> None:
    found = json.loads(ran("check", "lidarspec-ldrobot", "--max-examples", "3", "--json").stdout)
    assert [report["name"] for report in found] == ["ldrobot-ld06", "ldrobot-stl27l"]


def test_a_distribution_is_checked_by_its_folder(tmp_path: Path) -> None:
    report, _ = json.loads(ran("check", ROOT / "plugins" / "lidarspec-ldrobot", "--max-examples", "3", "--json").stdout)
    assert report["name"] == "ldrobot-ld06"
    (tmp_path / "pyproject.toml").write_text('[project]\nname = "lidarspec-nobody-has"\n', encoding="utf-8")
    assert f"lidarspec-nobody-has is not installed, or has no sensors: pip install -e {tmp_path}" in ran("check", tmp_path, code=3).output


@pytest.mark.parametrize(("name", "code", "said"), [("nobody-has", 2, "unknown sensor"), ("./none.py", 3, "no such file")])
def test_what_is_not_there_is_no_finding(name: str, code: int, said: str) -> None:
    assert said in ran("check", name, code=code).output


def test_every_rule_has_its_heading() -> None:
    page = (ROOT / "docs" / "reference" / "check.md").read_text(encoding="utf-8")
    assert re.findall(r"^### (LS\d+)$", page, re.MULTILINE) == list(RULES)
    for rule in RULES.values():
        assert rule.why in page
        assert rule.write in page


def test_what_keeps_a_file_from_being_a_sensor_is_said_with_its_place(tmp_path: Path) -> None:
    file = tmp_path / "empty.py"
    file.write_text("import lidarspec\n", encoding="utf-8")
    said = "there is no function lidarspec_sensors, marked @hookimpl, that returns a sensor"
    assert f"  where  {file}\n  what   {said}\n" in ran("check", file, code=1).stdout
    assert ran("show", file, code=1).stderr.splitlines() == [f"{file}: {said}", f"  next: lidarspec check {file}"]


def test_one_sensor_of_a_file_is_checked_by_its_id(tmp_path: Path) -> None:
    file = tmp_path / "two.py"
    text = STRANGER.read_text(encoding="utf-8").replace("return [X1]", "return [X1, dataclasses.replace(X1, id='acme-x2', aliases=())]")
    file.write_text(text, encoding="utf-8")
    assert ran("check", f"{file}:acme-x2", "--max-examples", "4").output.startswith("acme-x2: clean")
    assert "unknown sensor 'acme-x3'; did you mean 'acme-x2'?" in ran("check", f"{file}:acme-x3", code=2).output
