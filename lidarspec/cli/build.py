"""`build` and `send`: one frame out of field=value; a command sent to a sensor, and its reply."""

from __future__ import annotations

import functools
import math
import re
import time
from collections.abc import Mapping, Sequence
from fractions import Fraction
from shlex import quote
from typing import Any, Literal

import click

from lidarspec.cli.frames import listing, plain
from lidarspec.cli.options import DURATION, output_options, sensor_option
from lidarspec.cli.output import emit, emit_json, emit_lines, table
from lidarspec.cli.terminal import note
from lidarspec.device.device import Device, open as open_device
from lidarspec.device.session import Reply
from lidarspec.errors import CommandError, LidarSpecError, OutOfRange, UnknownCommand, UnknownField, UnknownFrame, UsageError, suggest
from lidarspec.explaining.explanation import explain
from lidarspec.explaining.pieces import explained, pieces
from lidarspec.plugins import sensor as named_sensor
from lidarspec.spec.arguments import Octets, Range
from lidarspec.spec.fields import factor, split_unit
from lidarspec.spec.sensor import Sensor
from lidarspec.spec.tree import FieldInfo, evaluated
from lidarspec.transports.hexadecimal import unhexed
from lidarspec.transports.open_url import is_live
from lidarspec.transports.protocol import Chunk
from lidarspec.wire.build import Steps, argument_slot, given_value, is_index, put, steps
from lidarspec.wire.schema import Schema, schema

#: seconds to wait for what comes back on bytes sent by hand, and of silence behind it that end it.
ANSWERED, QUIET = 1.0, 0.2
_STEP = r"\w+(?:\[(?:\d+|\*)\])*"
_PATH = re.compile(rf"{_STEP}(?:\.{_STEP})*")


@click.command()
@click.argument("sensor_id", metavar="ID")
@click.argument("frame")
@click.argument("assignments", metavar="FIELD=VALUE", nargs=-1)
@output_options
def build(sensor_id: str, frame: str, assignments: Sequence[str], as_json: bool, output: str | None) -> None:
    """The bytes of one frame from field=value; a unit makes a value physical.

    A bare number is the wire's integer. points[*].distance=1m sets every element, points[3].intensity=7 one; later ones win.
    Constants, counts and checksums are filled in. -o writes the bytes themselves, or text where FILE ends in .hex.
    """
    sensor = named_sensor(sensor_id)
    if frame not in sensor.frames:
        raise suggest(UnknownFrame(frame, sensor.frames, place=sensor.id), f"lidarspec show {quote(str(sensor_id))}")
    try:
        data = sensor.build(frame, values(schema(sensor.frames[frame].tree), assignments, f"{sensor.id} {frame}"))
    except LidarSpecError as error:
        raise suggest(error, f"lidarspec show {quote(str(sensor_id))}") from None
    if as_json:
        emit_json({"sensor": sensor.id, "frame": frame, "size": len(data), "hex": data.hex(" ")}, output)
    else:
        emit(data.hex(" ") if output is None or output.endswith(".hex") else data, output)


def values(table: Schema, assignments: Sequence[str], place: str) -> dict[str, Any]:
    """Raw values, nested as in the struct.

    Raises:
        UsageError: for an assignment that is none, an unknown field, or a value that its field cannot take.
    """
    parsed = [_assignment(table, text, place) for text in assignments]
    found: dict[str, Any] = {}
    for names, value in sorted(parsed, key=lambda item: any(is_index(step) for step in item[0])):
        put(found, names, value, lambda path: _length(table, found, path, place))
    return found


def _assignment(table: Schema, text: str, place: str) -> tuple[Steps, Any]:
    path, equals, value = text.partition("=")
    if not equals or not _PATH.fullmatch(path):
        raise UsageError(f"{place}: {text!r} is not field=value")
    names = steps(path)
    plain = ".".join(str(step) for step in names if not is_index(step))
    info = table.all_fields.get(plain)
    if info is None:
        raise UnknownField(path, table.all_fields, place=place)
    arrays = len(info.axes) - (info.kind == "bytes")
    given = sum(map(is_index, names))
    if given != arrays:
        raise UsageError(f"{place}: {plain} is in {arrays} array{'s' * (arrays != 1)}, and {path!r} has {given} indices")
    return names, _raw(info, value.strip(), path, place)


def _raw(info: FieldInfo, text: str, path: str, place: str) -> Any:
    """The raw value that a text stands for: hexadecimal for bytes, a label, a number, or a number with a unit."""
    if info.kind == "bytes":
        return _octets(text, f"{place}: {path}")
    for raw, label in info.labels.items():
        if text == label:
            return raw
    number, unit = _number(text, info.unit, f"{place}: {path}", "a number")
    if unit:
        return _nearest(info, number, path, place)
    if number.denominator == 1 and info.kind != "float":
        return int(number)
    if info.kind == "int":
        raise UsageError(f"{place}: {path} = {text} is not a raw integer{f'; give it a unit: {text}{info.unit}' if info.unit else ''}")
    return float(number)


