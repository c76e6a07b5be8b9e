"""One frame from values: counts filled in, units turned into raw steps, faults of the caller named
by field.
"""

from __future__ import annotations

import bisect
import copy
import functools
import itertools
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import construct
import numpy as np
from construct import Container

from lidarspec.errors import (
    LidarSpecError,
    MissingField,
    OutOfRange,
    SpecError,
    UnknownCommand,
    UnknownField,
    UnknownFrame,
    UsageError,
)
from lidarspec.frames.layout import Layout
from lidarspec.frames.layout_tree import TooLong, Unknown, layout_of
from lidarspec.frames.schema import Schema, schema
from lidarspec.frames.slots import SPELLING, Recoder, recoder
from lidarspec.spec.arguments import Address, Count, Filled, Range, Taken
from lidarspec.spec.description import Spec
from lidarspec.spec.syntax import Mismatch, WireNaN, field_path, member, seen
from lidarspec.spec.tree import (
    Blob,
    FieldInfo,
    Formula,
    Kind,
    Node,
    Number,
    Parts,
    Read,
    Sealed,
    Struct,
    evaluated,
    nodes,
    refs,
)

#: how often a frame is built until its lengths agree: once more where it has any, and again where
#: these themselves have no fixed length.
RETRIES = 4
#: The largest value that is tried for a field that counts.
LARGEST_TRIED = 65535

#: names of fields, and indices: a number, or "*" for every element.
Steps = list[int | str]


def build(
    sensor: Spec, frame: str, value: Any, values: Mapping[str, Any], *, units: bool = False
) -> bytes:
    """The bytes of one frame; constants, counts and the checksum are filled in.

    Args:
        value: a mapping of all fields, such as what `parse` returned, or None; `values` override
            it.
        units: take physical values, and round them to the wire's steps.

    Raises:
        UsageError: for a missing or unknown field, or a value that its field cannot hold.
    """
    if frame not in sensor.frames:
        raise UnknownFrame(frame, sensor.frames, place=sensor.id)
    if value is not None and not isinstance(value, Mapping):
        raise UsageError(f"{sensor.id} {frame}: fields come by name, not as {type(value).__name__}")
    tree, place = sensor.frames[frame].tree, f"{sensor.id} {frame}"
    table, known = _fields(tree)
    given = _Values(table, known, place, units=units).checked({**(value or {}), **values}, "")
    try:
        _fill(tree, given, sensor.frames[frame].room)
        data = _built(sensor.frames[frame].prepared, given)
        recoding = recoder(sensor.frames[frame])
        return (
            data
            if recoding is None
            else _written(recoding, data, (value or {}).get(SPELLING), place)
        )
    except Mismatch as fault:
        raise _usage(fault, place) from None
    except construct.ConstructError as fault:
        reason = str(fault).partition("\n")[2].strip() or str(fault)
        raise UsageError(f"{place}: {field_path(fault.path) or 'frame'}: {reason}") from None
    except LidarSpecError:
        raise
    except Exception as fault:
        raise SpecError(
            f"an expression of the struct failed: {type(fault).__name__}: {fault}",
            path=frame,
            sensor=sensor.id,
        ) from fault


def _built(con: Any, given: Container) -> bytes:
    """The bytes of a frame, built once more where fields say how long parts are, which is seen when
    these are built.
    """
    sizes, data = dict[str, int](), b""
    for _ in range(RETRIES):
        known = dict(sizes)
        data = con.build(given, _sizes=sizes)
        if sizes == known:
            break
    return bytes(data)


def _written(recoding: Recoder, row: bytes, spelling: object, place: str) -> bytes:
    """A row on the wire, as it was spelled if it says the same.

    Raises:
        UsageError: for values that its form cannot write.
    """
    if (
        isinstance(spelling, bytes)
        and (known := recoding.row(spelling)) is not None
        and known[1] == row
    ):
        return spelling
    layout = recoding.tree.layout(row)
    data = (
        recoding.written(np.frombuffer(row, np.uint8).reshape(1, -1), layout)[0]
        if isinstance(layout, Layout)
        else None
    )
    if data is None:
        raise UsageError(
            f"{place}: {recoding.form} cannot write these values: a number is too large for its"
            " digits, or a text has a mark in it"
        )
    return data


