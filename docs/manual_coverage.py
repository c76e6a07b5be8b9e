"""Pages that compare a manual with lidarspec, item by item.

The items are in `manual.toml` beside the tests of a plugin. Each item names the place in lidarspec,
the proof, and a test. `reference_pages.py` writes the pages. Tests compare the items with the
manual's tables, the fields of the sensor, and the named tests.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class Item:
    """An item of a manual.

    Attributes:
        section: its place in the manual.
        item: the content.
        place: its place in lidarspec.
        proof: the source of the proof.
        test: the path of a test file from the root, with "::" and a function.
        names: fields, as the manual prints them.
        fields: patterns of field paths, "frame.path".
        covers: text that the test contains, if it contains none of the names and fields.
    """

    section: str
    item: str
    place: str
    proof: str
    test: str
    names: tuple[str, ...] = ()
    fields: tuple[str, ...] = ()
    covers: str = ""


@dataclass(frozen=True)
class Coverage:
    """The items of the manual of one sensor.

    Attributes:
        sensor: the id of the sensor.
        manual: the name of the manual.
        tables: name of each table of the manual -> its fields, as printed.
        items: the items, in the order of the manual.
        gaps: parts of the manual that no item covers, with the reason.
    """

    sensor: str
    manual: str
    tables: dict[str, list[str]] = field(default_factory=dict)
    items: tuple[Item, ...] = ()
    gaps: tuple[str, ...] = ()


def read_coverages() -> list[Coverage]:
    """Return the items of every manual that a plugin describes."""
    return [read_coverage(path) for path in sorted(ROOT.glob("plugins/*/tests/manual.toml"))]


def read_coverage(path: Path) -> Coverage:
    """Return the items in a file; paths of tests are relative to its folder."""
    content = tomllib.loads(path.read_text(encoding="utf-8"))
    folder = path.parent.relative_to(ROOT).as_posix()
    items = tuple(_make_item(entry, folder) for entry in content["items"])
    gaps = tuple(content.get("gaps", ()))
    return Coverage(content["sensor"], content["manual"], content["tables"], items, gaps)


def _make_item(entry: dict[str, Any], folder: str) -> Item:
    test = entry["test"]
    test = test[1:] if test.startswith("/") else f"{folder}/{test}"
    lists = {name: tuple(entry.get(name, ())) for name in ("names", "fields")}
    return Item(**{**entry, **lists, "test": test})


def make_coverage_page(coverage: Coverage, title: str) -> str:
    """Return the page with all items of a manual, as Markdown.

    Args:
        title: the vendor and the model of the sensor.
    """
    lines = [
        f"# {title}: the manual, item by item",
        "",
        f"Source: {coverage.manual}. The fields and packets are on [the page of the"
        f" sensor]({coverage.sensor}.md).",
        "",
        "| section | manual | fields | in lidarspec | paths | proof | test |",
        "|---|---|---|---|---|---|---|",
    ]
    for item in coverage.items:
        cells = [
            item.section,
            item.item,
            ", ".join(item.names),
            item.place,
            ", ".join(f"`{path}`" for path in item.fields),
            item.proof,
            f"`{item.test.rpartition('/')[2]}`",
        ]
        lines.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |")
    if coverage.gaps:
        lines += ["", "Not covered:", "", *(f"* {gap}" for gap in coverage.gaps)]
    return "\n".join(lines) + "\n"
