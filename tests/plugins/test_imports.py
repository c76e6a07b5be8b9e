"""Tests that finding a sensor imports only its plugin and the sensor description."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys

import pytest

import lidarspec as ls

#: what a sensor is made of, and how it is found.
ALLOWED = {
    *(
        "_version",
        "expressions",
        "expressions.columns",
        "notebook_display",
        "entry_points",
        "errors",
        "known_sensors",
        "plugins",
        "sensor_operations",
        "spec",
        "spec.arguments",
        "spec.bits",
        "spec.checksums",
    ),
    *(
        "spec.syntax",
        "spec.syntax.adapters",
        "spec.syntax.meaning",
        "spec.syntax.raw_checksums",
        "spec.syntax.refusals",
        "spec.syntax.replacements",
    ),
    "spec.syntax.structs",
    *(
        "spec.description",
        "spec.fields",
        "spec.links",
        "spec.results",
        "spec.options",
        "spec.sensor",
        "spec.timing",
        "spec.enum_values",
        "spec.tree",
    ),
    *(
        "spec.vocabulary",
        "spec.wire_forms",
        "trusted_files",
        "frames",
        "frames.arrays",
        "frames.frame_table",
        "frames.layout",
        "frames.row_checksums",
        "frames.schema",
    ),
}
#: of the standard library, what takes long to import; NumPy and construct may bring it along,
#: lidarspec does not.
SLOW = {"difflib", "email", "importlib.metadata", "pathlib", "random", "socket", "zipfile"}

LOADED = """
import json, sys
import numpy, construct, pluggy
before = set(sys.modules)
import lidarspec as ls
{}
print(json.dumps(sorted(set(sys.modules) - before)))
"""


def list_imported(code: str) -> set[str]:
    """Return the modules that a new process imports for this code.

    NumPy, construct and pluggy are left out.
    """
    done = subprocess.run(
        [sys.executable, "-c", LOADED.format(code)],
        check=True,
        capture_output=True,
        text=True,
        timeout=60,
    )
    return set(json.loads(done.stdout))


def test_finding_a_sensor_imports_neither_the_engine_nor_other_plugins() -> None:
    found = list_imported("ls.sensor('ldrobot-stl27l')")
    assert {name for name in found if name.startswith("lidarspec_")} == {"lidarspec_ldrobot"}
    assert {
        name.removeprefix("lidarspec.") for name in found if name.startswith("lidarspec.")
    } <= ALLOWED
    assert not found & SLOW


def test_a_method_brings_the_engine() -> None:
    assert "lidarspec.framing.decoder" in list_imported("ls.sensor('ldrobot-stl27l').decoder()")


def test_importing_the_package_imports_no_library() -> None:
    code = (
        "import sys, lidarspec; print(sorted({'numpy', 'construct', 'pluggy'} & set(sys.modules)))"
    )
    assert (
        subprocess.run(
            [sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=60
        ).stdout
        == "[]\n"
    )


@pytest.mark.parametrize("options", [{}, {"frame": "vendor"}])
def test_a_sensor_is_unpickled_in_a_new_process(options: dict[str, str]) -> None:
    sensor = ls.sensor("ldrobot-stl27l")
    packed = pickle.dumps(sensor.configure(**options) if options else sensor)
    code = (
        f"import pickle; sensor = pickle.loads({packed!r}); print(sensor);"
        " sensor.parse(sensor.example('data'))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=60
    )
    assert "ldrobot-stl27l" in done.stdout
