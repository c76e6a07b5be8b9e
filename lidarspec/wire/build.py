"""One frame from values: counts filled in, units turned into raw steps, faults of the caller named by field."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import construct
import numpy as np
from construct import Construct, Container

from lidarspec.errors import LidarSpecError, MissingField, OutOfRange, SpecError, UnknownCommand, UnknownField, UnknownFrame, UsageError
from lidarspec.spec.construct_layer import Mismatch, WireNaN, field_path, unwrap
from lidarspec.spec.description import Spec
from lidarspec.spec.fields import Checksummed
from lidarspec.spec.rules import children
from lidarspec.wire.schema import FieldInfo, Schema, schema


def build(sensor: Spec, frame: str, value: Any, values: Mapping[str, Any], *, units: bool = False) -> bytes:
    """See `Sensor.build`."""
    if frame not in sensor.frames:
        raise UnknownFrame(frame, sensor.frames, place=sensor.id)
    if value is not None and not isinstance(value, Mapping):
        raise UsageError(f"{sensor.id} {frame}: fields come by name, not as {type(value).__name__}")
    con, place = sensor.frames[frame].prepared, f"{sensor.id} {frame}"
    table, known = _fields(con)
    given = _Values(table, known, place, units=units).checked({**(value or {}), **values}, "")
    try:
        _fill_counts(con, given, table)
        return bytes(con.build(_openings(con, given)))
    except Mismatch as fault:
        raise _usage(fault, place) from None
    except construct.ConstructError as fault:
        reason = str(fault).partition("\n")[2].strip() or str(fault)
        raise UsageError(f"{place}: {field_path(fault.path) or 'frame'}: {reason}") from None
    except LidarSpecError:
        raise
    except Exception as fault:
        raise SpecError(f"an expression of the struct failed: {type(fault).__name__}: {fault}", path=frame, sensor=sensor.id) from fault


def _usage(fault: Mismatch, place: str) -> UsageError:
    path = field_path(fault.path)
    if fault.reason == "missing":
        return MissingField(path, place=place)
    if fault.reason == "checksum" and not path:
        raise SpecError(str(fault.got), path=place)
    return UsageError(f"{place}: {path or 'frame'}: expected {fault.expected}, got {fault.got}")


@functools.lru_cache(maxsize=1024)
def _fields(con: Construct) -> tuple[Schema, frozenset[str]]:
    """The fields of a frame type, and the paths of these and of all that holds them."""
    table = schema(con)
    known = set(table.fields) | set(table.arrays) | set(_named(con, ""))
    parts = [path.split(".") for path in known]
    return table, frozenset(known | {".".join(names[:depth]) for names in parts for depth in range(len(names))})


def _named(con: Construct, path: str) -> Iterator[str]:
    """The paths of all parts with a name, those without a field too."""
    if isinstance(con, construct.Renamed):
        path = f"{path}.{con.name}" if path else str(con.name)
        yield path
    for child in children(con):
        yield from _named(child, path)


class _Values:
    """The caller's values checked against the fields: names, ranges, and units where they are physical."""

    def __init__(self, table: Schema, known: frozenset[str], place: str, *, units: bool) -> None:
        self._table, self._known, self._place, self._units = table, known, place, units

    def checked(self, value: Any, path: str, shown: str = "") -> Any:
        info = self._table.fields.get(path)
        if isinstance(value, Mapping):
            return self._mapping(value, path, shown)
        if info is not None and info.kind == "bytes" and isinstance(value, bytes | bytearray):
            return bytes(value)
        if isinstance(value, np.ndarray):
            value = value.tolist()
        if isinstance(value, list | tuple):
            found = [self.checked(element, path, f"{shown}[{index}]") for index, element in enumerate(value)]
            return self._bytes(found, shown) if info is not None and info.kind == "bytes" else found
        return value if info is None or value is None else self._number(info, value, shown)

    def _mapping(self, value: Mapping[str, Any], path: str, shown: str) -> Container:
        found = Container()
        for name, element in value.items():
            if name.startswith("_"):
                continue
            below = f"{path}.{name}" if path else name
            if below not in self._known:
                raise UnknownField(below, [known for known in self._known if known], place=self._place)
            found[name] = self.checked(element, below, f"{shown}.{name}" if shown else name)
        return found

    def _bytes(self, found: list[Any], shown: str) -> bytes | list[Any]:
        """Numbers as a byte string; an array of byte strings, or of what another branch has there, stays one."""
        if not any(isinstance(part, int | str) for part in found):
            return found
        try:
            return bytes(found)
        except (TypeError, ValueError):
            raise UsageError(f"{self._place}: {shown} takes bytes, or numbers from 0 to 255, not {found!r:.60}") from None

    def _number(self, info: FieldInfo, value: Any, shown: str) -> Any:
        if isinstance(value, np.generic):
            value = value.item()
        if isinstance(value, str | WireNaN | bytes) or info.kind not in ("int", "float"):
            return value
        if self._units and info.scaled:
            value = (value - info.offset) / info.scale
        if info.kind == "float":
            return value if isinstance(value, int) else float(value)
        if isinstance(value, float):
            if not np.isfinite(value) or (not self._units and value != int(value)):
                raise UsageError(f"{self._place}: {shown} = {value} is not a raw integer; pass units=True for physical values")
            value = round(value)
        low, high = info.limits
        if not low <= value <= high:
            edges = (low * info.scale + info.offset, high * info.scale + info.offset) if self._units else (low, high)
            shown_value = value * info.scale + info.offset if self._units else value
            raise OutOfRange(shown, shown_value, *edges, unit=info.unit if self._units else "", place=self._place)
        return int(value)


