"""Tests that the distribution that `new` writes works without changes."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

import lidarspec as ls
from lidarspec import spec
from lidarspec.drafting.distribution import DistributionNames
from lidarspec.exports import EXPORTS, export
from lidarspec.simulation.simulator import simulate
from tests.architecture import Module, find_private_imports
from tests.cli.running import ran

ROOT = Path(__file__).resolve().parents[2]


def make_environment(folder: Path) -> dict[str, str]:
    """Return the environment of a process with the distribution of this folder installed."""
    project = tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    about = folder / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    about.mkdir(exist_ok=True)
    groups = {
        group: "".join(f"{name} = {value}\n" for name, value in named.items())
        for group, named in project["entry-points"].items()
    }
    entries = "".join(f"[{group}]\n{listed}" for group, listed in groups.items())
    (about / "entry_points.txt").write_text(entries, encoding="utf-8")
    header = f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    (about / "METADATA").write_text(header, encoding="utf-8")
    paths = [str(folder), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "LIDARSPEC_EXAMPLES": "4"}


def run(folder: Path, *words: object, code: int = 0) -> str:
    """Return the output of ``python -m WORDS`` in the folder of an installed distribution."""
    command = [sys.executable, "-m", *map(str, words)]
    done = subprocess.run(
        command,
        cwd=folder,
        env=make_environment(folder),
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_the_tests_of_a_draft_pass(tmp_path: Path) -> None:
    (tmp_path / "some.bin").write_bytes(b"".join(simulate(ls.sensor("ldrobot-ld06"), 200)))
    ran("new", "acme-x1", "--into", tmp_path, "--from-capture", tmp_path / "some.bin")
    folder = tmp_path / "lidarspec-acme-x1"
    assert (
        len(json.loads((folder / "lidarspec_acme_x1" / "vectors.json").read_text(encoding="utf-8")))
        == 3
    )
    assert " passed" in run(folder, "pytest", "-q", "-p", "no:cacheprovider")
    assert "angle_4" in run(folder, "lidarspec", "explain", tmp_path / "some.bin", "-s", "acme-x1")


@pytest.mark.soak
@pytest.mark.parametrize("drafted", [False, True])
def test_the_readme_holds_in_a_clean_environment(tmp_path: Path, *, drafted: bool) -> None:
    (tmp_path / "some.bin").write_bytes(b"".join(simulate(ls.sensor("ldrobot-ld06"), 200)))
    ran(
        "new",
        "acme-x1",
        "--into",
        tmp_path,
        *(["--from-capture", tmp_path / "some.bin"] if drafted else []),
    )
    folder = tmp_path / "lidarspec-acme-x1"
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    lines = re.findall(
        r"^    (.+)$", (folder / "README.md").read_text(encoding="utf-8"), flags=re.MULTILINE
    )
    for line in lines:
        command = line.replace("CAPTURE", str(tmp_path / "some.bin")).replace(
            "install -e", f"install -q {ROOT} -e"
        )
        done = subprocess.run(
            command,
            shell=True,
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
            timeout=900,
        )
        assert done.returncode == 0, command + done.stdout + done.stderr
    assert len(lines) >= 5


@pytest.fixture(scope="module", params=["serial", "udp"])
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the distribution of an invented sensor with either link."""
    place = tmp_path_factory.mktemp("new")
    told = ran("new", "acme-x1", "--into", place, "--link", request.param)
    folder = place / "lidarspec-acme-x1"
    assert [Path(line) for line in told.stdout.splitlines()] == [
        path for path in map(Path, told.stdout.splitlines()) if path.is_file()
    ]
    assert f"pip install -e '{folder}[test]'" in told.stderr
    return folder


@pytest.mark.slow
def test_its_own_tests_pass(made: Path) -> None:
    assert " passed" in run(made, "pytest", "-q", "-p", "no:cacheprovider")


@pytest.mark.slow
def test_it_is_found_shown_simulated_and_converted(made: Path) -> None:
    assert "lidarspec.sensors = lidarspec_acme_x1" in run(made, "lidarspec", "plugins")
    shown = run(made, "lidarspec", "show", "acme-x1")
    assert "command speed speed=5..15, reply ack" in shown
    assert "CRC-16 poly 0x1021 init 0xffff over all other bytes" in shown
    suffix = "pcap" if "udp 2370" in shown else "bin"
    run(made, "lidarspec", "sim", "acme-x1", "--to", made / f"sent.{suffix}", "-t", "0.5s")
    run(made, "lidarspec", "convert", made / f"sent.{suffix}", made / "points.csv")
    lines = (made / "points.csv").read_text(encoding="utf-8").splitlines()
    assert lines[0].split(",")[:4] == ["x", "y", "z", "range"]
    assert len(lines) > 3000


@pytest.mark.slow
def test_its_simulation_can_be_viewed_and_recorded(made: Path) -> None:
    assert "acme-x1: Scan(720 points, 10.0 Hz" in run(
        made, "lidarspec", "view", "sim:acme-x1", "--once"
    )
    run(
        made,
        "lidarspec",
        "record",
        "sim:acme-x1",
        "-s",
        "acme-x1",
        "-o",
        made / "some.lsr",
        "-t",
        "0.3s",
    )
    assert len(run(made, "lidarspec", "read", made / "some.lsr").splitlines()) > 100


def test_it_is_exported_to_every_other_tool(made: Path) -> None:
    sensor = ls.sensor(made / "lidarspec_acme_x1" / "__init__.py")
    for kind in EXPORTS:
        text = export(sensor, kind)
        assert "checksum" in text.lower() or "crc" in text.lower() or kind == "pyi", kind
        assert "distance" in text, kind