def _usage(fault: Mismatch, place: str) -> UsageError:
    path = field_path(fault.path)
    if fault.reason == "missing":
        return MissingField(path, place=place)
    if fault.reason == "checksum" and not path:
        raise SpecError(str(fault.got), path=place)
    return UsageError(f"{place}: {path or 'frame'}: expected {fault.expected}, got {fault.got}")


@functools.lru_cache(maxsize=1024)
def _fields(tree: Node) -> tuple[Schema, frozenset[str]]:
    """The fields of a frame type, and the paths of these and of all that holds them."""
    table = schema(tree)
    named = {
        f"{node.path}.{member.name}".strip(".")
        for node in nodes(tree)
        if isinstance(node, Struct)
        for member in node.members
    }
    parts = [path.split(".") for path in {*table.all_fields, *table.arrays, *named}]
    return table, frozenset(
        ".".join(names[:depth]) for names in parts for depth in range(len(names) + 1)
    )


class _Values:
    """The caller's values checked against the fields: names, ranges, and units where they are
    physical.
    """

    def __init__(self, table: Schema, known: frozenset[str], place: str, *, units: bool) -> None:
        self._table, self._known, self._place, self._units = table, known, place, units

    def checked(self, value: Any, path: str, shown: str = "") -> Any:
        info = self._table.all_fields.get(path)
        if info is not None and info.kind == "other" and not (self._units and info.scaled):
            return value  # construct alone knows what it takes
        if isinstance(value, Mapping):
            return self._mapping(value, path, shown)
        if info is not None and info.kind == "bytes" and isinstance(value, bytes | bytearray):
            return bytes(value)
        if isinstance(value, np.ndarray):
            value = value.tolist()
        if isinstance(value, list | tuple):
            found = [
                self.checked(element, path, f"{shown}[{index}]")
                for index, element in enumerate(value)
            ]
            return self._bytes(found, shown) if info is not None and info.kind == "bytes" else found
        return value if info is None or value is None else self._number(info, value, shown)

    def _mapping(self, value: Mapping[str, Any], path: str, shown: str) -> Container:
        found = Container()
        for name, element in value.items():
            if name.startswith("_"):
                continue
            below = f"{path}.{name}" if path else name
            if below not in self._known:
                raise UnknownField(
                    below, [known for known in self._known if known], place=self._place
                )
            found[name] = self.checked(element, below, f"{shown}.{name}" if shown else name)
        return found

    def _bytes(self, found: list[Any], shown: str) -> bytes | list[Any]:
        """Numbers as a byte string; an array of byte strings, or of what another branch has there,
        stays one.
        """
        if not any(isinstance(part, int | str) for part in found):
            return found
        try:
            return bytes(found)
        except (TypeError, ValueError):
            raise UsageError(
                f"{self._place}: {shown} takes bytes, or numbers from 0 to 255, not {found!r:.60}"
            ) from None

    def _number(self, info: FieldInfo, value: Any, shown: str) -> Any:
        if isinstance(value, np.generic):
            value = value.item()
        if isinstance(value, str | WireNaN | bytes):
            return value
        if info.kind not in ("int", "float"):
            return (
                info.raw(value)
                if self._units and info.scaled and isinstance(value, int | float)
                else value
            )
        if info.kind == "float":
            raw = info.raw(value) if self._units else value
            return raw if isinstance(raw, int) else float(raw)
        if isinstance(value, float) and (
            not np.isfinite(value) or (not self._units and value != int(value))
        ):
            raise UsageError(
                f"{self._place}: {shown} = {value} is not a raw integer; pass units=True for"
                " physical values"
            )
        raw = info.raw(value) if self._units else int(value)
        low, high = info.limits
        if not low <= raw <= high:
            told = [info.physical(part) if self._units else part for part in (raw, low, high)]
            raise OutOfRange(shown, *told, unit=info.unit if self._units else "", place=self._place)
        return int(raw)


def _fill(root: Node, given: Container, limit: int) -> dict[str, int]:
    """Add what follows from the values of a frame, or of a part: counts, constants, the sizes of
    parts; the bytes of these, by path.
    """
    table = schema(root)
    _fill_counts(given, table)
    _open(root, given, given)
    totals = dict[str, int]()
    for node in table.parts.values():
        sizes = _fill_parts(node, given, table, limit)
        if sizes is not None:
            totals[node.total.path] = sum(sizes)
    return totals


