"""The verbs that look into frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import click

from lidarspec.cli.failures import suggest
from lidarspec.cli.inputs import Input, Piece, fitting, nearest, no_frame, pieces, read
from lidarspec.cli.output import emit, emit_json, note, output_options, sensor_option, table
from lidarspec.errors import WireError
from lidarspec.explain import explain as explained
from lidarspec.plugins import sensor as named_sensor
from lidarspec.spec import Sensor
from lidarspec.wording import LINED, Explanation, Row, number

count_option = click.option("-n", "--count", type=click.IntRange(min=1), help="Frames at most.")
words_argument = click.argument("words", metavar="HEX|FILE|-", nargs=-1, required=True)


@click.command()
@words_argument
@sensor_option
@count_option
@output_options
def parse(words: Sequence[str], sensor_id: str | None, count: int | None, as_json: bool, output: str | None) -> None:
    """The fields of each frame in some bytes."""
    given, sensor, fits, found = _found(words, sensor_id, count)
    if not found:
        raise no_frame(sensor, given)
    frames = [(piece, explained(sensor, piece.data, piece.frame)) for piece in found if piece.frame]
    if as_json:
        told = [{"frame": f.frame, "offset": p.offset, "size": len(p.data), "fields": _raw(sensor, p)} for p, f in frames]
        emit_json({"sensor": sensor.id, "fits": fits, "frames": told}, output)
        return
    skipped = sum(len(piece.data) for piece in found if not piece.frame)
    if skipped:
        note(f"{skipped} bytes are in no frame; lidarspec explain names them")
    parts = []
    for piece, frame in frames:
        rows = [[value.path, _raw_text(value.raw), str(value) if value.unit or value.label else ""] for value in _values(frame)]
        parts.append(_title(sensor, piece) + "\n" + table(["field", "raw", "value"], rows, output))
    emit("\n\n".join(parts), output)


@click.command()
@words_argument
@sensor_option
@click.option("-f", "--frame", metavar="NAME", help="The frame type, where the bytes do not tell.")
@count_option
@output_options
def explain(words: Sequence[str], sensor_id: str | None, frame: str | None, count: int | None, as_json: bool, output: str | None) -> None:
    """Every byte of each frame: offset, hex, field, value, unit, meaning."""
    given, sensor, fits, found = _found(words, sensor_id, count, frame, damaged=True)
    if not given.data:
        raise no_frame(sensor, given)
    parts = [(piece, _explained(sensor, piece)) for piece in found or [Piece(0, given.data, "?")]]
    if as_json:
        told = [{"offset": piece.offset, **part.to_dict()} for piece, part in parts]
        emit_json({"sensor": sensor.id, "fits": fits, "frames": told}, output)
    else:
        emit("\n\n".join(f"{_title(sensor, piece, part)}\n{part}" for piece, part in parts), output)
    fault = parts[0][1].fault
    if fault is not None:
        raise suggest(fault, f"lidarspec show {sensor.id}")


def _found(
    words: Sequence[str], sensor_id: str | None, count: int | None, frame: str | None = None, *, damaged: bool = False
) -> tuple[Input, Sensor, list[str], list[Piece]]:
    """The input, its sensor, the ids of all that fit, and what is in it up to frame number `count`.

    Raises:
        WireError: where no sensor was named and none fits; with `damaged`, one of which the bytes begin like a frame does.
    """
    given = read(words)
    sensor, fits = _sensor(given, sensor_id, damaged=damaged)
    found = [Piece(0, given.data, frame)] if frame else pieces(sensor, given)
    places = [place for place, piece in enumerate(found) if piece.frame]
    if count is not None and len(places) >= count:
        found = found[: places[count - 1] + 1]
    return given, sensor, fits, found


def _sensor(given: Input, sensor_id: str | None, *, damaged: bool) -> tuple[Sensor, list[str]]:
    """The sensor named, or the one whose bytes these are, and the ids of all whose bytes they could be."""
    if sensor_id is not None:
        return named_sensor(sensor_id), []
    found = fitting(given)
    if found:
        fits = [sensor.id for sensor in found]
        note(f"these bytes fit {fits[0]}" + (f"; so do {', '.join(fits[1:])}: choose with -s" if fits[1:] else ""))
        return found[0], fits
    fault = nearest(given)
    if not damaged or not fault.sensor:
        raise fault
    note(f"these bytes fit no sensor; they come nearest to {fault.sensor}")
    return named_sensor(fault.sensor), []


def _explained(sensor: Sensor, piece: Piece) -> Explanation:
    """A frame explained; bytes between frames as one row; "?" for bytes that may begin like a frame."""
    if not piece.frame:
        return Explanation(sensor.id, "", piece.data, (Row(0, piece.data, "", (), ("in no frame",), right=False),))
    try:
        return explained(sensor, piece.data, None if piece.frame == "?" else piece.frame)
    except WireError as fault:
        raise suggest(fault, f"lidarspec show {sensor.id}") from None


def _title(sensor: Sensor, piece: Piece, part: Explanation | None = None) -> str:
    kind = part.frame if part is not None else piece.frame
    where = f" at byte {piece.offset}" if piece.offset else ""
    return f"{sensor.id} {kind or 'skipped'}{where}, {len(piece.data)} byte{'s' * (len(piece.data) != 1)}"


def _values(frame: Explanation) -> Iterator[Any]:
    for row in frame.rows:
        yield from row.values


def _raw_text(raw: Any) -> str:
    if not isinstance(raw, bytes | bytearray):
        return str(raw)
    return raw.hex(" ") if len(raw) <= 2 * LINED else f"{raw[: 2 * LINED].hex(' ')} ... ({len(raw)} bytes)"


def _raw(sensor: Sensor, piece: Piece) -> Any:
    return plain(sensor.parse(piece.data, piece.frame))


def plain(parsed: Any) -> Any:
    """A parsed frame as JSON takes it: bytes as hexadecimal text, null for nan and infinity."""
    if isinstance(parsed, dict):
        return {name: plain(value) for name, value in parsed.items()}
    if isinstance(parsed, list):
        return [plain(value) for value in parsed]
    if isinstance(parsed, bytes | bytearray):
        return parsed.hex(" ")
    return getattr(parsed, "intvalue", None) if isinstance(parsed, str) else int(parsed) if isinstance(parsed, int) else number(parsed)
