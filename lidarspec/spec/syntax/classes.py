"""What stands in the places of construct's classes, and what one can ask of a construct, whatever
it is.

`prepare` copies an author's struct with a few classes replaced, and nothing else changed: structs
note where their members stand, arrays put the index into error paths, constants can be read
unchecked, and a NaN keeps its payload.
"""

from __future__ import annotations

import contextlib
import copy
import io
import math
import operator
import re
import struct
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import construct
from construct import (
    Array,
    BitsInteger,
    Bytes,
    BytesInteger,
    Const,
    Construct,
    Container,
    FormatField,
    Struct,
    Subconstruct,
)
from construct.expr import ExprMixin

from lidarspec.errors import SpecError
from lidarspec.spec import tree
from lidarspec.spec.checksums import Checksum

if TYPE_CHECKING:
    import random  # finding a sensor does without it

    #: field path -> what draws its value in place of chance
    Drawn = Mapping[str, Callable[[random.Random], Any]]

_MISSING = object()

#: what construct raises where bytes or values do not fit a struct.
Fault = construct.ConstructError


class Mismatch(construct.ConstructError):  # type: ignore[misc]
    """A value on the wire that is not what the spec asks for; made a `WireError` by the engine."""

    def __init__(self, path: str, offset: int, expected: object, got: object, reason: str) -> None:
        super().__init__(f"{reason}: expected {expected}, got {got}", path=path)
        self.offset = offset
        self.expected = expected
        self.got = got
        self.reason = reason


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
    """A Struct whose parsed container holds, under ``_marks``, the (start, end) of each member in
    the stream.
    """

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        obj = Container()
        inner = self._inner(stream, context, is_parsing=True)
        marks = inner._marks
        for con in self.subcons:
            start = stream.tell()
            value = con._parsereport(stream, inner, path)
            end = stream.tell()
            if con.name:
                obj[con.name] = inner[con.name] = value
                marks[con.name] = (start, end)
        obj["_marks"] = marks
        for sizing, place, spot, value in inner._sizings if verifying(context) else ():
            expected = sizing.value(obj)
            if value != expected:
                raise Mismatch(place, spot, expected, value, "length")
        return obj

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> Any:
        obj = {} if obj is None else obj
        if not isinstance(obj, dict):
            raise Mismatch(path, 0, "a mapping of its fields", repr(obj), "value")
        for con in self.subcons:
            if not con.flagbuildnone and con.name not in obj:
                raise Mismatch(f"{path} -> {con.name}", 0, "a value", "none", "missing")
        inner = self._inner(stream, context, is_parsing=False)
        inner.update({name: value for name, value in obj.items() if name != "_marks"})
        marks = inner._marks
        for con in self.subcons:
            start = stream.tell()
            value = con._build(obj.get(con.name), stream, inner, path)
            if con.name:
                inner[con.name] = value
                marks[con.name] = (start, stream.tell())
        for sizing, place, _, _ in inner._sizings:
            context._params["_sizes"][place] = sizing.value(inner)
        return inner

    def _inner(self, stream: Any, context: Any, *, is_parsing: bool) -> Container:
        """The context of the members' expressions.

        `_marks` holds (start, end) by name, `_sizings` (sizing, path, offset, value) of each field
        that states a length.
        """
        inner = Container(
            _=context,
            _params=context._params,
            _root=None,
            _parsing=is_parsing,
            _building=not is_parsing,
            _sizing=False,
        )
        inner._subcons = self._subcons
        inner._io = stream
        inner._index = context.get("_index", None)
        inner._root = context.get("_root", None) or inner
        inner._marks = {}
        inner._sizings = []
        return inner


class IndexedArray(Array):  # type: ignore[misc]
    """An Array that says in an error's path which element it was, and has no more elements than its
    frame can have bytes (or bits).

    Nor has a frame more elements without a byte, all its arrays together: nested ones would
    multiply.
    """

    limit: int
    in_bits: bool

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        count = bounded(construct.evaluate(self.count, context), self.limit, "count", path)
        found = construct.ListContainer()
        for index in range(count):
            context._index = index
            start = stream.tell()
            place = f"{path}[{index}]"
            element = self.subcon._parsereport(stream, context, place)
            found.append(element)
            if stream.tell() == start and not self.in_bits:
                context._params["_empty"] = bounded(
                    context._params.get("_empty", 0) + 1, self.limit, "count", path
                )
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
    """A GreedyRange that takes up all bytes of the part that bounds it: construct's own drops an
    element that fails, and what follows.
    """

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        found = construct.ListContainer()
        while stream.read(1):
            stream.seek(-1, io.SEEK_CUR)
            context._index = len(found)
            start = stream.tell()
            place = f"{path}[{len(found)}]"
            found.append(self.subcon._parsereport(stream, context, place))
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
            raise Mismatch(
                path, start, tree.format_hex(self.value), tree.format_hex(obj), "constant"
            )
        return obj