def _fill_parts(node: Parts, given: Container, table: Schema, limit: int) -> list[int] | None:
    """Fill in parts, and what says how many there are and how long; their sizes, None where they
    are not given as they have to be.
    """
    parts, sizes = member(given, node.axis, None), list[int]()
    if not isinstance(parts, list) or not all(isinstance(part, dict) for part in parts):
        return None  # construct says what is wrong
    kinds = [kind_of(node, part) for part in parts]
    around = {
        ref.path: value[1]
        for ref in node.outer
        if isinstance(value := given_value(given, table.fields, ref.path), tuple)
    }
    for kind, part in zip(kinds, parts, strict=True):
        totals = _fill(kind.root, part, limit)
        sizes.append(_size_of(kind.root, part, limit, totals, around))
    for kind, part, after in zip(kinds, parts, [*sizes[1:], 0], strict=False):
        fill_in(kind.following, part, after, schema(kind.root).fields, node.axis)
    for formula, number in (
        (node.count, len(parts)),
        (node.size, (sizes or [0])[0]),
        (node.within, sum(sizes)),
    ):
        fill_in(formula, given, number, table.fields, node.axis)
    return sizes


def kind_of(node: Parts, part: Mapping[str, Any]) -> Kind:
    """The kind of a part that is given by its values: the first that has all fields of these, and
    no other constant; else the first.
    """

    def fits(kind: Kind) -> bool:
        fields, names = _fields(kind.root)
        given = (
            (info, part.get(path)) for path, info in fields.fields.items() if info.const is not None
        )
        return part.keys() <= {*names, *fields.parts} and all(
            value in (None, info.const, info.labels.get(info.const)) for info, value in given
        )

    return next(filter(fits, node.kinds), node.kinds[0])


def _size_of(
    root: Node, part: Container, limit: int, totals: Mapping[str, int], around: Mapping[str, int]
) -> int:
    """The bytes of a part with these values, by its layout.

    Raises:
        MissingField: for a field that decides how long it is.
        UsageError: where it is longer than the frame may be.
    """
    values, fields = dict(totals), schema(root).fields
    while True:
        try:
            return layout_of(root, values, limit, around).size
        except Unknown as unknown:
            path = unknown.leaf.info.path
            found = (
                given_value(part, fields, path) if member(part, path, None) is not None else None
            )
            if not isinstance(found, tuple):
                raise MissingField(path) from None
            values[path] = int(found[1])
        except TooLong:
            raise UsageError(
                f"a part is longer than the {limit} bytes that a frame has at most"
            ) from None


def fill_in(
    formula: Formula | None,
    given: Container,
    value: int,
    fields: Mapping[str, FieldInfo],
    axis: str,
) -> None:
    """Set the field that a formula depends on, where it is left out, so that the formula gives a
    value.
    """
    asked = (
        ()
        if formula is None
        else tuple(ref for ref in refs(formula) if ref.path in fields and "[" not in ref.path)
    )
    if formula is None or not asked:
        return
    holder, name = _place(given, asked[0].path)
    if isinstance(holder, dict) and holder.get(name) is None:
        read = functools.partial(given_value, given, fields)
        holder[name] = _find_count(formula, read, holder, name, value, fields[asked[0].path], axis)


def _open(node: Node, given: Any, values: Container) -> None:
    """Add to the values of a part (`given`, of all `values`) the constants, and a place for each
    checksum, which is filled in later.
    """
    match node:
        case Sealed():
            _open(node.body, given, values)
            for path in node.fields:
                holder, name = _place(values, path)
                holder.setdefault(name, None)
        case Struct():
            for member in node.members:
                if isinstance(member, Struct | Sealed) and isinstance(given.get(member.name), dict):
                    _open(member, given[member.name], values)
                elif (
                    isinstance(member, Number | Blob)
                    and member.name
                    and member.info.const is not None
                ):
                    given.setdefault(member.name, seen(member.info, member.info.const))


def _fill_counts(given: Container, table: Schema) -> None:
    """Set the header fields that arrays take their length from, where the caller left them out."""
    for axis, count in table.arrays.items():
        array = member(given, axis, None)
        if isinstance(array, list | bytes):
            fill_in(count, given, len(array), table.fields, axis)


