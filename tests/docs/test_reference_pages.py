"""Tests of the scripts in docs/ that generate pages of the reference."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import lidarspec as ls
from lidarspec.cli.root import VERBS

DOCS = Path(__file__).parents[2] / "docs"


def load_script(name: str) -> ModuleType:
    """Import a script of docs/."""
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    sys.path.insert(0, str(DOCS))  # as if it were run; scripts import each other
    try:
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(DOCS))
    return module


def test_a_sensor_has_a_page_that_shows_its_diagram() -> None:
    files = load_script("reference_pages").make_sensor_files(ls.sensor("ldrobot-stl27l"))
    assert set(files) == {"ldrobot-stl27l.md", "ldrobot-stl27l.svg"}
    assert "](ldrobot-stl27l.svg)" in files["ldrobot-stl27l.md"]
    assert files["ldrobot-stl27l.svg"].startswith("<svg")


def test_each_data_frame_has_its_own_diagram() -> None:
    sensor = ls.sensor("slamtec-rplidar-a1")
    files = load_script("reference_pages").make_sensor_files(sensor)
    diagrams = {f"{sensor.id}-{name}.svg" for name, frame in sensor.frames.items() if frame.data}
    assert len(diagrams) > 1
    assert set(files) == {f"{sensor.id}.md", *diagrams}
    assert all(f"]({diagram})" in files[f"{sensor.id}.md"] for diagram in diagrams)


def test_the_index_links_every_page() -> None:
    sensors = [ls.sensor("ldrobot-stl27l"), ls.sensor("velodyne-vlp16")]
    index = load_script("reference_pages").make_index(sensors)
    assert all(f"({sensor.id}.md)" in index for sensor in sensors)


def test_the_navigation_lists_the_pages_of_each_vendor() -> None:
    sensors = [ls.sensor(name) for name in ("velodyne-vlp16", "ldrobot-ld06", "ldrobot-stl27l")]
    entries = load_script("sensor_navigation").make_entries(sensors)
    assert [list(entry) for entry in entries] == [["All sensors"], ["LDROBOT"], ["Velodyne"]]
    assert {"STL-27L": "reference/sensors/ldrobot-stl27l.md"} in entries[1]["LDROBOT"]
    manual = {"STL-27L: its manual": "reference/sensors/ldrobot-stl27l-manual.md"}
    assert manual in entries[1]["LDROBOT"]


def test_files_of_removed_sensors_are_deleted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sensor = ls.sensor("ldrobot-stl27l")
    monkeypatch.setattr(ls, "sensors", lambda: {sensor.id: sensor})
    script = load_script("reference_pages")
    monkeypatch.setattr(script, "FOLDER", tmp_path / "sensors")
    (tmp_path / "sensors").mkdir()
    (tmp_path / "sensors" / "acme-x1.md").touch()
    script.main()
    written = {path.name for path in (tmp_path / "sensors").iterdir()}
    pages = {"index.md", "ldrobot-stl27l.md", "ldrobot-stl27l-manual.md"}
    assert written == {*pages, "ldrobot-stl27l.svg"}


def test_the_generated_parts_of_the_reference_are_up_to_date() -> None:
    pages = load_script("command_pages").update_pages()
    stale = [
        path for path, text in pages.items() if text != (DOCS / path).read_text(encoding="utf-8")
    ]
    assert not stale, f"out of date, run `make reference`: {', '.join(stale)}"
    assert "* `--scan NUMBER`: " in pages["reference/command-line.md"]


def test_every_verb_has_a_manual_page() -> None:
    manuals = load_script("command_pages").make_manuals()
    assert set(manuals) == {"man/lidarspec.1", *(f"man/lidarspec-{verb}.1" for verb in VERBS)}
    assert "\\fB\\-\\-scan NUMBER\\fR" in manuals["man/lidarspec-plot.1"]


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
@pytest.mark.skipif(not (DOCS.parent / ".git").exists(), reason="needs a git checkout")
@pytest.mark.parametrize("path", ["docs/reference/sensors/index.md", "docs/man/lidarspec.1"])
def test_git_ignores_generated_files(path: str) -> None:
    subprocess.run(["git", "check-ignore", "--quiet", path], cwd=DOCS.parent, check=True)
