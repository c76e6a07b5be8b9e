"""The plan of the house, held against the source; each rule is also shown a small tree that breaks it."""

from __future__ import annotations

import importlib
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

import lidarspec
from tests.architecture import (
    CONSTRUCT_LAYER,
    FACES,
    Module,
    climbing,
    construct_asked,
    misplaced_imports,
    named_sensors,
    private_imports,
    read,
)

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
    assert not climbing(CORE)


def test_io_and_libraries_are_imported_where_they_belong() -> None:
    assert not misplaced_imports(CORE)


def test_one_package_knows_the_classes_of_construct() -> None:
    assert not construct_asked(CORE)
    for name in ("classes", "refusals", "meaning"):
        asked = Module(f"{CONSTRUCT_LAYER}_gadgets.{name}", CORE[f"{CONSTRUCT_LAYER}.{name}"].text, False)
        assert len(construct_asked({asked.name: asked})) > 5


def test_no_submodule_shadows_a_public_function() -> None:
    objects = {name: getattr(lidarspec, name) for name in lidarspec.__all__}
    functions = {name for name, value in objects.items() if callable(value) and not isinstance(value, type)}
    submodules = {name.split(".")[1] for name in CORE if "." in name}
    assert {"sensor", "sensors"} <= functions
    assert not functions & submodules


def test_the_core_names_no_sensor() -> None:
    sensors = lidarspec.sensors()
    names = {name for sensor in sensors.values() for name in (sensor.id, sensor.vendor, sensor.model, *sensor.aliases)}
    assert sensors, "no sensor is installed: `make test` installs those of plugins/"
    assert not named_sensors(CORE, names)


@pytest.mark.parametrize("plugin", PLUGINS, ids=lambda path: path.name)
def test_plugins_import_public_names_only(plugin: Path) -> None:
    assert not private_imports(read(plugin), {face: importlib.import_module(face).__all__ for face in FACES})


def test_the_extra_all_names_every_distribution() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert sorted(project["optional-dependencies"]["all"]) == sorted(path.parent.name for path in PLUGINS)


def projects() -> dict[str, dict[str, Any]]:
    """What each distribution says of itself, by its folder."""
    folders = [".", *(path.parent.relative_to(ROOT).as_posix() for path in PLUGINS)]
    return {folder: tomllib.loads((ROOT / folder / "pyproject.toml").read_text(encoding="utf-8"))["project"] for folder in folders}


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
        links = re.findall(r"\]\(([^)#]+)", (ROOT / folder / "README.md").read_text(encoding="utf-8"))
        assert all(link.startswith("https://") for link in links)
        assert all((ROOT / link.removeprefix(tree)).is_file() for link in links if link.startswith(tree))


def test_the_oldest_versions_that_are_tested_are_those_that_are_declared() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    declared = [re.match(r"([\w-]+)>=([\d.]+)", text) for text in (*project["dependencies"], *extras["jit"], *extras["testing"])]
    tested = re.findall(r"^([\w-]+)==([\d.]+)$", (ROOT / ".ci" / "oldest.txt").read_text(encoding="utf-8"), re.MULTILINE)
    assert None not in declared
    assert dict(tested).keys() == {match[1] for match in declared if match}
    assert all(f"{dict(tested)[match[1]]}.0".startswith(f"{match[2]}.") for match in declared if match)


def tree(files: Mapping[str, str]) -> dict[str, Module]:
    """Modules from their texts; a name that ends in a dot is a package."""
    packages = {name.removesuffix("."): Module(name.removesuffix("."), text, name.endswith(".")) for name, text in files.items()}
    return {"lidarspec": Module("lidarspec", "", True), **packages}


