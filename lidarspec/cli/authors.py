"""`new`, `check` and `export`: the verbs for authors of sensors."""

from __future__ import annotations

import contextlib
from pathlib import Path
from shlex import quote

import click

from lidarspec.cli.failures import FINDINGS
from lidarspec.cli.output import Progress, emit, emit_json, output_option
from lidarspec.cli.terminal import note, say
from lidarspec.detect.sample_bytes import read_beginning
from lidarspec.drafting.distribution import (
    DistributionNames,
    Link,
    make_added_files,
    make_draft_files,
    make_example_files,
    write_files,
)
from lidarspec.drafting.draft import make_draft
from lidarspec.errors import UsageError, WireError, suggest
from lidarspec.exports import (
    BYTE_EXPORTS,
    EXPORTS,
    ExportError,
    describe_left_out,
    export as exported,
    select_frame,
)
from lidarspec.optional_libraries import import_library
from lidarspec.plugins import sensor as named_sensor, sensors
from lidarspec.testing.check import Report, find_target, iter_reports
from lidarspec.testing.sensor_under_test import EXAMPLES
from lidarspec.transports.open_url import open_transport
from lidarspec.transports.protocol import Chunk, no_bytes_message

#: Maximum number of bytes of a capture to analyse.
MAX_CAPTURE_BYTES = 1 << 22


@click.command()
@click.argument("sensor_id", metavar="ID")
@click.option(
    "--into",
    metavar="DIR",
    default=".",
    help="Create the distribution in this folder; default: the current one.",
)
@click.option(
    "--distribution",
    metavar="NAME",
    help="Name of the distribution, such as lidarspec-acme. The sensor is added to an existing"
    " distribution of this name.",
)
@click.option("--vendor", metavar="NAME", help="Name of the vendor; default: taken from the id.")
@click.option("--model", metavar="NAME", help="Name of the model; default: taken from the id.")
@click.option(
    "--link",
    type=click.Choice(["serial", "udp"]),
    help="Link over which the sensor sends data; default: serial.",
)
@click.option(
    "--from-capture",
    "capture",
    metavar="FILE",
    help="Draft the frames from a capture: raw bytes, .pcap, .lsr or .hex.",
)
def new(
    sensor_id: str,
    into: str,
    distribution: str | None,
    vendor: str | None,
    model: str | None,
    link: str | None,
    capture: str | None,
) -> None:
    """Create a distribution for your own sensor, with a working example.

    The distribution contains an invented sensor, which has frames, a checksum, points, commands and
    a simulation. It also contains tests, and an entry point by which lidarspec finds the sensor
    after installation. --distribution adds a module and its tests to an existing distribution.

    With --from-capture, the frames are drafted from the bytes of a capture. The draft contains the
    sync bytes, length, checksum, counters and angles that were found, each with its evidence.
    All other bytes are marked as unknown.
    """
    names = DistributionNames(sensor_id, distribution or "", vendor or "", model or "")
    if sensor_id in sensors():
        raise suggest(
            UsageError(f"{sensor_id} is installed already: choose another id"),
            f"lidarspec show {quote(sensor_id)}",
        )
    folder = Path(into) / names.distribution
    if folder.exists() and distribution is None:
        raise suggest(
            UsageError(f"{folder} exists already: nothing was written"),
            f"lidarspec new {quote(sensor_id)} --distribution NAME",
        )
    if capture is None:
        texts = make_example_files(names, "udp" if link == "udp" else "serial")
    else:
        texts = _draft_files(names, link, capture)
    if folder.exists():
        texts = make_added_files(folder, names, texts)
    write_files(folder, texts)
    for name in texts:
        say(str(folder / name))
    if capture is None:
        look = f"demo -s {sensor_id}"
    else:
        look = f"explain {quote(capture)} -s {sensor_id}"
    note(
        f"next: pip install -e {quote(f'{folder}[test]')} && pytest {quote(str(folder))} &&"
        f" lidarspec {look}"
    )


