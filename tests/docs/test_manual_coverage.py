"""Tests of the pages that compare a manual with lidarspec, item by item."""

from __future__ import annotations

import ast
import functools
import re
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


@functools.cache
def read_tests(file: str) -> dict[str, str]:
    """Return the text of each test function in a file, with its decorators."""
    path = ROOT / file
    if not path.is_file():
        return {}
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines()
    tests = {}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
            first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
            tests[node.name] = "\n".join(lines[first - 1 : node.end_lineno])
    return tests


def read_test(item: Any) -> str:
    """Return the text of the test that an item names; "" if it does not exist."""
    file, _, function = item.test.partition("::")
    return read_tests(file).get(function, "")


def list_missing_tests(coverage: Any) -> list[str]:
    """Return the tests that items name and that do not exist."""
    return [item.test for item in coverage.items if not read_test(item)]


def list_unrelated_tests(coverage: Any) -> list[str]:
    """Return the items whose test contains none of their words.

    The words are `covers`, or else the names in the manual and the last part of each field's path.
    """
    unrelated = []
    for item in coverage.items:
        last_parts = {path.rpartition(".")[2].strip("*_") for path in item.fields}
        words = {item.covers} if item.covers else {*item.names, *last_parts}
        text = read_test(item)
        found = (re.search(rf"(?<!\w){re.escape(word)}(?!\w)", text) for word in words if word)
        if not any(found):
            unrelated.append(f"{item.section}: {item.item} ({item.test})")
    return unrelated


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
def test_each_item_names_a_test_that_contains_it(coverage: Any) -> None:
    assert list_unrelated_tests(coverage) == []


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
        assert all(f"`{path}`" in row for path in item.fields)
    assert all(f"* {gap}" in page.splitlines() for gap in coverage.gaps)


def test_gaps_are_found() -> None:
    item = SCRIPT.Item("1", "it", "here", "so", "tests/docs/test_docs.py::test_nothing")
    coverage = SCRIPT.Coverage("ldrobot-stl27l", "manual", {"3.1": ["speed"]}, (item,))
    assert list_missing_tests(coverage) == [item.test]
    assert list_missing_names(coverage) == {"speed"}
    assert "data.speed" in list_missing_fields(coverage)


@pytest.mark.parametrize(
    ("words", "is_related"),
    [
        ({"fields": ("data.speed", "data.crc")}, True),
        ({"names": ("speed",)}, True),
        ({"covers": "list_missing_names"}, True),
        ({"fields": ("data.start_angle",)}, False),
        ({"fields": ("data.spee",)}, False),
        ({"fields": ("data.speed",), "covers": "10 Hz"}, False),
        ({}, False),
    ],
)
def test_a_test_without_the_words_of_its_item_is_found(
    words: dict[str, Any], is_related: bool
) -> None:
    test = "tests/docs/test_manual_coverage.py::test_gaps_are_found"  # it contains "speed"
    item = SCRIPT.Item("1", "it", "here", "so", test, **words)
    coverage = SCRIPT.Coverage("ldrobot-stl27l", "manual", {}, (item,))
    assert (list_unrelated_tests(coverage) == []) == is_related
