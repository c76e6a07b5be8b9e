"""The layer over construct, and the only module that knows its classes: an author's struct made fit for the engine, and read off.

`prepare` copies an author's struct with a few classes replaced, and nothing else changed: structs note where their members stand,
arrays put the index into error paths, constants can be read unchecked, and a NaN keeps its payload. `frame_tree` reads the same struct
off as nodes (`lidarspec.spec.tree`): expressions are called with symbols in place of fields and what they do with them is written down,
and the bits of a bit block are found out by parsing it with construct, so that no rule about bit order stands anywhere else. What no
node stands for stays a part of construct's, with the reason.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import io
import math
import operator
import re
import struct
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import construct
import numpy as np
from construct import Array, BitsInteger, Bytes, BytesInteger, Const, Construct, Container, FormatField, Struct, Subconstruct
from construct.expr import BinExpr, ExprMixin, UniExpr

from lidarspec.errors import SpecError
from lidarspec.spec import tree
from lidarspec.spec.bits import BitField, probe
from lidarspec.spec.checksums import Checksum

if TYPE_CHECKING:
    import random  # finding a sensor does without it

    #: field path -> what draws its value in place of chance
    Drawn = Mapping[str, Callable[[random.Random], Any]]

_MISSING = object()

#: what a constant without a name is called.
UNNAMED = "(constant)"


#: what construct raises where bytes or values do not fit a struct.
Fault = construct.ConstructError


class Mismatch(construct.ConstructError):  # type: ignore[misc]
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
    """An Array that says in an error's path which element it was, and has no more elements than its frame can have bytes (or bits).

    Nor has a frame more elements without a byte, all its arrays together: nested ones would multiply.
    """

    limit: int
    in_bits: bool

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        count = bounded(construct.evaluate(self.count, context), self.limit, "count", path)
        found = construct.ListContainer()
        for index in range(count):
            context._index = index
            start = stream.tell()
            found.append(self.subcon._parsereport(stream, context, f"{path}[{index}]"))
            note(context, f"{path}[{index}]", start, stream.tell(), found[-1])
            if stream.tell() == start and not self.in_bits:
                context._params["_empty"] = bounded(context._params.get("_empty", 0) + 1, self.limit, "count", path)
        return found

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> Any:
        count = construct.evaluate(self.count, context)
        if not isinstance(obj, list | tuple | bytes):
            raise Mismatch(path, 0, "a list of its elements", repr(obj), "value")
        if len(obj) != count:
            raise construct.RangeError(f"expected {count} elements, found {len(obj)}", path=path)
        return _built(self, obj, stream, context, path)


def _built(con: Subconstruct, elements: Iterable[Any], stream: Any, context: Any, path: str) -> Any:
    """Build the elements of an array, with the index in an error's path."""
    built = construct.ListContainer()
    for index, element in enumerate(elements):
        context._index = index
        built.append(con.subcon._build(element, stream, context, f"{path}[{index}]"))
    return built


class FullRange(construct.GreedyRange):  # type: ignore[misc]
    """A GreedyRange that takes up all bytes of the part that bounds it: construct's own drops an element that fails, and what follows."""

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        found = construct.ListContainer()
        while stream.read(1):
            stream.seek(-1, io.SEEK_CUR)
            context._index, start, place = len(found), stream.tell(), f"{path}[{len(found)}]"
            found.append(self.subcon._parsereport(stream, context, place))
            note(context, place, start, stream.tell(), found[-1])
            if stream.tell() == start:
                raise construct.RangeError("an element without a byte never ends", path=place)
        return found

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> Any:
        if not isinstance(obj, list | tuple):
            raise Mismatch(path, 0, "a list of its elements", repr(obj), "value")
        return _built(self, obj, stream, context, path)


def bounded(number: int, limit: int, what: str, path: str) -> int:
    """A count or a length that a frame can have; RangeError for another one."""
    if not 0 <= number <= limit:
        raise construct.RangeError(f"invalid {what} {number}", path=path)
    return number


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

    limit: int

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        length = bounded(operator.index(construct.evaluate(self.length, context)), self.limit, "length", path)
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


class Describing(Subconstruct):  # type: ignore[misc]
    """A part that only says something of the field below it: parses and builds what that does."""

    def described(self, info: tree.FieldInfo) -> tree.FieldInfo:
        """What is known of the field, with what this part says of it."""
        raise NotImplementedError


class Sealing(Subconstruct):  # type: ignore[misc]
    """A struct with a checksum.

    Attributes:
        fields: names of the fields that hold it, low bits first.
        algorithm: of the checksum, None where a hook has to supply it.
        over: names of the fields that it covers, in a row; None: all bytes that hold no bit of `fields`.
        absent: values that mean "not filled".
    """

    fields: tuple[str, ...]
    algorithm: Checksum | None
    over: tuple[str, ...] | None
    absent: frozenset[int]


