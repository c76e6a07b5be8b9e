"""`parse` and `explain`: print the fields of frames, or explain every byte of frames."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import click

from lidarspec.cli.failures import FINDINGS
from lidarspec.cli.inputs import make_no_frame_error, make_no_sensor_error, open_input
from lidarspec.cli.listing import emit_lines
from lidarspec.cli.options import OFFSET, count_option, selection_options, sensor_option
from lidarspec.cli.output import emit_json, emit_json_list, emit_parts, output_options, table
from lidarspec.cli.terminal import note
from lidarspec.detect.sample_bytes import SampleBytes
from lidarspec.errors import UsageError, WireError, suggest
from lidarspec.explaining.explanation import Explanation, read_values
from lidarspec.explaining.formatting import TextSpan, to_json_number
from lidarspec.explaining.input_segments import InputPiece, explain_piece, iter_pieces
from lidarspec.explaining.listing import LINE_BYTES, Line, list_differences
from lidarspec.plugins import sensor as named_sensor
from lidarspec.scans import selection as scans
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.enum_values import EnumValue

words_argument = click.argument("words", metavar="HEX|FILE|-", nargs=-1, required=True)


@click.command()
@words_argument
@sensor_option
@count_option("frames")
@selection_options("times")
@output_options
def parse(
    words: Sequence[str],
    sensor_id: str | Sensor | None,
    count: int | None,
    selection: scans.Selection,
    as_json: bool,
    output: str | None,
) -> None:
    """Read frames from hexadecimal text or a file, and print their fields.

    --slice selects by arrival time. Offsets are then relative to the beginning of the slice.
    """
    with open_input(words, selection.times, reports_damage=True) as (sample, chunks):
        sensor, fits = _find_sensor(sample, sensor_id)
        wanted = FrameSelection(sensor, count=count)
        selected = wanted.iter_valid(iter_pieces(sensor, chunks, datagrams=sample.datagrams))
        first = next(selected, None)
        if first is None:
            raise make_no_frame_error(sensor, sample)
        frames = itertools.chain([first], selected)
        if as_json:
            emit_json_list(
                {"sensor": sensor.id, "fits": fits},
                "frames",
                (_frame_to_dict(sensor, piece) for piece in frames),
                output,
            )
        else:
            emit_parts(_iter_tables(sensor, frames, output), output)
        if wanted.unframed:
            note(f"{wanted.unframed} bytes are outside frames; lidarspec explain shows them")


def _frame_to_dict(sensor: Sensor, piece: InputPiece) -> dict[str, Any]:
    """Return a frame as a JSON object."""
    facts = {"frame": piece.frame, "offset": piece.offset, "size": len(piece.data)}
    parsed = sensor.parse(piece.data, piece.frame)
    return {**facts, "fields": to_json_values(parsed), "names": dict(_iter_names(parsed, ""))}


def _iter_names(parsed: Any, path: str) -> Iterator[tuple[str, str]]:
    """Yield (path, name) of each enum value in a parsed frame; name "" if it is unknown."""
    if isinstance(parsed, dict):
        for name, value in parsed.items():
            yield from _iter_names(value, f"{path}.{name}" if path else name)
    elif isinstance(parsed, list):
        for index, value in enumerate(parsed):
            yield from _iter_names(value, f"{path}[{index}]")
    elif isinstance(parsed, EnumValue):
        yield path, parsed.name


def _iter_tables(sensor: Sensor, frames: Iterable[InputPiece], output: str | None) -> Iterator[str]:
    for index, piece in enumerate(frames):
        field_values = read_values(piece.data, sensor, piece.frame).values()
        rows = [
            [value.path, _format_raw(value.raw), str(value) if value.has_meaning else ""]
            for value in field_values
        ]
        yield (
            "\n" * bool(index)
            + _format_title(sensor, piece, piece.frame)
            + "\n"
            + table(["field", "raw", "value"], rows, output)
        )


@click.command()
@words_argument
@sensor_option
@click.option(
    "-f",
    "--frame",
    metavar="NAME",
    help="Explain only frames of this type.",
)
@count_option("frames")
@click.option("--bad", is_flag=True, help="Show only damaged frames and bytes outside frames.")
@click.option(
    "--at",
    type=OFFSET,
    metavar="OFFSET",
    help="Explain only the frame that contains this offset.",
)
@click.option(
    "--bytes",
    "stretch",
    metavar="FROM:TO",
    help="Explain only the frames in this range of bytes.",
)
@selection_options("times")
@click.option(
    "--bits",
    is_flag=True,
    help="Draw the bits of every array element; default: only of the first element.",
)
@click.option(
    "--diff",
    metavar="HEX|FILE|next",
    help="Compare the first frame with this frame bit by bit; 'next': the next frame of its type.",
)
@output_options
def explain(
    words: Sequence[str],
    sensor_id: str | Sensor | None,
    frame: str | None,
    count: int | None,
    bad: bool,
    at: int | None,
    stretch: str | None,
    selection: scans.Selection,
    bits: bool,
    diff: str | None,
    as_json: bool,
    output: str | None,
) -> None:
    """Explain every byte of each frame: offset, hex, field, value, unit, meaning.

    The damage of a frame is described: a flipped bit, a lost or inserted byte, or the offset at
    which the frame is truncated. With --bad, the exit code is 1 if a frame is damaged or bytes are
    outside frames. An OFFSET is decimal or hexadecimal: 940 or 0x3ac. In a capture, it is an offset
    in the joined payloads. --slice selects by arrival time; offsets are then relative to the
    beginning of the slice.
    """
    if at is not None and stretch is not None:
        raise UsageError(
            "--at and --bytes cannot be combined: use --at for one byte, or --bytes for a range"
        )
    with open_input(words, selection.times, reports_damage=True) as (sample, chunks):
        sensor, fits = _find_sensor(sample, sensor_id, allow_similar=True)
        if not sample.data:
            raise make_no_frame_error(sensor, sample)
        pieces = iter_pieces(sensor, chunks, datagrams=sample.datagrams, frame=frame)
        if diff is not None:
            _compare(sensor, sample, pieces, diff, frame, as_json=as_json, output=output)
            return
        wanted = FrameSelection(sensor, frame, count=count, bad=bad, at=at, stretch=stretch)
        parts = wanted.iter_explained(pieces)
        if as_json:
            listed = ({"offset": piece.offset, **part.to_dict()} for piece, part in parts)
            emit_json_list({"sensor": sensor.id, "fits": fits}, "frames", listed, output)
        else:
            emit_lines(listing(sensor, parts, at, every=bits, verdicts=bad), output)
        wanted.report_outcome(sample)


def listing(
    sensor: Sensor,
    parts: Iterable[tuple[InputPiece, Explanation]],
    at: int | None = None,
    *,
    every: bool = False,
    verdicts: bool = False,
) -> Iterator[Line]:
    """Yield the lines of explained pieces of the input; each piece has a title.

    Args:
        parts: pairs of a piece and its explanation.
        at: the offset of a byte; the title names the field at this offset.
        every: whether to draw the bits of all elements of an array, instead of the first element.
        verdicts: whether the title of a damaged piece describes the damage.
    """
    for index, (piece, part) in enumerate(parts):
        yield from [()] * bool(index)
        title = TextSpan(_format_title(sensor, piece, part.frame), "title")
        if at is None:
            path = ""
        else:
            path = next(
                (
                    value.path
                    for value in part.fields.values()
                    if value.covers_byte(at - piece.offset)
                ),
                "",
            )
        if verdicts and part.fault is not None:
            verdict = f": {part.verdict}"
        else:
            verdict = ""
        yield (
            title,
            TextSpan(f"; byte {at} is in {path}" if path else ""),
            TextSpan(verdict, "bad"),
        )
        yield from part.lines(every=every)


class FrameSelection:
    """Selects the frames and other bytes of an input to show, and counts all of them.

    Args:
        frame: show only this frame type.
        count: maximum number of frames to show; with `bad`, maximum number of damaged frames.
        bad: show only damaged frames and bytes outside frames.
        at: show only the frame, or the bytes, at this offset.
        stretch: show only the bytes in this range of offsets, "FROM:TO".

    Attributes:
        valid: number of valid frames.
        damaged: number of damaged frames.
        unframed: number of bytes outside frames.
        others: number of frames of other types.

    Raises:
        UsageError: if `stretch` is invalid.
    """

    def __init__(
        self,
        sensor: Sensor,
        frame: str | None = None,
        *,
        count: int | None = None,
        bad: bool = False,
        at: int | None = None,
        stretch: str | None = None,
    ) -> None:
        self._sensor = sensor
        self._frame = frame
        self._count = math.inf if count is None else count
        self._bad = bad
        stretched: tuple[float, float] = _parse_stretch(stretch) if at is None else (at, at + 1)
        self._from, self._to = stretched
        self._fault: WireError | None = None
        self._shown = 0
        self._end = 0
        self._ended = False
        self.valid = self.damaged = self.unframed = self.others = 0

    def iter_valid(self, pieces: Iterable[InputPiece]) -> Iterator[InputPiece]:
        """Yield the valid frames, and count the bytes outside them."""
        for piece in pieces:
            if piece.is_valid:
                self.valid += 1
                yield piece
                if self.valid == self._count:
                    return
            else:
                self.unframed += len(piece.data)

    def iter_explained(
        self, pieces: Iterable[InputPiece]
    ) -> Iterator[tuple[InputPiece, Explanation]]:
        """Yield the selected pieces with their explanations, as they are found.

        Raises:
            WireError: if nothing in the input begins like a frame.
        """
        for piece in pieces:
            if piece.offset >= self._to:
                return
            self._end = piece.end
            is_other = self._frame is not None and piece.is_valid and piece.frame != self._frame
            self.others += is_other
            self.valid += piece.is_valid and not is_other
            if is_other or (self._bad and piece.is_valid) or piece.end <= self._from:
                continue
            yield from self._iter_within(piece)
            if (self.damaged if self._bad else self.valid) >= self._count:
                return
        self._ended = True

    def _iter_within(self, piece: InputPiece) -> Iterator[tuple[InputPiece, Explanation]]:
        """Yield the selected parts of a piece with their explanations, and count them."""
        try:
            for part, what in explain_piece(self._sensor, piece, self._frame):
                if self._bad and what.is_filler:
                    continue
                if self._frame not in (None, what.frame):
                    self.others, self.unframed = (
                        self.others + bool(what.frame),
                        self.unframed + (0 if what.frame or what.is_filler else len(part.data)),
                    )
                elif part.end > self._from and part.offset < self._to:
                    self._fault = self._fault or what.fault
                    self._shown += 1
                    self.damaged += bool(what.frame) and what.fault is not None
                    self.unframed += 0 if what.frame or what.is_filler else len(part.data)
                    yield part, what
                    if self._bad and self.damaged >= self._count:
                        return
        except WireError as fault:
            raise suggest(fault, f"lidarspec show {self._sensor.id}") from None

    def report_outcome(self, sample: SampleBytes) -> None:
        """Print the numbers of frames, and of bytes outside frames, that were counted.

        Raises:
            UsageError: if the input ends before the selected bytes.
            WireError: if the input contains no frame.
            Exit: with exit code 1, if only damage was to be shown (`bad`) and some was found.
        """
        if self._ended and not self._shown and self._end <= self._from:
            raise UsageError(
                f"{sample.source} has only {self._end} bytes; byte {self._from} does not exist"
            )
        has_frame = self.valid or (self._bad and self.damaged)
        if not has_frame and (self._ended or not self._bad):
            if self._fault is None and self._frame is not None:
                if self.others:
                    others = f"; it contains {self.others} frames of other types"
                else:
                    others = ""
                raise WireError(
                    f"no {self._frame} frame in {sample.source}{others}",
                    sensor=self._sensor.id,
                )
            raise (
                make_no_frame_error(self._sensor, sample)
                if self._fault is None
                else suggest(self._fault, f"lidarspec show {self._sensor.id}")
            )
        if self._bad or self.others or ((self.damaged or self.unframed) and self._shown > 1):
            note(", ".join(self._iter_counts()))
        if self._bad and (self.damaged or self.unframed):
            raise click.exceptions.Exit(FINDINGS)

    def _iter_counts(self) -> Iterator[str]:
        yield f"{self.valid} frame{'s' * (self.valid != 1)}"
        yield f"{self.damaged} damaged"
        yield f"{self.unframed} byte{'s' * (self.unframed != 1)} outside frames"
        if self.others:
            yield f"{self.others} frames of other types omitted"


def _parse_stretch(text: str | None) -> tuple[float, float]:
    """Return the start and the end of "FROM:TO"; an empty TO is infinity."""
    first, colon, last = (text or ":").partition(":")
    try:
        start = int(first or "0", 0)
        end = int(last, 0) if last else math.inf
    except ValueError:
        start = 0
        end = 0
    if not colon or not 0 <= start < end:
        raise UsageError(
            f"{text!r} is not a byte range FROM:TO, such as '940:1034', '0x3ac:' or ':47'"
        )
    return start, end


def _compare(
    sensor: Sensor,
    sample: SampleBytes,
    pieces: Iterator[InputPiece],
    diff: str,
    frame: str | None,
    *,
    as_json: bool,
    output: str | None,
) -> None:
    """Print the differences between the first frame of the input and another frame.

    Args:
        diff: "next" to compare with the next frame of the same type in the input; else a file or
            hexadecimal text that contains the other frame.
    """
    frames = (
        piece
        for piece in pieces
        if piece.frame and (frame is None or piece.frame == frame or not piece.is_valid)
    )
    first = next(frames, None)
    if first is None:
        raise make_no_frame_error(sensor, sample)
    if diff == "next":
        other = next((piece for piece in frames if piece.frame == first.frame), None)
        if other is None:
            raise UsageError(f"the input has no second {first.frame} frame to compare with")
    else:
        with open_input([diff]) as (other_sample, chunks):
            second = iter_pieces(sensor, chunks, datagrams=other_sample.datagrams, frame=frame)
            other = next(
                (piece for piece in second if piece.frame == first.frame),
                InputPiece(0, other_sample.data, first.frame),
            )
    (_, before), (_, after) = (
        next(explain_piece(sensor, piece, frame)) for piece in (first, other)
    )
    differing = before.differences(after)
    if as_json:
        emit_json(
            {
                "sensor": sensor.id,
                "frame": before.frame,
                "differences": [part.to_dict() for part in differing],
            },
            output,
        )
    else:
        emit_lines(
            [
                (TextSpan(f"{sensor.id} {before.frame}", "title"),),
                *list_differences(differing, (len(before.data), len(after.data))),
            ],
            output,
        )


def _find_sensor(
    sample: SampleBytes, sensor_id: str | Sensor | None, *, allow_similar: bool = False
) -> tuple[Sensor, list[str]]:
    """Return the named sensor, or the sensor that fits some bytes best.

    Args:
        sensor_id: the named sensor; None to find a sensor.
        allow_similar: whether to return the most similar sensor if the bytes contain no valid
            frame, instead of raising an error.

    Returns:
        The sensor, and the ids of all sensors that fit; no ids for a named sensor.
    """
    if sensor_id is not None:
        return named_sensor(sensor_id), []
    # A named sensor does not need this module, which is slow to import.
    from lidarspec.detect.identification import find_fitting_sensors

    sensors = find_fitting_sensors(sample.chunks, datagrams=sample.datagrams)
    if sensors:
        fits = [sensor.id for sensor in sensors]
        note(
            f"these bytes are frames of {fits[0]}"
            + (f", or of {', '.join(fits[1:])}; choose with -s" if fits[1:] else "")
        )
        return sensors[0], fits
    fault = make_no_sensor_error(sample)
    if not allow_similar or not fault.sensor:
        raise fault
    note(f"these bytes contain no valid frame; they are most similar to {fault.sensor}")
    return named_sensor(fault.sensor), []


def _format_title(sensor: Sensor, piece: InputPiece, frame: str) -> str:
    where = f" at byte {piece.offset}" if piece.offset else ""
    return (
        f"{sensor.id} {frame or 'skipped'}{where}, {len(piece.data)}"
        f" byte{'s' * (len(piece.data) != 1)}"
    )


def _format_raw(raw: Any) -> str:
    if not isinstance(raw, bytes | bytearray):
        return str(raw)
    if len(raw) <= 2 * LINE_BYTES:
        return raw.hex(" ")
    return f"{raw[: 2 * LINE_BYTES].hex(' ')} ... ({len(raw)} bytes)"


def to_json_values(parsed: Any) -> Any:
    """Return a parsed frame as JSON values."""
    if isinstance(parsed, dict):
        return {
            name: to_json_values(value)
            for name, value in parsed.items()
            if not name.startswith("_")
        }
    if isinstance(parsed, list):
        return [to_json_values(value) for value in parsed]
    if isinstance(parsed, bytes | bytearray):
        return parsed.hex(" ")
    if isinstance(parsed, int):
        return int(parsed)
    return to_json_number(parsed)