class Limited(Subconstruct):  # type: ignore[misc]
    """A number that accepts only some raw values.

    It represents OneOf, NoneOf and Mapping of construct.
    """

    def __init__(self, subcon: Construct, allowed: tuple[int, ...]) -> None:
        super().__init__(subcon)
        self.allowed = allowed

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        start = stream.tell()
        obj = self.subcon._parsereport(stream, context, path)
        if verifying(context):
            return self._held(obj, start, path)
        return obj

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> Any:
        return self._held(self.subcon._build(obj, stream, context, path), 0, path)

    def _held(self, obj: Any, start: int, path: str) -> Any:
        if int(obj) not in self.allowed:
            raise Mismatch(path, start, tree.listed(self.allowed), int(obj), "value")
        return obj


class HeldCheck(construct.Check):  # type: ignore[misc]
    """A Check that can be read unchecked."""

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        if verifying(context):
            return super()._parse(stream, context, path)
        return None


class _Compared:
    """What stands for a value that a validator is given, and remembers what it is compared with."""

    __hash__ = None  # type: ignore[assignment]

    def __init__(self) -> None:
        self.values: list[Any] = []

    def __eq__(self, other: object) -> bool:
        self.values.append(other)
        return False


def _allowed(con: construct.Validator) -> tuple[int, ...] | None:
    """The raw values that a validator lets pass: those that it compares with, or of 16 bits all
    that pass; None where neither is known.
    """
    field = unwrap(con)
    subcon = con.subcon
    while isinstance(subcon, Subconstruct) and not isinstance(subcon, construct.Enum):
        subcon = subcon.subcon
    if (
        not isinstance(field, FormatField | BytesInteger | BitsInteger)
        or getattr(field, "fmtstr", "B")[-1] in "efd?"
    ):
        return None
    width = bit_width(field)
    if isinstance(field, FormatField):
        signed = field.fmtstr[-1].islower()
    else:
        signed = field.signed
    low, high = (-(1 << (width - 1)), (1 << (width - 1)) - 1) if signed else (0, (1 << width) - 1)
    with contextlib.suppress(
        Exception
    ):  # the author's function may raise anything at what is no number
        passes = con._validate(compared := _Compared(), None, "")
        if compared.values and not passes and all(type(value) is int for value in compared.values):
            return tuple(
                value
                for value in sorted({*compared.values})
                if low <= value <= high and con._validate(value, None, "")
            )
    with contextlib.suppress(Exception):  # or at numbers that it does not expect
        if width <= 16:
            seen = (
                (lambda raw: subcon._decode(raw, None, None))
                if isinstance(subcon, construct.Enum)
                else int
            )
            return tuple(raw for raw in range(low, high + 1) if con._validate(seen(raw), None, ""))
    return None


