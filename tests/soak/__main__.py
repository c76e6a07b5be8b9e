"""Test and measure every promise, and write the table of figures: `make soak`.

The table goes into docs/explanation/reliability.md.
"""

from __future__ import annotations

import argparse
import datetime
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
import traceback
import xml.etree.ElementTree as xml
from pathlib import Path

import lidarspec
from tests.soak.figures import ROOT, Figure
from tests.soak.promises import EVERY, Promise

PAGE = ROOT / "docs" / "explanation" / "reliability.md"
BEGIN, END = "<!-- written by make soak -->", "<!-- to here -->"


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(prog="make soak", description=__doc__)
    parser.add_argument(
        "--only",
        metavar="NAME",
        action="append",
        help="these promises alone, such as P3; the table is printed and not written",
    )
    parser.add_argument(
        "--share",
        metavar="SHARE",
        type=float,
        default=1.0,
        help="of the full effort, up to 1; the table says it",
    )
    parser.add_argument(
        "--no-tests",
        action="store_true",
        help="measure alone, and run no tests; the table says what was not run",
    )
    return parser.parse_args()


def main() -> int:
    """Run the soak; return 1 if a promise is not kept, otherwise 0."""
    given = arguments()
    chosen = [promise for promise in EVERY if not given.only or promise.name in given.only]
    figures, began = {}, time.monotonic()
    for promise in chosen:
        figures[promise] = measure_promise(promise, given.share, tests=not given.no_tests)
        print(f"{promise.name}: {verdict(figures[promise])}: {figures[promise].words}", flush=True)
    effort = "" if given.share == 1 else f" and {100 * given.share:g} % of the full effort"
    text = table(figures, time.monotonic() - began, effort)
    if given.only:
        print(text)
    else:
        write_table(text)
    return int(not all(figure.kept for figure in figures.values()))


def measure_promise(promise: Promise, share: float, *, tests: bool = True) -> Figure:
    """Run the tests and measurements of a promise; return the result as text."""
    parts = [run_tests(promise, long=share == 1)] if promise.tests and tests else []
    if promise.measured is not None:
        try:
            parts.append(promise.measured(share))
        except Exception as error:
            traceback.print_exc()
            parts.append(
                Figure(f"could not be measured: {type(error).__name__}: {error}"[:200], False)
            )
    return Figure(
        "; ".join(part.words for part in parts if part.words) or "not run",
        all(part.kept for part in parts),
    )


def run_tests(promise: Promise, *, long: bool) -> Figure:
    """Run the tests of a promise; return their number and the result as text."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder, "report.xml")
        words = [
            sys.executable,
            "-m",
            "pytest",
            "-p",
            "no:cacheprovider",
            "-n",
            "2",
            f"--junitxml={report}",
            *promise.tests,
        ]
        subprocess.run(
            [*words, *(["-m", "soak or not soak"] if long else [])],
            cwd=ROOT,
            stdout=subprocess.DEVNULL,
            check=False,
        )
        cases = list(xml.parse(report).getroot().iter("testcase")) if report.is_file() else []
    failed = [
        str(case.get("name"))
        for case in cases
        if case.find("failure") is not None or case.find("error") is not None
    ]
    passed = len(cases) - len(failed) - sum(case.find("skipped") is not None for case in cases)
    if failed or not passed:
        return Figure(f"{len(failed)} of {len(cases)} tests fail: {', '.join(failed[:3])}", False)
    text = promise.result if long else ""
    if not text and promise.measured is None:
        text = f"{passed} tests"
    return Figure(text, True)


def table(figures: dict[Promise, Figure], seconds: float, effort: str = "") -> str:
    """Return the table with the date, version, machine and, if reduced, the effort."""
    day, machine = (
        datetime.date.today().isoformat(),
        f"{os.cpu_count()} cores, {platform.machine()}, {platform.system()}",
    )
    what = (
        f"{day}, lidarspec {lidarspec.__version__}, Python {platform.python_version()}, {machine};"
        f" {seconds / 60:.0f} minutes{effort}."
    )
    rows = [
        [promise.name, promise.words, figure.words.replace("|", "/"), verdict(figure)]
        for promise, figure in figures.items()
    ]
    return "\n".join(
        [
            what,
            "",
            "| | promise | today | kept |",
            "|---|---|---|---|",
            *(f"| {' | '.join(row)} |" for row in rows),
        ]
    )


def verdict(figure: Figure) -> str:
    """Return the table's text for whether a promise is kept."""
    return "" if figure.words == "not run" else "yes" if figure.kept else "**no**"


def write_table(text: str) -> None:
    """Write the table into the page, between its marks."""
    page = PAGE.read_text(encoding="utf-8")
    found = re.sub(
        f"{BEGIN}.*{END}", lambda _: f"{BEGIN}\n\n{text}\n\n{END}", page, flags=re.DOTALL
    )
    PAGE.write_text(found, encoding="utf-8")
    print(f"written into {PAGE.relative_to(ROOT)}")


if __name__ == "__main__":
    sys.exit(main())