def _openings(con: Construct, given: Container) -> Container:
    """The values with the constants, and with a place for each checksum, which fills it in itself."""
    for name, child in _members(con):
        inner = unwrap(child, bits=False)
        if isinstance(inner, construct.Const):
            given.setdefault(name, inner.value)
        if isinstance(inner, construct.Struct) and isinstance(given.get(name), dict):
            _openings(child, given[name])
    for seal in _seals(con):
        for dotted in seal.fields:
            *parents, last = dotted.split(".")
            target = given
            for parent in parents:
                target = target.setdefault(parent, Container())
            target.setdefault(last, None)
    return given


def _seals(con: Construct) -> Iterator[Checksummed]:
    while isinstance(con, construct.Subconstruct):
        if isinstance(con, Checksummed):
            yield con
        con = con.subcon


def _members(con: Construct) -> list[tuple[str, Construct]]:
    inner = unwrap(con)
    return [(child.name, child) for child in inner.subcons if child.name] if isinstance(inner, construct.Struct) else []


def _fill_counts(con: Construct, given: Container, table: Schema) -> None:
    """Set the header fields that arrays take their length from, where the caller left them out."""
    for axis, expression in table.arrays.items():
        if not callable(expression) or "[]" in axis:
            continue
        inner, _, name = axis.rpartition(".")
        scope, asked = _scope(given, inner), _asked_for(expression)
        if scope is None or not isinstance(scope.get(name), list | bytes) or asked is None:
            continue
        parent = inner
        while asked[0] == "_":
            parent, asked = parent.rpartition(".")[0], asked[1:]
        *levels, field = asked
        holder = _scope(given, parent)
        for level in levels:
            holder = holder.setdefault(level, Container())
        if holder.get(field) is None:
            info = table.fields.get(".".join(part for part in (parent, *asked) if part))
            context = functools.partial(_context, given, inner)
            holder[field] = _solved(expression, context, holder, field, len(scope[name]), info, axis)


def _scope(given: Any, path: str) -> Any:
    for name in path.split(".") if path else ():
        given = given.get(name) if isinstance(given, dict) else None
    return given if isinstance(given, dict) else None


def _context(given: Container, path: str) -> Container:
    """What an expression sees that stands in the struct at `path`: its fields, and under ``_`` those further out."""
    context = Container(given)
    for name in path.split(".") if path else ():
        context = Container(context[name], _=context)
    return context


def build_command(sensor: Spec, name: str, arguments: Mapping[str, Any]) -> bytes:
    """The bytes of a command, none for one that only moves lines.

    Args:
        arguments: by name, in the units of their fields.

    Raises:
        UnknownCommand: for a command that the sensor does not have.
        UnknownField, MissingField: for an argument that it does not take, or that is left out.
        OutOfRange: for one beyond its limits.
    """
    if name not in sensor.commands:
        raise UnknownCommand(name, sensor.commands, place=sensor.id)
    command, place = sensor.commands[name], f"{sensor.id} {name}"
    unknown = set(arguments) - set(command.args)
    if unknown:
        raise UnknownField(min(unknown), command.args, place=place)
    if command.frame is None:
        return b""
    fields = schema(sensor.frames[command.frame].prepared).fields
    values: dict[str, Any] = {}
    for path, value in command.values.items():
        _put(values, path, value)
    for argument, (path, low, high) in command.args.items():
        if argument not in arguments:
            raise MissingField(argument, place=place)
        value = arguments[argument]
        if not low <= value <= high:
            raise OutOfRange(argument, value, low, high, unit=fields[path].unit, place=place)
        raw = round((value - fields[path].offset) / fields[path].scale)
        bottom, top = fields[path].limits
        _put(values, path, min(max(raw, bottom), top))
    return build(sensor, command.frame, None, values)


def _put(values: dict[str, Any], path: str, value: Any) -> None:
    *parents, last = path.split(".")
    for parent in parents:
        values = values.setdefault(parent, {})
    values[last] = value


class _Asked(Exception):
    """Carries the path of the first field that an expression asks for."""


class _Recorder:
    """Stands in for a context and notes which field is asked for; arithmetic on it ends the search."""

    def __init__(self, path: tuple[str, ...] = ()) -> None:
        object.__setattr__(self, "_path", path)

    def __getitem__(self, name: str) -> _Recorder:
        return _Recorder((*object.__getattribute__(self, "_path"), name))

    def __getattr__(self, name: str) -> Any:
        return self[name]


for _operator in (
    "add",
    "sub",
    "mul",
    "floordiv",
    "truediv",
    "mod",
    "and",
    "or",
    "rshift",
    "lshift",
    "radd",
    "rsub",
    "rmul",
    "rand",
    "int",
    "index",
    "eq",
    "lt",
    "gt",
    "le",
    "ge",
    "neg",
):

    def _stop(self: _Recorder, *_: Any) -> Any:
        raise _Asked(object.__getattribute__(self, "_path"))

    setattr(_Recorder, f"__{_operator}__", _stop)


def _asked_for(expression: Any) -> tuple[str, ...] | None:
    try:
        found = expression(_Recorder())
    except _Asked as asked:
        return tuple(asked.args[0]) or None
    except Exception:
        return None
    return tuple(object.__getattribute__(found, "_path")) if isinstance(found, _Recorder) else None


def _solved(
    expression: Any, context: Callable[[], Container], holder: Container, field: str, length: int, info: FieldInfo | None, axis: str
) -> int:
    """The value of the count field that gives this length."""
    top = info.limits[1] if info is not None and info.kind == "int" else 65535

    def gives(value: int) -> bool:
        holder[field] = value
        try:
            return bool(expression(context()) == length)
        except Exception:
            return False

    for value in (length, *range(int(min(top, 65535)) + 1)):
        if value <= top and gives(value):
            return int(value)
    raise UsageError(f"{axis}: no value of {field} gives {length} elements")
