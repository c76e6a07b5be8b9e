"""The verb that finds out why nothing comes."""

from __future__ import annotations

import click

from lidarspec.cli.failures import FINDINGS
from lidarspec.cli.output import emit, emit_json, note, output_options, sensor_option
from lidarspec.cli.streams import Duration
from lidarspec.detection.diagnosis import Finding, computer, examined
from lidarspec.detection.hearing import LISTEN
from lidarspec.plugins import sensor as named_sensor


@click.command()
@click.argument("source", required=False)
@sensor_option
@click.option("-t", "--duration", type=Duration(), default=LISTEN, metavar="TIME", help="How long to listen for, each time.")
@output_options
def doctor(source: str | None, sensor_id: str | None, duration: float, as_json: bool, output: str | None) -> None:
    """What keeps a sensor's bytes from coming, and the command that mends it.

    Looks for missing ports and rights, ports in use, small buffers, silence, a wrong baud rate, a wrong interface. Without SOURCE
    all ports of this computer. Ends with 1 where something is wrong.
    """
    sensor = None if sensor_id is None else named_sensor(sensor_id)
    if source is not None and not as_json:
        note(f"listening to {source}")
    found = list(computer()) if source is None else list(examined(source, sensor, seconds=duration))
    if as_json:
        emit_json([vars(finding) for finding in found], output)
    else:
        emit("\n".join(line for finding in found for line in _lines(finding)) or "nothing is wrong with the ports of this computer", output)
    if any(not finding.ok for finding in found):
        raise click.exceptions.Exit(FINDINGS)


def _lines(finding: Finding) -> list[str]:
    return [f"{'ok   ' if finding.ok else 'wrong'}  {finding.text}"] + ([f"       next: {finding.mend}"] if finding.mend else [])
