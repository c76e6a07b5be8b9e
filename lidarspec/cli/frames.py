"""The verbs that look into frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import click

from lidarspec.cli.inputs import nearest_fault, no_frame, read
from lidarspec.cli.options import output_options, sensor_option
from lidarspec.cli.output import emit, emit_json, emit_lines, note, table
from lidarspec.discovery.detect import Piece, fitting, likely_starts, pieces
from lidarspec.discovery.listen import Heard
from lidarspec.errors import UsageError, WireError, suggest
from lidarspec.explaining.explanation import Explanation, explain as explained
from lidarspec.explaining.listing import LINED, Line, told
from lidarspec.explaining.wording import Row, Span, number
from lidarspec.plugins import sensor as named_sensor
from lidarspec.spec.sensor import Sensor

#: places in bytes between frames that are explained as damaged frames, at most.
DAMAGED = 64

count_option = click.option("-n", "--count", type=click.IntRange(min=1), help="Frames at most.")
words_argument = click.argument("words", metavar="HEX|FILE|-", nargs=-1, required=True)


@click.command()
@words_argument
@sensor_option
@count_option
@output_options
def parse(words: Sequence[str], sensor_id: str | Sensor | None, count: int | None, as_json: bool, output: str | None) -> None:
    """The fields of each frame in some bytes."""
    given, sensor, fits, found = _found(words, sensor_id, count)
    if not found:
        raise no_frame(sensor, given)
    frames = [(piece, explained(piece.data, sensor, piece.frame)) for piece in found if piece.frame]
    if as_json:
        listed = [
            {"frame": f.frame, "offset": p.offset, "size": len(p.data), "fields": plain(sensor.parse(p.data, p.frame))} for p, f in frames
        ]
        emit_json({"sensor": sensor.id, "fits": fits, "frames": listed}, output)
        return
    skipped = sum(len(piece.data) for piece in found if not piece.frame)
    if skipped:
        note(f"{skipped} bytes are in no frame; lidarspec explain names them")
    parts = []
    for piece, frame in frames:
        rows = [[value.path, _raw_text(value.raw), str(value) if value.unit or value.label else ""] for value in frame.fields.values()]
        parts.append(_title(sensor, piece) + "\n" + table(["field", "raw", "value"], rows, output))
    emit("\n\n".join(parts), output)


@click.command()
@words_argument
@sensor_option
@click.option("-f", "--frame", metavar="NAME", help="The frame type, where the bytes do not tell.")
@count_option
@click.option("--bits", is_flag=True, help="Draw the bits of every element of an array, not of the first alone.")
@click.option(
    "--diff", metavar="HEX|FILE|next", help="What differs from this frame, to the bit; 'next': from the second frame of the input."
)
@output_options
def explain(
    words: Sequence[str],
    sensor_id: str | Sensor | None,
    frame: str | None,
    count: int | None,
    bits: bool,
    diff: str | None,
    as_json: bool,
    output: str | None,
) -> None:
    """Every byte of each frame: offset, hex, field, value, unit, meaning."""
    given, sensor, fits, found = _found(words, sensor_id, count, frame, damaged=True)
    if not given.data:
        raise no_frame(sensor, given)
    if diff is not None:
        _compare(sensor, given, found, diff, frame, as_json=as_json, output=output)
        return
    parts = [part for piece in found or [Piece(0, given.data, "?")] for part in _parts(sensor, piece)]
    if as_json:
        listed = [{"offset": piece.offset, **part.to_dict()} for piece, part in parts]
        emit_json({"sensor": sensor.id, "fits": fits, "frames": listed}, output)
    else:
        lines: list[Line] = []
        for piece, part in parts:
            lines += [()] * bool(lines) + [(Span(_title(sensor, piece, part), "title"),), *part.lines(every=bits)]
        emit_lines(lines, output)
    if not any(part.frame and part.fault is None for _, part in parts):
        raise suggest(next(part.fault for _, part in parts if part.fault), f"lidarspec show {sensor.id}")


def _compare(sensor: Sensor, given: Heard, found: list[Piece], diff: str, frame: str | None, *, as_json: bool, output: str | None) -> None:
    """Print what differs between the first frame of the input and another one."""
    frames = [piece for piece in found if piece.frame] or [Piece(0, given.data, "?")]
    if diff == "next":
        same = [piece for piece in frames[1:] if piece.frame == frames[0].frame]
        if not same:
            raise UsageError(f"the input has no second {frames[0].frame} frame to compare with")
        other = same[0]
    else:
        data = read([diff])
        whole = [Piece(0, data.data, frame)] if frame else pieces(sensor, data.chunks, datagrams=data.datagrams)
        rest = [piece for piece in whole if piece.frame]
        other = next((piece for piece in rest if piece.frame == frames[0].frame), Piece(0, data.data, frames[0].frame))
    first, second = _explained(sensor, frames[0]), _explained(sensor, other)
    differing = first.differences(second)
    if as_json:
        emit_json({"sensor": sensor.id, "frame": first.frame, "differences": [part.to_dict() for part in differing]}, output)
    else:
        emit_lines([(Span(f"{sensor.id} {first.frame}", "title"),), *told(differing, (len(first.data), len(second.data)))], output)


def _found(
    words: Sequence[str], sensor_id: str | Sensor | None, count: int | None, frame: str | None = None, *, damaged: bool = False
) -> tuple[Heard, Sensor, list[str], list[Piece]]:
    """The input, its sensor, the ids of all that fit, and what is in it up to frame number `count`.

    Raises:
        WireError: where no sensor was named and none fits; with `damaged`, one of which the bytes begin like a frame does.
    """
    given = read(words)
    sensor, fits = _sensor(given, sensor_id, damaged=damaged)
    found = [Piece(0, given.data, frame)] if frame else pieces(sensor, given.chunks, datagrams=given.datagrams)
    places = [place for place, piece in enumerate(found) if piece.frame]
    if count is not None and len(places) >= count:
        found = found[: places[count - 1] + 1]
    return given, sensor, fits, found


def _sensor(given: Heard, sensor_id: str | Sensor | None, *, damaged: bool) -> tuple[Sensor, list[str]]:
    """The sensor named, or the one whose bytes these are, and the ids of all whose bytes they could be."""
    if sensor_id is not None:
        return named_sensor(sensor_id), []
    found = fitting(given.chunks, datagrams=given.datagrams)
    if found:
        fits = [sensor.id for sensor in found]
        note(f"these bytes fit {fits[0]}" + (f"; so do {', '.join(fits[1:])}: choose with -s" if fits[1:] else ""))
        return found[0], fits
    fault = nearest_fault(given)
    if not damaged or not fault.sensor:
        raise fault
    note(f"these bytes fit no sensor; they come nearest to {fault.sensor}")
    return named_sensor(fault.sensor), []


def _explained(sensor: Sensor, piece: Piece) -> Explanation:
    """A frame explained; "?" for bytes that may begin like one."""
    try:
        return explained(piece.data, sensor, None if piece.frame == "?" else piece.frame)
    except WireError as fault:
        raise suggest(fault, f"lidarspec show {sensor.id}") from None


def _parts(sensor: Sensor, piece: Piece) -> Iterator[tuple[Piece, Explanation]]:
    """A piece of the input explained; of bytes that are in no frame, those that begin like one as far as they go."""
    if piece.frame:
        yield piece, _explained(sensor, piece)
        return
    data, end = piece.data, 0
    for start in likely_starts(sensor, data)[:DAMAGED]:
        if start < end:
            continue
        try:
            found = explained(data[start:], sensor)
            left = found.rows[-1].data if found.rows and not found.rows[-1].path else b""
            found = explained(data[start : len(data) - len(left)], sensor, found.frame)
        except WireError:
            continue
        if start > end:
            yield _skipped(sensor, Piece(piece.offset + end, data[end:start], ""))
        end = start + len(found.data)
        yield Piece(piece.offset + start, found.data, found.frame), found
    if end < len(data):
        yield _skipped(sensor, Piece(piece.offset + end, data[end:], ""))


def _skipped(sensor: Sensor, piece: Piece) -> tuple[Piece, Explanation]:
    return piece, Explanation(sensor.id, "", piece.data, (Row(0, piece.data, "", (), ("in no frame",), right=False),))


def _title(sensor: Sensor, piece: Piece, part: Explanation | None = None) -> str:
    kind = part.frame if part is not None else piece.frame
    where = f" at byte {piece.offset}" if piece.offset else ""
    return f"{sensor.id} {kind or 'skipped'}{where}, {len(piece.data)} byte{'s' * (len(piece.data) != 1)}"


def _raw_text(raw: Any) -> str:
    if not isinstance(raw, bytes | bytearray):
        return str(raw)
    return raw.hex(" ") if len(raw) <= 2 * LINED else f"{raw[: 2 * LINED].hex(' ')} ... ({len(raw)} bytes)"


def plain(parsed: Any) -> Any:
    """A parsed frame as JSON takes it: bytes as hexadecimal text, null for nan and infinity."""
    if isinstance(parsed, dict):
        return {name: plain(value) for name, value in parsed.items()}
    if isinstance(parsed, list):
        return [plain(value) for value in parsed]
    if isinstance(parsed, bytes | bytearray):
        return parsed.hex(" ")
    return getattr(parsed, "intvalue", None) if isinstance(parsed, str) else int(parsed) if isinstance(parsed, int) else number(parsed)