def _octets(text: str, place: str) -> bytes:
    try:
        return unhexed(text)
    except ValueError:
        raise UsageError(f"{place} takes bytes in hexadecimal, not {text!r}") from None


def _number(text: str, unit: str, place: str, wanted: str) -> tuple[Fraction, str]:
    """A number, turned into a unit where it has one of its own, and this one."""
    digits, given = split_unit(text)
    per_unit = factor(given, unit) if given else Fraction(1)
    if per_unit is None:
        raise UsageError(f"{place} is in {unit or 'no unit'}, and {given!r} cannot be turned into that")
    try:
        number = Fraction(int(digits, 0)) if digits[:2].lower() in ("0x", "0b", "0o") else Fraction(digits)
    except ValueError:
        raise UsageError(f"{place} takes {wanted}, not {text!r}") from None
    return number * per_unit, given


def _nearest(info: FieldInfo, number: Fraction, path: str, place: str) -> int | float:
    """The raw value nearest to a physical one."""
    raw: int | float = info.raw(number)
    if info.kind != "int":
        return float(raw)
    low, high = info.limits
    if not low <= raw <= high:
        edges = [float(info.physical(Fraction(edge))) for edge in (low, high)]
        raise OutOfRange(path, float(number), *edges, unit=info.unit, place=place)
    return raw


def _length(table: Schema, given: Mapping[str, Any], path: str, place: str) -> int:
    """The length of an array: declared, or from the count fields given; 0 where it follows from single elements given."""
    declared = table.arrays.get(path)
    if isinstance(declared, int):
        return declared
    try:
        return int(evaluated(declared, functools.partial(given_value, given, table.fields)))  # type: ignore[arg-type]
    except Exception:
        target: Any = given
        for name in path.removesuffix("[]").split("."):
            target = target.get(name, {}) if isinstance(target, Mapping) else {}
        if isinstance(target, list) and target:
            return 0
        raise UsageError(f"{place}: how many elements {path}[*] has is not known: give the count field, or {path}[0]=...") from None


