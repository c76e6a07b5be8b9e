"""The plan of the house, held against the source; each rule is also shown a small tree that breaks it."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path

import pytest

import lidarspec
from tests.architecture import (
    FILE_LINES,
    FUNCTION_LINES,
    Module,
    climbing,
    misplaced_imports,
    named_sensors,
    oversized,
    private_imports,
    read,
)

ROOT = Path(__file__).resolve().parent.parent
CORE = read(ROOT / "lidarspec")
PLUGINS = sorted(path.parent for path in (ROOT / "plugins").glob("*/lidarspec_*/__init__.py"))


def test_imports_go_down_without_circles() -> None:
    assert "lidarspec.spec" in CORE
    assert not climbing(CORE)


def test_io_and_libraries_are_imported_where_they_belong() -> None:
    assert not misplaced_imports(CORE)


def test_files_and_functions_are_small() -> None:
    assert not oversized(CORE)


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
    assert not private_imports(read(plugin), lidarspec.__all__)


def test_the_extra_all_names_every_distribution() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert sorted(project["optional-dependencies"]["all"]) == sorted(path.parent.name for path in PLUGINS)


def tree(files: Mapping[str, str]) -> dict[str, Module]:
    """Modules from their texts; a name that ends in a dot is a package."""
    packages = {name.removesuffix("."): Module(name.removesuffix("."), text, name.endswith(".")) for name, text in files.items()}
    return {"lidarspec": Module("lidarspec", "", True), **packages}


@pytest.mark.parametrize(
    ("files", "complaint"),
    [
        (
            {"lidarspec.fields": "def f():\n    from lidarspec.spec import Sensor"},
            "lidarspec.fields:2 (floor 0) imports lidarspec.spec (floor 1)",
        ),
        ({"lidarspec.fields": "from . import spec"}, "lidarspec.fields:1 (floor 0) imports lidarspec.spec (floor 1)"),
        ({"lidarspec.cli.": "", "lidarspec.view.": "from ..cli import main"}, "lidarspec.view:1 (floor 6) imports lidarspec.cli (floor 7)"),
        ({"lidarspec.fields": "import lidarspec"}, "lidarspec.fields:1 (floor 0) imports lidarspec (floor 8)"),
        ({"lidarspec.fields": "import_module('lidarspec.spec')"}, "lidarspec.fields:1 (floor 0) imports lidarspec.spec (floor 1)"),
        ({"lidarspec.gadgets": ""}, "lidarspec.gadgets stands on no floor: add it to FLOORS"),
        (
            {
                "lidarspec.bits": "from .units import a",
                "lidarspec.units": "import lidarspec.angles",
                "lidarspec.angles": "from lidarspec import bits",
            },
            "circle: lidarspec.bits imports lidarspec.units imports lidarspec.angles imports lidarspec.bits",
        ),
        (
            {"lidarspec.spec": "if TYPE_CHECKING:\n    import time\nelse:\n    import lidarspec.cli", "lidarspec.cli.": ""},
            "lidarspec.spec:4 (floor 1) imports lidarspec.cli (floor 7)",
        ),
    ],
)
def test_a_climbing_import_is_found(files: dict[str, str], complaint: str) -> None:
    assert climbing({**tree({"lidarspec.spec": ""}), **tree(files)}) == [complaint]


def test_imports_for_type_checkers_do_not_count() -> None:
    files = {"lidarspec.fields": "if TYPE_CHECKING:\n    from lidarspec.spec import Sensor", "lidarspec.spec": "import lidarspec.fields"}
    assert not climbing(tree(files))


@pytest.mark.parametrize(
    ("name", "text", "complaint"),
    [
        ("session", "import time", "imports time below floor 5"),
        ("points", "def f():\n    from asyncio import Queue", "imports asyncio below floor 5"),
        ("device", "import pluggy", "imports pluggy, which is for hookspecs, plugins"),
        ("transports.udp", "from serial.tools import list_ports", "imports serial, which is for transports.ports, transports.serial"),
        ("decoder", "import construct.core", "imports construct, which is for"),
    ],
)
def test_a_misplaced_import_is_found(name: str, text: str, complaint: str) -> None:
    (found,) = misplaced_imports(tree({f"lidarspec.{name}": text}))
    assert complaint in found


@pytest.mark.parametrize(
    "text",
    [
        "from lidarspec.spec import Sensor",
        "from lidarspec import _secret",
        "from lidarspec import *",
        "import lidarspec.spec",
        "import pluggy",
        "import lidarspec as ls\nls.spec.Sensor",
        "if TYPE_CHECKING:\n    from lidarspec.spec import Sensor",
    ],
)
def test_a_private_import_is_found(text: str) -> None:
    assert len(private_imports({"plugin": Module("plugin", text, True)}, ["Sensor"])) == 1


@pytest.mark.parametrize(
    "text",
    [
        "import json",
        "import numpy.typing",
        "from construct import Struct",
        "from lidarspec import Sensor",
        "import lidarspec as ls\nls.Sensor",
        "from .more import x",
        "import plugin.more",
    ],
)
def test_a_public_import_is_free(text: str) -> None:
    assert not private_imports({"plugin": Module("plugin", text, True)}, ["Sensor"])


def test_a_large_file_and_a_long_function_are_found() -> None:
    text = "def f():\n" + "    pass\n" * FUNCTION_LINES + "\n" * FILE_LINES
    assert oversized(tree({"lidarspec.spec": text})) == ["lidarspec.spec has 411 lines", "lidarspec.spec:1 f has 61 lines"]
    text = "def f():\n" + "    pass\n" * (FUNCTION_LINES - 1) + "\n" * (FILE_LINES - FUNCTION_LINES)
    assert not oversized(tree({"lidarspec.spec": text}))


@pytest.mark.parametrize("text", ["acme-x9", "default = 'ACME_X9'", "an acmex9", "# of Acme", "of_acme", "on an R1"])
def test_a_named_sensor_is_found(text: str) -> None:
    assert named_sensors(tree({"lidarspec.demo": f"\n{text}"}), ["acme-x9", "Acme", "R1"])


@pytest.mark.parametrize("text", ["acmes", "x9", "r1 = 1", "FR1", "macme-x90"])
def test_other_words_are_not_sensors(text: str) -> None:
    assert not named_sensors(tree({"lidarspec.demo": text}), ["acme-x9", "Acme", "R1"])