def given_value(
    given: Mapping[str, Any], fields: Mapping[str, FieldInfo], path: str
) -> tuple[FieldInfo, Any] | str | None:
    """A value that is given for a frame, as formulas read it (`lidarspec.spec.tree.Read`).

    Raises:
        LookupError: where there is none.
    """
    value: Any = given
    for step in steps(path):
        value = value[step]
    if isinstance(value, Mapping) or path not in fields:
        return path
    info = fields[path]
    raw = (
        next((raw for raw, name in info.labels.items() if name == value), value)
        if isinstance(value, str)
        else value
    )
    return None if value is None else (info, raw)


def build_command(sensor: Spec, name: str, arguments: Mapping[str, Any]) -> bytes:
    """The bytes of a command, none for one that only moves lines.

    Args:
        arguments: by name, in the units of their fields; a value that is found out when it is sent
            by its path.

    Raises:
        UnknownCommand: for a command that the sensor does not have.
        UnknownField, MissingField: for an argument that it does not take, or that is left out.
        OutOfRange: for one beyond its limits.
    """
    if name not in sensor.commands:
        raise UnknownCommand(name, sensor.commands, place=sensor.id)
    command, place = sensor.commands[name], f"{sensor.id} {name}"
    unknown = set(arguments) - set(command.args) - set(command.filled)
    if unknown:
        raise UnknownField(min(unknown), command.args, place=place)
    if command.frame is None:
        return b""
    values: Any = {}
    for path, value in command.values.items():
        filled = (
            _found_out(sensor, name, path, value, arguments.get(path))
            if path in command.filled
            else copy.deepcopy(value)
        )
        values = put(values, steps(path), filled)
    for argument, declared in command.arguments.items():
        slot = argument_slot(sensor, name, argument)
        if argument not in arguments:
            raise MissingField(argument, place=place)
        values = put(
            values,
            steps(declared.path),
            raw_argument(slot, declared.kind, arguments[argument], argument, place),
        )
    return build(sensor, command.frame, None, values)


@dataclass(frozen=True)
class Slot:
    """Where an argument goes: its field; and how many bytes, or numbers of an array, there are for
    it, None where that varies.
    """

    info: FieldInfo
    room: int | None
    is_array: bool = False


def argument_slot(sensor: Spec, name: str, argument: str) -> Slot:
    """Where an argument of a command goes.

    Raises:
        SpecError: where its kind of value cannot stand there.
    """
    declared, place = sensor.commands[name].arguments[argument], f"commands.{name}.args.{argument}"
    slot = _slot(sensor, name, declared.path, place)
    takes = (
        {"int", "float"}
        if isinstance(declared.kind, Range)
        else {"bytes", "other"} | ({"int"} if slot.is_array else set())
    )
    takes |= {"int"} if isinstance(declared.kind, Address) else set()
    if slot.info.kind not in takes or (slot.is_array and isinstance(declared.kind, Range)):
        what = (
            f"an array, of which an element is {declared.path}[0]"
            if slot.is_array
            else f"a field of kind {slot.info.kind!r}"
        )
        raise SpecError(
            f"{type(declared.kind).__name__} cannot stand in {declared.path!r}, which is {what}",
            path=place,
            sensor=sensor.id,
        )
    return slot


def _slot(sensor: Spec, name: str, path: str, place: str) -> Slot:
    frame, names = sensor.commands[name].frame or "", steps(path)
    table = schema(sensor.frames[frame].tree) if frame else None
    info = (
        table.all_fields.get(".".join(step for step in names if isinstance(step, str)))
        if table is not None
        else None
    )
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
            for below, count in schema(kind.root).arrays.items()
        }
    indices, counts = (
        [step for step in names if isinstance(step, int)],
        [arrays.get(axis) for axis in info.axes],
    )
    left = counts[len(indices) :]
    if len(left) > 1 or len(indices) > len(counts) - (info.kind == "bytes"):
        reason = (
            f"{path!r} names {len(indices)} elements of the {len(counts) - (info.kind == 'bytes')}"
            " arrays that its field is in"
        )
        raise SpecError(reason, path=place, sensor=sensor.id)
    for index, count in zip(indices, counts, strict=False):
        if isinstance(count, int) and index >= count:
            raise SpecError(
                f"{path!r}: there are {count} elements, of which {index} is none",
                path=place,
                sensor=sensor.id,
            )
    room = left[0] if left else info.bits // 8 if info.kind == "int" else None
    return Slot(info, room if isinstance(room, int) else None, bool(left) and info.kind != "bytes")