class Pieces(construct.ListContainer):  # type: ignore[misc]
    """Parts that were parsed or built: kind, first byte and the one after the last of each as `spans`; `size`: the bytes of all."""

    def __init__(self) -> None:
        super().__init__()
        self.spans: list[tuple[str, int, int]] = []

    @property
    def size(self) -> int:
        """The bytes of all parts."""
        return sum(end - start for _, start, end in self.spans)

    def __getitem__(self, key: Any) -> Any:
        return self.size if key == "size" else super().__getitem__(key)


class Partition(Construct):  # type: ignore[misc]
    """Structs one after another, each of a size of its own.

    Attributes:
        cases: what a part can be, by the name of its kind.
        count, size, within: how many there are, the bytes of the first of a chain, or those of all.
        following: of a part's own fields, the bytes of the next one.
        limit: the longest frame, in bytes.
    """

    cases: dict[str, Construct]
    count: Any
    size: Any
    within: Any
    following: Any
    limit: int = sys.maxsize


def verifying(context: Any, *, checksums: bool = False) -> bool:
    """Whether constants, or checksums too, are checked in this parse (``_verify``: True, "constants" or False)."""
    wanted = context._params.get("_verify", True)
    return wanted is True if checksums else bool(wanted)


#: construct's classes -> those that stand in for them.
_OWN: dict[type, type] = {
    **{Struct: MarkedStruct, Array: IndexedArray, Const: CheckedConst, construct.Enum: NamedEnum, construct.GreedyRange: FullRange},
}

#: attributes of constructs that hold others; "cases" does by key.
_INNER = ("subcon", "thensubcon", "elsesubcon", "default")


def prepare(con: Construct, limit: int = sys.maxsize, *, in_bits: bool = False) -> Construct:
    """A copy of an author's struct with the engine's own classes in the places of construct's.

    Args:
        limit: the longest frame, in bytes; within a bit block in bits.
        in_bits: whether it stands within a bit block.
    """
    if isinstance(con, FormatField):
        return ExactFloat(con.fmtstr[0], con.fmtstr[-1]) if con.fmtstr[-1] in "efd" else con
    if isinstance(con, Bytes):
        counted = CountedBytes(con.length)
        counted.limit = limit
        return counted
    if isinstance(con, Struct):
        return MarkedStruct(*(prepare(child, limit, in_bits=in_bits) for child in con.subcons))
    if isinstance(con, construct.Renamed):
        inner = con.subcon
        while isinstance(inner, construct.Renamed):  # ("name" / con) * "docs" wraps twice, and the path would name it twice
            inner = inner.subcon
        return construct.Renamed(prepare(inner, limit, in_bits=in_bits), newname=con.name, newdocs=con.docs)
    if not isinstance(con, Subconstruct | construct.IfThenElse | construct.Switch | Partition):
        return con
    same = copy.copy(con)
    same.__class__ = next((own for kind, own in _OWN.items() if isinstance(con, kind)), type(con))
    is_block = isinstance(con, construct.Transformed | construct.Restreamed)
    for name in vars(con).keys() & _INNER:
        setattr(same, name, prepare(getattr(con, name), 8 * limit if is_block else limit, in_bits=in_bits or is_block))
    if isinstance(con, construct.Switch | Partition):
        same.cases = {key: prepare(case, limit, in_bits=in_bits) for key, case in con.cases.items()}
    if isinstance(same, IndexedArray):
        same.limit, same.in_bits = limit, in_bits
    if isinstance(same, Partition):
        same.limit = limit
    return same


def unwrap(con: Construct, *, bits: bool = True) -> Construct:
    """The construct below names, units and checksums, and below bit transformations unless `bits` is False."""
    while isinstance(con, Subconstruct) and not isinstance(con, Array | Const):
        if isinstance(con, construct.Transformed | construct.Restreamed) and not bits:
            return con
        con = con.subcon
    return con


def is_struct(con: Construct) -> bool:
    """Whether it is a Struct, sealed or not."""
    return isinstance(unwrap(con, bits=False), Struct)


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
        if default is not _MISSING and (not isinstance(obj, Mapping) or part not in obj):
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


#: names that `points` and the engine need for themselves.
RESERVED = frozenset({"state", "on"})
SHADOWED = frozenset(name for name in dir(Container) if not name.startswith("_"))

#: the rule under which `lidarspec check` explains it, and the reason.
_REFUSED: dict[type, tuple[str, str]] = {
    type(construct.Pickled): ("LS110", "Pickled runs code from the wire"),
    construct.FlagsEnum: ("LS108", "FlagsEnum loses undeclared bits: declare each bit as a field of a BitStruct"),
    construct.RawCopy: ("LS109", "RawCopy ignores edits on rebuild: use Checksummed"),
    construct.Checksum: ("LS109", "construct's Checksum needs RawCopy, which ignores edits on rebuild: use Checksummed"),
    construct.Padded: ("LS106", "padding loses its bytes on a round trip: declare it as a field, such as 'reserved' / Bytes(n)"),
    construct.Aligned: (
        "LS106",
        "Aligned loses its padding on a round trip: declare it as a field, such as 'reserved' / Bytes(-this.size % 4)",
    ),
    construct.Pointer: ("LS112", "Pointer reads outside the frame"),
    construct.Seek: ("LS112", "Seek reads outside the frame"),
    construct.Select: ("LS113", "Select and Optional hide errors in the bytes: use If or Switch on a header field"),
}

