"""The classes of a prepared struct: replacements for construct's, and new classes.

`prepare` replaces a class of construct if the class loses bytes, does not report the offset of an
error, or always verifies values, so that `parse(verify=False)` would be impossible.

Most frames have a layout, and are parsed and built without construct. These classes parse and build
the other frames (`lidarspec.frames.plain`). `tests/frames/test_plain.py` tests such frames, and
fails if a class of construct is not replaced.

Plugins use the new classes through `lidarspec.spec.fields`.
"""

from __future__ import annotations

import io
import math
import operator
import struct
import sys
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import construct
from construct import (
    Array,
    Bytes,
    Const,
    Construct,
    Container,
    FormatField,
    Struct,
    Subconstruct,
)

from lidarspec.errors import SpecError
from lidarspec.spec import tree
from lidarspec.spec.checksums import Checksum

_MISSING = object()

#: The exceptions of construct for bytes or values that do not match a struct.
Fault = construct.ConstructError


class MismatchError(construct.ConstructError):  # type: ignore[misc]
    """Raised for a value that contradicts the spec.

    The engine converts this error to a `WireError`.
    """

    def __init__(self, path: str, offset: int, expected: object, got: object, reason: str) -> None:
        super().__init__(f"{reason}: expected {expected}, got {got}", path=path)
        self.offset = offset
        self.expected = expected
        self.got = got
        self.reason = reason


class WireNaN(float):
    """A NaN that keeps its bits, so that a signalling NaN is built unchanged."""

    raw: bytes

    def __new__(cls, raw: bytes) -> WireNaN:
        value = super().__new__(cls, math.nan)
        value.raw = raw
        return value

    def __reduce__(self) -> tuple[type[WireNaN], tuple[bytes]]:
        return WireNaN, (self.raw,)


def is_verifying(context: Any) -> bool:
    """Return whether parsing checks constants, lengths, checksums and values."""
    return bool(context._params.get("_verify", True))


def check_bound(number: int, limit: int, what: str, path: str) -> int:
    """Return a count or length after checking that a frame can have it.

    Args:
        what: the name of the number in the error message, for example "count".

    Raises:
        construct.RangeError: if the number is negative or larger than `limit`.
    """
    if number < 0:
        raise construct.RangeError(f"the {what} {number} is negative", path=path)
    if number > limit:
        raise construct.RangeError(
            f"the {what} {number} is larger than the limit, {limit}", path=path
        )
    return number


def get_member(obj: Any, dotted: str, default: object = _MISSING) -> Any:
    """Return the member at a dotted path of a nested mapping."""
    for part in dotted.split("."):
        if default is not _MISSING and (not isinstance(obj, Mapping) or part not in obj):
            return default
        obj = obj[part]
    return obj


class MeasuredStruct(Struct):  # type: ignore[misc]
    """A Struct that adds the offsets of its members to the parsed value.

    The entry ``_spans`` of the value has the (start, end) of each member, by name.
    """

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        obj = Container()
        inner = self._make_inner_context(stream, context, is_parsing=True)
        spans = inner._spans
        for con in self.subcons:
            start = stream.tell()
            value = con._parsereport(stream, inner, path)
            end = stream.tell()
            if con.name:
                obj[con.name] = inner[con.name] = value
                spans[con.name] = (start, end)
        obj["_spans"] = spans
        for sizing, field, offset, value in inner._sizings if is_verifying(context) else ():
            expected = sizing.value(obj)
            if value != expected:
                raise MismatchError(field, offset, expected, value, "length")
        return obj

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> Any:
        obj = {} if obj is None else obj
        if not isinstance(obj, dict):
            raise MismatchError(path, 0, "a mapping of field names to values", repr(obj), "value")
        for con in self.subcons:
            if not con.flagbuildnone and con.name not in obj:
                raise MismatchError(f"{path} -> {con.name}", 0, "a value", "none", "missing")
        inner = self._make_inner_context(stream, context, is_parsing=False)
        inner.update({name: value for name, value in obj.items() if name != "_spans"})
        spans = inner._spans
        for con in self.subcons:
            start = stream.tell()
            value = con._build(obj.get(con.name), stream, inner, path)
            if con.name:
                inner[con.name] = value
                spans[con.name] = (start, stream.tell())
        for sizing, field, _, _ in inner._sizings:
            context._params["_sizes"][field] = sizing.value(inner)
        return inner

    def _make_inner_context(self, stream: Any, context: Any, *, is_parsing: bool) -> Container:
        """Return the context of the members' expressions."""
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
        inner._spans = {}
        inner._sizings = []
        return inner


