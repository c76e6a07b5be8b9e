"""Tests that the pages' examples run.

They also require a heading for every hook, error and verb.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import operator
import os
import re
from collections import Counter, defaultdict
from pathlib import Path

import pytest

import lidarspec as ls
from lidarspec import errors, plugins as hookspecs, spec
from lidarspec.cli.root import VERBS
from lidarspec.spec import Checksummed, Clock, Command, Frame, PacketCounter, Polar, Scaled
from tests.docs import pages
from tests.docs.pages import DOCS

#: pages that `make docs` generates, not tracked.
GENERATED = "reference/sensors/"
PAGES = sorted(
    page
    for page in (path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md"))
    if not page.startswith(GENERATED)
)


def headings(page: str) -> set[str]:
    return set(
        re.findall(r"^## (\S+)$", (DOCS / page).read_text(encoding="utf-8"), flags=re.MULTILINE)
    )


#: as a page under docs/.
README = "../README.md"
#: pages with something to run.
FOLLOWED = [
    page
    for page in [README, *PAGES]
    if any(block.language in ("sh", "python") for block in pages.blocks(page))
]


@pytest.mark.slow
@pytest.mark.skipif(
    os.name == "nt", reason="shell blocks are for bash, and some use a pseudo-terminal"
)
@pytest.mark.parametrize("page", FOLLOWED)
def test_a_page_can_be_followed_to_its_end(page: str, tmp_path: Path) -> None:
    (tmp_path / "here").mkdir()
    shells = any(block.language == "sh" for block in pages.blocks(page))
    environment = pages.clean_environment(tmp_path / "environment") if shells else {}
    ran, left_out = pages.follow(
        page, tmp_path / "here", {**environment, "LIDARSPEC_EXAMPLES": "8"}
    )
    assert ran
    if left_out:
        pytest.skip("; ".join(left_out))


def test_a_page_that_is_wrong_is_found(tmp_path: Path) -> None:
    def block(language: str, text: str, title: str = "") -> pages.Block:
        return pages.Block(language, title, text, "invented.md", 7)

    with pytest.raises(AssertionError, match=r"invented.md:7: exit code 3"):
        pages.shell(block("sh", "(exit 3) | cat"), tmp_path)
    with pytest.raises(ZeroDivisionError):
        pages.python(block("python", "1 / 0"), tmp_path, {})
    pages.assert_printed(block("text", "a ... d\ne\n", pages.OUTPUT), "a b c d  \ne\n")
    with pytest.raises(AssertionError, match="the page says"):
        pages.assert_printed(block("text", "a\n", pages.OUTPUT), "a\nb\n")


def test_the_python_of_the_readme_prints_its_output(tmp_path: Path) -> None:
    code, output = pages.blocks(README)[:2]
    pages.assert_printed(output, pages.python(code, tmp_path, {}))


def test_the_readme_counts_the_models_of_each_vendor_by_status() -> None:
    text = (DOCS / README).read_text(encoding="utf-8")
    statuses = defaultdict(Counter)
    for sensor in map(ls.sensor, ls.sensors()):
        statuses[sensor.vendor][sensor.status] += 1
    expected = {
        vendor: (
            str(counts.total()),
            f"{counts['capture']} / {counts['vectors']} / {counts['manual']}",
        )
        for vendor, counts in statuses.items()
    }
    cells = re.findall(r"\| (\w[^|]*) \| (\d+) \| (\d+ / \d+ / \d+)(?= \|)", text)
    assert {vendor: (models, verified) for vendor, models, verified in cells} == expected
    totals = sum(statuses.values(), Counter())
    total = f"{totals['capture']} / {totals['vectors']} / {totals['manual']}"
    assert f"In total {totals.total()} models: {total}." in text
    assert f"{totals.total()} sensors are described" in " ".join(text.split())


HOOKS = {
    name: function for name, function in vars(hookspecs).items() if name.startswith("lidarspec_")
}


def test_every_hook_has_its_heading() -> None:
    assert set(HOOKS) <= headings("reference/hooks.md")


@pytest.mark.parametrize("name", HOOKS)
def test_every_hook_is_written_with_its_arguments(name: str) -> None:
    found = re.search(
        rf"^`{name}\((.*?)\) -> .+?`",
        (DOCS / "reference/hooks.md").read_text(encoding="utf-8"),
        flags=re.MULTILINE,
    )
    assert found
    assert re.findall(r"(\w+):", found[1]) == list(inspect.signature(HOOKS[name]).parameters)


def test_every_public_name_is_on_the_page_of_docstrings() -> None:
    public = {*ls.__all__, *spec.__all__, *public_errors()}
    shown = re.findall(
        r"^::: (lidarspec[\w.]*)\.(\w+)$",
        (DOCS / "reference/api.md").read_text(encoding="utf-8"),
        re.MULTILINE,
    )
    assert sorted(name for _, name in shown) == sorted(public)
    assert all(hasattr(importlib.import_module(module), name) for module, name in shown)


def public_errors() -> set[str]:
    classes = {
        name
        for name, value in vars(errors).items()
        if isinstance(value, type) and issubclass(value, errors.LidarSpecError)
    }
    return classes - {"UnknownName"}


@pytest.mark.parametrize(
    "value", [ls.Sensor, Frame, Command, Scaled, Checksummed, Clock, PacketCounter, Polar]
)
def test_every_argument_of_the_authors_api_is_documented(value: type) -> None:
    arguments = (inspect.getdoc(value) or "").partition("Args:")[2]
    named = set(re.findall(r"\w+", " ".join(re.findall(r"^ +([\w, ]+):", arguments, re.MULTILINE))))
    assert set(inspect.signature(value).parameters) <= named


def test_every_public_error_has_its_heading() -> None:
    assert public_errors() - {"LidarSpecError"} == headings("reference/errors.md")


def test_every_verb_has_its_heading() -> None:
    assert set(VERBS) <= headings("reference/command-line.md")


@pytest.mark.parametrize("page", PAGES)
def test_links_between_pages_lead_somewhere(page: str) -> None:
    path = DOCS / page
    for target in re.findall(r"\]\(([^)#:]+\.md)", path.read_text(encoding="utf-8")):
        # `make docs` checks the links to generated pages
        assert GENERATED in target or (path.parent / target).is_file(), target


def test_every_page_is_in_the_contents_of_the_site() -> None:
    contents = (DOCS.parent / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:")[2]
    listed = re.findall(r": (\S+\.md)(?: #.*)?$", contents, re.MULTILINE)
    assert sorted(listed) == sorted([*PAGES, f"{GENERATED}index.md"])


HOUSE = Path(ls.__file__).parent


@pytest.mark.parametrize(
    "package",
    sorted(path.parent.relative_to(HOUSE).as_posix() for path in HOUSE.glob("*/**/__init__.py")),
)
def test_a_package_docstring_lists_its_modules(package: str) -> None:
    text = (
        ast.get_docstring(ast.parse((HOUSE / package / "__init__.py").read_text(encoding="utf-8")))
        or ""
    )
    modules = {
        path.stem
        for path in (HOUSE / package).iterdir()
        if path.suffix == ".py" or (path / "__init__.py").is_file()
    }
    listed = {
        name
        for line in re.findall(r"^\* (.*?): ", text, re.MULTILINE)
        for name in re.findall(r"`(\w+)`", line)
    }
    assert listed == modules - {"__init__"}


CONTRIBUTING = (DOCS.parent / "CONTRIBUTING.md").read_text(encoding="utf-8")


def list_opened_names(section: str) -> list[tuple[str, str]]:
    """Return module and name of everything that CONTRIBUTING's tables refer to.

    A name belongs to the last module before it.
    """
    text = CONTRIBUTING.partition(f"## {section}\n")[2].partition("\n## ")[0]
    named = []
    for row in re.findall(r"^\|.*`.*\|$", text, re.MULTILINE):
        module = ""
        _, _, module_cell, names, *_ = row.split("|")
        for word in re.findall(r"`([\w.]+)`", module_cell + names):
            place = HOUSE / word.replace(".", "/")
            if place.is_dir() or place.with_suffix(".py").is_file():
                module = word
            elif module:
                named.append((module, word))
    return named


@pytest.mark.parametrize(("module", "name"), list_opened_names("Where things are"))
def test_names_in_contributing_exist(module: str, name: str) -> None:
    assert operator.attrgetter(name)(importlib.import_module(f"lidarspec.{module}"))