def raw_argument(slot: Slot, kind: Taken, value: Any, argument: str, place: str) -> Any:
    """The raw value of a field that an argument stands for.

    Raises:
        UsageError: for what it does not take.
    """
    info = slot.info
    if isinstance(kind, Range):
        if not isinstance(value, int | float | np.number):
            raise UsageError(f"{place}: {argument} is a number, not {value!r:.60}")
        if not kind.low <= value <= kind.high:
            raise OutOfRange(argument, value, kind.low, kind.high, unit=info.unit, place=place)
        raw = info.raw(value)
        bottom, top = info.limits if info.kind == "int" else (raw, raw)
        return min(max(raw, bottom), top)
    try:
        data = kind.packed(value, slot.room)
    except ValueError:
        raise UsageError(
            f"{place}: {argument} is {kind.words(slot.room)}, not {value!r:.60}"
        ) from None
    if info.kind == "other":
        return data if isinstance(value, bytes) else str(value)
    return _placed(slot, data)


def _placed(slot: Slot, data: bytes) -> Any:
    """Bytes as the raw value of a field that is plain bytes, an array of numbers, or one number in
    network order.
    """
    return (
        data
        if slot.info.kind == "bytes"
        else list(data)
        if slot.is_array
        else int.from_bytes(data, "big")
    )


def _found_out(sensor: Spec, name: str, path: str, value: Filled, given: Any) -> Any:
    """A value that is found out when a command is sent; where nobody says it, the first number, and
    no address.
    """
    if isinstance(value, Count):
        return value.first if given is None else given
    slot = _slot(sensor, name, path, f"commands.{name}.values.{path}")
    return (
        _placed(slot, bytes(slot.room or 4))
        if given is None
        else raw_argument(slot, value, given, path, f"{sensor.id} {name}")
    )


def is_index(step: int | str) -> bool:
    """Whether a step of a path leads to elements of an array."""
    return step == "*" or isinstance(step, int)


def steps(path: str) -> Steps:
    """The names and indices of a path: ["points", 3, "distance"] of "points[3].distance"."""
    return [int(step) if step.isdigit() else step for step in re.findall(r"\w+|\*", path)]


def put(
    target: Any,
    path: Steps,
    value: Any,
    length: Callable[[str], int] = lambda array: 0,
    place: str = "",
) -> Any:
    """A struct or array, or a new one for None, with a value set in it.

    Args:
        length: how many elements the array of a path has, where that is known; "*" stands for each
            of them.
    """
    if not path:
        return value
    step, *rest = path
    if not is_index(step):
        target = {} if target is None else target
        target[step] = put(
            target.get(step),
            rest,
            value,
            length,
            f"{place.removesuffix('[]')}.{step}".removeprefix("."),
        )
        return target
    target = [] if target is None else list(target)
    for index in range(length(place) or len(target)) if step == "*" else [int(step)]:
        target.extend([None] * (index + 1 - len(target)))
        element = target[index]
        target[index] = put(
            dict(element) if isinstance(element, dict) else element,
            rest,
            value,
            length,
            f"{place}[]",
        )
    return target


def _place(values: Any, path: str) -> tuple[Any, str]:
    """Which of nested mappings holds a field, and under which name; those on the way are made where
    they are not there.
    """
    *parents, last = path.split(".")
    for parent in parents:
        values = values.setdefault(parent, Container())
    return values, last


def _find_count(
    count: Formula,
    read: Read,
    holder: Container,
    field: str,
    length: int,
    info: FieldInfo,
    axis: str,
) -> int:
    """Return the value of the count field that gives this length, and leave it in its holder."""
    top = int(info.limits[1]) if info.kind == "int" else LARGEST_TRIED

    def length_for(value: int) -> Any:
        holder[field] = value
        try:
            return evaluated(count, read)
        except Exception:  # an expression of the struct, that may divide by what is tried
            return -1

    tried = range(min(top, LARGEST_TRIED) + 1)
    # Mostly the length itself, or a number that the length grows with.
    if length <= top and length_for(length) == length:
        return length
    guess = bisect.bisect_left(tried, length, key=length_for)
    for value in itertools.chain((guess,), tried):
        if value <= top and length_for(value) == length:
            return value
    raise UsageError(f"{axis}: no value of {field} gives {length}")