#: what gives a greedy part its end, and what has none of its own.
_BOUNDED = (construct.NullTerminated, construct.FixedSized, construct.Prefixed)
_GREEDY = (construct.GreedyRange, type(construct.GreedyBytes))


def check_struct(con: Construct) -> None:
    """Raise `SpecError` with path and reason if a frame cannot be described by this construct.

    Raises:
        SpecError: for a shadowed, reserved, duplicate or missing name, or a construct that loses bits or never ends.
    """
    _check_ends(con, "", bounded=False)
    for path, part, in_bits in _walk(con, "", in_bits=False):
        for kind, (rule, reason) in _REFUSED.items():
            if isinstance(part, kind):
                raise SpecError(reason, path=path, rule=rule)
        if isinstance(part, type(construct.Flag)) and not in_bits:
            raise SpecError("Flag keeps one bit of its byte only: use a BitStruct, or Int8ul", path=path, rule="LS107")
        if isinstance(part, Struct):
            _check_names(part, path, in_bits=in_bits)
        if isinstance(part, Partition) and any(child.name == "frame" for case in part.cases.values() for child in unwrap(case).subcons):
            raise SpecError("no field of a part may be called 'frame', which is the frame around it", path=f"{path}.frame", rule="LS102")
    _check_measures(con, "", (1, 0, ""), {})


def _check_ends(con: Construct, path: str, *, bounded: bool) -> None:
    """Refuse what has no end on a stream: greedy parts, unless they are the last in one that has an end; and what such a one would drop."""
    path = f"{path}.{con.name}".strip(".") if isinstance(con, construct.Renamed) else path
    if isinstance(con, _GREEDY) and not bounded:
        name, what = (type(con), "length") if con is construct.GreedyBytes else (construct.GreedyRange, "count")
        reason = f"{name.__name__} has no end of its own on a stream: give a {what}, or a terminator, or bound it by Prefixed or FixedSized"
        raise SpecError(reason, path=path, rule="LS111")
    below = children(con)
    for child in below:
        passes = bounded and child is below[-1] if isinstance(con, Struct) else bounded
        _check_ends(child, path, bounded=isinstance(con, _BOUNDED) or (passes and not isinstance(con, Array | construct.GreedyRange)))
    is_sized = isinstance(con, construct.FixedSized)
    fits = is_sized and isinstance(con.length, int) and fixed_size(con.subcon) == con.length
    if isinstance(con, _BOUNDED) and not fits and not _fills(con.subcon, padded=is_sized):
        reason = f"{type(con).__name__} loses what its content leaves of it: let the content end with a field for it, 'rest' / GreedyBytes"
        raise SpecError(reason, path=path, rule="LS106")


def _fills(con: Construct, *, padded: bool) -> bool:
    """Whether a part takes up all bytes that it is given, and builds them again; `padded`: with zeros behind it where it is shorter."""
    if isinstance(con, construct.NullStripped):
        return padded and con.pad == b"\0" and con.subcon is construct.GreedyBytes
    if isinstance(con, (Array, *_BOUNDED)) or not children(con):
        return con is construct.GreedyBytes
    return isinstance(con, construct.GreedyRange) or _fills(children(con)[-1], padded=padded)


def _check_names(struct: Struct, path: str, *, in_bits: bool) -> None:
    seen: set[str] = set()
    for child in struct.subcons:
        name = child.name
        place = f"{path}.{name}" if path else str(name)
        if isinstance(child, construct.Padded):
            continue  # refused on its own, and with a better reason
        if name is None:
            if in_bits or not isinstance(unwrap(child), Const):
                raise SpecError(f"an unnamed {type(unwrap(child)).__name__} would lose its value: give it a name", path=path, rule="LS105")
            continue
        if name in seen:
            raise SpecError("two fields of this name: the last one would win silently", path=place, rule="LS104")
        if name in RESERVED:
            raise SpecError("no field may be called 'state' or 'on'", path=place, rule="LS102")
        if name in SHADOWED:
            raise SpecError(f"the name {name!r} is shadowed by a method of construct's Container", path=place, rule="LS101")
        if name.startswith("_") or not name.isidentifier():
            raise SpecError("a field name must be a Python identifier without a leading underscore", path=place, rule="LS103")
        seen.add(name)


def _check_measures(con: Construct, path: str, measure: tuple[float, float, str], found: dict[str, tuple[float, float, str]]) -> None:
    """Refuse a field that branches measure in different steps or units: it is one column, and has one of each."""
    if isinstance(con, construct.Renamed):
        path = f"{path}.{con.name}" if path else str(con.name)
        measure = (1, 0, "")
    if isinstance(con, Describing):
        said = con.described(tree.FieldInfo(""))
        measure = (said.scale, said.offset, said.unit)
    is_number = isinstance(con, construct.FormatField | construct.BytesInteger | construct.BitsInteger)
    if is_number and found.setdefault(path, measure) != measure:
        raise SpecError("its branches have different scales or units: give each a name of its own", path=path)
    for child in children(con):
        if not isinstance(con, Struct) or child.name is not None:
            _check_measures(child, path, measure, found)


