"""Tests of the architecture rules, and of the metadata of every distribution."""

from __future__ import annotations

import importlib
import re
import tomllib
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest

import lidarspec
from tests.architecture import (
    FACES,
    PAGE_MAY_IMPORT,
    Module,
    core_modules,
    find_construct_checks,
    find_misplaced_imports,
    find_private_imports,
    find_upward_imports,
    named_sensors,
    read,
)
from tests.installed import sensor_modules

ROOT = Path(__file__).resolve().parent.parent
CORE = read(ROOT / "lidarspec")
#: those of sensors; one with a verb is a program over all of lidarspec.
PLUGINS = sorted(
    path.parent
    for path in (ROOT / "plugins").glob("*/lidarspec_*/__init__.py")
    if "lidarspec.sensors" in (path.parents[1] / "pyproject.toml").read_text(encoding="utf-8")
)


def test_imports_go_down_without_circles() -> None:
    assert "lidarspec.spec" in CORE
    assert not find_upward_imports(CORE)


def test_an_import_inside_a_function_counts_as_a_cycle() -> None:
    name = "lidarspec.spec.sensor"
    upward = "\n\ndef parse():\n    from lidarspec.frames.parse import parse\n"
    planted = {**CORE, name: Module(name, CORE[name].text + upward, is_package=False)}
    complaints = find_upward_imports(planted)
    assert any(line.startswith(f"{name}:") for line in complaints)
    assert any(line.startswith("circle: ") for line in complaints)


def test_io_and_libraries_are_imported_where_they_belong() -> None:
    assert not find_misplaced_imports(CORE)


def test_one_package_knows_the_classes_of_construct() -> None:
    assert not find_construct_checks(CORE)


def test_no_submodule_shadows_a_public_name() -> None:
    submodules = {name.split(".")[1] for name in CORE if "." in name}
    assert "plugins" in submodules
    assert not submodules & set(lidarspec.__all__)


def test_the_core_names_no_sensor() -> None:
    entries = entry_points(group="lidarspec.sensors")
    vendors = {module.removeprefix("lidarspec_") for module in sensor_modules()}
    assert entries, "no sensor is installed: `make test` installs those of plugins/"
    assert not named_sensors(CORE, {*vendors, *entries.names})


@pytest.mark.slow
def test_the_core_names_no_model_of_a_sensor() -> None:
    sensors = lidarspec.sensors()
    assert not named_sensors(
        CORE, {name for sensor in sensors.values() for name in (sensor.vendor, sensor.model)}
    )


@pytest.mark.parametrize("plugin", PLUGINS, ids=lambda path: path.name)
def test_plugins_import_public_names_only(plugin: Path) -> None:
    assert not find_private_imports(
        read(plugin), {face: importlib.import_module(face).__all__ for face in FACES}
    )


def test_the_page_imports_few_modules_of_the_core() -> None:
    page = read(ROOT / "plugins" / "lidarspec-web" / "lidarspec_web")
    public = {face: importlib.import_module(face).__all__ for face in FACES}
    assert core_modules(page, CORE, public) == PAGE_MAY_IMPORT


def test_the_extra_all_names_every_distribution() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert sorted(project["optional-dependencies"]["all"]) == sorted(
        path.parent.name for path in PLUGINS
    )


def projects() -> dict[str, dict[str, Any]]:
    """Return the metadata of each distribution, by its folder."""
    distributions = sorted((ROOT / "plugins").glob("*/pyproject.toml"))
    folders = [".", *(path.parent.relative_to(ROOT).as_posix() for path in distributions)]
    return {
        folder: tomllib.loads((ROOT / folder / "pyproject.toml").read_text(encoding="utf-8"))[
            "project"
        ]
        for folder in folders
    }


#: what is the same for all of them.
SAME = ("license", "license-files", "authors", "classifiers", "urls", "requires-python", "readme")


def test_every_distribution_says_the_same_of_licence_kind_and_home() -> None:
    core = projects()["."]
    for folder, project in projects().items():
        assert {name: project[name] for name in SAME} == {name: core[name] for name in SAME}
        assert (ROOT / folder / "LICENSE").read_bytes() == (ROOT / "LICENSE").read_bytes()


def test_links_of_every_readme_work_on_the_index() -> None:
    tree = projects()["."]["urls"]["Homepage"] + "/blob/main/"
    for folder in projects():
        links = re.findall(
            r"\]\(([^)#]+)", (ROOT / folder / "README.md").read_text(encoding="utf-8")
        )
        assert all(link.startswith("https://") for link in links)
        assert all(
            (ROOT / link.removeprefix(tree)).is_file() for link in links if link.startswith(tree)
        )


def test_the_oldest_versions_that_are_tested_are_those_that_are_declared() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    declared = [
        re.match(r"([\w-]+)>=([\d.]+)", text)
        for text in (*project["dependencies"], *extras["jit"], *extras["testing"])
    ]
    tested = re.findall(
        r"^([\w-]+)==([\d.]+)$",
        (ROOT / ".ci" / "oldest.txt").read_text(encoding="utf-8"),
        re.MULTILINE,
    )
    assert None not in declared
    assert dict(tested).keys() == {match[1] for match in declared if match}
    assert all(
        f"{dict(tested)[match[1]]}.0".startswith(f"{match[2]}.") for match in declared if match
    )
