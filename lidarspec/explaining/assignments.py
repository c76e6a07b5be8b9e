"""Parse field=value of a frame, and argument=value of a command.

In field=value, a number with a unit is converted to a raw value, and a number without a unit is the
raw value. In argument=value, a number without a unit is in the unit of the argument's field.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

from lidarspec.errors import OutOfRange, UnknownCommand, UnknownField, UsageError
from lidarspec.frames.commands import find_argument_slot
from lidarspec.frames.encode import read_given_value
from lidarspec.frames.field_paths import Steps, is_index, put_value, split_path
from lidarspec.frames.schema import Schema
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.arguments import Octets, Range
from lidarspec.spec.fields import factor, split_unit
from lidarspec.spec.tree import FieldInfo, evaluate
from lidarspec.transports.hex_text import parse_hex

_STEP = r"\w+(?:\[(?:\d+|\*)\])*"
_PATH = re.compile(rf"{_STEP}(?:\.{_STEP})*")


def parse_values(table: Schema, assignments: Sequence[str], place: str) -> dict[str, Any]:
    """Return the raw values of assignments "field=value", nested as in the struct.

    Args:
        place: the names of the sensor and of the frame, for error messages.

    Raises:
        UsageError: for an invalid assignment, an unknown field, or a value outside the limits of
            its field.
    """
    parsed = [_parse_assignment(table, text, place) for text in assignments]
    raw_values: dict[str, Any] = {}
    # Count fields give the lengths of arrays, so elements of arrays are assigned last.
    for names, value in sorted(parsed, key=lambda item: any(is_index(step) for step in item[0])):
        put_value(
            raw_values, names, value, lambda path: _find_length(table, raw_values, path, place)
        )
    return raw_values


def _parse_assignment(table: Schema, text: str, place: str) -> tuple[Steps, Any]:
    """Return the path and the raw value of an assignment."""
    path, equals, value = text.partition("=")
    if not equals or not _PATH.fullmatch(path):
        raise UsageError(f"{place}: expected field=value, got {text!r}")
    names = split_path(path)
    plain = ".".join(str(step) for step in names if not is_index(step))
    info = table.all_fields.get(plain)
    if info is None:
        raise UnknownField(path, table.all_fields, place=place)
    arrays = len(info.axes) - (info.kind == "bytes")
    indices = sum(map(is_index, names))
    if indices != arrays:
        raise UsageError(
            f"{place}: {plain} is inside {arrays} array{'s' * (arrays != 1)}, so {path!r} requires"
            f" {arrays} ind{'ex' if arrays == 1 else 'ices'}, but has {indices}"
        )
    return names, _parse_raw(info, value.strip(), path, place)


def _parse_raw(info: FieldInfo, text: str, path: str, place: str) -> Any:
    """Return the raw value that a text assigns to a field."""
    if info.kind == "bytes":
        return _parse_bytes(text, f"{place}: {path}")
    for raw, label in info.labels.items():
        if text == label:
            return raw
    expected = " or ".join([*info.labels.values(), "a number"])
    number, unit = _parse_number(text, info.unit, f"{place}: {path}", expected)
    if unit:
        return _to_raw(info, number, path, place)
    if number.denominator == 1 and info.kind != "float":
        return int(number)
    if info.kind == "int":
        raise UsageError(
            f"{place}: {path} = {text} is not a raw"
            f" integer{f'; give it a unit: {text}{info.unit}' if info.unit else ''}"
        )
    return float(number)


def _parse_bytes(text: str, place: str) -> bytes:
    try:
        return parse_hex(text)
    except ValueError:
        raise UsageError(f"{place}: expected bytes in hexadecimal, got {text!r}") from None


def _parse_number(text: str, unit: str, place: str, expected: str) -> tuple[Fraction, str]:
    """Return the number and the unit in a text; the unit is "" if the text has none.

    Args:
        unit: the unit to convert to, if the text has a unit.
    """
    digits, unit_text = split_unit(text, unit)
    if unit_text:
        per_unit = factor(unit_text, unit)
    else:
        per_unit = Fraction(1)
    if per_unit is None:
        raise UsageError(
            f"{place}: the unit {unit_text!r} cannot be converted; expected {unit or 'no unit'}"
        )
    try:
        if digits[:2].lower() in ("0x", "0b", "0o"):
            number = Fraction(int(digits, 0))
        else:
            number = Fraction(digits)
    except ValueError:
        raise UsageError(f"{place}: expected {expected}, got {text!r}") from None
    return number * per_unit, unit_text


def _begins_a_number(text: str) -> bool:
    return text.lstrip("+-.")[:1].isdigit()


def _to_raw(info: FieldInfo, number: Fraction, path: str, place: str) -> int | float:
    """Return the raw value nearest to a physical value."""
    raw: int | float = info.raw(number)
    if info.kind != "int":
        return float(raw)
    low, high = info.limits
    if not low <= raw <= high:
        limits = [float(info.physical(Fraction(limit))) for limit in (low, high)]
        raise OutOfRange(path, float(number), *limits, unit=info.unit, place=place)
    return raw


def _find_length(table: Schema, given: Mapping[str, Any], path: str, place: str) -> int:
    """Return the length of an array, as declared or calculated from count fields."""
    declared = table.arrays.get(path)
    if isinstance(declared, int):
        return declared
    try:
        return int(evaluate(declared, functools.partial(read_given_value, given, table.fields)))  # type: ignore[arg-type]
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
            f"{place}: the number of elements of {path} is unknown: set its count field, or name"
            f" the elements one by one, as in {path}[0]=..."
        ) from None


def parse_arguments(sensor: Sensor, name: str, assignments: Sequence[str]) -> dict[str, Any]:
    """Return the arguments of a command from texts "argument=value".

    Numbers are converted to the units of their fields, and hexadecimal digits to bytes.

    Raises:
        UsageError: for an unknown command or argument, or an invalid value.
    """
    if name not in sensor.commands:
        hint = "" if sensor.commands else "; the sensor has no commands"
        raise UnknownCommand(name, sensor.commands, place=sensor.id, hint=hint)
    command = sensor.commands[name]
    given: dict[str, Any] = {}
    for text in assignments:
        argument, equals, value = text.partition("=")
        if not equals:
            raise UsageError(f"{sensor.id} {name}: {text!r} is not argument=value")
        if argument not in command.args or command.frame is None:
            raise UnknownField(argument, command.args, place=f"{sensor.id} {name}")
        slot = find_argument_slot(sensor, name, argument)
        kind = command.arguments[argument].kind
        place = f"{sensor.id} {name}: {argument}"
        if isinstance(kind, Range) and slot.info.labels and not _begins_a_number(value.strip()):
            given[argument] = value.strip()
        elif isinstance(kind, Range):
            unit = slot.info.unit
            number, _ = _parse_number(
                value.strip(), unit, place, f"a number in {unit}" if unit else "a number"
            )
            given[argument] = int(number) if number.denominator == 1 else float(number)
        else:
            given[argument] = _parse_bytes(value, place) if isinstance(kind, Octets) else value
    return given