def _walk(con: Construct, path: str, *, in_bits: bool) -> Iterator[tuple[str, Construct, bool]]:
    if con.name is not None and isinstance(con, construct.Renamed):
        path = f"{path}.{con.name}" if path else con.name
    yield path, con, in_bits
    if isinstance(con, construct.Transformed | construct.Restreamed):
        in_bits = True
    for child in children(con):
        yield from _walk(child, path, in_bits=in_bits)


def children(con: Construct) -> list[Construct]:
    """The constructs directly below one, branches included."""
    if isinstance(con, Struct):
        return list(con.subcons)
    found = [getattr(con, name) for name in _INNER if name in vars(con)]
    return found + (list(con.cases.values()) if "cases" in vars(con) else [])


def seals(con: Construct) -> Iterator[Sealing]:
    """The sealed structs of a struct, outer ones first."""
    if isinstance(con, Sealing):
        yield con
    for child in children(con):
        yield from seals(child)


#: the highest of the low numbers that are drawn half of the time: as a count, a number of any size hardly ever fits.
MANY = 40


def random_value(con: Construct, source: random.Random, drawn: Drawn, scope: Any = None, path: str = "") -> Any:
    """A random value that a construct can build; for parts that have no places and so cannot be filled with random bytes.

    Args:
        drawn: field path -> what draws its value in place of chance.
        scope: what its expressions see.
    """
    if path in drawn:
        return drawn[path](source)
    if isinstance(con, Const):
        return con.parse(con.build(con.value), _verify=False)  # a name of an Enum with its number, as other expressions see it
    if isinstance(con, construct.Rebuild):
        with contextlib.suppress(Exception):  # it may ask for what comes after it, and is evaluated again when the frame is built
            return con.func(scope)
    if isinstance(con, Struct):
        values = Container(_=scope)
        values._root = values if scope is None else scope._root
        for child in con.subcons:
            if child.name is not None:
                values[child.name] = random_value(child, source, drawn, values, f"{path}.{child.name}" if path else child.name)
        return values
    if isinstance(con, construct.GreedyRange):
        return [random_value(con.subcon, source, drawn, scope, path) for _ in range(source.randint(0, 4))]
    if isinstance(con, Partition):
        return _random_parts(con, source, drawn, scope, path)
    if isinstance(con, Array):
        count = bounded(construct.evaluate(con.count, scope), con.limit, "count", path)
        return [random_value(con.subcon, source, drawn, scope, path) for _ in range(count)]
    if isinstance(con, construct.IfThenElse):
        return random_value(con.thensubcon if construct.evaluate(con.condfunc, scope) else con.elsesubcon, source, drawn, scope, path)
    if isinstance(con, construct.Switch):
        return random_value(con.cases.get(construct.evaluate(con.keyfunc, scope), con.default), source, drawn, scope, path)
    if isinstance(con, construct.Enum):
        named = list(con.ksymapping) if not isinstance(unwrap(con), Const) and source.random() < 0.5 else []
        return con._decode(source.choice(named) if named else random_value(con.subcon, source, drawn, scope, path), None, None)
    if isinstance(con, construct.NullTerminated) or not isinstance(con, Subconstruct):
        return _random_leaf(con, source, scope)
    if isinstance(con, construct.Adapter):
        return clean(con.parse(con.subcon.build(random_value(con.subcon, source, drawn, scope, path))))
    return random_value(con.subcon, source, drawn, scope, path)


def _random_parts(con: Partition, source: random.Random, drawn: Drawn, scope: Any, path: str) -> Pieces:
    """Some parts, with how long each is, which what stands behind them may ask for."""
    found = Pieces()
    around = Container({**scope, "_params": Container(), "_parsing": False, "_building": True, "_sizing": False})
    for _ in range(source.randint(0, 4)):
        name, stream = source.choice(list(con.cases)), io.BytesIO()
        found.append(random_value(con.cases[name], source, drawn, scope, path))
        con.cases[name]._build(found[-1], stream, around, path)
        found.spans.append((name, 0, stream.tell()))
    return found


def _random_leaf(con: Construct, source: random.Random, scope: Any) -> Any:
    if con is construct.Pass or isinstance(con, construct.Check):
        return None  # whether a Check holds is seen when the frame is built
    if isinstance(con, construct.NullTerminated):
        return str(source.randrange(10 ** source.randint(1, 4))).encode()
    if isinstance(con, construct.Computed):
        return construct.evaluate(con.func, scope)
    if con is construct.GreedyBytes:
        return source.randbytes(source.randint(0, 4))
    if isinstance(con, Bytes):
        return source.randbytes(bounded(construct.evaluate(con.length, scope), con.limit, "length", ""))
    if isinstance(con, FormatField | BytesInteger | BitsInteger) and source.random() < 0.5:  # it may be a count
        return con.parse(con.build(source.randint(0, min(MANY, (1 << (bit_width(con) - 1)) - 1))))
    if isinstance(con, BitsInteger):
        value = source.getrandbits(con.length)
        return value - (1 << con.length) if con.signed and value >> (con.length - 1) else value
    return con.parse(source.randbytes(con.sizeof()))


