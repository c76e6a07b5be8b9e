"""Tests of the pages that compare a manual with lidarspec, item by item."""

from __future__ import annotations

import ast
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import pytest

import lidarspec as ls
from lidarspec.frames.schema import make_schema
from tests.docs.test_reference_pages import load_script

ROOT = Path(__file__).parents[2]
SCRIPT = load_script("manual_coverage")
COVERAGES: list[Any] = SCRIPT.read_coverages()
EACH_MANUAL = pytest.mark.parametrize("coverage", COVERAGES, ids=lambda each: each.sensor)


def test_the_three_first_sensors_have_a_page() -> None:
    sensors = {coverage.sensor for coverage in COVERAGES}
    assert sensors == {"cspc-m1c1-mini", "ldrobot-stl27l", "robosense-m1"}


def list_missing_tests(coverage: Any) -> list[str]:
    """Return the tests that items name and that do not exist."""
    missing = []
    for item in coverage.items:
        file, _, function = item.test.partition("::")
        path = ROOT / file
        names = set[str]()
        if path.is_file():
            nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            names = {node.name for node in nodes if isinstance(node, ast.FunctionDef)}
        if function not in names or not function.startswith("test_"):
            missing.append(item.test)
    return missing


def list_missing_names(coverage: Any) -> set[str]:
    """Return the fields of the manual's tables that no item has."""
    printed = {name for names in coverage.tables.values() for name in names}
    return printed - {name for item in coverage.items for name in item.names}


def list_missing_fields(coverage: Any) -> list[str]:
    """Return the fields of the sensor's frames that no item has."""
    patterns = [pattern for item in coverage.items for pattern in item.fields]
    return [
        path
        for path in list_fields(coverage.sensor)
        if not any(fnmatchcase(path, pattern) for pattern in patterns)
    ]


def list_fields(sensor: str) -> list[str]:
    """Return the paths of all fields of a sensor, "frame.path"."""
    return [
        f"{name}.{path}"
        for name, frame in ls.sensor(sensor).frames.items()
        for path in make_schema(frame.tree).columns
    ]


@EACH_MANUAL
def test_each_item_names_a_test_that_exists(coverage: Any) -> None:
    assert list_missing_tests(coverage) == []


@EACH_MANUAL
def test_each_field_of_the_manuals_tables_is_an_item(coverage: Any) -> None:
    assert list_missing_names(coverage) == set()


@EACH_MANUAL
def test_each_field_of_the_sensor_is_in_an_item(coverage: Any) -> None:
    assert list_missing_fields(coverage) == []


@EACH_MANUAL
def test_each_item_has_fields_that_exist(coverage: Any) -> None:
    paths = list_fields(coverage.sensor)
    printed = {name for names in coverage.tables.values() for name in names}
    for item in coverage.items:
        assert all((item.section, item.item, item.place, item.proof))
        assert set(item.names) <= printed
        for pattern in item.fields:
            assert any(fnmatchcase(path, pattern) for path in paths), pattern


@EACH_MANUAL
def test_a_page_has_a_row_for_each_item(coverage: Any) -> None:
    page = SCRIPT.make_coverage_page(coverage, "Title")
    rows = [line for line in page.splitlines() if line.startswith("| ")]
    assert len(rows) == 1 + len(coverage.items)
    for row, item in zip(rows[1:], coverage.items, strict=True):
        assert row.startswith(f"| {item.section} |")
        assert item.test.rpartition("/")[2] in row


def test_gaps_are_found() -> None:
    item = SCRIPT.Item("1", "it", "here", "so", "tests/docs/test_docs.py::test_nothing")
    coverage = SCRIPT.Coverage("ldrobot-stl27l", "manual", {"3.1": ["speed"]}, (item,))
    assert list_missing_tests(coverage) == [item.test]
    assert list_missing_names(coverage) == {"speed"}
    assert "data.speed" in list_missing_fields(coverage)
