"""`export`: a spec in the language of another tool."""

from __future__ import annotations

import click

from lidarspec.cli.failures import suggest
from lidarspec.cli.output import emit
from lidarspec.export import EXPORTS, Refused, export as exported, narrowed
from lidarspec.plugins import sensor as named_sensor


@click.command()
@click.argument("kind", metavar="KIND", type=click.Choice(list(EXPORTS)))
@click.argument("sensor_id", metavar="SENSOR")
@click.option("-o", "--output", metavar="FILE", help="Write to a file instead of standard output.")
@click.option("-f", "--frame", metavar="NAME", help="One frame type alone; by default all, or the one that carries the points.")
def export(kind: str, sensor_id: str, output: str | None, frame: str | None) -> None:
    """A sensor's spec for another tool: wireshark, c, ksy (Kaitai), md, svg, json, pyi.

    SENSOR is an id or a file ./mysensor.py. What the target cannot say is refused, with the reason.
    """
    sensor = named_sensor(sensor_id)
    chosen = sensor if frame is None else narrowed(sensor, frame)
    try:
        text = exported(kind, chosen)
    except Refused as refused:
        raise suggest(refused, f"lidarspec show {sensor.id}") from None
    emit(text.removesuffix("\n"), output)
