"""The verb that makes a new sensor's distribution."""

from __future__ import annotations

from pathlib import Path
from shlex import quote

import click

from lidarspec.cli.failures import suggest
from lidarspec.cli.output import note
from lidarspec.drafts.draft import draft
from lidarspec.errors import UsageError, WireError
from lidarspec.files import Chunk
from lidarspec.plugins import sensors
from lidarspec.scaffold import Link, Names, captured, invented, write
from lidarspec.sources import transport

#: bytes of a capture that are looked at.
MOST = 1 << 22


@click.command()
@click.argument("sensor_id", metavar="ID")
@click.option("--into", metavar="DIR", default=".", help="Where the distribution's folder goes; by default into this one.")
@click.option("--link", type=click.Choice(["serial", "udp"]), help="What the sensor sends over; serial by default.")
@click.option("--from-capture", "capture", metavar="FILE", help="Draft the frames from their bytes: raw, .pcap, .lsr, .hex.")
def new(sensor_id: str, into: str, link: str | None, capture: str | None) -> None:
    """A distribution for a sensor of your own, which works before anything in it is changed.

    It has an invented sensor with frames, checksum, points, commands and simulation, its tests, and the entry point by which it is
    found once it is installed. With --from-capture it has what the bytes of a capture can be told to consist of: sync bytes, length,
    checksum, counters, angles, each with the evidence for it; what cannot be told is called unknown.
    """
    names = Names(sensor_id)
    if sensor_id in sensors():
        raise suggest(UsageError(f"{sensor_id} is installed already: choose another id"), f"lidarspec show {sensor_id}")
    folder = Path(into) / names.distribution
    if folder.exists():
        raise UsageError(f"{folder} exists already: nothing was written")
    texts = invented(names, "udp" if link == "udp" else "serial") if capture is None else _drafted(names, link, capture)
    write(folder, texts)
    for name in texts:
        click.echo(folder / name)
    look = f"demo -s {sensor_id}" if capture is None else f"explain {quote(capture)} -s {sensor_id}"
    note(f"next: pip install -e {quote(f'{folder}[test]')} && pytest {quote(str(folder))} && lidarspec {look}")


def _drafted(names: Names, link: str | None, capture: str) -> dict[str, str]:
    """The files with a draft of the capture's frames: of several senders and ports, those that the most bytes come from and go to."""
    opened = transport(capture)
    groups: dict[object, list[Chunk]] = {}
    size = 0
    try:
        for chunk in opened.chunks():
            groups.setdefault((chunk.sender and chunk.sender[0], chunk.receiver and chunk.receiver[1]), []).append(chunk)
            size += len(chunk.data)
            if size >= MOST:
                break
    finally:
        opened.close()
    chunks = max(groups.values(), key=lambda group: sum(len(chunk.data) for chunk in group), default=[])
    if not size:
        raise WireError(f"{capture} holds no bytes")
    found = draft([chunk.data for chunk in chunks], datagrams=opened.datagrams)
    note(f"{capture}: {len(found.frames)} frames, {found.share:.1%} of {found.bytes_in} bytes")
    receiver = chunks[0].receiver
    chosen: Link = "udp" if (link or ("udp" if opened.datagrams else "serial")) == "udp" else "serial"
    return captured(names, chosen, found, origin=f"a capture, {Path(capture).name}", port=receiver[1] if receiver else None)
