"""Tests of optional libraries: versions, missing and old ones.

The table must agree with pyproject.toml.
"""

from __future__ import annotations

import importlib.metadata
import re
import tomllib
from pathlib import Path

import pytest

from lidarspec.errors import LibraryError, UsageError, suggestion
from lidarspec.formats import write
from lidarspec.optional_libraries import EXTRAS, check_version, import_library, release_numbers

ROOT = Path(__file__).parents[1]
#: extras that install plugins or tools, and no library that lidarspec imports.
TOOL_EXTRAS = {"all", "bench", "dev", "docs", "notebook", "test", "web"}
REQUIREMENT = re.compile(r"([\w.-]+)(?:\[[\w,]+\])?>=([\w.]+)")
IMPORT_CALL = re.compile(r'import_library\("([\w.]+)", "(\w+)"\)')


def declared_requirements() -> dict[str, set[tuple[str, str]]]:
    """Return extra -> (distribution, least version), as pyproject.toml declares them."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    declared = {}
    for extra, lines in project["optional-dependencies"].items():
        if extra not in TOOL_EXTRAS:
            matches = [REQUIREMENT.match(line) for line in lines]
            assert all(matches), (extra, lines)
            declared[extra] = {(match[1], match[2]) for match in matches if match}
    return declared


def test_the_table_of_extras_agrees_with_pyproject() -> None:
    table = {extra: set(map(tuple, modules.values())) for extra, modules in EXTRAS.items()}
    assert table == declared_requirements()


def test_every_imported_library_is_in_the_table() -> None:
    calls = set()
    for file in (ROOT / "lidarspec").rglob("*.py"):
        calls.update(IMPORT_CALL.findall(file.read_text(encoding="utf-8")))
    assert len(calls) > 20
    missing = {module for module, extra in calls if module.partition(".")[0] not in EXTRAS[extra]}
    assert missing == {"distributed"}  # dask requires it


def test_a_missing_library_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(
        EXTRAS["ros"],
        "absent_library",
        EXTRAS["ros"]["rosbags"]._replace(distribution="absent-library"),
    )
    with pytest.raises(LibraryError) as caught:
        import_library("absent_library.reader", "ros")
    error = caught.value
    assert isinstance(error, UsageError)
    assert (error.distribution, error.extra) == ("absent-library", "ros")
    assert (error.least_version, error.installed_version) == ("0.11", "")
    assert suggestion(error) == "pip install 'lidarspec[ros]'"


def test_an_old_library_is_named_with_both_versions(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    versions = {"rosbags": "0.9.23"}
    check_version.cache_clear()
    monkeypatch.setattr(importlib.metadata, "version", versions.__getitem__)
    with pytest.raises(LibraryError) as caught:
        write(tmp_path / "scan.bag", [])
    error = caught.value
    assert (error.least_version, error.installed_version) == ("0.11", "0.9.23")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("version", "numbers"),
    [
        ("0.11", (0, 11)),
        ("0.11.0", (0, 11)),
        ("3.0.8rc1", (3, 0, 8)),
        ("2024.8.1.dev3", (2024, 8, 1)),
        ("unknown", ()),
    ],
)
def test_versions_are_compared_by_their_release(version: str, numbers: tuple[int, ...]) -> None:
    assert release_numbers(version) == numbers
