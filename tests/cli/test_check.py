"""Tests of `lidarspec check` as a user runs it."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest

import lidarspec as ls
from lidarspec.testing.findings import RULES
from tests.cli.running import ran

ROOT = Path(__file__).resolve().parents[2]
STRANGER = ROOT / "tests" / "shapes" / "stranger" / "acme_lidars.py"


def ldrobot_ids() -> list[str]:
    """Return the ids of one distribution."""
    return [name for name in ls.sensors() if name.startswith("ldrobot-")]


@pytest.mark.slow
def test_a_clean_file_says_so() -> None:
    done = ran("check", STRANGER, "--max-examples", "8", "-v")
    assert "acme-x1: clean" in done.output
    assert re.search(
        r"measured  data, with a checksum: undetected single-bit errors: 0 %", done.output
    )
    assert "skipped   vectors_hold: there is no file with golden vectors" in done.output


@pytest.mark.slow
def test_a_finding_has_a_place_a_reason_and_a_fix(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    text = STRANGER.read_text(encoding="utf-8")
    bare = text.replace(
        '"distance" / Scaled(BitsInteger(16), 0.001, "m")', '"distance" / BitsInteger(16)'
    )
    assert bare != text
    file.write_text(bare, encoding="utf-8")
    done = ran("check", file, "--max-examples", "8", code=1)
    line = next(number for number, row in enumerate(bare.splitlines(), 1) if '"distance" /' in row)
    assert (
        f"LS201 {RULES['LS201'].title}\n  where  acme-x1 data.samples.distance ({file}:{line})\n"
        "  what   "
    ) in done.output
    assert f"  why    {RULES['LS201'].why}\n  fix    {RULES['LS201'].fix}" in done.output
    assert [line for line in done.output.splitlines() if line[:1] != " "][-1].startswith(
        "acme-x1: 1 finding, "
    )


def test_json_has_the_same(tmp_path: Path) -> None:
    file = tmp_path / "broken.py"
    file.write_text("import a_library_that_nobody_has\n", encoding="utf-8")
    (report,) = json.loads(ran("check", file, "--json", code=1).stdout)
    (finding,) = report["findings"]
    assert (finding["code"], finding["file"], finding["line"]) == ("LS001", str(file), 1)
    assert finding["why"] == RULES["LS001"].why


@pytest.mark.slow
def test_measured_values_are_listed_beside_references() -> None:
    lines = ran("check", "ldrobot-stl27l", "--max-examples", "3").output.splitlines()
    assert lines == [
        lines[0],
        "  data: first beam: at azimuth 0.0 deg if start_angle is 0 (0 is ahead, 90 is left)",
        "  data: range: the field can represent 0.001 .. 65.535 m; range_limits are 0.03 .. 25 m",
        lines[3],
        "  data: sense: clockwise as start_angle grows, seen from above",
        "  data: step: 0.166 deg clockwise from one simulated point to the next",
        "  data: vectors: ranges 0.192 .. 2 m in 2 vectors; the points are in 3 quadrants",
        "  vendor_axes: x, y, z are forward, right, up",
        "  source: STL-27L development manual, sections 1 to 4",
    ]
    assert re.fullmatch(r"  data: rate: 21[56]\d\d points per second, simulated", lines[3])
    unproven = ran("check", STRANGER, "--max-examples", "3").output
    assert (
        "  vectors: there is no file with golden vectors;"
        " to verify these values, add vectors with points in two quadrants"
    ) in unproven


@pytest.mark.slow
def test_a_file_with_the_id_of_an_installed_sensor_names_its_plugin(tmp_path: Path) -> None:
    installed = ROOT / "plugins" / "lidarspec-camsense" / "lidarspec_camsense" / "__init__.py"
    shutil.copy(installed, tmp_path / "mine.py")
    shutil.copy(installed.with_name("vectors.json"), tmp_path)
    (loading, *others) = json.loads(
        ran("check", tmp_path / "mine.py", "--max-examples", "3", "--json", code=1).stdout
    )
    assert sorted(finding["sensor"] for finding in loading["findings"]) == [
        "camsense-lds08rr",
        "camsense-x1",
    ]
    assert {finding["code"] for finding in loading["findings"]} == {"LS005"}
    said = (
        "the installed lidarspec-camsense has a sensor with this id"
        " (lidarspec.sensors = lidarspec_camsense)"
    )
    assert loading["findings"][0]["what"] == said
    assert all(finding["line"] for finding in loading["findings"])
    assert not any(report["findings"] for report in others)
    ran("check", installed, "--max-examples", "3")


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["ldrobot-ld06", "lidarspec-ldrobot", ROOT / "plugins" / "lidarspec-ldrobot"]
)
def test_a_sensor_or_all_of_a_distribution_are_checked_with_their_vectors(name: str | Path) -> None:
    reports = json.loads(ran("check", name, "--max-examples", "3", "--json").stdout)
    assert sorted(report["name"] for report in reports) == (
        [name] if name == "ldrobot-ld06" else ldrobot_ids()
    )
    for report in reports:
        assert not {"vectors_hold", "every_data_field_is_pinned_down"} & report["skipped"].keys()


def test_a_folder_of_a_distribution_that_is_not_installed_is_named(tmp_path: Path) -> None:
    (tmp_path / "pyproject.toml").write_text(
        '[project]\nname = "lidarspec-nobody-has"\n', encoding="utf-8"
    )
    assert (
        f"lidarspec-nobody-has is not installed, or has no sensors: pip install -e {tmp_path}"
        in ran("check", tmp_path, code=3).stderr
    )


def test_a_folder_with_another_copy_of_an_installed_distribution_is_refused(tmp_path: Path) -> None:
    (tmp_path / "pyproject.toml").write_text(
        '[project]\nname = "lidarspec-ldrobot"\n', encoding="utf-8"
    )
    message = ran("check", tmp_path, code=3).stderr
    assert "the installed lidarspec-ldrobot contains the module " in message
    assert f", which is not in {tmp_path}: run pip install" in message
    assert f"pip install -e {tmp_path}" in message


def test_every_rule_is_on_its_page() -> None:
    page = (ROOT / "docs" / "reference" / "check.md").read_text(encoding="utf-8")
    rows = [f"| **{rule.code}** | {rule.title} | {rule.fix} |" for rule in RULES.values()]
    shown = re.findall(r"^\| \*\*LS.+$", page, re.MULTILINE)
    assert [row.replace(r"\|", "|") for row in shown] == rows


@pytest.mark.slow
def test_one_sensor_of_a_file_is_checked_by_its_id(tmp_path: Path) -> None:
    file = tmp_path / "two.py"
    text = STRANGER.read_text(encoding="utf-8").replace(
        "return [X1]", "return [X1, dataclasses.replace(X1, id='acme-x2', aliases=())]"
    )
    file.write_text(text, encoding="utf-8")
    assert ran("check", f"{file}:acme-x2", "--max-examples", "4").output.startswith(
        "acme-x2: clean"
    )
    assert (
        "unknown sensor 'acme-x3'; did you mean 'acme-x2'?"
        in ran("check", f"{file}:acme-x3", code=2).stderr
    )
