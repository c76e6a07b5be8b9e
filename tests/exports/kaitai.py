"""Compile the Kaitai spec of a sensor, and import the resulting Python module."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from lidarspec import Sensor
from lidarspec.exports import export, make_prefix
from lidarspec.exports.ksy import identifier
from tests.exports.trees import number

HERE = Path(__file__).parent
#: the compiler of Kaitai's own packages, by path or on PATH; without it the npm package is looked
#: for, as node does (NODE_PATH).
COMPILER = os.environ.get("LIDARSPEC_KSC", "kaitai-struct-compiler")


def compile_all(sensors: Iterable[Sensor], folder: Path) -> None:
    """Compile the export of each sensor to Python; skip the test without the compiler."""
    specs = []
    for sensor in sensors:
        specs.append(folder / f"{sensor.id}.ksy")
        specs[-1].write_text(export(sensor, "ksy"), encoding="utf-8")
    if shutil.which(COMPILER):
        command = [COMPILER, "--target", "python", "--outdir", str(folder), *map(str, specs)]
    elif _has_packages():
        command = ["node", str(HERE / "compile_ksy.js"), str(folder), *map(str, specs)]
    else:
        pytest.skip(
            "no Kaitai compiler: npm install kaitai-struct-compiler js-yaml, and name its"
            " node_modules in NODE_PATH"
        )
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr


def _has_packages() -> bool:
    if not shutil.which("node"):
        return False
    script = "require.resolve('kaitai-struct-compiler'); require.resolve('js-yaml')"
    return (
        subprocess.run(
            ["node", "-e", script], capture_output=True, check=False, timeout=60
        ).returncode
        == 0
    )


def module(sensor: Sensor, folder: Path) -> ModuleType:
    """Return the compiled module of a sensor."""
    name = identifier(make_prefix(sensor))
    spec = importlib.util.spec_from_file_location(name, folder / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    found = importlib.util.module_from_spec(spec)
    sys.modules[name] = found
    spec.loader.exec_module(found)
    return found


def reader(found: ModuleType, sensor: Sensor, frame: str) -> Any:
    """Return the class of a frame type."""
    return getattr(getattr(found, camel(identifier(make_prefix(sensor)))), camel(identifier(frame)))


def camel(name: str) -> str:
    """Return a name as in Kaitai's classes."""
    return "".join(part.capitalize() for part in re.split("_+", name) if part)


def differences(parsed: Any, read: Any, path: str = "") -> list[str]:
    """Return the differences between construct's values and those of Kaitai's class.

    Blocks and arrays inside it are compared by their flattened names.
    """
    if isinstance(parsed, Mapping):
        return [
            place
            for name, value in parsed.items()
            for place in differences(value, _member(read, name), f"{path}.{name}")
        ]
    if isinstance(parsed, list):
        # A chain without parts is missing.
        read = [] if read is None else getattr(read, "value", read)
        if len(parsed) != len(read):
            return [f"{path}: {len(parsed)} elements, and {len(read)} in Kaitai"]
        return [
            place
            for index, value in enumerate(parsed)
            for place in differences(value, read[index], f"{path}[{index}]")
        ]
    value = read
    while hasattr(value, "value"):  # of an array, and then of one of its alternatives
        value = value.value
    if isinstance(parsed, str):
        parsed = parsed.encode()
    parsed = number(parsed)
    value = None if parsed is None and value == b"" else value  # a check
    same = parsed == value or (parsed != parsed and value != value)
    return [] if same else [f"{path}: {parsed!r}, and {value!r} in Kaitai"]


def _member(read: Any, name: str) -> Any:
    return getattr(read, identifier(name), None)