@pytest.mark.parametrize(
    ("files", "complaint"),
    [
        (
            {"lidarspec.spec.fields": "def f():\n    from lidarspec.wire.layout import Leaf"},
            "lidarspec.spec.fields:2 (floor 2) imports lidarspec.wire.layout (floor 3)",
        ),
        (
            {"lidarspec.cli.": "", "lidarspec.view.": "from ..cli import main"},
            "lidarspec.view:1 (floor 17) imports lidarspec.cli (floor 19)",
        ),
        ({"lidarspec.wire.parse": "import lidarspec"}, "lidarspec.wire.parse:1 (floor 3) imports lidarspec (floor 20)"),
        (
            {"lidarspec.wire.parse": "import_module('lidarspec.spec.sensor')", "lidarspec.spec.sensor": ""},
            "lidarspec.wire.parse:1 (floor 3) imports lidarspec.spec.sensor (floor 10)",
        ),
        (
            {"lidarspec.spec.fields": "from lidarspec.spec import Sensor", "lidarspec.spec.": ""},
            "lidarspec.spec.fields:1 (floor 2) imports lidarspec.spec (floor 12)",
        ),
        ({"lidarspec.gadgets": ""}, "lidarspec.gadgets stands on no floor: add it to FLOORS"),
        (
            {
                "lidarspec.wire.a": "from .b import x",
                "lidarspec.wire.b": "import lidarspec.wire.c",
                "lidarspec.wire.c": "from lidarspec.wire import a",
            },
            "circle: lidarspec.wire.a imports lidarspec.wire.b imports lidarspec.wire.c imports lidarspec.wire.a",
        ),
        (
            {"lidarspec.wire.layout": "if TYPE_CHECKING:\n    import lidarspec.cli", "lidarspec.cli.": ""},
            "lidarspec.wire.layout:2 (floor 3) imports lidarspec.cli (floor 19)",
        ),
    ],
)
def test_a_climbing_import_is_found(files: dict[str, str], complaint: str) -> None:
    assert climbing({**tree({"lidarspec.wire.layout": ""}), **tree(files)}) == [complaint]


@pytest.mark.parametrize(
    ("name", "text", "complaint"),
    [
        ("framing.decoder", "import time", "imports time below floor 11"),
        ("points.plan", "def f():\n    from asyncio import Queue", "imports asyncio below floor 11"),
        ("device.device", "import pluggy", "imports pluggy, which is for plugins"),
        ("transports.udp", "from serial.tools import list_ports", "imports serial, which is for transports.ports, transports.serial"),
        ("framing.decoder", "import construct.core", "imports construct, which is for"),
        ("view.polar", "import click", "imports click, which is for cli"),
    ],
)
def test_a_misplaced_import_is_found(name: str, text: str, complaint: str) -> None:
    (found,) = misplaced_imports(tree({f"lidarspec.{name}": text}))
    assert complaint in found


PUBLIC = {"lidarspec": ["Scan", "sensor"], "lidarspec.spec": ["Sensor"]}


@pytest.mark.parametrize(
    "text",
    [
        "from lidarspec.spec.sensor import Sensor",
        "from lidarspec import _secret",
        "from lidarspec import *",
        "import lidarspec.wire",
        "import pluggy",
        "import lidarspec as ls\nls.wire.parse",
        "if TYPE_CHECKING:\n    from lidarspec.wire.parse import parse",
    ],
)
def test_a_private_import_is_found(text: str) -> None:
    assert len(private_imports({"plugin": Module("plugin", text, True)}, PUBLIC)) == 1


@pytest.mark.parametrize(
    "text",
    [
        "import json",
        "import numpy.typing",
        "from construct import Struct",
        "from lidarspec import Scan",
        "from lidarspec.spec import Sensor",
        "import lidarspec as ls\nls.Scan",
        "from .more import x",
        "import plugin.more",
    ],
)
def test_a_public_import_is_free(text: str) -> None:
    assert not private_imports({"plugin": Module("plugin", text, True)}, PUBLIC)


@pytest.mark.parametrize("text", ["acme-x9", "default = 'ACME_X9'", "an acmex9", "# of Acme", "of_acme", "on an R1"])
def test_a_named_sensor_is_found(text: str) -> None:
    assert named_sensors(tree({"lidarspec.demo": f"\n{text}"}), ["acme-x9", "Acme", "R1"])


@pytest.mark.parametrize("text", ["acmes", "x9", "r1 = 1", "FR1", "DVB-R1", "macme-x90"])
def test_other_words_are_not_sensors(text: str) -> None:
    assert not named_sensors(tree({"lidarspec.demo": text}), ["acme-x9", "Acme", "R1"])