# construct's Array takes minutes if an invalid count is large and its elements have no bytes.
class IndexedArray(Array):  # type: ignore[misc]
    """An Array that does not parse more than `limit` elements.

    The path of an error in an element includes the index of the element.

    Attributes:
        limit: the maximum size of a frame, in bytes, or in bits inside a bit block. A frame cannot
            contain more elements than this.
        in_bits: whether the array is inside a bit block.
    """

    limit: int
    in_bits: bool

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        count = check_bound(construct.evaluate(self.count, context), self.limit, "count", path)
        elements = construct.ListContainer()
        for index in range(count):
            context._index = index
            start = stream.tell()
            place = f"{path}[{index}]"
            element = self.subcon._parsereport(stream, context, place)
            elements.append(element)
            if stream.tell() == start and not self.in_bits:
                context._params["_empty"] = check_bound(
                    context._params.get("_empty", 0) + 1, self.limit, "count", path
                )
        return elements

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> Any:
        count = construct.evaluate(self.count, context)
        if not isinstance(obj, list | tuple | bytes):
            raise MismatchError(path, 0, "a list of elements", repr(obj), "value")
        if len(obj) != count:
            raise construct.RangeError(f"expected {count} elements, found {len(obj)}", path=path)
        return _build_elements(self, obj, stream, context, path)


# construct's GreedyRange ends at an element that fails, and loses all bytes after it.
class FullRange(construct.GreedyRange):  # type: ignore[misc]
    """A GreedyRange that reads all bytes of its enclosing part."""

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        elements = construct.ListContainer()
        while stream.read(1):
            stream.seek(-1, io.SEEK_CUR)
            context._index = len(elements)
            start = stream.tell()
            place = f"{path}[{len(elements)}]"
            elements.append(self.subcon._parsereport(stream, context, place))
            if stream.tell() == start:
                raise construct.RangeError(
                    "an element without bytes would repeat forever", path=place
                )
        return elements

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> Any:
        if not isinstance(obj, list | tuple):
            raise MismatchError(path, 0, "a list of elements", repr(obj), "value")
        return _build_elements(self, obj, stream, context, path)


def _build_elements(
    con: Subconstruct, elements: Iterable[Any], stream: Any, context: Any, path: str
) -> Any:
    """Build the elements of an array; the path of an error includes the index."""
    built = construct.ListContainer()
    for index, element in enumerate(elements):
        context._index = index
        built.append(con.subcon._build(element, stream, context, f"{path}[{index}]"))
    return built


class SkippableConst(Const):  # type: ignore[misc]
    """A Const that is not verified by ``parse(verify=False)``."""

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        start = stream.tell()
        obj = self.subcon._parsereport(stream, context, path)
        if obj != self.value and is_verifying(context):
            raise MismatchError(
                path, start, tree.format_hex(self.value), tree.format_hex(obj), "constant"
            )
        return obj


class LimitedNumber(Subconstruct):  # type: ignore[misc]
    """A number that accepts only some raw values, like construct's OneOf and NoneOf."""

    def __init__(self, subcon: Construct, allowed: tuple[int, ...]) -> None:
        super().__init__(subcon)
        self.allowed = allowed

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        start = stream.tell()
        obj = self.subcon._parsereport(stream, context, path)
        if is_verifying(context):
            return self._check_allowed(obj, start, path)
        return obj

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> Any:
        return self._check_allowed(self.subcon._build(obj, stream, context, path), 0, path)

    def _check_allowed(self, obj: Any, start: int, path: str) -> Any:
        if int(obj) not in self.allowed:
            raise MismatchError(path, start, tree.format_values(self.allowed), int(obj), "value")
        return obj


class SkippableCheck(construct.Check):  # type: ignore[misc]
    """A Check that is not verified by ``parse(verify=False)``."""

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        if is_verifying(context):
            return super()._parse(stream, context, path)
        return None


# construct's Bytes reports an incomplete frame, so a decoder would wait for more bytes.
class CountedBytes(Bytes):  # type: ignore[misc]
    """Bytes that raise `RangeError` if their length is too large for a frame."""

    limit: int

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        length = check_bound(
            operator.index(construct.evaluate(self.length, context)), self.limit, "length", path
        )
        return construct.stream_read(stream, length, path)


class FastNullTerminated(construct.NullTerminated):  # type: ignore[misc]
    """A NullTerminated with a fast search for its terminator."""

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        if len(self.term) != 1 or not self.require or not isinstance(stream, io.BytesIO):
            return super()._parse(stream, context, path)
        start = stream.tell()
        end = stream.getvalue().find(self.term, start)
        if end < 0:
            stream.seek(0, io.SEEK_END)
            return super()._parse(stream, context, path)  # raises, because the stream has ended
        data = stream.read(end + self.include - start)
        stream.seek(end + self.consume)
        within = construct.core.BytesIOWithOffsets(data, stream, start)
        return self.subcon._parsereport(within, context, path)


