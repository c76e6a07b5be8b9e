"""The thin layer over construct: one struct, made fit for the engine, and construct's errors made ours.

`prepare` copies an author's tree with a few classes replaced, and nothing else changed: structs note where their
members stand, arrays put the index into error paths, constants can be read unchecked, and a NaN keeps its payload.
"""

from __future__ import annotations

import copy
import math
import operator
import re
import struct
from typing import Any, NamedTuple

import construct
from construct import (
    Array,
    BitsInteger,
    Bytes,
    BytesInteger,
    Const,
    Construct,
    ConstructError,
    Container,
    FormatField,
    Struct,
    Subconstruct,
)

_MISSING = object()

#: what a constant without a name is called.
UNNAMED = "(constant)"


class Mismatch(ConstructError):  # type: ignore[misc]
    """A value on the wire that is not what the spec asks for; made a `WireError` by the engine."""

    def __init__(self, path: str, offset: int, expected: object, got: object, reason: str) -> None:
        super().__init__(f"{reason}: expected {expected}, got {got}", path=path)
        self.offset, self.expected, self.got, self.reason = offset, expected, got, reason


class Seen(NamedTuple):
    """A part that was parsed: construct's path, first byte and the one after its last, the value, and the construct if it is a seal.

    Within a bit block `start` and `end` count what the block was unpacked to.
    """

    path: str
    start: int
    end: int
    value: Any
    seal: Any = None


def note(context: Any, path: str, start: int, end: int, value: Any, seal: Any = None) -> None:
    """Add a `Seen` to the list that a parse was given as ``_trail``, so that a parse that fails has still said how far it came."""
    trail = context._params.get("_trail")
    if trail is not None:
        trail.append(Seen(path, start, end, value, seal))


class WireNaN(float):
    """A NaN that keeps its bits, so that a signalling NaN is built as it was parsed."""

    raw: bytes

    def __new__(cls, raw: bytes) -> WireNaN:
        value = super().__new__(cls, math.nan)
        value.raw = raw
        return value

    def __reduce__(self) -> tuple[type[WireNaN], tuple[bytes]]:
        return WireNaN, (self.raw,)


class MarkedStruct(Struct):  # type: ignore[misc]
    """A Struct whose parsed container holds, under ``_marks``, the (start, end) of each member in the stream."""

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        marks: dict[str, tuple[int, int]] = {}
        obj = Container()
        inner = Container(_=context, _params=context._params, _root=None, _parsing=True, _building=False, _sizing=False)
        inner._subcons, inner._io, inner._index = self._subcons, stream, context.get("_index", None)
        inner._root = context.get("_root", None) or inner
        for con in self.subcons:
            start = stream.tell()
            value = con._parsereport(stream, inner, path)
            note(context, f"{path} -> {con.name or UNNAMED}", start, stream.tell(), value)
            if con.name:
                obj[con.name] = inner[con.name] = value
                marks[con.name] = (start, stream.tell())
        obj["_marks"] = marks
        return obj

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> Any:
        obj = {} if obj is None else obj
        if not isinstance(obj, dict):
            raise Mismatch(path, 0, "a mapping of its fields", repr(obj), "value")
        for con in self.subcons:
            if not con.flagbuildnone and con.name not in obj:
                raise Mismatch(f"{path} -> {con.name}", 0, "a value", "none", "missing")
        return super()._build(obj, stream, context, path)


class IndexedArray(Array):  # type: ignore[misc]
    """An Array that says in an error's path which element it was."""

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        count = construct.evaluate(self.count, context)
        if count < 0:
            raise construct.RangeError(f"invalid count {count}", path=path)
        found = construct.ListContainer()
        for index in range(count):
            context._index = index
            start = stream.tell()
            found.append(self.subcon._parsereport(stream, context, f"{path}[{index}]"))
            note(context, f"{path}[{index}]", start, stream.tell(), found[-1])
        return found

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> Any:
        count = construct.evaluate(self.count, context)
        if not isinstance(obj, list | tuple | bytes):
            raise Mismatch(path, 0, "a list of its elements", repr(obj), "value")
        if len(obj) != count:
            raise construct.RangeError(f"expected {count} elements, found {len(obj)}", path=path)
        built = construct.ListContainer()
        for index, element in enumerate(obj):
            context._index = index
            built.append(self.subcon._build(element, stream, context, f"{path}[{index}]"))
        return built


class CheckedConst(Const):  # type: ignore[misc]
    """A Const that can be read unchecked, and that says where it stands and what was there."""

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        start = stream.tell()
        obj = self.subcon._parsereport(stream, context, path)
        if obj != self.value and verifying(context):
            raise Mismatch(path, start, _shown(self.value), _shown(obj), "constant")
        return obj


