"""`build` and `send`: build a frame from the values of its fields; send a command."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from shlex import quote
from typing import Any, Literal

import click

from lidarspec.cli.frames import listing, to_json_values
from lidarspec.cli.listing import emit_lines
from lidarspec.cli.options import DURATION, sensor_option
from lidarspec.cli.output import emit, emit_json, output_options, table
from lidarspec.cli.terminal import note
from lidarspec.device.device import Device, open as open_device
from lidarspec.device.session import Reply
from lidarspec.errors import CommandError, LidarSpecError, UnknownFrame, UsageError, suggest
from lidarspec.explaining.assignments import parse_arguments, parse_values
from lidarspec.explaining.explanation import describe_reply, explain
from lidarspec.explaining.input_segments import explain_piece, iter_pieces
from lidarspec.frames.schema import make_schema
from lidarspec.plugins import sensor as named_sensor
from lidarspec.sensor_operations import Sensor
from lidarspec.transports.hex_text import parse_hex
from lidarspec.transports.open_url import is_live
from lidarspec.transports.protocol import Chunk

#: Timeout for the reply to the bytes of --hex, in seconds. The reply ends when no data arrives for
#: `REPLY_SILENCE_S`.
REPLY_TIMEOUT_S = 1.0
REPLY_SILENCE_S = 0.2


@click.command()
@click.argument("sensor_id", metavar="ID")
@click.argument("frame")
@click.argument("assignments", metavar="FIELD=VALUE", nargs=-1)
@output_options
def build(
    sensor_id: str, frame: str, assignments: Sequence[str], as_json: bool, output: str | None
) -> None:
    """Build one frame from the values of its fields.

    A number without a unit is the raw integer, and a number with a unit, such as 1.5m, is
    converted. points[*].distance=1m sets every element of an array, and points[3].intensity=7 sets
    a single element. A later assignment overrides an earlier one. Constants, counts and checksums
    are filled in. -o writes the bytes, or hexadecimal text if FILE ends in .hex.
    """
    sensor = named_sensor(sensor_id)
    if "=" in frame:
        error = UsageError(
            f"the name of the frame is missing before {frame!r}; {sensor.id} has the frames"
            f" {', '.join(sensor.frames)}"
        )
        raise suggest(
            error,
            f"lidarspec build {quote(str(sensor_id))} {next(iter(sensor.frames), 'FRAME')}"
            f" {quote(frame)}",
        )
    if frame not in sensor.frames:
        raise suggest(
            UnknownFrame(frame, sensor.frames, place=sensor.id),
            f"lidarspec show {quote(str(sensor_id))}",
        )
    try:
        data = sensor.build(
            frame,
            parse_values(
                make_schema(sensor.frames[frame].tree), assignments, f"{sensor.id} {frame}"
            ),
        )
    except LidarSpecError as error:
        raise suggest(error, f"lidarspec show {quote(str(sensor_id))}") from None
    if as_json:
        emit_json(
            {"sensor": sensor.id, "frame": frame, "size": len(data), "hex": data.hex(" ")}, output
        )
    else:
        emit(data.hex(" ") if output is None or output.endswith(".hex") else data, output)


@click.command()
@click.argument("source")
@click.argument("command", required=False)
@click.argument("assignments", metavar="[ARGUMENT=VALUE]...", nargs=-1)
@sensor_option
@click.option(
    "--hex",
    "digits",
    metavar="HEX",
    help="Send these bytes instead of a command, and explain the reply.",
)
@click.option(
    "--timeout",
    type=DURATION,
    metavar="TIME",
    help="Timeout for the reply; default: the timeout that the sensor declares.",
)
@output_options
def send(
    source: str,
    command: str | None,
    assignments: Sequence[str],
    sensor_id: str | Sensor | None,
    digits: str | None,
    timeout: float | None,
    as_json: bool,
    output: str | None,
) -> None:
    """Send a command to a sensor, and print its reply.

    No stop command is sent, so a sensor that was started keeps running. A value without a unit, as
    in rate=10, is in the unit that `show` prints. A value with another unit, as in rate=600rpm, is
    converted. A sensor that sends nothing until it is started cannot be detected: name it with -s.
    """
    if (command is None) == (digits is None):
        raise UsageError("send requires the name of a command, or bytes such as --hex 'a5 50'")
    data = b"" if digits is None else _parse_hex(digits)
    answer = _AnswerLog()
    record = (lambda _: answer) if digits is not None and is_live(source) else None
    with open_device(source, sensor_id, start=False, record=record) as device:
        device.leave_on()
        if command is None:
            _write_bytes(device, source, data, answer, timeout, as_json=as_json, output=output)
            return
        reply = _send_command(device, source, command, assignments, timeout)
        sensor = device.sensor
    if as_json:
        emit_json(_reply_to_dict(sensor, reply), output)
    else:
        result, rows = describe_reply(sensor, reply)
        if rows:
            shown = f"\n{table(['field', 'value', 'meaning'], rows, output)}"
        else:
            shown = ""
        emit(f"{sensor.id} {reply.command}: {result}{shown}", output)


def _parse_hex(digits: str) -> bytes:
    try:
        return parse_hex(digits)
    except ValueError as error:
        raise UsageError(f"--hex requires bytes in hexadecimal: {error}") from None


class _AnswerLog:
    """A recorder that keeps the received chunks in memory."""

    error = None

    def __init__(self) -> None:
        self.chunks: list[Chunk] = []

    def write(self, chunk: Chunk, direction: Literal["in", "out"] = "in") -> None:
        if direction == "in":
            self.chunks.append(chunk)

    def event(self, name: str, at: int | None = None, **details: Any) -> None:
        """Ignore events."""

    def close(self) -> None:
        """Do nothing."""

    def await_reply(self, number: int, seconds: float) -> list[Chunk]:
        """Wait for the end of a reply, and return its chunks.

        Args:
            number: number of chunks that were received before the reply.
        """
        end = time.monotonic() + seconds
        count = number
        quiet = math.inf
        while (now := time.monotonic()) < min(end, quiet):
            if len(self.chunks) > count:
                count = len(self.chunks)
                quiet = now + REPLY_SILENCE_S
            time.sleep(REPLY_SILENCE_S / 10)
        return self.chunks[number:]


def _write_bytes(
    device: Device,
    source: str,
    data: bytes,
    answer: _AnswerLog,
    timeout: float | None,
    *,
    as_json: bool,
    output: str | None,
) -> None:
    """Send bytes, and print an explanation of the reply."""
    _refuse_file(device, source)
    sensor = device.sensor
    before = len(answer.chunks)
    device.write(data)
    note(f"sent {len(data)} byte{'s' * (len(data) != 1)}: {data.hex(' ')}")
    chunks = answer.await_reply(before, REPLY_TIMEOUT_S if timeout is None else timeout)
    if chunks:
        pieces = list(iter_pieces(sensor, chunks, datagrams=sensor.datagrams))
    else:
        pieces = []
    rest = [piece for piece in pieces if piece.frame not in sensor.data_frames]
    if len(rest) < len(pieces):
        # Data frames arrived as well, so incomplete pieces at both ends are parts of data frames.
        note(f"{len(pieces) - len(rest)} data frames were received besides the reply")
        rest = [piece for piece in rest if piece.is_valid or piece not in (pieces[0], pieces[-1])]
    parts = [
        (piece, part)
        for cut in rest
        for piece, part in explain_piece(sensor, cut)
        if not part.is_filler
    ]
    if as_json:
        frames = [{"offset": piece.offset, **part.to_dict()} for piece, part in parts]
        emit_json({"sensor": sensor.id, "sent": data.hex(" "), "frames": frames}, output)
    elif parts:
        emit_lines(listing(sensor, parts), output)
    if not parts:
        note("no reply received")


def _send_command(
    device: Device, source: str, command: str, assignments: Sequence[str], timeout: float | None
) -> Reply:
    sensor = device.sensor
    _refuse_file(device, source)
    try:
        return device.send(
            command, timeout=timeout, **parse_arguments(sensor, command, assignments)
        )
    except UsageError as error:
        raise suggest(error, f"lidarspec show {sensor.id}") from None
    except CommandError as error:
        raise suggest(error, f"lidarspec doctor {quote(source)} -s {sensor.id}") from None


def _refuse_file(device: Device, source: str) -> None:
    if not device.is_live:
        raise suggest(UsageError(f"cannot send to a file: {source}"), "lidarspec ports")


def _reply_to_dict(sensor: Sensor, reply: Reply) -> dict[str, Any]:
    head: dict[str, Any] = {
        "sensor": sensor.id,
        "command": reply.command,
        "confirmed": reply.confirmed,
        "frame": reply.frame,
    }
    if reply.frame is None:
        return {**head, "hex": None, "fields": None, "values": []}
    values = [value.to_dict() for value in explain(reply.data, sensor, reply.frame).fields.values()]
    return {
        **head,
        "hex": reply.data.hex(" "),
        "fields": to_json_values(reply.values),
        "values": values,
    }