def frame_tree(con: Construct) -> tree.Node:
    """The tree of a struct.

    Raises:
        SpecError: for a constant that its Enum has no value for.
    """
    first = _Builder({})
    root = first.node(con, _Place(tree.FieldInfo(""), None))
    return _Builder(first.scopes).node(con, _Place(tree.FieldInfo(""), None)) if first.rebuilding else root


def _traced(expression: Any, scope: tree.Scope) -> Any:
    """What an expression comes to; construct's own are walked, since its ``~`` asks for the truth of a value."""
    if isinstance(expression, BinExpr):
        return expression.op(_traced(expression.lhs, scope), _traced(expression.rhs, scope))
    if isinstance(expression, UniExpr):
        operand = _traced(expression.operand, scope)
        if expression.op is operator.not_ and isinstance(operand, tree.Symbol):
            return tree.Symbol(tree.Op("not", (operand.formula,)))
        return expression.op(operand)
    return expression(scope) if callable(expression) else expression


def _spelled(expression: Any, path: str) -> str:
    """An expression of the part at `path` as its author wrote it, with fields by their whole paths; "?" for a function."""
    text = repr(expression)
    if " at 0x" in text:
        return "?"
    return re.sub(r"\bthis(?:\.\w+)+", functools.partial(_whole_path, path), re.sub(r"\['(\w+)'\]", r".\1", text))


def _whole_path(path: str, way: re.Match[str]) -> str:
    """``this.count`` or ``this._.count`` in the part at `path` as the path from the top of the frame."""
    names = path.split(".")[:-1]
    for name in way[0].split(".")[1:]:
        names = [] if name == "_root" else names[:-1] if name == "_" else [*names, name]
    return ".".join(names)


class _Fields:
    """What an expression sees when it is evaluated: values by name, as construct shows them."""

    def __init__(self, read: tree.Read, paths: tuple[str, ...]) -> None:
        self._read, self._paths = read, paths

    def __getitem__(self, name: str) -> Any:
        if name == "_":
            return _Fields(self._read, self._paths[1:]) if len(self._paths) > 1 else None
        if name == "_root":
            return _Fields(self._read, self._paths[-1:])
        value = self._read(f"{self._paths[0]}.{name}" if self._paths[0] else name)
        if isinstance(value, str):
            return _Fields(self._read, (value, *self._paths))
        return value and seen(*value)

    def __getattr__(self, name: str) -> Any:
        return self[name]


def seen(info: tree.FieldInfo, raw: int) -> Any:
    """A raw value as the expressions of a struct see it: where construct's Enum has a name for it, that name."""
    return construct.EnumIntegerString.new(raw, info.labels[raw]) if raw in info.labels else raw


def unnamed(raw: int) -> Any:
    """A raw value that construct's Enum has no name for."""
    return construct.EnumInteger(raw)


@dataclass(frozen=True)
class _Place:
    """Where in the tree a construct stands: what is said of it, what its expressions see, and whether it is a part of a bit block."""

    info: tree.FieldInfo
    scope: tree.Scope | None
    name: str = ""
    in_bits: bool = False

    def inside(self, **changes: Any) -> _Place:
        """The place with some facts of the field changed."""
        return replace(self, info=replace(self.info, **changes))


