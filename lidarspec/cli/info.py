"""`info`: describe the contents of files."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence

import click

from lidarspec.cli.failures import NO_DATA
from lidarspec.cli.output import emit_parts, output_options, size
from lidarspec.cli.terminal import note
from lidarspec.explaining.file_contents import format_contents, read_contents


@click.command()
@click.argument("files", metavar="FILE...", nargs=-1, required=True)
@output_options
def info(files: Sequence[str], as_json: bool, output: str | None) -> None:
    """Describe the contents of files: kind, times, senders, sensor, rates, loss.

    FILE is any readable file: a recording, a capture, a robotics log, raw bytes. If a file is long,
    only its beginning and the time of its end are read. Several files are printed one after
    another.
    """
    unknown_files = []

    def iter_texts() -> Iterator[str]:
        for file in files:
            held = read_contents(file)
            if as_json:
                yield json.dumps(held.to_dict(), indent=2, allow_nan=False)
            else:
                yield f"{held.path}: {held.kind}, {size(held.size)}"
                yield from (f"  {word:<8}  {text}" for word, text in format_contents(held))
            for warning in held.warnings:
                note(warning)
            if not any(content.sensors for content in held.contents):
                unknown_files.append(file)

    emit_parts(iter_texts(), output)
    if unknown_files:
        raise click.exceptions.Exit(NO_DATA)
