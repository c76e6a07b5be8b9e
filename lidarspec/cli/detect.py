"""The verb that finds out which sensor it is."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from shlex import quote
from typing import Any

import click

from lidarspec.cli.crc import told as checksum_told
from lidarspec.cli.failures import DEVICE, NO_DATA, suggest
from lidarspec.cli.output import emit, emit_json, note, output_options, table
from lidarspec.cli.streams import Duration
from lidarspec.detection.detect import Score, Verdict, verdict, verdicts
from lidarspec.detection.hearing import LISTEN, Heard, everywhere, udp_ports
from lidarspec.detection.probing import probe, started_first
from lidarspec.detection.structure import Structure, structure
from lidarspec.errors import SourceError, UsageError
from lidarspec.settings import named
from lidarspec.sources import live_address
from lidarspec.transports.ports import serial_ports

#: checksums that are told of unknown bytes.
TOLD = 2


@click.command()
@click.argument("source", required=False)
@click.option("-t", "--duration", type=Duration(), default=LISTEN, metavar="TIME", help="How long to listen for, each time.")
@click.option("--start", is_flag=True, help="Also send the start commands of sensors that keep silent until they are started.")
@output_options
def detect(source: str | None, duration: float, start: bool, as_json: bool, output: str | None) -> None:
    """Which installed sensor sends, and at which port and baud rate.

    SOURCE is a port, a file or a capture; without it every serial port is listened to at every baud rate that installed sensors
    declare, and every UDP port. A sensor fits by the share of the bytes in frames that pass checksum and plausibility. Sensors
    with the same frames are told apart by their clocks, names in their frames and baud rates, as far as that goes.
    """
    if source == "-":
        raise suggest(UsageError("standard input can be read only once: write it to a file first"), "lidarspec detect FILE")
    device = None if source is None else named(source)
    source = source if device is None else device.source
    found = list(_everywhere(duration, start=start)) if source is None else _one(source, duration, start=start)
    fitting = [one for one in found if one.scores]
    unknown = None if fitting else _unknown(found)
    if as_json:
        emit_json({"sources": [_told(one) for one in found], "structure": _structure_told(unknown)}, output)
    elif fitting:
        emit(_text(found, output), output)
    elif unknown is not None:
        emit(_structure_text(unknown), output)
    for line in _conclusions(source, found, unknown, start=start):
        note(line)
    if not fitting:
        raise click.exceptions.Exit(_code(source, found))


def _code(source: str | None, found: Sequence[Verdict]) -> int:
    """The exit code where no sensor fits: nothing came from a source, or nothing that is known."""
    is_silent = source is not None and live_address(source) is not None and not any(one.heard.size for one in found)
    return DEVICE if is_silent else NO_DATA


def _one(source: str, duration: float, *, start: bool) -> list[Verdict]:
    found = verdicts(source, seconds=duration)
    if start and not any(one.scores for one in found):
        for heard in probe(source):
            found = [_best([*found, verdict(heard)])]
            if found[0].is_clear:
                break
    return found


def _everywhere(duration: float, *, start: bool) -> Iterator[Verdict]:
    ports = [port.path for port in serial_ports()]
    note(f"listening to {len(ports)} serial port{'s' * (len(ports) != 1)} and UDP {', '.join(map(str, udp_ports()))}")
    for port in ports:
        try:
            yield from _one(port, duration, start=start)
        except SourceError as error:
            yield Verdict(Heard(port, failure=error), (), ())
    for heard in everywhere([], seconds=duration):
        yield verdict(heard)


def _best(found: Sequence[Verdict]) -> Verdict:
    return max(found, key=lambda one: (one.scores[0].share if one.scores else 0.0, one.heard.size))


def _unknown(found: Sequence[Verdict]) -> Structure | None:
    """What the bytes are made of that fit no sensor."""
    heard = max((one.heard for one in found), key=lambda heard: heard.size, default=None)
    return structure(heard.chunks, datagrams=heard.datagrams) if heard is not None and heard.size else None


def _text(found: Sequence[Verdict], output: str | None) -> str:
    rows = []
    for one in found:
        alike = {score.sensor.id for score in one.alike}
        for score in one.scores:
            verdict_of = "no" if score.sensor.id not in alike else "yes" if len(alike) == 1 else "perhaps"
            rows.append([_place(one.heard), score.sensor.id, verdict_of, f"{score.share:.1%}", str(score.data_frames), score.why])
    return table(["source", "sensor", "is it", "in frames", "data frames", "told by"], rows, output)


def _place(heard: Heard) -> str:
    where = heard.source + (f" from {heard.sender}" if heard.sender else "")
    return f"{where} at {heard.baud} baud" if heard.baud is not None else where


def _conclusions(source: str | None, found: Sequence[Verdict], unknown: Structure | None, *, start: bool) -> Iterator[str]:
    for one in found:
        if one.heard.failure is not None:
            yield f"{one.heard.failure}"
        elif one.sensor is not None:
            yield f"next: lidarspec {_verb(one)} {_again(one)} -s {one.sensor.id}"
        elif one.alike:
            ids = [score.sensor.id for score in one.alike]
            yield f"{_place(one.heard)}: {', '.join(ids)} send the same frames, and nothing in these tells them apart: choose one"
            yield f"next: lidarspec {_verb(one)} {_again(one)} -s {ids[0]}"
    if any(one.scores for one in found):
        return
    size = sum(one.heard.size for one in found)
    if size:
        yield f"{size} bytes, and no frame of an installed sensor" + ("" if unknown else "; nor can frames of one kind be seen in them")
        yield f"next: {_following(source, unknown)}"
        return
    yield "nothing came"
    is_serial = source is None or ((address := live_address(source)) is not None and address.scheme == "serial")
    if is_serial and not start and started_first():
        yield f"{', '.join(sensor.id for sensor in started_first())} send nothing before they are started"
        yield f"next: lidarspec detect {source or ''}".rstrip() + " --start"
    else:
        yield f"next: lidarspec doctor {quote(source) if source else ''}".rstrip()


def _verb(one: Verdict) -> str:
    return "read" if live_address(one.heard.source) is None else "view"


def _following(source: str | None, unknown: Structure | None) -> str:
    """What to type where bytes come that no sensor fits."""
    if source is None or live_address(source) is not None:
        return f"lidarspec doctor {quote(source) if source else ''}".rstrip()
    if unknown is not None and unknown.period and not unknown.checksums:
        return f"lidarspec crc {source} --period {unknown.period}"
    return "lidarspec sensors"


def _again(one: Verdict) -> str:
    """The source as it has to be opened for the sensor that was found."""
    source, heard = one.heard.source, one.heard
    link = one.sensor.links.get("data") if one.sensor is not None else None
    if heard.baud is not None and "baud=" not in source and heard.baud != getattr(link, "baud", None):
        source += f"{'&' if '?' in source else '?'}baud={heard.baud}"
    if heard.sender and "src=" not in source:
        source += f"{'&' if '?' in source else '?'}src={heard.sender}"
    return quote(source)


def _told(one: Verdict) -> dict[str, Any]:
    """A verdict for JSON."""
    heard = one.heard
    return {
        "source": heard.source,
        "baud": heard.baud,
        "sender": heard.sender or None,
        "bytes": heard.size,
        "failure": str(heard.failure) if heard.failure else None,
        "sensor": one.sensor.id if one.sensor is not None else None,
        "alike": [score.sensor.id for score in one.alike],
        "fits": [_score(score) for score in one.scores],
    }


def _score(score: Score) -> dict[str, Any]:
    return {"sensor": score.sensor.id, "share": round(score.share, 4), "data_frames": score.data_frames, "told_by": score.why}


def _structure_told(found: Structure | None) -> dict[str, Any] | None:
    if found is None:
        return None
    checksums = [checksum_told(match) for match in found.checksums]
    return {
        "sync": found.sync.hex(" "),
        "period": found.period,
        "length": str(found.length) if found.length else None,
        "share": round(found.share, 4),
        "frames": len(found.frames),
        "checksums": checksums,
    }


def _structure_text(found: Structure) -> str:
    length = f"{found.period} bytes each" if found.period else f"of {found.length} bytes"
    lines = [
        "unknown frames:",
        f"  sync      {found.sync.hex(' ') or 'not known'}",
        f"  length    {length}: {len(found.frames)} of them, {found.share:.0%} of the bytes",
    ]
    for match in found.checksums[:TOLD]:
        told = match.paste if "\n" not in match.paste else match.algorithm.describe()
        lines.append(f"  checksum  {told} in {match.place}: right in {match.right} of {match.total}")
    return "\n".join(lines if found.checksums else [*lines, "  checksum  none was found"])