@click.command()
@click.argument("source")
@click.argument("command", required=False)
@click.argument("assignments", metavar="[ARGUMENT=VALUE]...", nargs=-1)
@sensor_option
@click.option("--hex", "digits", metavar="HEX", help="Send these bytes in the place of a command, and explain what comes back.")
@click.option("--timeout", type=DURATION, metavar="TIME", help="How long to wait for the reply; by default what the sensor declares.")
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

    Nothing else is sent: a sensor that it starts goes on when the verb ends. Values are in the unit that `show` prints, or bring
    their own: rate=600rpm. A sensor that keeps silent until it is started has to be named with -s.
    """
    if (command is None) == (digits is None):
        raise UsageError("send takes either the name of a command, or bytes: --hex 'a5 50'")
    data, answer = b"" if digits is None else _bytes(digits), _Answer()
    record = (lambda _: answer) if digits is not None and is_live(source) else None
    with open_device(source, sensor_id, start=False, record=record) as device:
        device.leave_on()
        if command is None:
            _write(device, source, data, answer, timeout, as_json=as_json, output=output)
            return
        reply = _sent(device, source, command, assignments, timeout)
        sensor = device.sensor
    if as_json:
        emit_json(_told(sensor, reply), output)
    else:
        emit(replied(sensor, reply, output), output)


def _bytes(digits: str) -> bytes:
    try:
        return unhexed(digits)
    except ValueError as error:
        raise UsageError(f"--hex takes bytes in hexadecimal: {error}") from None


class _Answer:
    """What arrives, in the place of a recording."""

    error = None

    def __init__(self) -> None:
        self.chunks: list[Chunk] = []

    def write(self, chunk: Chunk, direction: Literal["in", "out"] = "in") -> None:
        if direction == "in":
            self.chunks.append(chunk)

    def event(self, name: str, at: int | None = None, **details: Any) -> None:
        """Nothing is made of it: what was lost is missing in the answer."""

    def close(self) -> None:
        """There is nothing to close."""

    def after(self, number: int, seconds: float) -> list[Chunk]:
        """The chunks behind the first so many: until the line has been quiet for a moment, or so many seconds have passed."""
        end, heard, quiet = time.monotonic() + seconds, number, math.inf
        while (now := time.monotonic()) < min(end, quiet):
            if len(self.chunks) > heard:
                heard, quiet = len(self.chunks), now + QUIET
            time.sleep(QUIET / 10)
        return self.chunks[number:]


def _write(device: Device, source: str, data: bytes, answer: _Answer, timeout: float | None, *, as_json: bool, output: str | None) -> None:
    """Send bytes, and print what comes back, explained; data frames, which come all the same, are only counted."""
    _refuse_file(device, source)
    sensor, before = device.sensor, len(answer.chunks)
    device.write(data)
    note(f"sent {len(data)} byte{'s' * (len(data) != 1)}: {data.hex(' ')}")
    heard = answer.after(before, ANSWERED if timeout is None else timeout)
    found = list(pieces(sensor, heard, datagrams=sensor.datagrams)) if heard else []
    rest = [piece for piece in found if piece.frame not in sensor.data_frames]
    if len(rest) < len(found):  # they go on: what is cut off by the beginning and the end of listening is of these
        note(f"{len(found) - len(rest)} data frames came meanwhile")
        rest = [piece for piece in rest if piece.is_valid or piece not in (found[0], found[-1])]
    parts = [(piece, part) for cut in rest for piece, part in explained(sensor, cut) if not part.is_filler]
    if as_json:
        frames = [{"offset": piece.offset, **part.to_dict()} for piece, part in parts]
        emit_json({"sensor": sensor.id, "sent": data.hex(" "), "frames": frames}, output)
    elif parts:
        emit_lines(listing(sensor, parts), output)
    if not parts:
        note("nothing came back")


def _sent(device: Device, source: str, command: str, assignments: Sequence[str], timeout: float | None) -> Reply:
    sensor = device.sensor
    _refuse_file(device, source)
    try:
        return device.send(command, timeout=timeout, **arguments(sensor, command, assignments))
    except UsageError as error:
        raise suggest(error, f"lidarspec show {sensor.id}") from None
    except CommandError as error:
        raise suggest(error, f"lidarspec doctor {quote(source)} -s {sensor.id}") from None


def _refuse_file(device: Device, source: str) -> None:
    if not device.is_live:
        raise suggest(UsageError(f"{source} is a file: nothing can be sent to it"), "lidarspec ports")


def arguments(sensor: Sensor, name: str, assignments: Sequence[str]) -> dict[str, Any]:
    """The arguments of a command: numbers in the units of their fields, texts and addresses as they are, bytes from hexadecimal digits.

    Raises:
        UsageError: for an unknown command or argument, or a text that stands for no value of it.
    """
    if name not in sensor.commands:
        hint = "" if sensor.commands else "; it takes no commands"
        raise UnknownCommand(name, sensor.commands, place=sensor.id, hint=hint)
    command = sensor.commands[name]
    found: dict[str, Any] = {}
    for text in assignments:
        argument, equals, value = text.partition("=")
        if not equals:
            raise UsageError(f"{sensor.id} {name}: {text!r} is not argument=value")
        if argument not in command.args or command.frame is None:
            raise UnknownField(argument, command.args, place=f"{sensor.id} {name}")
        slot, kind, place = argument_slot(sensor, name, argument), command.arguments[argument].kind, f"{sensor.id} {name}: {argument}"
        if isinstance(kind, Range):
            unit = slot.info.unit
            number, _ = _number(value.strip(), unit, place, f"a number in {unit}" if unit else "a number")
            found[argument] = int(number) if number.denominator == 1 else float(number)
        else:
            found[argument] = _octets(value, place) if isinstance(kind, Octets) else value
    return found


def replied(sensor: Sensor, reply: Reply, output: str | None = None) -> str:
    """A reply in words: each field with its value and its meaning; `output`: the file that it is for, which has no width."""
    if not reply.confirmed or reply.frame is None:
        return f"{sensor.id} {reply.command}: sent; no answer is documented, so whether it took is not known"
    values = explain(reply.data, sensor, reply.frame).fields.values()
    rows = [[value.path, value.raw.hex(" ") if isinstance(value.raw, bytes) else str(value), value.docs] for value in values]
    return f"{sensor.id} {reply.command}: answered with {reply.frame}\n{table(['field', 'value', 'meaning'], rows, output)}"


def _told(sensor: Sensor, reply: Reply) -> dict[str, Any]:
    told: dict[str, Any] = {"sensor": sensor.id, "command": reply.command, "confirmed": reply.confirmed, "frame": reply.frame}
    if reply.frame is None:
        return {**told, "hex": None, "fields": None, "values": []}
    values = [value.to_dict() for value in explain(reply.data, sensor, reply.frame).fields.values()]
    return {**told, "hex": reply.data.hex(" "), "fields": plain(reply.values), "values": values}