def _draft_files(names: DistributionNames, link: str | None, capture: str) -> dict[str, str]:
    """Draft the frames in a capture, and return the files of a distribution by name."""
    groups: dict[object, list[Chunk]] = {}
    with contextlib.closing(open_transport(capture)) as opened:
        for chunk in read_beginning(opened, MAX_CAPTURE_BYTES):
            groups.setdefault((chunk.sender, chunk.receiver and chunk.receiver[1]), []).append(
                chunk
            )
    chunks = max(
        groups.values(), key=lambda group: sum(len(chunk.data) for chunk in group), default=[]
    )
    if not any(chunk.data for chunk in chunks):
        raise WireError(no_bytes_message(capture, opened.warnings))
    frame_draft = make_draft([chunk.data for chunk in chunks], datagrams=opened.datagrams)
    note(
        f"{capture}: found {len(frame_draft.frames)} frames, which contain"
        f" {frame_draft.share:.1%} of the {frame_draft.bytes_in} bytes"
    )
    receiver = chunks[0].receiver
    chosen: Link = (
        "udp" if (link or ("udp" if opened.datagrams else "serial")) == "udp" else "serial"
    )
    return make_draft_files(
        names,
        chosen,
        frame_draft,
        origin=f"a capture, {Path(capture).name}",
        port=receiver[1] if receiver else None,
    )


@click.command()
@click.argument("name", metavar="ID|FILE|DISTRIBUTION|FOLDER")
@click.option(
    "--max-examples",
    type=click.IntRange(1),
    metavar="N",
    default=EXAMPLES,
    show_default=True,
    help="Number of examples of each frame type.",
)
@click.option(
    "--vectors",
    metavar="FILE",
    help="File with example frames and their expected values. [default: vectors.json beside the"
    " module, in its project folder, or in tests]",
)
@click.option(
    "-v",
    "--verbose",
    is_flag=True,
    help="Also print measured values, and the reasons for skipped checks.",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@output_option
@click.pass_context
def check(
    ctx: click.Context,
    name: str,
    max_examples: int,
    vectors: str | None,
    verbose: bool,
    as_json: bool,
    output: str | None,
) -> None:
    """Run the checks of the test kit on a sensor, a file or a distribution.

    You need not write any test for this. The exit code is 1 if a check fails.
    """
    import_library("hypothesis", "testing")
    file = Path(vectors) if vectors else None
    with Progress(lambda number: f"{number:.1f} properties", period=0.0) as line:

        def show(text: str, done: int, total: int) -> None:
            line(lambda: text, (done, total))

        line(lambda: f"{name}: loading", (0, 1))
        found_reports = list(
            iter_reports(find_target(name), name, examples=max_examples, vectors=file, watch=show)
        )
    if as_json:
        emit_json([report.to_dict() for report in found_reports], output)
    else:
        emit(
            "\n\n".join(
                text for report in found_reports for text in _format_report(report, verbose=verbose)
            ),
            output,
        )
    if any(report.findings for report in found_reports):
        ctx.exit(FINDINGS)


def _format_report(report: Report, *, verbose: bool) -> list[str]:
    paragraphs = [str(finding) for finding in report.findings]
    number = len(report.findings)
    if number:
        verdict = f"{number} finding{'s' * (number != 1)}"
    else:
        verdict = "clean"
    if report.held:
        more = f", {report.held} checks passed"
    else:
        more = ""
    more += f", {len(report.skipped)} skipped" if report.skipped else ""
    lines = [f"{report.name}: {verdict}{more}"]
    lines += [f"  {name}: {value}" for name, value in report.picture.items()]
    if verbose:
        lines += [f"  skipped   {name}: {reason}" for name, reason in report.skipped.items()]
        lines += [f"  measured  {name}: {value}" for name, value in report.measured.items()]
    return [*paragraphs, "\n".join(lines)]


@click.command()
@click.argument("kind", metavar="KIND", type=click.Choice(list(EXPORTS)))
@click.argument("sensor_id", metavar="SENSOR")
@output_option
@click.option(
    "-f",
    "--frame",
    metavar="NAME",
    help="Export only this frame type; default: all types.",
)
def export(kind: str, sensor_id: str, output: str | None, frame: str | None) -> None:
    """Export a sensor's spec: wireshark, c, ksy (Kaitai), md, svg, json, pyi.

    SENSOR is an id or a file ./mysensor.py. If the target cannot express a part of the spec, the
    export fails and gives the reason.
    """
    sensor = named_sensor(sensor_id)
    chosen = sensor if frame is None else select_frame(sensor, frame)
    try:
        text = exported(chosen, kind)
    except ExportError as refused:
        raise suggest(refused, f"lidarspec show {sensor.id}") from None
    emit(text.removesuffix("\n"), output)
    if kind in BYTE_EXPORTS and (left_out := describe_left_out(chosen)):
        note(left_out)