@pytest.mark.slow
def test_the_points_are_compiled(made: Path) -> None:
    assert "per packet or block" in run(made, "lidarspec", "show", "acme-x1", "--plan")


def test_its_vectors_are_true(made: Path) -> None:
    sensor = ls.sensor(made / "lidarspec_acme_x1" / "__init__.py")
    listed = json.loads((made / "lidarspec_acme_x1" / "vectors.json").read_text(encoding="utf-8"))
    assert {vector["frame"] for vector in listed} == set(sensor.frames)
    for vector in listed:
        parsed = sensor.parse(bytes.fromhex(vector["hex"]), vector["frame"])
        assert {path: read(parsed, path) for path in vector["values"]} == vector["values"]
        assert "Acme X1 manual, section" in vector["source"]


def read(parsed: Any, path: str) -> Any:
    for part in path.replace("[", ".").replace("]", "").split("."):
        parsed = parsed[int(part)] if part.isdigit() else parsed[part]
    return parsed


def test_it_is_written_as_the_projects_own_sensors_are(made: Path) -> None:
    module = Module(
        "lidarspec_acme_x1",
        (made / "lidarspec_acme_x1" / "__init__.py").read_text(encoding="utf-8"),
        True,
    )
    assert not find_private_imports(
        {module.name: module}, {"lidarspec": ls.__all__, "lidarspec.spec": spec.__all__}
    )
    config = ["--config", str(ROOT / "pyproject.toml")]
    for words in (["check"], ["format", "--check"]):
        ruff = [sys.executable, "-m", "ruff", *words, *config, str(made)]
        # In this folder, ruff sorts lidarspec as first party.
        done = subprocess.run(ruff, cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout


def test_it_has_the_files_and_facts_that_the_projects_own_distributions_have(made: Path) -> None:
    ours = ROOT / "plugins" / "lidarspec-camsense"
    kept = {"README.md", "LICENSE", "pyproject.toml"}
    assert (
        {path.name for path in ours.iterdir() if path.is_file()}
        == kept
        == kept & {path.name for path in made.iterdir()}
    )
    inside = {"__init__.py", "py.typed", "vectors.json"}
    assert {
        path.name for path in (ours / "lidarspec_camsense").iterdir() if path.is_file()
    } == inside
    assert inside <= {path.name for path in (made / "lidarspec_acme_x1").iterdir()}
    assert (made / "LICENSE").read_bytes() == (ours / "LICENSE").read_bytes()
    about, model = (
        tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
        for folder in (made, ours)
    )
    for name in ("license", "license-files", "classifiers", "dependencies", "requires-python"):
        assert about[name] == model[name]
    assert not model.keys() - about.keys() - {"authors", "urls"}


def test_existing_files_are_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "lidarspec-acme-x1").mkdir()
    assert "exists already" in ran("new", "acme-x1", "--into", tmp_path, code=2).stderr
    assert not list((tmp_path / "lidarspec-acme-x1").iterdir())


@pytest.mark.parametrize("name", ["3d-360", "acme-data", "acme-x-1b", "a-1"])
def test_odd_ids_make_working_modules(tmp_path: Path, name: str) -> None:
    ran("new", name, "--into", tmp_path)
    names = DistributionNames(name)
    assert ls.sensor(tmp_path / names.distribution / names.package / "__init__.py").id == name
    assert names.constant.isidentifier()


@pytest.mark.slow
def test_a_second_model_joins_a_distribution(tmp_path: Path) -> None:
    family = ("--into", tmp_path, "--distribution", "lidarspec-acme", "--vendor", "ACME Robotics")
    ran("new", "acme-x1", *family, "--model", "X1 Pro")
    folder = tmp_path / "lidarspec-acme"
    before = {file: file.read_bytes() for file in folder.rglob("*.py")}
    told = ran("new", "acme-2d-x", *family, "--link", "udp").stdout.splitlines()
    assert all(file.read_bytes() == text for file, text in before.items())
    assert str(folder / "lidarspec_acme" / "model_2d_x.py") in told
    assert [
        ls.sensor(folder / "lidarspec_acme" / name).vendor
        for name in ("__init__.py", "model_2d_x.py")
    ] == ["ACME Robotics"] * 2
    listed = json.loads((folder / "lidarspec_acme" / "vectors.json").read_text(encoding="utf-8"))
    assert {entry["sensor"] for entry in listed} == {"acme-x1", "acme-2d-x"}
    assert "acme-2d-x" in (folder / "README.md").read_text(encoding="utf-8")
    assert " passed" in run(
        folder, "pytest", "-q", "-p", "no:cacheprovider", "-k", "vectors or by_hand or declaration"
    )
    assert "ACME Robotics X1 Pro" in run(folder, "lidarspec", "show", "acme-x1")
    assert "exists already" in ran("new", "acme-2d-x", *family, code=2).stderr
    assert (
        "does not define the distribution lidarspec-other"
        in ran(
            "new",
            "acme-x3",
            "--into",
            _other(tmp_path),
            "--distribution",
            "lidarspec-other",
            code=2,
        ).stderr
    )


def _other(folder: Path) -> Path:
    """Return a folder with a subfolder lidarspec-other that is not a distribution."""
    (place := folder / "elsewhere" / "lidarspec-other").mkdir(parents=True)
    for name in ("pyproject.toml", "README.md"):
        (place / name).write_text("[project]\n", encoding="utf-8")
    return place.parent
