"""The verb that checks a plugin."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import click

from lidarspec.cli.failures import FINDINGS
from lidarspec.cli.output import emit, emit_json
from lidarspec.cli.progress import Progress
from lidarspec.errors import UsageError
from lidarspec.testing.checking import Report, reports
from lidarspec.testing.subject import EXAMPLES
from lidarspec.testing.targets import target


@click.command()
@click.argument("name", metavar="ID|FILE|DISTRIBUTION|FOLDER")
@click.option("--max-examples", type=click.IntRange(1), default=EXAMPLES, show_default=True, help="Examples of each frame type.")
@click.option("--vectors", metavar="FILE", help="Golden vectors; by default vectors.json beside a file.")
@click.option("-v", "--verbose", is_flag=True, help="Also what was skipped and why, and what was measured.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@click.option("-o", "--output", metavar="FILE", help="Write to a file instead of standard output.")
@click.pass_context
def check(ctx: click.Context, name: str, max_examples: int, vectors: str | None, verbose: bool, as_json: bool, output: str | None) -> None:
    """What is wrong with a sensor, a file or a distribution: every promise, and mistakes in its spec.

    Everything that the test kit asks, without a test file. Exit code 1 where there are findings.
    """
    if importlib.util.find_spec("hypothesis") is None:
        raise UsageError("check needs hypothesis: pip install 'lidarspec[testing]'")
    file = Path(vectors) if vectors else None
    with Progress() as line:
        found = list(reports(target(name), name, examples=max_examples, vectors=file, watch=lambda text: line(lambda: text)))
    if as_json:
        emit_json([report.to_dict() for report in found], output)
    else:
        emit("\n\n".join(text for report in found for text in _told(report, verbose=verbose)), output)
    if any(report.findings for report in found):
        ctx.exit(FINDINGS)


def _told(report: Report, *, verbose: bool) -> list[str]:
    """A report in paragraphs."""
    paragraphs = [str(finding) for finding in report.findings]
    number = len(report.findings)
    verdict = f"{number} finding{'s' * (number != 1)}" if number else "clean"
    more = f", {report.held} properties hold" if report.held else ""
    more += f", {len(report.skipped)} skipped" if report.skipped else ""
    lines = [f"{report.name}: {verdict}{more}"]
    if verbose:
        lines += [f"  skipped   {name}: {reason}" for name, reason in report.skipped.items()]
        lines += [f"  measured  {name}: {value}" for name, value in report.measured.items()]
    return [*paragraphs, "\n".join(lines)]