class CountedBytes(Bytes):  # type: ignore[misc]
    """Bytes, of which a wrong length is told from an end of the stream, and what are none from an expression that fails."""

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        length = operator.index(construct.evaluate(self.length, context))
        if length < 0:
            raise construct.RangeError(f"invalid length {length}", path=path)
        return construct.stream_read(stream, length, path)

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> Any:
        if not isinstance(obj, bytes | bytearray | int):
            raise Mismatch(path, 0, "bytes", repr(obj), "value")
        return super()._build(obj, stream, context, path)


class ExactFloat(FormatField):  # type: ignore[misc]
    """A float field that carries the payload of a NaN through parsing and building."""

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        raw = construct.stream_read(stream, self.length, path)
        value = struct.unpack(self.fmtstr, raw)[0]
        return WireNaN(raw) if math.isnan(value) else value

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> Any:
        if isinstance(obj, WireNaN) and len(obj.raw) == self.length:
            construct.stream_write(stream, obj.raw, self.length, path)
            return obj
        return super()._build(obj, stream, context, path)


class NamedEnum(construct.Enum):  # type: ignore[misc]
    """An Enum that shows expressions the same name of a number in building as in parsing."""

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> Any:
        raw = self._encode(obj, context, path)
        self.subcon._build(raw, stream, context, path)
        return self._decode(raw, context, path)


def verifying(context: Any, *, checksums: bool = False) -> bool:
    """Whether constants, or checksums too, are checked in this parse (``_verify``: True, "constants" or False)."""
    wanted = context._params.get("_verify", True)
    return wanted is True if checksums else bool(wanted)


def prepare(con: Construct) -> Construct:
    """A copy of an author's tree with the engine's own classes in the places of construct's."""
    if isinstance(con, Struct):
        return MarkedStruct(*(prepare(child) for child in con.subcons))
    if isinstance(con, FormatField):
        if con.fmtstr[-1] not in "efd":
            return con
        return ExactFloat(con.fmtstr[0], con.fmtstr[-1])
    if isinstance(con, Bytes):
        return CountedBytes(con.length)
    if isinstance(con, Array):
        return IndexedArray(con.count, prepare(con.subcon))
    if isinstance(con, Const):
        return CheckedConst(con.value, prepare(con.subcon))
    if isinstance(con, construct.Enum):
        named = NamedEnum(prepare(con.subcon))
        named.encmapping, named.decmapping, named.ksymapping = con.encmapping, con.decmapping, con.ksymapping
        return named
    if isinstance(con, construct.IfThenElse):
        return construct.IfThenElse(con.condfunc, prepare(con.thensubcon), prepare(con.elsesubcon))
    if isinstance(con, construct.Switch):
        return construct.Switch(con.keyfunc, {key: prepare(case) for key, case in con.cases.items()}, prepare(con.default))
    if isinstance(con, construct.Renamed):
        inner = con.subcon
        while isinstance(inner, construct.Renamed):  # ("name" / con) * "docs" wraps twice, and the path would name it twice
            inner = inner.subcon
        return construct.Renamed(prepare(inner), newname=con.name, newdocs=con.docs)
    if isinstance(con, Subconstruct):
        same = copy.copy(con)
        same.subcon = prepare(con.subcon)
        return same
    return con


def unwrap(con: Construct, *, bits: bool = True) -> Construct:
    """The construct below names, units and checksums, and below bit transformations unless `bits` is False."""
    while isinstance(con, Subconstruct) and not isinstance(con, Array | Const):
        if isinstance(con, construct.Transformed | construct.Restreamed) and not bits:
            return con
        con = con.subcon
    return con


def bit_width(con: Construct) -> int:
    """The number of bits of a field of fixed size."""
    inner = unwrap(con)
    if isinstance(inner, BitsInteger):
        return int(inner.length)
    if isinstance(inner, FormatField | BytesInteger | Bytes):
        return 8 * int(inner.length)
    return 8 * int(inner.sizeof())


def fixed_size(con: Construct) -> int:
    """The number of bytes of a struct of fixed size; 0 where it depends on what is parsed."""
    try:
        return int(con.sizeof())
    except Exception:  # construct lets a KeyError through where a condition asks for a field
        return 0


def member(obj: Any, dotted: str, default: object = _MISSING) -> Any:
    """The member of a nested mapping under a dotted name."""
    for part in dotted.split("."):
        if default is not _MISSING and (obj is None or part not in obj):
            return default
        obj = obj[part]
    return obj


def clean(parsed: Any) -> Any:
    """The parsed object without construct's and our own private entries."""
    if isinstance(parsed, dict):
        return Container({name: clean(value) for name, value in parsed.items() if not name.startswith("_")})
    if isinstance(parsed, list):
        return construct.ListContainer(clean(value) for value in parsed)
    return parsed


def field_path(path: str | None) -> str:
    """construct's "(parsing) -> points[1] -> intensity" as "points[1].intensity"; a text on a part without name makes a "None"."""
    names = re.sub(r" -> None(?=$| ->|\[)", "", path or "").split(" -> ")[1:]
    return ".".join(names)


def _shown(value: object) -> str:
    return value.hex(" ") if isinstance(value, bytes) else f"0x{value:x}" if isinstance(value, int) else repr(value)
