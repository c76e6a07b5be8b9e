"""Tests of installed distributions: other authors' sensors, and isolated failures."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import lidarspec

pytestmark = pytest.mark.slow  # pip builds, and processes that load every plugin

CHECKOUT = Path(__file__).resolve().parents[2]
HERE = CHECKOUT / "tests" / "shapes"

#: what each broken entry point is reported with.
REPORTS = {
    "absent-module = lidarspec_broken.absent": "No module named 'lidarspec_broken.absent'",
    "absent-import = lidarspec_broken.absent_import": "No module named 'a_library_that_nobody_has'",
    "syntax = lidarspec_broken.syntax": "SyntaxError",
    "exits = lidarspec_broken.exits": "SystemExit: leaving",
    "wrong-signature = lidarspec_broken.wrong_signature": "everything",
    "misspelt = lidarspec_broken.misspelt": "unknown hook 'lidarspec_sensor'",
    "unmarked = lidarspec_broken.unmarked": "lidarspec_sensors lacks @hookimpl",
    "duplicate = lidarspec_broken.duplicate": (
        "acme-x1: this id is already used by acme-lidars:acme_lidars"
    ),
    "raises = lidarspec_broken.raises": "ZeroDivisionError",
    "no-sensor = lidarspec_broken.no_sensor": "must return sensors, got str",
    "bad-spec = lidarspec_broken.bad_spec": "is_on: Flag keeps only one bit of its byte",
    "hook = lidarspec_broken.hook": "KeyError",
}

#: sensors that fail at work, and what they say.
FAILING = {
    "broken-checksum": "ZeroDivisionError",
    "broken-parse": "ZeroDivisionError",
    "broken-plausible": "no such luck",
    "broken-points": "no such luck",
    "broken-field": "did you mean 'distances'?",
    "broken-shape": "the arrays of the points have different lengths",
    "broken-result": "the function must return Polar or Cartesian",
}

FRAME = "bb ad 01 0a 0b 0c 0d 00"

LOOK = """
import json, lidarspec as ls
from lidarspec.plugins import registry
sensors = ls.sensors()
plugins = [[p.distribution, p.version, p.entry_point, list(p.sensors), p.error, bool(p.traceback)] for p in registry().plugins]
good = [name for name, s in sensors.items() if not name.startswith("broken-") and all(s.parse(s.example(name), name) for name in s.main_frames)]
"""

WORK = """
from tests.by_construct import by_construct