class _Builder:
    """Makes the nodes of a struct; `scopes`: what was known at the end of each struct, for values that follow from later ones."""

    def __init__(self, known: Mapping[str, tree.Scope]) -> None:
        self._known, self.scopes, self.rebuilding = known, dict[str, tree.Scope](), False
        self._asked: list[tree.Ref] = []

    def node(self, con: Construct, place: _Place) -> tree.Node:
        """The node of a construct, whatever it is."""
        inner, place = self._peeled(con, place)
        name, info = place.name, place.info
        is_block = isinstance(inner, construct.Transformed | construct.Restreamed)
        if not place.in_bits and (is_block or (isinstance(inner, BytesInteger) and _is_odd(inner))):
            return self._block(inner, place)
        if is_block:
            return self.node(inner.subcon, place)
        if isinstance(inner, Sealing):
            return self._sealed(inner, place)
        if isinstance(inner, Struct):
            return self._struct(inner, place)
        if isinstance(inner, Array):
            axis = axis_path(info)
            count = self._formula(inner.count, place)
            return tree.Repeat(name, axis, count, self.node(inner.subcon, place.inside(axes=(*info.axes, axis))))
        if isinstance(inner, Partition):
            return self._parts(inner, place)
        if isinstance(inner, construct.IfThenElse):
            condition = self._formula(inner.condfunc, place)
            branches = (self.node(branch, place.inside(optional=True)) for branch in (inner.thensubcon, inner.elsesubcon))
            return tree.When(name, condition, *branches)
        if isinstance(inner, construct.Switch):
            return self._select(inner, place)
        return tree.Empty(name) if inner is construct.Pass else self._leaf(inner, place)

    def _peeled(self, con: Construct, place: _Place) -> tuple[Construct, _Place]:
        """What is below the wrappers that only describe (name, unit, labels, constant), and what they say."""
        while True:
            if isinstance(con, construct.Renamed):
                place = place.inside(docs=con.docs or place.info.docs)
            elif isinstance(con, Describing):
                place = replace(place, info=con.described(place.info))
            elif isinstance(con, construct.Enum):
                place = place.inside(labels={int(value): str(name) for value, name in con.ksymapping.items()})
            elif isinstance(con, Const):
                place = place.inside(const=_constant(con))
            elif isinstance(con, construct.Rebuild):
                self.rebuilding = True
                known = None if place.scope is None else self._known.get(place.scope.path)
                place = place.inside(rebuilt=self._formula(con.func, place, known))
            elif not isinstance(con, construct.Default):
                return con, place
            con = con.subcon

    def _formula(self, expression: Any, place: _Place, known: tree.Scope | None = None, *, is_key: bool = False) -> tree.Formula:
        """A count, length, condition or key as data, as far as it can be written down."""
        if isinstance(expression, int):
            return int(expression)
        scope = next((scope for scope in (known, place.scope) if scope is not None), tree.Scope(None, "", self._asked))
        scope.asked.clear()
        blind = False
        try:
            value = _traced(expression, scope)
            if not isinstance(expression, ExprMixin) and any(ref.info.optional for ref in scope.asked):
                reason = "a Python function of a field that may be left out"
            elif isinstance(value, bool | int):
                return int(value)
            elif not isinstance(value, tree.Symbol):
                reason = f"an expression that gives {value!r}"
            elif not is_key and isinstance(value.formula, tree.Ref) and value.formula.info.labels:
                reason = "an expression takes the name of a value for a number"
            else:
                return value.formula
        except tree.Untraceable as untraceable:
            reason, blind = str(untraceable), isinstance(untraceable, tree.Blind)
        except Exception as error:
            reason = f"a Python function of other fields ({type(error).__name__}: {error})"
        return self._code(expression, place, reason, tuple(scope.asked), blind=blind)

    def _code(self, expression: Any, place: _Place, reason: str, asked: tuple[tree.Ref, ...], *, blind: bool = False) -> tree.Code:
        paths, scope = list[str](), place.scope
        while scope is not None:
            paths.append(scope.path)
            scope = scope.parent
        ways, path = tuple(paths or [""]), place.info.path

        def function(read: tree.Read) -> Any:
            return expression(_Fields(read, ways)) if callable(expression) else expression

        return tree.Code(function, tuple(dict.fromkeys(asked)), f"{path}: {reason}", _spelled(expression, path), blind)

    def _select(self, con: construct.Switch, place: _Place) -> tree.Select:
        key = self._formula(con.keyfunc, place, is_key=True)
        labels = key.info.labels if isinstance(key, tree.Ref) else {}
        raw = {name: value for value, name in labels.items()}
        # construct looks a value that has a name up by that name alone
        values = {case: raw.get(str(case), case) if isinstance(case, str) else case for case in con.cases if case not in labels}
        odd = [case for case, value in values.items() if not isinstance(value, int)]
        if odd and not isinstance(key, tree.Code):
            named = isinstance(key, tree.Ref) and isinstance(odd[0], str)
            reason = f"{key.path} has no value named {odd[0]!r}" if named else f"a case for {odd[0]!r}, which is no integer"  # type: ignore[union-attr]
            key = self._code(con.keyfunc, place, reason, tuple(tree.refs(key)))
        if isinstance(key, tree.Code):
            values = {case: case for case in con.cases}
        cases = tuple((value, self._branch(con.cases[case], place)) for case, value in values.items())
        return tree.Select(place.name, key, cases, self._branch(con.default, place))

    def _branch(self, con: Construct, place: _Place) -> tree.Node:
        return self.node(con, place.inside(optional=True))

    def _struct(self, con: Struct, place: _Place) -> tree.Struct:
        info = place.info
        scope = tree.Scope(place.scope, info.path, self._asked)
        if place.name and place.scope is not None:
            place.scope.add(place.name, scope)
        members = []
        for child in con.subcons:
            path = ".".join(part for part in (info.path, child.name) if part)
            said = tree.FieldInfo(path, info.axes, docs=info.docs if place.in_bits else "", optional=info.optional)
            members.append(self.node(child, _Place(said, scope, child.name or "", place.in_bits)))
        self.scopes[info.path] = scope
        return tree.Struct(place.name, info.path, tuple(members), info.docs)

    def _parts(self, con: Partition, place: _Place) -> tree.Parts:
        info, scope, axis = place.info, place.scope, axis_path(place.info)
        assert scope is not None  # since parts are a member of a struct
        elements = [self.node(case, place.inside(axes=(*info.axes, axis))) for case in con.cases.values()]
        kinds, outer = list[tree.Kind](), dict[tree.Ref, None]()
        for (name, case), element in zip(con.cases.items(), elements, strict=True):
            root, following = self._alone(case, con.following, place)
            kinds.append(tree.Kind(name, element, root, following))
            asked = [ref for node in tree.nodes(root) for formula in tree.formulas(node) for ref in tree.refs(formula)]
            asked += [] if following is None else tree.refs(following)
            outer |= dict.fromkeys(tree.Ref(ref.path[2:], ref.info) for ref in asked if ref.path.startswith("_."))
        count, size, within = (None if rule is None else self._formula(rule, place) for rule in (con.count, con.size, con.within))
        total = tree.FieldInfo(f"{info.path}.size", info.axes, np.dtype(np.int64), "int", bits=64, docs="bytes of all parts")
        known = scope.names[place.name] = tree.Scope(scope, info.path, self._asked)
        known.add("size", tree.Ref(total.path, total))
        return tree.Parts(place.name, axis, tuple(kinds), count, size, within, tuple(outer), total)

    def _alone(self, case: Construct, following: Any, place: _Place) -> tuple[tree.Node, tree.Formula | None]:
        """A part as a frame in itself, and the size of the one behind it."""
        builder = _Builder({})
        for _ in range(2):  # the second time values that follow from later fields know these
            around = _Place(tree.FieldInfo(""), tree.Outside(place.scope, builder._asked))  # type: ignore[arg-type]
            root = builder.node(case, around)
            if not builder.rebuilding:
                break
            builder = _Builder(builder.scopes)
        rule = None if following is None else builder._formula(following, replace(around, scope=builder.scopes[""]))
        return root, rule

    def _sealed(self, con: Sealing, place: _Place) -> tree.Node:
        body = self.node(con.subcon, place)
        if not isinstance(body, tree.Struct):
            return tree.Opaque(place.name, place.info, type(con).__name__, "a checksum around something that is no struct", (body,))
        prefix = f"{place.info.path}." if place.info.path else ""
        over = (prefix + con.over[0], prefix + con.over[-1]) if con.over is not None else None
        return tree.Sealed(body, tuple(prefix + name for name in con.fields), over, con.algorithm, tuple(sorted(con.absent)))

    def _leaf(self, con: Construct, place: _Place) -> tree.Node:
        name, info = place.name, _typed(con, place.info)
        if name and place.scope is not None:
            place.scope.add(name, tree.Ref(info.path, info))
        if isinstance(con, FormatField) and con.fmtstr[-1] != "?":
            big = con.fmtstr[0] in ">!" or (con.fmtstr[0] == "=" and sys.byteorder == "big")
            node: tree.Node = tree.Number(info, con.length, _KINDS[info.dtype.kind], "big" if big else "little")  # type: ignore[union-attr]
        elif isinstance(con, BytesInteger) and not _is_odd(con):
            node = tree.Number(info, con.length, _KINDS[info.dtype.kind], "little" if con.swapped else "big")  # type: ignore[union-attr]
        elif isinstance(con, Bytes):
            node = tree.Blob(name, info, self._formula(con.length, place), info.const)
        else:
            kind = type(con).__name__
            size = self._formula(con.length, place) if isinstance(con, construct.FixedSized) else None
            node = tree.Opaque(name, info, kind, f"{kind} has no fixed place", size=size, form=_form(con))
        if not name and info.const is not None and not isinstance(node, tree.Opaque):
            return tree.Blob("", info, con.length, con.build(info.const))
        return node

    def _block(self, con: Construct, place: _Place) -> tree.Node:
        """A bit block: the bits of each field come from probing construct itself."""
        inside = self.node(con, replace(place, in_bits=True))
        try:
            size = int(con.sizeof())
            fields = _probed(con, size)
        except (construct.ConstructError, LookupError):
            fields = None
        if fields is None:
            reason = "a bit block whose values are not plain bits of it"
            return tree.Opaque(place.name, place.info, type(con).__name__, reason, (inside,), in_bits=True)
        infos = {node.info.path: node.info for node in tree.nodes(inside) if isinstance(node, tree.Number | tree.Blob | tree.Opaque)}
        parts = []
        for bits in fields:
            names = tuple(key for key in bits.keys if isinstance(key, str))
            info = infos[".".join(part for part in (place.info.path, *names) if part)]
            parts.append(tree.Part(info, bits, names, tuple(key for key in bits.keys if isinstance(key, int))))
        return tree.Block(place.name, place.info, size, tuple(parts))


