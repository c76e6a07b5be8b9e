"""Tests of plugins' verbs: listed without loading the plugin, isolated failures."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

MODULE = """
import sys
import click
from lidarspec.spec import hookimpl

print("loaded", file=sys.stderr)

@click.command()
@click.argument("word")
def survey(word):
    '''Says a word.'''
    click.echo(word)

@hookimpl
def lidarspec_verbs():
    return [survey]
"""


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """Return a folder with a distribution of some verbs."""
    about = tmp_path / "acme_survey-1.2.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: acme-survey\nVersion: 1.2\n", encoding="utf-8"
    )
    verbs = {
        "survey": "acme_survey",
        "read": "acme_survey",
        "absent": "acme_absent",
        "other": "acme_survey",
        "plain": "acme_plain",
    }
    lines = "".join(f"{verb} = {module}\n" for verb, module in verbs.items())
    (about / "entry_points.txt").write_text(f"[lidarspec.verbs]\n{lines}", encoding="utf-8")
    (tmp_path / "acme_survey.py").write_text(MODULE, encoding="utf-8")
    (tmp_path / "acme_plain.py").write_text(
        "def lidarspec_verbs():\n    return []\n", encoding="utf-8"
    )
    return tmp_path


def run_verb(site: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(site), *filter(None, sys.path)])}
    command = [sys.executable, "-P", "-m", "lidarspec", *words]
    return subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=60, check=False
    )


@pytest.mark.slow
def test_a_verb_is_listed_without_being_loaded_and_runs(site: Path) -> None:
    listed = run_verb(site, "--help")
    assert "loaded" not in listed.stderr
    assert "survey  From the plugin acme-survey 1.2." in listed.stdout
    done = run_verb(site, "survey", "hills")
    assert (done.returncode, done.stdout) == (0, "hills\n")
    assert "Says a word." in run_verb(site, "help", "survey").stdout
    assert "next: lidarspec survey --help" in run_verb(site, "survey").stderr
    assert "did you mean 'survey'?" in run_verb(site, "surveys").stderr
    # ours comes first
    assert "Print the points or the packets of a sensor" in run_verb(site, "read", "--help").stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    ("verb", "reason"),
    [
        ("absent", "No module named 'acme_absent'"),
        ("other", "the hook lidarspec_verbs returns no verb 'other'"),
        ("plain", "lidarspec_verbs lacks @hookimpl"),
    ],
)
def test_a_verb_that_cannot_be_loaded_is_named_with_its_distribution(
    site: Path, verb: str, reason: str
) -> None:
    done = run_verb(site, verb)
    assert done.returncode == 1
    assert "acme-survey" in done.stderr
    assert reason in done.stderr
    assert run_verb(site, "sensors").returncode == 0


@pytest.mark.slow
def test_plugins_with_verbs_are_among_the_plugins(site: Path) -> None:
    found = json.loads(run_verb(site, "plugins", "--json").stdout)
    errors = {
        one["entry_point"]: one["error"] for one in found if one["distribution"] == "acme-survey"
    }
    assert errors["other = acme_survey"] == ""
    assert "No module named 'acme_absent'" in errors["absent = acme_absent"]
