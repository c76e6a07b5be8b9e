"""`info`: describe the contents of files."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence

import click

from lidarspec.cli.failures import NO_DATA
from lidarspec.cli.inputs import exit_if_damaged
from lidarspec.cli.output import emit_parts, format_size, output_options
from lidarspec.cli.terminal import note
from lidarspec.explaining.file_contents import format_contents, read_contents


@click.command()
@click.argument("files", metavar="FILE...", nargs=-1, required=True)
@output_options
def info(files: Sequence[str], as_json: bool, output: str | None) -> None:
    """Describe the contents of files: kind, times, senders, sensor, rates, loss.

    FILE is a recording, a capture, a robotics log, raw bytes or hexadecimal text. Only the
    beginning and the last timestamp of a long file are read. The exit code is 4 if no sensor is
    identified in a file, and 1 if a file is corrupt.
    """
    has_unknown_file = False
    unread = 0

    def iter_texts() -> Iterator[str]:
        """Yield texts about each file."""
        nonlocal has_unknown_file, unread
        for file in files:
            contents = read_contents(file)
            if as_json:
                yield json.dumps(contents.to_dict(), indent=2, allow_nan=False)
            else:
                yield f"{contents.path}: {contents.kind}, {format_size(contents.size)}"
                yield from format_contents(contents)
            for warning in contents.warnings:
                note(warning)
            if not any(content.sensors for content in contents.contents):
                has_unknown_file = True
            unread += contents.unread

    emit_parts(iter_texts(), output)
    if has_unknown_file:
        raise click.exceptions.Exit(NO_DATA)
    exit_if_damaged(unread)