#: of numbers, by those of their types.
_KINDS: dict[str, Literal["uint", "int", "float"]] = {"u": "uint", "i": "int", "f": "float"}


def axis_path(info: tree.FieldInfo) -> str:
    """The name of the axis of an array at this place; an array directly in an array gets brackets."""
    path = info.path
    while path in info.axes:
        path += "[]"
    return path


def integer_type(bits: int, *, signed: bool = False) -> np.dtype[Any]:
    """The smallest integer type of at least so many bits."""
    size = next(size for size in (1, 2, 4, 8) if bits <= 8 * size)
    return np.dtype(f"{'i' if signed else 'u'}{size}")


def _typed(con: Construct, info: tree.FieldInfo) -> tree.FieldInfo:
    """What is known of a field, with the type of its values."""
    if isinstance(con, FormatField):
        code = con.fmtstr[-1]
        kind, letter = ("float", "f") if code in "efd" else ("int", "u" if code.isupper() or code == "?" else "i")
        return replace(info, dtype=np.dtype(f"{letter}{con.length}"), kind=kind, bits=8 * con.length)
    if isinstance(con, BytesInteger | BitsInteger) and isinstance(con.length, int):
        bits = con.length * (8 if isinstance(con, BytesInteger) else 1)
        dtype = integer_type(bits, signed=bool(con.signed)) if bits <= 64 else None
        return replace(info, dtype=dtype, kind="int" if dtype is not None else "other", bits=bits)
    if isinstance(con, type(construct.Flag)):
        return replace(info, dtype=np.dtype("u1"), kind="int", bits=1)
    if isinstance(con, Bytes):
        bits = 8 * con.length if isinstance(con.length, int) else 0
        return replace(info, dtype=np.dtype("u1"), kind="bytes", bits=bits, axes=(*info.axes, axis_path(info)))
    if _is_text(con):
        return replace(info, dtype=np.dtype("u1"), kind="bytes", axes=(*info.axes, axis_path(info)))
    return info


