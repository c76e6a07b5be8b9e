"""`lidarspec check` as a user runs it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from lidarspec.testing.rules import RULES
from tests.cli.running import run

ROOT = Path(__file__).resolve().parents[2]
STRANGER = ROOT / "tests" / "shapes" / "stranger" / "acme_lidars.py"


def test_a_clean_file_says_so(tmp_path: Path) -> None:
    done = run("check", str(STRANGER), "--max-examples", "8", "-v")
    assert done.code == 0, done.out
    assert "acme-x1: clean" in done.out
    assert re.search(r"measured  data, under a checksum: single-bit errors that pass: 0 %", done.out)
    assert "skipped   vectors_hold: there is no file of golden vectors" in done.out


def test_a_finding_says_what_where_why_and_what_to_write(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    text = STRANGER.read_text(encoding="utf-8")
    assert '"rate" / ' in text
    file.write_text(re.sub(r'"(start|rate)" / Scaled\((\w+), [^)]*\)', r'"\1" / \2', text), encoding="utf-8")
    done = run("check", str(file), "--max-examples", "8")
    assert done.code == 1
    line = next(number for number, row in enumerate(file.read_text(encoding="utf-8").splitlines(), 1) if '"start" /' in row)
    assert f"LS201 {RULES['LS201'].title}\n  where  acme-x1 data.start ({file}:{line})\n  what   " in done.out
    assert f"  why    {RULES['LS201'].why}\n  write  {RULES['LS201'].write}" in done.out


def test_json_has_the_same(tmp_path: Path) -> None:
    file = tmp_path / "broken.py"
    file.write_text("import a_library_that_nobody_has\n", encoding="utf-8")
    done = run("check", str(file), "--json")
    assert done.code == 1
    (report,) = json.loads(done.out)
    (finding,) = report["findings"]
    assert (finding["code"], finding["file"], finding["line"]) == ("LS001", str(file), 1)
    assert finding["why"] == RULES["LS001"].why


def test_a_distribution_is_checked_with_all_of_its_sensors() -> None:
    done = run("check", "lidarspec-ldrobot", "--max-examples", "3", "--json")
    assert done.code == 0, done.out
    assert [report["name"] for report in json.loads(done.out)] == ["ldrobot-stl27l", "ldrobot-ld06"]


@pytest.mark.parametrize(("name", "code", "said"), [("nobody-has", 2, "unknown sensor"), ("./none.py", 3, "no such file")])
def test_what_is_not_there_is_no_finding(name: str, code: int, said: str) -> None:
    done = run("check", name)
    assert done.code == code
    assert said in done.err


def test_every_rule_has_its_heading() -> None:
    page = (ROOT / "docs" / "reference" / "check.md").read_text(encoding="utf-8")
    assert re.findall(r"^### (LS\d+)$", page, re.MULTILINE) == list(RULES)
    for rule in RULES.values():
        assert rule.why in page
        assert rule.write in page