class CountedBytes(Bytes):  # type: ignore[misc]
    """Bytes, of which a wrong length is told from an end of the stream, and what are none from an
    expression that fails.
    """

    limit: int

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        length = bounded(
            operator.index(construct.evaluate(self.length, context)), self.limit, "length", path
        )
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
        if math.isnan(value):
            return WireNaN(raw)
        return value

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
        over: names of the fields that it covers, in a row; None: all bytes that hold no bit of
            `fields`.
        absent: values that mean "not filled".
    """

    fields: tuple[str, ...]
    algorithm: Checksum | None
    over: tuple[str, ...] | None
    absent: frozenset[int]


class Sizing(Subconstruct):  # type: ignore[misc]
    """A number that says how many bytes a part has: made of it, and held to it.

    Attributes:
        of: the names that lead to the part from the struct that it stands in, which is itself what
            no names lead to; "_" leads one struct out.
        plus: what is added.
        since: a member before the part, from which on is measured; "" for the part alone.
    """

    def __init__(
        self, subcon: Construct, of: tuple[str, ...], plus: int = 0, since: str = ""
    ) -> None:
        super().__init__(subcon)
        self.of = of
        self.plus = plus
        self.since = since
        self.flagbuildnone = True

    @property
    def out(self) -> int:
        """How many structs further out the one is that has the part."""
        return self.of.count("_")

    def value(self, obj: Any) -> int:
        """What it has to say, of the struct that has the part, parsed or built."""
        *parents, name = self.of[self.out :] or ("",)
        try:
            marks = (member(obj, ".".join(parents)) if parents else obj)["_marks"]
            if name:
                start, end = marks[name]
            else:
                start = min(marks.values())[0]
                end = max(end for _, end in marks.values())
            start = marks[self.since][0] if self.since else start
        except (KeyError, TypeError):
            raise SpecError(
                f"SizeOf measures {'.'.join(self.of)!r}, and there is no such part"
            ) from None
        return int(end - start + self.plus)

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        start = stream.tell()
        value = self.subcon._parsereport(stream, context, path)
        self._enter(context, (path, start, value))
        return value

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> Any:
        sizes = context._params.setdefault("_sizes", {})
        self._enter(context, (path, 0, obj))
        return self.subcon._build(sizes.get(path, obj or 0), stream, context, path)

    def _enter(self, context: Any, said: tuple[str, int, Any]) -> None:
        """Register the value with the struct that contains the part.

        A bit block that is probed on its own has no such struct.
        """
        for _ in range(self.out):
            context = context.get("_", {})
        context.get("_sizings", []).append((self, *said))


class Counting(Subconstruct):  # type: ignore[misc]
    """The number of elements of a later array, `of`.

    It is built from the length of the array; the value given is ignored.
    """

    def __init__(self, subcon: Construct, of: str) -> None:
        super().__init__(subcon)
        self.of = of
        self.flagbuildnone = True

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> Any:
        array = context.get(self.of)
        return self.subcon._build(
            len(array) if isinstance(array, list | tuple | bytes) else obj, stream, context, path
        )


class Bounded(Subconstruct):  # type: ignore[misc]
    """A part that ends after `length` bytes of a frame that comes, and is as long as its values are
    in one that is made.
    """

    def __init__(self, length: Any, subcon: Construct) -> None:
        super().__init__(subcon)
        self.length = length

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        start = stream.tell()
        length = bounded(construct.evaluate(self.length, context), sys.maxsize, "length", path)
        stream.seek(0)
        within = io.BytesIO(construct.stream_read(stream, start + length, path))
        within.seek(start)
        value = self.subcon._parsereport(within, context, path)
        stream.seek(within.tell())
        return value


class Filler(CountedBytes):
    """The bytes behind members (from one to another, `of`), up to a length (`to`) or to a multiple
    of one (`modulus`).

    They are those of a pattern unless given.
    """

    def __init__(
        self, of: tuple[str, str], to: Any = None, modulus: Any = None, pattern: bytes = b"\0"
    ) -> None:
        super().__init__(self._missing)
        self.of = of
        self.to = to
        self.modulus = modulus
        self.pattern = pattern
        self.flagbuildnone = True

    def _missing(self, context: Any) -> int:
        start = context._marks[self.of[0]][0]
        end = context._marks[self.of[1]][1]
        number = construct.evaluate(self.modulus if self.to is None else self.to, context)
        return int((start - end) % number if self.to is None else number - (end - start))

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> Any:
        length = bounded(self._missing(context), self.limit, "length", path)
        return super()._build(self.pattern * length if obj is None else obj, stream, context, path)


class Pieces(construct.ListContainer):  # type: ignore[misc]
    """Parts that were parsed or built: kind, first byte and the one after the last of each as
    `spans`; `size`: the bytes of all.
    """

    def __init__(self) -> None:
        super().__init__()
        self.spans: list[tuple[str, int, int]] = []

    @property
    def size(self) -> int:
        """The bytes of all parts."""
        return sum(end - start for _, start, end in self.spans)

    def __getitem__(self, key: Any) -> Any:
        if key == "size":
            return self.size
        return super().__getitem__(key)


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


def verifying(context: Any) -> bool:
    """Return whether constants, lengths, checksums and values are checked in this parse."""
    return bool(context._params.get("_verify", True))


#: construct's classes -> those that stand in for them.
_OWN: dict[type, type] = {
    **{
        Struct: MarkedStruct,
        Array: IndexedArray,
        Const: CheckedConst,
        construct.Enum: NamedEnum,
        construct.GreedyRange: FullRange,
    },
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
        if con.fmtstr[-1] in "efd":
            return ExactFloat(con.fmtstr[0], con.fmtstr[-1])
        return con
    if isinstance(
        con, construct.Hex | construct.HexDump
    ):  # how a value is printed; it is the value below it
        return prepare(con.subcon, limit, in_bits=in_bits)
    if isinstance(con, construct.Check):
        return HeldCheck(con.func)
    if isinstance(con, construct.Mapping) and {
        *map(type, con.encmapping),
        *map(type, con.decmapping),
    } == {str, int}:
        return Limited(
            NamedEnum(prepare(con.subcon, limit, in_bits=in_bits), **con.encmapping),
            tuple(sorted(con.decmapping)),
        )
    if isinstance(con, construct.ExprValidator) and (allowed := _allowed(con)) is not None:
        return Limited(prepare(con.subcon, limit, in_bits=in_bits), allowed)
    if isinstance(con, Filler):
        con.limit = limit
        return con
    if isinstance(con, Bytes):
        counted = CountedBytes(con.length)
        counted.limit = limit
        return counted
    if isinstance(con, Struct):
        if in_bits:
            members = con.subcons
        else:
            members = [member for child in con.subcons for member in _spelled_out(child)]
        return MarkedStruct(*(prepare(child, limit, in_bits=in_bits) for child in members))
    if isinstance(con, construct.Renamed):
        inner = con.subcon
        while isinstance(
            inner, construct.Renamed
        ):  # ("name" / con) * "docs" wraps twice, and the path would name it twice
            inner = inner.subcon
        return construct.Renamed(
            prepare(inner, limit, in_bits=in_bits), newname=con.name, newdocs=con.docs
        )
    if not isinstance(con, Subconstruct | construct.IfThenElse | construct.Switch | Partition):
        return con
    same = copy.copy(con)
    same.__class__ = next((own for kind, own in _OWN.items() if isinstance(con, kind)), type(con))
    is_block = isinstance(con, construct.Transformed | construct.Restreamed)
    for name in vars(con).keys() & _INNER:
        setattr(
            same,
            name,
            prepare(
                getattr(con, name), 8 * limit if is_block else limit, in_bits=in_bits or is_block
            ),
        )
    if isinstance(con, construct.Switch | Partition):
        same.cases = {key: prepare(case, limit, in_bits=in_bits) for key, case in con.cases.items()}
    if isinstance(same, IndexedArray):
        same.limit = limit
        same.in_bits = in_bits
    if isinstance(same, Partition):
        same.limit = limit
    return same


def _spelled_out(con: Construct) -> list[Construct]:
    """A member of a struct; of those that construct prefixes, pads or aligns, what it does not
    show: the length or count, the padding.
    """
    name = con.name
    inner = con
    docs = con.docs
    while isinstance(inner, construct.Renamed):
        inner = inner.subcon

    def named(ending: str, part: Construct, what: str) -> Construct:
        return construct.Renamed(part, newname=name + ending, newdocs=f"{what} {name}")

    if name and isinstance(inner, construct.IfThenElse) and inner.elsesubcon is construct.Pass:
        members = _spelled_out(construct.Renamed(inner.thensubcon, newname=name, newdocs=docs))
        optional = (
            construct.Renamed(
                construct.If(inner.condfunc, one.subcon), newname=one.name, newdocs=one.docs
            )
            for one in members
        )
        if len(members) == 1:
            return [con]
        return list(optional)
    if name and isinstance(inner, construct.Prefixed):
        if inner.includelength:
            plus = inner.lengthfield.sizeof()
        else:
            plus = 0
        length = construct.this[f"{name}_size"]
        if is_greedy(inner.subcon):
            content = Bounded(length - plus if plus else length, inner.subcon)
        else:
            content = inner.subcon
        members = _spelled_out(construct.Renamed(content, newname=name, newdocs=docs))
        return [
            named(
                "_size",
                Sizing(inner.lengthfield, (members[-1].name,), plus, members[0].name),
                "bytes of",
            ),
            *members,
        ]
    if (
        name
        and isinstance(inner, construct.FocusedSeq)
        and [part.name for part in inner.subcons] == ["count", "items"]
    ):  # PrefixedArray
        count, items = (part.subcon for part in inner.subcons)
        array = Array(construct.this[f"{name}_count"], items.subcon)
        return [
            named("_count", Counting(count.subcon, name), "number of"),
            construct.Renamed(array, newname=name, newdocs=docs),
        ]
    if name and (
        isinstance(inner, construct.Aligned)
        or (isinstance(inner, construct.FixedSized) and not is_greedy(inner.subcon))
    ):
        members = _spelled_out(construct.Renamed(inner.subcon, newname=name, newdocs=docs))
        span = (members[0].name, members[-1].name)
        if isinstance(inner, construct.Aligned):
            return [
                *members,
                named(
                    "_padding",
                    Filler(span, modulus=inner.modulus, pattern=inner.pattern),
                    "padding of",
                ),
            ]
        is_full = isinstance(inner.length, int) and inner.length == fixed_size(inner.subcon)
        if is_full:
            return members
        return [*members, named("_padding", Filler(span, to=inner.length), "padding of")]
    return [con]


#: what takes all bytes that there are.
GREEDY = (construct.GreedyRange, type(construct.GreedyBytes))


def is_greedy(con: Construct, kinds: tuple[type, ...] = (*GREEDY, construct.NullStripped)) -> bool:
    """Whether a part takes all bytes that it is given, by ending in one of some kinds that do."""
    if isinstance(con, kinds):
        return True
    if isinstance(
        con,
        Array
        | construct.NullTerminated
        | construct.NullStripped
        | construct.FixedSized
        | construct.Prefixed
        | Bounded,
    ):
        return False
    return any(
        is_greedy(child, kinds)
        for child in (children(con)[-1:] if isinstance(con, Struct) else children(con))
    )


def unwrap(con: Construct, *, bits: bool = True) -> Construct:
    """The construct below names, units and checksums, and below bit transformations unless `bits`
    is False.
    """
    while isinstance(con, Subconstruct) and not isinstance(con, Array | Const):
        if isinstance(con, construct.Transformed | construct.Restreamed) and not bits:
            return con
        con = con.subcon
    return con


def is_struct(con: Construct) -> bool:
    """Whether it is a Struct, sealed or not."""
    return isinstance(unwrap(con, bits=False), Struct)


def has_member(con: Construct, dotted: str) -> bool:
    """Whether a struct has a member under a dotted name."""
    inner: Any = unwrap(con)
    for part in dotted.split("."):
        if not isinstance(inner, Struct) or part not in inner._subcons:
            return False
        inner = unwrap(inner._subcons[part])
    return True


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
        return Container(
            {name: clean(value) for name, value in parsed.items() if not name.startswith("_")}
        )
    if isinstance(parsed, list):
        return construct.ListContainer(clean(value) for value in parsed)
    return parsed


def field_path(path: str | None) -> str:
    """construct's "(parsing) -> points[1] -> intensity" as "points[1].intensity"; a text on a part
    without name makes a "None".
    """
    names = re.sub(r" -> None(?=$| ->|\[)", "", path or "").split(" -> ")[1:]
    return ".".join(names)


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


def leaves(
    parsed: Any, keys: tuple[str | int, ...] = ()
) -> Iterator[tuple[tuple[str | int, ...], Any]]:
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


#: the highest of the low numbers that are drawn half of the time: as a count or a choice, a number
#: of any size hardly ever fits.
MANY = (1, 6, 40)

#: how often a part is drawn that does not fit.
DRAWS = 100


def random_value(
    con: Construct, source: random.Random, drawn: Drawn, scope: Any = None, path: str = ""
) -> Any:
    """A random value that a construct can build; for parts that have no places and so cannot be
    filled with random bytes.

    Args:
        drawn: field path -> what draws its value in place of chance.
        scope: what its expressions see.
    """
    if path in drawn:
        return drawn[path](source)
    if isinstance(con, Const):
        return con.parse(
            con.build(con.value), _verify=False
        )  # a name of an Enum with its number, as other expressions see it
    if isinstance(con, construct.Rebuild):
        with contextlib.suppress(
            Exception
        ):  # it may ask for what comes after it, and is evaluated again when the frame is built
            return con.func(scope)
    if isinstance(con, Struct):
        values = Container(_=scope)
        values._root = values if scope is None else scope._root
        for child in con.subcons:
            if child.name is not None:
                values[child.name] = random_value(
                    child, source, drawn, values, f"{path}.{child.name}" if path else child.name
                )
        return values
    if isinstance(con, construct.GreedyRange):
        return [
            random_value(con.subcon, source, drawn, scope, path)
            for _ in range(source.randint(0, 4))
        ]
    if isinstance(con, Partition):
        return _random_parts(con, source, drawn, scope, path)
    if isinstance(con, Array):
        count = bounded(construct.evaluate(con.count, scope), con.limit, "count", path)
        bounded(count * _elements(con.subcon, scope), con.limit, "count", path)
        return [random_value(con.subcon, source, drawn, scope, path) for _ in range(count)]
    if isinstance(con, construct.IfThenElse):
        return random_value(
            con.thensubcon if construct.evaluate(con.condfunc, scope) else con.elsesubcon,
            source,
            drawn,
            scope,
            path,
        )
    if isinstance(con, construct.Switch):
        return random_value(
            con.cases.get(construct.evaluate(con.keyfunc, scope), con.default),
            source,
            drawn,
            scope,
            path,
        )
    if isinstance(con, Limited):
        raw = source.choice(con.allowed)
        if isinstance(con.subcon, construct.Enum):
            return con.subcon._decode(raw, None, None)
        return raw
    if isinstance(con, construct.Enum):
        if not isinstance(unwrap(con), Const) and source.random() < 0.5:
            named = list(con.ksymapping)
        else:
            named = []
        return con._decode(
            source.choice(named) if named else random_value(con.subcon, source, drawn, scope, path),
            None,
            None,
        )
    if isinstance(con, construct.NullTerminated) or not isinstance(con, Subconstruct):
        return _random_leaf(con, source, scope)
    if isinstance(con, construct.Adapter):
        return clean(
            con.parse(con.subcon.build(random_value(con.subcon, source, drawn, scope, path)))
        )
    return random_value(con.subcon, source, drawn, scope, path)


def _elements(con: Construct, scope: Any) -> int:
    """How many an element of an array has itself, where it is an array too; as far as that is known
    before there is one.
    """
    with contextlib.suppress(
        Exception
    ):  # whatever an expression raises that asks for what is not there yet
        if isinstance(con, Array):
            return int(construct.evaluate(con.count, scope)) * _elements(con.subcon, scope)
        return 1
    return 1


def _random_parts(
    con: Partition, source: random.Random, drawn: Drawn, scope: Any, path: str
) -> Pieces:
    """Some parts, with how long each is, which what stands behind them may ask for."""
    found = Pieces()
    around = Container(
        {**scope, "_params": Container(), "_parsing": False, "_building": True, "_sizing": False}
    )
    for _ in range(source.randint(0, 4)):
        name = source.choice(list(con.cases))
        stream = io.BytesIO()
        found.append(_random_part(con.cases[name], source, drawn, scope, path))
        con.cases[name]._build(found[-1], stream, around, path)
        found.spans.append((name, 0, stream.tell()))
    return found


def _random_part(con: Construct, source: random.Random, drawn: Drawn, scope: Any, path: str) -> Any:
    """One part; drawn again by itself where it is too long, since frames of many counts would else
    have no part at all.
    """
    for _ in range(DRAWS):
        with contextlib.suppress(Fault):
            return random_value(con, source, drawn, scope, path)
    return random_value(con, source, drawn, scope, path)


def _random_leaf(con: Construct, source: random.Random, scope: Any) -> Any:
    if con is construct.Pass or isinstance(con, construct.Check | Filler):
        # whether a Check holds, and how much there is to fill, is seen when the frame is built
        return None
    if isinstance(con, construct.NullTerminated):
        return str(source.randrange(10 ** source.randint(1, 4))).encode()
    if isinstance(con, construct.Computed):
        return construct.evaluate(con.func, scope)
    if con is construct.GreedyBytes:
        return source.randbytes(source.randint(0, 4))
    if isinstance(con, Bytes):
        return source.randbytes(
            bounded(construct.evaluate(con.length, scope), con.limit, "length", "")
        )
    if (
        isinstance(con, FormatField | BytesInteger | BitsInteger) and source.random() < 0.5
    ):  # it may be a count
        return con.parse(
            con.build(source.randint(0, min(source.choice(MANY), (1 << (bit_width(con) - 1)) - 1)))
        )
    if con in (construct.VarInt, construct.ZigZag):
        return source.randint(0, source.choice(MANY))
    if isinstance(con, BitsInteger):
        value = source.getrandbits(con.length)
        if con.signed and value >> (con.length - 1):
            return value - (1 << con.length)
        return value
    return con.parse(source.randbytes(con.sizeof()))