def _is_text(con: Construct) -> bool:
    """Whether it gives the bytes up to a terminator, or as many as are said in front of them."""
    while isinstance(con, construct.NullTerminated | construct.NullStripped | construct.FixedSized | construct.Prefixed):
        con = con.subcon
    return con is construct.GreedyBytes


def _form(con: Construct) -> str:
    """How a field without a size of its own stands on the wire."""
    below = con
    while isinstance(below, Subconstruct):
        if isinstance(below, construct.NullTerminated):
            return f"text up to {str(below.term)[1:]}"
        below = below.subcon
    return type(con).__name__


def _constant(con: Const) -> Any:
    """The raw value of a constant, also where it is given by the name that construct's Enum has for it."""
    below = con.subcon
    while isinstance(con.value, str) and isinstance(below, Subconstruct):
        if isinstance(below, construct.Enum):
            if con.value not in below.encmapping:
                raise SpecError(f"the constant {str(con.value)!r} is none of {', '.join(map(str, below.encmapping))}")
            return int(below.encmapping[con.value])
        below = below.subcon
    return con.value


def _is_odd(con: BytesInteger) -> bool:
    """Whether its length or byte order is not plain."""
    return not isinstance(con.length, int) or con.length > 8 or not isinstance(con.swapped, bool)


@functools.lru_cache(maxsize=4096)
def _probed(con: Construct, size: int) -> list[BitField] | None:
    """The bit fields of a block; None where construct decides on its bits, or values are no plain integers."""
    return probe(lambda block: dict(leaves(con.parse(block, _verify=False))), size) if _is_even(con) else None  # every pattern is tried


def _is_even(con: Construct) -> bool:
    """Whether every block is read in the same way: what a value decides on shows with few blocks only, and probing could miss it."""
    if isinstance(con, Struct):
        return all(map(_is_even, con.subcons))
    if isinstance(con, Subconstruct):
        return (isinstance(con, construct.Enum) or not isinstance(con, construct.Adapter)) and _is_even(con.subcon)
    return isinstance(con, BitsInteger | Bytes | BytesInteger | FormatField | type(construct.Flag))


def bytes_of(con: Construct, names: Iterable[str]) -> list[int]:
    """The offsets of the bytes of a block that hold any bit of one of its fields."""
    keys = tuple(names)
    for field in _probed(con, con.sizeof()) or ():
        if field.keys == keys:
            return [segment.byte for segment in field.segments]
    raise KeyError(".".join(keys))


def leaves(parsed: Any, keys: tuple[str | int, ...] = ()) -> Iterator[tuple[tuple[str | int, ...], Any]]:
    """The values of a parsed object with where they stand in it, private entries left out."""
    if isinstance(parsed, dict):
        for name, value in parsed.items():
            if not name.startswith("_"):
                yield from leaves(value, (*keys, name))
    elif isinstance(parsed, list):
        for index, value in enumerate(parsed):
            yield from leaves(value, (*keys, index))
    else:
        yield keys, int(parsed) if isinstance(parsed, construct.EnumIntegerString) else parsed


def is_expression(value: object) -> bool:
    """Whether a value is an expression or a part of a struct, where a number is wanted."""
    return isinstance(value, ExprMixin | Construct)