# construct's FormatField builds a signalling NaN as a quiet NaN.
class ExactFloat(FormatField):  # type: ignore[misc]
    """A float field that keeps the bits of a NaN."""

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


# If a frame is built from the number, construct's Enum gives expressions the number, so the key of
# a Switch matches no case.
class NamedEnum(construct.Enum):  # type: ignore[misc]
    """An Enum whose value is a name in expressions, as in ``this.mode == "dual"``.

    This is also true while a frame is built and the caller has given the number instead of the
    name.
    """

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> Any:
        raw = self._encode(obj, context, path)
        self.subcon._build(raw, stream, context, path)
        return self._decode(raw, context, path)


# construct's RawCopy builds from `data`, and ignores a changed `value`.
class RawPart(Construct):  # type: ignore[misc]
    """A part that is parsed to its value, bytes and offsets, like construct's RawCopy.

    The part is built from the entry `value`, and from the entry `data` only if `value` is missing.
    """

    def __init__(self, subcon: Construct) -> None:
        super().__init__()
        self.subcon = subcon

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        start = stream.tell()
        value = self.subcon._parsereport(stream, context, f"{path} -> value")
        return self._describe(value, stream, start)

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> Any:
        if not isinstance(obj, dict) or not {"value", "data"} & obj.keys():
            raise MismatchError(path, 0, "a mapping with the key 'value'", repr(obj), "value")
        start = stream.tell()
        value = obj.get("value")
        if "value" in obj:
            value = self.subcon._build(value, stream, context, f"{path} -> value")
        else:
            construct.stream_write(stream, obj["data"], len(obj["data"]), path)
        return self._describe(value, stream, start)

    def _describe(self, value: Any, stream: Any, start: int) -> Container:
        end = stream.tell()
        stream.seek(start)
        data = stream.read(end - start)
        return Container(
            data=data,
            value=value,
            offset1=start,
            offset2=end,
            length=end - start,
            _spans={"value": (start, end)},
        )

    def _sizeof(self, context: Any, path: str) -> int:
        return int(self.subcon._sizeof(context, path))


class SkippableChecksum(construct.Checksum):  # type: ignore[misc]
    """A Checksum that is not verified by ``parse(verify=False)``."""

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        start = stream.tell()
        stored = self.checksumfield._parsereport(stream, context, path)
        if is_verifying(context):
            computed = self.hashfunc(self.bytesfunc(context))
            if stored != computed:
                expected = tree.format_hex(computed)
                raise MismatchError(path, start, expected, tree.format_hex(stored), "checksum")
        return stored


class BareNamedTuple(construct.NamedTuple):  # type: ignore[misc]
    """A NamedTuple without the private entries that a prepared struct adds."""

    def _decode(self, obj: Any, context: Any, path: str) -> Any:
        if not isinstance(obj, dict):
            return super()._decode(obj, context, path)
        return self.factory(**{name: obj[name] for name in self.factory._fields})


class CheckedCompressed(construct.Compressed):  # type: ignore[misc]
    """A Compressed that raises `MismatchError` for bytes that cannot be decompressed."""

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        start = stream.tell()
        try:
            return super()._parse(stream, context, path)
        except construct.ConstructError:
            raise
        except Exception as error:  # each compression library has its own exceptions
            expected = f"bytes compressed by {self.encoding}"
            got = "bytes that cannot be decompressed"
            raise MismatchError(path, start, expected, got, "value") from error


class Reserved(CountedBytes):
    """Reserved bytes, in place of construct's Padding, which loses them."""

    def __init__(self, length: Any, pattern: bytes = b"\0") -> None:
        super().__init__(length)
        self.pattern = pattern
        self.flagbuildnone = True

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> Any:
        if obj is None:
            obj = self.pattern * int(construct.evaluate(self.length, context))
        return super()._build(obj, stream, context, path)


class DescribedField(Subconstruct):  # type: ignore[misc]
    """A wrapper that only describes its field, and does not affect its bytes."""

    def describe(self, info: tree.FieldInfo) -> tree.FieldInfo:
        """Return the description of the wrapped field, extended by this wrapper."""
        raise NotImplementedError


class ChecksummedBase(Subconstruct):  # type: ignore[misc]
    """A struct with a checksum.

    Attributes:
        fields: the names of the fields with the checksum, low bits first.
        algorithm: the algorithm; None if a hook has to return it.
        over: the names of the consecutive fields that the checksum covers; None if it covers all
            bytes that contain no bit of `fields`.
        absent: the values that mean that the sensor has computed no checksum.
    """

    fields: tuple[str, ...]
    algorithm: Checksum | None
    over: tuple[str, ...] | None
    absent: frozenset[int]

    #: The class that plugins use, `Checksummed`. It also replaces construct's Checksum of a
    #: RawCopy.
    plugin_class: Callable[..., ChecksummedBase]


