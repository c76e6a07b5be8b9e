"""Build the frame of a command from its arguments."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lidarspec.errors import (
    MissingField,
    OutOfRange,
    SpecError,
    UnknownCommand,
    UnknownField,
    UsageError,
)
from lidarspec.frames.build import build
from lidarspec.frames.field_paths import put_value, split_path
from lidarspec.frames.schema import make_schema
from lidarspec.spec.arguments import (
    Address,
    Argument,
    Choice,
    Count,
    Port,
    Range,
    Taken,
    Template,
    Text,
)
from lidarspec.spec.sensor import SensorDescription
from lidarspec.spec.tree import FieldInfo


def build_command(sensor: SensorDescription, name: str, arguments: Mapping[str, Any]) -> bytes:
    """Return the bytes of a command; b"" for a command that only sets control lines.

    Args:
        arguments: the arguments by name, in the units of their fields.

    Raises:
        UnknownCommand: if the sensor has no such command.
        UnknownField: for an argument that the command does not have.
        MissingField: for an argument that is missing.
        OutOfRange: for a value that exceeds the limits of the argument.
        SpecError: if neither the declaration nor an argument gives a field of the frame a value.
    """
    if name not in sensor.commands:
        raise UnknownCommand(name, sensor.commands, place=sensor.id)
    command = sensor.commands[name]
    place = f"{sensor.id} {name}"
    unknown = set(arguments) - set(command.args) - set(command.filled) - command.placeholders
    if unknown:
        raise UnknownField(min(unknown), command.args, place=place)
    if command.frame is None:
        return b""
    values: Any = {}
    for path, value in command.values.items():
        if isinstance(value, Template):
            continue
        if path in command.filled:
            filled = _resolve_filled_value(sensor, name, path, value, arguments.get(path))
        else:
            filled = copy.deepcopy(value)
        values = put_value(values, split_path(path), filled)
    for argument, declared in command.arguments.items():
        slot = find_argument_slot(sensor, name, argument)
        if argument not in arguments:
            raise MissingField(argument, place=place)
        if declared.path in command.templates:
            to_raw_argument(slot, declared.kind, arguments[argument], argument, place)
            continue
        values = put_value(
            values,
            split_path(declared.path),
            to_raw_argument(slot, declared.kind, arguments[argument], argument, place),
        )
    for path, template in command.templates.items():
        text = _fill_template(template, arguments, place)
        values = put_value(values, split_path(path), text)
    try:
        return build(sensor, command.frame, None, values)
    except MissingField as error:
        raise SpecError(
            f"neither `values` nor `args` gives the field {error.path!r} of {command.frame} a"
            " value",
            path=f"commands.{name}",
            sensor=sensor.id,
        ) from error


def _fill_template(template: Template, arguments: Mapping[str, Any], place: str) -> bytes:
    """Return the text of a template; missing values are 0."""
    given = {name: arguments.get(name, 0) for name in template.names}
    try:
        return template.fill(given)
    except ValueError as error:
        raise UsageError(f"{place}: {error}") from None


@dataclass(frozen=True)
class ArgumentSlot:
    """The field of a command frame that an argument is written to.

    Attributes:
        info: the field.
        length: the size of the field in bytes, or the number of elements of an array; None if it
            varies.
        is_in_template: whether the argument is inserted into a text (`Template`).
    """

    info: FieldInfo
    length: int | None
    is_array: bool = False
    is_in_template: bool = False


def find_argument_slot(sensor: SensorDescription, name: str, argument: str) -> ArgumentSlot:
    """Return the field that an argument of a command is written to.

    Raises:
        SpecError: if the field is not suitable for this kind of argument.
    """
    declared = sensor.commands[name].arguments[argument]
    place = f"commands.{name}.args.{argument}"
    slot = _make_slot(sensor, name, declared.path, place)
    template = sensor.commands[name].templates.get(declared.path)
    if template is not None:
        return _find_template_slot(sensor, template, declared, argument, place)
    if isinstance(declared.kind, Range):
        takes = {"int", "float"}
    else:
        takes = {"bytes", "other"} | ({"int"} if slot.is_array else set())
    takes |= {"int"} if isinstance(declared.kind, Address) else set()
    if slot.info.kind not in takes or (slot.is_array and isinstance(declared.kind, Range)):
        if slot.is_array:
            what = f"an array; to set one element, name {declared.path}[0]"
        else:
            what = f"a field of kind {slot.info.kind!r}"
        raise SpecError(
            f"{type(declared.kind).__name__} cannot set {declared.path!r}, which is {what}",
            path=place,
            sensor=sensor.id,
        )
    if isinstance(declared.kind, Choice):
        low, high = slot.info.limits
        is_integer = slot.info.kind == "int" and not slot.info.scaled
        if not is_integer or not low <= declared.kind.low <= declared.kind.high <= high:
            raise SpecError(
                f"Choice cannot set {declared.path!r}: the field must be an unscaled"
                " integer that can contain all numbers of the Choice",
                path=place,
                sensor=sensor.id,
            )
        names = {raw: text for text, raw in declared.kind.names.items()}
        return replace(slot, info=replace(slot.info, labels=names))
    return slot


def _find_template_slot(
    sensor: SensorDescription, template: Template, declared: Argument, argument: str, place: str
) -> ArgumentSlot:
    """Return the slot of an argument that is a part of a template."""
    is_text = isinstance(declared.kind, Range | Text) and not isinstance(declared.kind, Choice)
    if argument not in template.names or not is_text:
        raise SpecError(
            f"the argument {argument!r} must be named in the text {template.text!r}, and must be"
            " declared with a range or Text(size)",
            path=place,
            sensor=sensor.id,
        )
    if isinstance(declared.kind, Range):
        return ArgumentSlot(FieldInfo(declared.path, kind="float"), None, is_in_template=True)
    return ArgumentSlot(FieldInfo(declared.path, kind="bytes"), None, is_in_template=True)


def _make_slot(sensor: SensorDescription, name: str, path: str, place: str) -> ArgumentSlot:
    frame = sensor.commands[name].frame or ""
    names = split_path(path)
    table = make_schema(sensor.frames[frame].tree) if frame else None
    if table is not None:
        info = table.all_fields.get(".".join(step for step in names if isinstance(step, str)))
    else:
        info = None
    if table is None or info is None:
        raise SpecError(
            f"{frame or 'a command without a frame'} has no field {path!r}",
            path=place,
            sensor=sensor.id,
        )
    arrays = dict(table.arrays)
    for axis, node in table.parts.items():
        arrays |= {
            f"{axis}.{below}": count
            for kind in node.kinds
            for below, count in make_schema(kind.root).arrays.items()
        }
    indices = [step for step in names if isinstance(step, int)]
    counts = [arrays.get(axis) for axis in info.axes]
    left = counts[len(indices) :]
    if len(left) > 1 or len(indices) > len(counts) - (info.kind == "bytes"):
        reason = (
            f"{path!r} has {len(indices)} indices, but the field is inside"
            f" {len(counts) - (info.kind == 'bytes')} arrays"
        )
        raise SpecError(reason, path=place, sensor=sensor.id)
    for index, count in zip(indices, counts, strict=False):
        if isinstance(count, int) and index >= count:
            raise SpecError(
                f"{path!r}: index {index} is out of range for {count} elements",
                path=place,
                sensor=sensor.id,
            )
    if left:
        length = left[0]
    elif info.kind == "int":
        length = info.bits // 8
    else:
        length = None
    return ArgumentSlot(
        info, length if isinstance(length, int) else None, bool(left) and info.kind != "bytes"
    )


def to_raw_argument(slot: ArgumentSlot, kind: Taken, value: Any, argument: str, place: str) -> Any:
    """Convert the value of an argument to the raw value of its field.

    Raises:
        UsageError: for a value that the argument does not accept.
    """
    info = slot.info
    if isinstance(kind, Range):
        if isinstance(value, str) and info.labels:
            value = _find_named_value(info, kind, value, f"{place}: {argument}")
        if not isinstance(value, int | float | np.number):
            raise UsageError(f"{place}: {argument} must be a number, not {value!r:.60}")
        if isinstance(kind, Choice) and value not in kind.names.values():
            choices = ", ".join(f"{name} ({number})" for name, number in kind.names.items())
            raise UsageError(f"{place}: {argument} must be one of {choices}, not {value!r:.60}")
        if not kind.low <= value <= kind.high:
            raise OutOfRange(argument, value, kind.low, kind.high, unit=info.unit, place=place)
        raw = info.raw(value)
        bottom, top = info.limits if info.kind == "int" else (raw, raw)
        return min(max(raw, bottom), top)
    try:
        data = kind.pack(value, slot.length)
    except ValueError:
        raise UsageError(
            f"{place}: {argument} must be {kind.describe(slot.length)}, not {value!r:.60}"
        ) from None
    if info.kind == "other":
        if isinstance(value, bytes):
            return data
        return str(value)
    return _to_raw_value(slot, data)


def list_choices(info: FieldInfo, kind: Range) -> dict[str, float]:
    """Return the names that an argument accepts, and their physical values."""
    values = {name: info.physical(raw) for raw, name in info.labels.items()}
    return {name: value for name, value in values.items() if kind.low <= value <= kind.high}


def has_only_names(kind: Range, choices: Mapping[str, float]) -> bool:
    """Return whether the names cover all numbers that an argument accepts."""
    return isinstance(kind, Choice) or len(choices) > kind.high - kind.low


def _find_named_value(info: FieldInfo, kind: Range, name: str, place: str) -> float:
    """Return the physical value for a name that an argument accepts."""
    choices = list_choices(info, kind)
    if name not in choices:
        raise UsageError(f"{place} must be {' or '.join(choices) or 'a number'}, not {name!r:.60}")
    return choices[name]


def _to_raw_value(slot: ArgumentSlot, data: bytes) -> Any:
    """Convert bytes to the raw value of a field."""
    if slot.info.kind == "bytes":
        return data
    if slot.is_array:
        return list(data)
    return int.from_bytes(data, "big")


def _resolve_filled_value(
    sensor: SensorDescription, name: str, path: str, value: Count | Address | Port, given: Any
) -> Any:
    """Return the raw value of a field that is filled in when a command is sent.

    Args:
        value: the declaration of what is filled in: a count, an address or a port.
        given: the value to fill in; None for the first count, the address 0 or the port 0.
    """
    if isinstance(value, Count):
        if given is None:
            return value.first
        return given
    if isinstance(value, Port):
        return given or 0
    slot = _make_slot(sensor, name, path, f"commands.{name}.values.{path}")
    if given is None:
        return _to_raw_value(slot, bytes(slot.length or 4))
    return to_raw_argument(slot, value, given, path, f"{sensor.id} {name}")
