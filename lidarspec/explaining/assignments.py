"""Parse field=value of a frame, and the arguments of a command, as raw values.

A bare number is the raw integer of a field, but an argument in the unit of its field; a number with
a unit is converted.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

from lidarspec.errors import OutOfRange, UnknownCommand, UnknownField, UsageError
from lidarspec.frames.commands import argument_slot
from lidarspec.frames.encode import read_given
from lidarspec.frames.field_paths import Steps, is_index, put_value, split_path
from lidarspec.frames.schema import Schema
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.arguments import Octets, Range
from lidarspec.spec.fields import factor, split_unit
from lidarspec.spec.tree import FieldInfo, evaluate
from lidarspec.transports.hex_text import parse_hex

_STEP = r"\w+(?:\[(?:\d+|\*)\])*"
_PATH = re.compile(rf"{_STEP}(?:\.{_STEP})*")


def values(table: Schema, assignments: Sequence[str], place: str) -> dict[str, Any]:
    """Return the raw values, nested as in the struct.

    Raises:
        UsageError: for an invalid assignment, an unknown field, or a value that its field cannot
            hold.
    """
    parsed = [_assignment(table, text, place) for text in assignments]
    raw_values: dict[str, Any] = {}
    for names, value in sorted(parsed, key=lambda item: any(is_index(step) for step in item[0])):
        put_value(raw_values, names, value, lambda path: _length(table, raw_values, path, place))
    return raw_values


def _assignment(table: Schema, text: str, place: str) -> tuple[Steps, Any]:
    path, equals, value = text.partition("=")
    if not equals or not _PATH.fullmatch(path):
        raise UsageError(f"{place}: {text!r} is not field=value")
    names = split_path(path)
    plain = ".".join(str(step) for step in names if not is_index(step))
    info = table.all_fields.get(plain)
    if info is None:
        raise UnknownField(path, table.all_fields, place=place)
    arrays = len(info.axes) - (info.kind == "bytes")
    given = sum(map(is_index, names))
    if given != arrays:
        raise UsageError(
            f"{place}: {plain} is in {arrays} array{'s' * (arrays != 1)}, but {path!r} has {given}"
            f" ind{'ex' if given == 1 else 'ices'}"
        )
    return names, _raw(info, value.strip(), path, place)


def _raw(info: FieldInfo, text: str, path: str, place: str) -> Any:
    """Return the raw value of a text.

    It is hexadecimal for bytes, a label, a number, or a number with a unit.
    """
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
        raise UsageError(
            f"{place}: {path} = {text} is not a raw"
            f" integer{f'; give it a unit: {text}{info.unit}' if info.unit else ''}"
        )
    return float(number)


def _octets(text: str, place: str) -> bytes:
    try:
        return parse_hex(text)
    except ValueError:
        raise UsageError(f"{place}: expected bytes in hexadecimal, got {text!r}") from None


def _number(text: str, unit: str, place: str, wanted: str) -> tuple[Fraction, str]:
    """Return a number, converted to `unit` if it has a unit, and its own unit."""
    digits, unit_text = split_unit(text)
    if unit_text:
        per_unit = factor(unit_text, unit)
    else:
        per_unit = Fraction(1)
    if per_unit is None:
        raise UsageError(
            f"{place}: expected {unit or 'no unit'}, cannot convert from {unit_text!r}"
        )
    try:
        if digits[:2].lower() in ("0x", "0b", "0o"):
            number = Fraction(int(digits, 0))
        else:
            number = Fraction(digits)
    except ValueError:
        raise UsageError(f"{place}: expected {wanted}, got {text!r}") from None
    return number * per_unit, unit_text


def _nearest(info: FieldInfo, number: Fraction, path: str, place: str) -> int | float:
    """Return the raw value nearest to a physical one."""
    raw: int | float = info.raw(number)
    if info.kind != "int":
        return float(raw)
    low, high = info.limits
    if not low <= raw <= high:
        edges = [float(info.physical(Fraction(edge))) for edge in (low, high)]
        raise OutOfRange(path, float(number), *edges, unit=info.unit, place=place)
    return raw


def _length(table: Schema, given: Mapping[str, Any], path: str, place: str) -> int:
    """Return the length of an array: declared, or from the given count fields.

    Returns 0 if it follows from single elements that are given.
    """
    declared = table.arrays.get(path)
    if isinstance(declared, int):
        return declared
    try:
        return int(evaluate(declared, functools.partial(read_given, given, table.fields)))  # type: ignore[arg-type]
    except Exception:
        target: Any = given
        for name in path.removesuffix("[]").split("."):
            if isinstance(target, Mapping):
                target = target.get(name, {})
            else:
                target = {}
        if isinstance(target, list) and target:
            return 0
        raise UsageError(
            f"{place}: the number of elements of {path}[*] is not known: give the count field, or"
            f" {path}[0]=..."
        ) from None


def arguments(sensor: Sensor, name: str, assignments: Sequence[str]) -> dict[str, Any]:
    """Return the arguments of a command.

    Numbers are in the units of their fields, texts and addresses are unchanged, bytes come from
    hexadecimal digits.

    Raises:
        UsageError: for an unknown command or argument, or an invalid value.
    """
    if name not in sensor.commands:
        hint = "" if sensor.commands else "; it has no commands"
        raise UnknownCommand(name, sensor.commands, place=sensor.id, hint=hint)
    command = sensor.commands[name]
    given: dict[str, Any] = {}
    for text in assignments:
        argument, equals, value = text.partition("=")
        if not equals:
            raise UsageError(f"{sensor.id} {name}: {text!r} is not argument=value")
        if argument not in command.args or command.frame is None:
            raise UnknownField(argument, command.args, place=f"{sensor.id} {name}")
        slot = argument_slot(sensor, name, argument)
        kind = command.arguments[argument].kind
        place = f"{sensor.id} {name}: {argument}"
        if isinstance(kind, Range):
            unit = slot.info.unit
            number, _ = _number(
                value.strip(), unit, place, f"a number in {unit}" if unit else "a number"
            )
            given[argument] = int(number) if number.denominator == 1 else float(number)
        else:
            given[argument] = _octets(value, place) if isinstance(kind, Octets) else value
    return given
