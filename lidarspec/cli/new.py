"""The verb that makes a new sensor's distribution."""

from __future__ import annotations

from pathlib import Path
from shlex import quote

import click

from lidarspec.cli.failures import suggest
from lidarspec.cli.output import note
from lidarspec.errors import UsageError
from lidarspec.plugins import sensors
from lidarspec.scaffold import Names, invented, write


@click.command()
@click.argument("sensor_id", metavar="ID")
@click.option("--into", metavar="DIR", default=".", help="Where the distribution's folder goes; by default into this one.")
@click.option("--link", type=click.Choice(["serial", "udp"]), help="What the sensor sends over; serial by default.")
def new(sensor_id: str, into: str, link: str | None) -> None:
    """A distribution for a sensor of your own, which works before anything in it is changed.

    It has an invented sensor with frames, checksum, points, commands and simulation, its tests, and the entry point by which it is
    found once it is installed.
    """
    names = Names(sensor_id)
    if sensor_id in sensors():
        raise suggest(UsageError(f"{sensor_id} is installed already: choose another id"), f"lidarspec show {sensor_id}")
    folder = Path(into) / names.distribution
    texts = invented(names, "udp" if link == "udp" else "serial")
    write(folder, texts)
    for name in texts:
        click.echo(folder / name)
    note(f"next: pip install -e {quote(f'{folder}[test]')} && lidarspec demo -s {sensor_id} && pytest {quote(str(folder))}")
