"""The verb that talks to a sensor."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from shlex import quote
from typing import Any

import click

from lidarspec.cli.frames import plain
from lidarspec.cli.options import DURATION, output_options, sensor_option
from lidarspec.cli.output import emit, emit_json, table
from lidarspec.device.device import Device, open as open_device
from lidarspec.device.session import Reply
from lidarspec.errors import CommandError, UnknownCommand, UnknownField, UsageError, suggest
from lidarspec.explaining.explanation import explain
from lidarspec.spec.fields import factor, split_unit
from lidarspec.spec.sensor import Sensor
from lidarspec.wire.schema import schema


@click.command()
@click.argument("source")
@click.argument("command")
@click.argument("assignments", metavar="ARGUMENT=VALUE", nargs=-1)
@sensor_option
@click.option("--timeout", type=DURATION, metavar="TIME", help="How long to wait for the reply; by default what the sensor declares.")
@output_options
def send(
    source: str,
    command: str,
    assignments: Sequence[str],
    sensor_id: str | None,
    timeout: float | None,
    as_json: bool,
    output: str | None,
) -> None:
    """Send a command to a sensor, and print its reply.

    Nothing else is sent: a sensor that it starts goes on when the verb ends. Values are in the unit that `show` prints, or bring
    their own: rate=600rpm. A sensor that keeps silent until it is started has to be named with -s.
    """
    with open_device(source, sensor_id, start=False) as device:
        device.leave_on()
        reply = _sent(device, source, command, assignments, timeout)
        sensor = device.sensor
    if as_json:
        emit_json(_told(sensor, reply), output)
    else:
        emit(_text(sensor, reply, output), output)


def _sent(device: Device, source: str, command: str, assignments: Sequence[str], timeout: float | None) -> Reply:
    sensor = device.sensor
    if not device.is_live:
        raise suggest(UsageError(f"{source} is a file: nothing can be sent to it"), "lidarspec ports")
    try:
        return device.send(command, timeout=timeout, **arguments(sensor, command, assignments))
    except UsageError as error:
        raise suggest(error, f"lidarspec show {sensor.id}") from None
    except CommandError as error:
        raise suggest(error, f"lidarspec doctor {quote(source)} -s {sensor.id}") from None


def arguments(sensor: Sensor, name: str, assignments: Sequence[str]) -> dict[str, float | int]:
    """The arguments of a command, in the units of their fields.

    Raises:
        UsageError: for an unknown command or argument, or a text that is no number in a unit of its field.
    """
    if name not in sensor.commands:
        hint = "" if sensor.commands else "; it takes no commands"
        raise UnknownCommand(name, sensor.commands, place=sensor.id, hint=hint)
    command = sensor.commands[name]
    found: dict[str, float | int] = {}
    for text in assignments:
        argument, equals, value = text.partition("=")
        if not equals:
            raise UsageError(f"{sensor.id} {name}: {text!r} is not argument=value")
        if argument not in command.args or command.frame is None:
            raise UnknownField(argument, command.args, place=f"{sensor.id} {name}")
        unit = schema(sensor.frames[command.frame].tree).fields[command.args[argument][0]].unit
        found[argument] = _number(value, unit, f"{sensor.id} {name}: {argument}")
    return found


def _number(text: str, unit: str, place: str) -> float | int:
    """A number in a unit, out of one with or without a unit of its own."""
    digits, given = split_unit(text.strip())
    per_unit = factor(given, unit) if given else Fraction(1)
    if per_unit is None:
        raise UsageError(f"{place} is in {unit or 'no unit'}, and {given!r} cannot be turned into that")
    try:
        number = Fraction(int(digits, 0)) if digits[:2].lower() in ("0x", "0b", "0o") else Fraction(digits)
    except ValueError:
        raise UsageError(f"{place} takes a number{f' in {unit}' * bool(unit)}, not {text!r}") from None
    number *= per_unit
    return int(number) if number.denominator == 1 else float(number)


def _text(sensor: Sensor, reply: Reply, output: str | None) -> str:
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