class SizeField(Subconstruct):  # type: ignore[misc]
    """A number that declares the size of a part.

    Attributes:
        of: the names that lead from the struct with this field to the part; "_" leads to the outer
            struct.
        plus: a number that is added to the size to give the value of the field.
        since: the name of a member before the part. The size is then counted from the start of this
            member to the end of the part. "" counts the part alone.
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
    def levels_up(self) -> int:
        """The number of steps to outer structs in `of`."""
        return self.of.count("_")

    def value(self, obj: Any) -> int:
        """Return the size of the part in a parsed or built struct."""
        *parents, name = self.of[self.levels_up :] or ("",)
        try:
            spans = (get_member(obj, ".".join(parents)) if parents else obj)["_spans"]
            if name:
                start, end = spans[name]
            else:
                start = min(spans.values())[0]
                end = max(end for _, end in spans.values())
            start = spans[self.since][0] if self.since else start
        except (KeyError, TypeError):
            raise SpecError(
                f"SizeOf refers to {'.'.join(self.of)!r}, which does not exist"
            ) from None
        return int(end - start + self.plus)

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        start = stream.tell()
        value = self.subcon._parsereport(stream, context, path)
        self._add_to_sizings(context, (path, start, value))
        return value

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> Any:
        sizes = context._params.setdefault("_sizes", {})
        self._add_to_sizings(context, (path, 0, obj))
        return self.subcon._build(sizes.get(path, obj or 0), stream, context, path)

    def _add_to_sizings(self, context: Any, entry: tuple[str, int, Any]) -> None:
        """Register this field in the struct that contains the part."""
        for _ in range(self.levels_up):
            context = context.get("_", {})
        context.get("_sizings", []).append((self, *entry))


class CountField(Subconstruct):  # type: ignore[misc]
    """A field with the number of elements of a later array.

    Attributes:
        of: the name of the array.
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


class BoundedPart(Subconstruct):  # type: ignore[misc]
    """A part that is parsed from `length` bytes."""

    def __init__(self, length: Any, subcon: Construct) -> None:
        super().__init__(subcon)
        self.length = length

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        start = stream.tell()
        length = check_bound(construct.evaluate(self.length, context), sys.maxsize, "length", path)
        stream.seek(0)
        within = io.BytesIO(construct.stream_read(stream, start + length, path))
        within.seek(start)
        value = self.subcon._parsereport(within, context, path)
        stream.seek(within.tell())
        return value


class PaddingField(CountedBytes):
    """The padding after consecutive members.

    Args:
        of: the names of the first and the last of the members.
        to: the total size of members and padding, in bytes, or None.
        modulus: the total size is a multiple of this number of bytes; None if `to` is given.
        pattern: the byte that `build` repeats if no value is given.
    """

    def __init__(
        self, of: tuple[str, str], to: Any = None, modulus: Any = None, pattern: bytes = b"\0"
    ) -> None:
        super().__init__(self._count_missing)
        self.of = of
        self.to = to
        self.modulus = modulus
        self.pattern = pattern
        self.flagbuildnone = True

    def _count_missing(self, context: Any) -> int:
        start = context._spans[self.of[0]][0]
        end = context._spans[self.of[1]][1]
        number = construct.evaluate(self.modulus if self.to is None else self.to, context)
        return int((start - end) % number if self.to is None else number - (end - start))

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> Any:
        length = check_bound(self._count_missing(context), self.limit, "length", path)
        return super()._build(self.pattern * length if obj is None else obj, stream, context, path)


class ParsedParts(construct.ListContainer):  # type: ignore[misc]
    """Parts that were parsed or built.

    Attributes:
        spans: for each part, its kind, the offset of its first byte and the offset after its last
            byte.
    """

    def __init__(self) -> None:
        super().__init__()
        self.spans: list[tuple[str, int, int]] = []

    @property
    def size(self) -> int:
        """The total size of all parts in bytes."""
        return sum(end - start for _, start, end in self.spans)

    def __getitem__(self, key: Any) -> Any:
        if key == "size":
            return self.size
        return super().__getitem__(key)


class Partition(Construct):  # type: ignore[misc]
    """Consecutive structs of different sizes.

    Attributes:
        cases: the struct of each kind of parts, by name.
        count: the number of parts, or None.
        size: the size of the first part in bytes, or None.
        within: the total size of all parts in bytes, or None.
        following: an expression of the fields of a part, which gives the size of the next part; or
            None.
        limit: the maximum size of a frame, in bytes.
    """

    cases: dict[str, Construct]
    count: Any
    size: Any
    within: Any
    following: Any
    limit: int = sys.maxsize
