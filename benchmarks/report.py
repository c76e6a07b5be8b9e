"""Print the table of benchmark results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

#: ratios that have a column of their own; the others stand in the last one.
COLUMNS = {
    "construct": "construct",
    "compiled": "compiled\nconstruct",
    "plain": "plain\npoints",
    "by hand": "by\nhand",
}
#: contenders that only a fact is made of.
INNER = ("libraries",)
#: characters; what is piped to a file is not folded to a terminal.
WIDE = 180
#: Smallest meaningful share of memcpy.
LEAST_SHARE = 1e-4


def print_rows(
    rows: Sequence[Mapping[str, Any]], versions: Mapping[str, str], *, title: str, best: bool
) -> None:
    """Print the rows: medians, or the best run of each contender."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=WIDE)
    table = Table(title=title, caption=_caption(versions))
    table.add_column("work")
    for heading in (
        "back\nend",
        "a second",
        "MB/s",
        "of memcpy",
        *(f"x {name}" for name in COLUMNS.values()),
    ):
        table.add_column(heading, justify="right")
    table.add_column("x others; more")
    for row in rows:
        table.add_row(*_cells({**row, **row["best"]} if best else row))
    console.print(table)


def _caption(versions: Mapping[str, str]) -> str:
    return "x: times as fast as. " + ", ".join(
        f"{name} {version}" for name, version in versions.items()
    )


def _cells(row: Mapping[str, Any]) -> list[str]:
    ratios = row["times"]
    share = row["share_of_memcpy"]
    return [
        row["title"],
        row["backend"],
        _number(row["million_per_s"], row["unit"]),
        _figure(row["mb_per_s"]) if row["bytes"] else "",
        f"{100 * share:.2f} %" if row["bytes"] and share > LEAST_SHARE else "",
        *(_figure(ratios[name]) if name in ratios else "" for name in COLUMNS),
        "; ".join(_more(row)),
    ]


def _more(row: Mapping[str, Any]) -> list[str]:
    others = [
        f"{name} {_figure(ratio)}"
        for name, ratio in row["times"].items()
        if name not in COLUMNS and name not in INNER
    ]
    missing = [f"{name}: {reason}" for name, reason in row["not_installed"].items()]
    return [
        *others,
        *missing,
        *(f"{_figure(value)} {name}" for name, value in row["facts"].items()),
    ]


def _number(millions: float, unit: str) -> str:
    """Format a number in millions, or as it is if it is small."""
    return (
        f"{_figure(millions)} M {unit}" if millions >= 0.01 else f"{_figure(millions * 1e6)} {unit}"
    )


def _figure(value: float) -> str:
    """Format a number with three digits, or as a whole number."""
    return f"{value:.0f}" if value >= 100 or value == int(value) else f"{value:.3g}"