report = {}
for name in (n for n in sensors if n.startswith("broken-")):
    s, said = sensors[name], []
    data = bytes.fromhex(FRAME) * 3
    for judge in (s, by_construct(s)):
        decoder = judge.decoder()
        found = decoder.feed(data) + decoder.finish()
        try:
            cloud = judge.decode(data).points()
            said.append([len(found), decoder.stats.plugin_errors, int(cloud.valid.sum()), len(cloud), "".join(decoder.stats.tracebacks)])
        except ls.SpecError as error:
            said.append([len(found), decoder.stats.plugin_errors, 0, 0, str(error)])
        scans = list(judge.scans(data))
    try:
        s.parse(data[:8])
        parsed = ""
    except ls.LidarSpecError as error:
        parsed = type(error).__name__ + ": " + str(error)
    report[name] = [said, parsed]
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the external and the broken distributions.

    They are installed by pip, as a user would install them.
    """
    folder = tmp_path_factory.mktemp("plugins")
    sources = [shutil.copytree(HERE / name, folder / name) for name in ("stranger", "broken")]
    (folder / "broken" / "lidarspec_broken" / "syntax.py").write_text(
        "def broken(:\n", encoding="utf-8"
    )
    command = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--disable-pip-version-check",
        "--no-index",
        "--no-deps",
    ]
    command += [
        "--no-build-isolation",
        "--no-compile",
        "--target",
        str(folder / "site"),
        *map(str, sources),
    ]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    own = folder / "site" / "lidarspec" / "lidarspec.toml"
    own.parent.mkdir()
    own.write_text('[owners]\nacme-x1 = "acme-lidars"\n', encoding="utf-8")
    return folder / "site"


@pytest.fixture(scope="module")
def seen(site: Path) -> dict[str, Any]:
    """Return the output of a program that runs with these plugins installed."""
    code = (
        f"FRAME = {FRAME!r}\n{LOOK}{WORK}\n"
        "print(json.dumps([plugins, good, sorted(sensors), report]))"
    )
    done = python(site, "-c", code)
    assert done.returncode == 0, done.stderr
    return dict(zip(("plugins", "good", "sensors", "report"), json.loads(done.stdout), strict=True))


def python(site: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    paths = [str(site), str(CHECKOUT), os.environ.get("PYTHONPATH", "")]
    own = dict.fromkeys(("XDG_CONFIG_HOME", "APPDATA"), str(site))
    environment = {
        **os.environ,
        **own,
        "PYTHONPATH": os.pathsep.join(path for path in paths if path),
    }
    return subprocess.run(
        [sys.executable, *arguments],
        check=False,
        env=environment,
        cwd=site,
        capture_output=True,
        text=True,
        timeout=120,
    )


def test_a_third_party_sensor_is_found_and_works(seen: dict[str, Any]) -> None:
    assert ["acme-lidars", "3.2.1", "acme = acme_lidars", ["acme-x1"], "", False] in seen["plugins"]
    assert {"acme-x1", *lidarspec.sensors()} <= set(seen["good"])


def test_every_broken_plugin_is_named_with_its_error(seen: dict[str, Any]) -> None:
    errors = {
        entry: (distribution, version, error, kept)
        for distribution, version, entry, _, error, kept in seen["plugins"]
        if error
    }
    assert errors.keys() == REPORTS.keys()
    for entry, (distribution, version, error, kept) in errors.items():
        assert (distribution, version) == ("lidarspec-broken", "0.0.7")
        assert REPORTS[entry] in error
        assert "\n" not in error
        assert kept or entry.startswith("duplicate")  # which raises nothing


def test_a_broken_plugin_is_removed_completely(seen: dict[str, Any]) -> None:
    assert set(seen["sensors"]) - set(seen["good"]) == {
        *FAILING,
        "broken-nan",
        "broken-fresh",
    }  # which stands beside a duplicate


@pytest.mark.parametrize("name", FAILING)
def test_a_plugin_that_fails_at_work_is_counted_and_says_so(
    seen: dict[str, Any], name: str
) -> None:
    said, parsed = seen["report"][name]
    assert said[0][:4] == said[1][:4]
    for frames, errors, _, _, text in said:
        assert FAILING[name] in text
        assert frames == 3 or errors >= 3
    assert parsed == "" or (
        parsed.startswith("SpecError") and name in parsed and FAILING[name] in parsed
    )


def test_points_that_are_not_numbers_are_not_valid(seen: dict[str, Any]) -> None:
    said, _ = seen["report"]["broken-nan"]
    assert [case[:4] for case in said] == [[3, 0, 0, 12]] * 2


def test_the_command_line_lists_broken_plugins(site: Path) -> None:
    done = python(site, "-m", "lidarspec", "plugins", "--json")
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stderr
    for entry, error in REPORTS.items():
        if entry.startswith("hook"):
            continue  # fails when a sensor is asked for, and a list of plugins asks for none
        assert entry.partition(" ")[0] in done.stdout
        assert json.dumps(error)[1:-1] in done.stdout
    assert python(site, "-m", "lidarspec", "show", "acme-x1").returncode == 0


#: what `check` names each broken entry point with.
RULES = {
    "absent-module = lidarspec_broken.absent": "LS001",
    "absent-import = lidarspec_broken.absent_import": "LS001",
    "syntax = lidarspec_broken.syntax": "LS001",
    "exits = lidarspec_broken.exits": "LS001",
    "wrong-signature = lidarspec_broken.wrong_signature": "LS004",
    "misspelt = lidarspec_broken.misspelt": "LS002",
    "unmarked = lidarspec_broken.unmarked": "LS003",
    "duplicate = lidarspec_broken.duplicate": "LS005",
    "raises = lidarspec_broken.raises": "LS006",
    "no-sensor = lidarspec_broken.no_sensor": "LS006",
    "hook = lidarspec_broken.hook": "LS010",
}


def test_a_broken_distribution_is_checked_to_its_end(site: Path) -> None:
    done = python(
        site, "-m", "lidarspec", "check", "lidarspec-broken", "--max-examples", "3", "--json"
    )
    assert (done.returncode, done.stderr) == (1, "")
    loading, *sensors = json.loads(done.stdout)
    named = {finding["path"]: finding["code"] for finding in loading["findings"]}
    assert RULES.items() <= named.items()
    assert named.get("is_on") == "LS107"
    assert {"broken-checksum", "broken-plausible", "broken-points"} <= {
        report["name"] for report in sensors if report["findings"]
    }
    assert {
        finding["path"]
        for finding in loading["findings"]
        if finding["code"] == "LS001" and not finding["line"]
    } == {"absent-module = lidarspec_broken.absent"}


@pytest.mark.parametrize("name", ["acme-x1", "acme-lidars", "lidarspec-broken"])
def test_check_names_both_plugins_with_one_id(site: Path, name: str) -> None:
    done = python(site, "-m", "lidarspec", "check", name, "--max-examples", "3", "--json")
    reports = {report["name"]: report for report in json.loads(done.stdout)}
    (taken,) = [
        finding
        for report in reports.values()
        for finding in report["findings"]
        if finding["code"] == "LS005"
    ]
    assert taken["what"] == (
        "lidarspec-broken: acme-x1: this id is already used by acme-lidars:acme_lidars"
    )
    assert taken["path"] == "duplicate = lidarspec_broken.duplicate"
    source = reports["acme-x1"]["picture"].get("source")
    assert (source == "Acme X1 manual, which nobody wrote") == (name != "lidarspec-broken")
