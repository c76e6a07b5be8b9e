"""Functions that work on the constructs of a plugin's struct.

`prepare` replaces construct's classes in the struct. Other functions find properties of constructs,
and draw random values that a construct can build.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import io
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
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

from lidarspec.spec.enum_values import EnumValue
from lidarspec.spec.syntax.raw_checksums import add_checksums, extract_checksums
from lidarspec.spec.syntax.replacements import (
    BareNamedTuple,
    BoundedPart,
    CheckedCompressed,
    ChecksummedBase,
    CountedBytes,
    CountField,
    DescribedField,
    ExactFloat,
    FastNullTerminated,
    Fault,
    FullRange,
    IndexedArray,
    LimitedNumber,
    MeasuredStruct,
    NamedEnum,
    PaddingField,
    ParsedParts,
    Partition,
    RawPart,
    Reserved,
    SizeField,
    SkippableCheck,
    SkippableChecksum,
    SkippableConst,
    check_bound,
)

if TYPE_CHECKING:
    import random  # imported here because finding a sensor does not need it

    #: The functions that draw the values of certain fields, by path.
    Drawn = Mapping[str, Callable[[random.Random], Any]]

#: The replacements of construct's classes.
_REPLACEMENTS: dict[type, type] = {
    Struct: MeasuredStruct,
    Array: IndexedArray,
    Const: SkippableConst,
    construct.Enum: NamedEnum,
    construct.GreedyRange: FullRange,
    construct.NullTerminated: FastNullTerminated,
    construct.NamedTuple: BareNamedTuple,
    construct.Compressed: CheckedCompressed,
}

#: Wrappers that only change how a value is printed or when it is read.
_TRANSPARENT = (
    construct.Hex,
    construct.HexDump,
    construct.Lazy,
    construct.Debugger,
    construct.Rebuffered,
)

#: The LazyBound constructs that are being prepared, to detect recursion.
_BINDING: list[Construct] = []

#: The attributes in which constructs contain other constructs. The attribute "cases" contains them
#: by key.
_INNER = ("subcon", "thensubcon", "elsesubcon", "default", "checksumfield")


def prepare(con: Construct, limit: int = sys.maxsize, *, in_bits: bool = False) -> Construct:
    """Return a copy of a struct in which construct's classes are replaced.

    Args:
        limit: the maximum size of a frame, in bytes, or in bits inside a bit block.
        in_bits: whether the construct is inside a bit block.
    """
    if isinstance(con, FormatField):
        if con.fmtstr[-1] in "efd":
            return ExactFloat(con.fmtstr[0], con.fmtstr[-1])
        return con
    if isinstance(con, _TRANSPARENT):
        return prepare(con.subcon, limit, in_bits=in_bits)
    if isinstance(con, construct.LazyStruct):
        return prepare(Struct(*con.subcons), limit, in_bits=in_bits)
    if isinstance(con, construct.LazyArray):
        return prepare(Array(con.count, con.subcon), limit, in_bits=in_bits)
    if isinstance(con, construct.LazyBound):
        return _bind(con, limit, in_bits=in_bits)
    if isinstance(con, construct.Compiled):
        return prepare(con.defersubcon, limit, in_bits=in_bits)
    if isinstance(con, construct.Sequence | construct.FocusedSeq):
        same = copy.copy(con)
        same.subcons = [prepare(child, limit, in_bits=in_bits) for child in con.subcons]
        return same
    if isinstance(con, construct.Check):
        return SkippableCheck(con.func)
    if isinstance(con, construct.Mapping) and {
        *map(type, con.encmapping),
        *map(type, con.decmapping),
    } == {str, int}:
        return LimitedNumber(
            NamedEnum(prepare(con.subcon, limit, in_bits=in_bits), **con.encmapping),
            tuple(sorted(con.decmapping)),
        )
    if isinstance(con, construct.ExprValidator) and (allowed := _find_allowed(con)) is not None:
        return LimitedNumber(prepare(con.subcon, limit, in_bits=in_bits), allowed)
    if isinstance(con, PaddingField | Reserved):
        con.limit = limit
        return con
    if isinstance(con, construct.RawCopy):
        return RawPart(prepare(con.subcon, limit, in_bits=in_bits))
    if isinstance(con, construct.Checksum):
        field = prepare(con.checksumfield, limit, in_bits=in_bits)
        return SkippableChecksum(field, con.hashfunc, con.bytesfunc)
    if isinstance(con, construct.Padded):
        padded = _replace_padding(con, in_bits=in_bits)
        if padded is not None:
            return prepare(padded, limit, in_bits=in_bits)
    if isinstance(con, Bytes):
        counted = CountedBytes(con.length)
        counted.limit = limit
        return counted
    if isinstance(con, Struct):
        members = _name_padding(con.subcons)
        if not in_bits:
            members = [member for child in members for member in _expand_macro(child)]
            members = [
                _to_count_field(member, members[number:])
                for number, member in enumerate(members, 1)
            ]
        members, checksums = extract_checksums(members)
        prepared = (prepare(child, limit, in_bits=in_bits) for child in members)
        return add_checksums(MeasuredStruct(*prepared), checksums)
    if isinstance(con, construct.Renamed):
        # ("name" / con) * "docs" wraps twice, and the path would name it twice
        inner = prepare(_strip_name(con), limit, in_bits=in_bits)
        return construct.Renamed(inner, newname=con.name, newdocs=con.docs)
    if not isinstance(con, Subconstruct | construct.IfThenElse | construct.Switch | Partition):
        return con
    same = copy.copy(con)
    same.__class__ = next(
        (own for kind, own in _REPLACEMENTS.items() if isinstance(con, kind)), type(con)
    )
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


def _strip_name(con: Construct) -> Construct:
    """Return a construct without its name and documentation."""
    while isinstance(con, construct.Renamed):
        con = con.subcon
    return con


def _bind(con: construct.LazyBound, limit: int, *, in_bits: bool) -> Construct:
    """Return the construct of a LazyBound, or a recursive LazyBound unchanged."""
    if con in _BINDING:
        return con
    _BINDING.append(con)
    try:
        return prepare(con.subconfunc(), limit, in_bits=in_bits)
    finally:
        _BINDING.remove(con)


def _name_padding(members: list[Construct]) -> list[Construct]:
    """Return the members of a struct after naming unnamed paddings and checks."""
    taken = {member.name for member in members}
    named = list[Construct]()
    for member in members:
        part = _strip_name(member)
        is_padding = isinstance(part, construct.Padded) and part.subcon is construct.Pass
        if member.name is None and (is_padding or isinstance(part, construct.Check)):
            kind = "padding" if is_padding else "check"
            number = 1
            name = kind
            while name in taken:
                number += 1
                name = f"{kind}_{number}"
            taken.add(name)
            named.append(construct.Renamed(member, newname=name))
        else:
            named.append(member)
    return named


def _replace_padding(con: construct.Padded, *, in_bits: bool) -> Construct | None:
    """Return the field or struct that replaces padding or a padded struct, or None."""
    if con.subcon is construct.Pass and in_bits:
        return construct.Default(BitsInteger(con.length), 0)
    if con.subcon is construct.Pass:
        return Reserved(con.length, con.pattern)
    inner = con.subcon
    if not in_bits and isinstance(inner, Struct) and isinstance(con.length, int):
        left = con.length - fixed_size(inner)
        if fixed_size(inner) and left >= 0:
            return Struct(*inner.subcons, construct.Padded(left, construct.Pass, con.pattern))
    return None


def _expand_macro(con: Construct) -> list[Construct]:
    """Return the members that replace a prefixed, padded or aligned member."""
    inner = _strip_name(con)
    if not con.name:
        return [con]
    if isinstance(inner, construct.IfThenElse) and inner.elsesubcon is construct.Pass:
        return _expand_optional(con, inner)
    if _is_pascal_string(inner):
        text = construct.StringEncoded(construct.GreedyBytes, inner.encoding)
        length = inner.subcon
        prefixed = construct.Prefixed(length.lengthfield, text, length.includelength)
        return _expand_prefixed(con, prefixed)
    if isinstance(inner, construct.FixedSized | construct.Prefixed):
        distributed = _distribute_xor(inner.subcon)
        if distributed is not inner.subcon:
            inner = copy.copy(inner)
            inner.subcon = distributed
            con = construct.Renamed(inner, newname=con.name, newdocs=con.docs)
    if isinstance(inner, construct.Prefixed):
        return _expand_prefixed(con, inner)
    if isinstance(inner, construct.FocusedSeq):
        return _expand_focused(con, inner)
    if isinstance(inner, construct.Aligned):
        members, span = _expand_padded(con, inner)
        filler = PaddingField(span, modulus=inner.modulus, pattern=inner.pattern)
        return [*members, _name_field(con, "_padding", filler, "padding of")]
    is_padded = isinstance(inner, construct.Padded) and inner.subcon is not construct.Pass
    if is_padded or (isinstance(inner, construct.FixedSized) and not is_greedy(inner.subcon)):
        members, span = _expand_padded(con, inner)
        if isinstance(inner.length, int) and inner.length == fixed_size(inner.subcon):
            return members
        pattern = inner.pattern if is_padded else b"\0"
        filler = PaddingField(span, to=inner.length, pattern=pattern)
        return [*members, _name_field(con, "_padding", filler, "padding of")]
    return [con]


def _is_pascal_string(con: Construct) -> bool:
    return (
        isinstance(con, construct.StringEncoded)
        and isinstance(con.subcon, construct.Prefixed)
        and con.subcon.subcon is construct.GreedyBytes
    )


def _distribute_xor(con: Construct) -> Construct:
    """Apply the ProcessXor of a struct to each member of the struct."""
    if not isinstance(con, construct.ProcessXor) or not isinstance(con.subcon, Struct):
        return con
    key = find_xor_key(con)
    members = list[Construct]()
    for member in con.subcon.subcons:
        content = _strip_name(member)
        size = fixed_size(content) if is_independent(content) else 0
        is_rest = content is construct.GreedyBytes and member is con.subcon.subcons[-1]
        if key is None or not member.name or not (size or is_rest):
            return con
        part = _distribute_xor(construct.ProcessXor(key, content))
        if size and not isinstance(part, Struct):
            part = construct.FixedSized(size, part)
        members.append(construct.Renamed(part, newname=member.name, newdocs=member.docs))
        start = size % len(key)
        key = key[start:] + key[:start]
    return Struct(*members)


def find_xor_key(con: construct.ProcessXor) -> bytes | None:
    """Return the key of a ProcessXor; None if the key is an expression, or empty."""
    if isinstance(con.padfunc, int):
        return bytes([con.padfunc])
    if isinstance(con.padfunc, bytes) and con.padfunc:
        return con.padfunc
    return None


def _name_field(con: Construct, ending: str, field: Construct, what: str) -> Construct:
    """Return `field` with a name and documentation that contain the name of a member.

    Args:
        con: the member of the struct.
        ending: the text after the member's name in the name of the field, such as "_size".
        field: a field for bytes that construct does not show as a value, such as a length.
        what: the text before the member's name in the documentation, such as "bytes of".
    """
    return construct.Renamed(field, newname=con.name + ending, newdocs=f"{what} {con.name}")


def _expand_content(con: Construct, content: Construct) -> list[Construct]:
    """Return the members that replace a member with this content."""
    return _expand_macro(construct.Renamed(content, newname=con.name, newdocs=con.docs))


def _expand_optional(con: Construct, inner: construct.IfThenElse) -> list[Construct]:
    members = _expand_content(con, inner.thensubcon)
    if len(members) == 1:
        return [con]
    return [
        construct.Renamed(
            construct.If(inner.condfunc, member.subcon), newname=member.name, newdocs=member.docs
        )
        for member in members
    ]


def _expand_prefixed(con: Construct, inner: construct.Prefixed) -> list[Construct]:
    plus = inner.lengthfield.sizeof() if inner.includelength else 0
    content = inner.subcon
    if is_greedy(content):
        length = construct.this[f"{con.name}_size"]
        content = BoundedPart(length - plus if plus else length, content)
    members = _expand_content(con, content)
    size = SizeField(inner.lengthfield, (members[-1].name,), plus, members[0].name)
    return [_name_field(con, "_size", size, "bytes of"), *members]


def _expand_focused(con: Construct, inner: construct.FocusedSeq) -> list[Construct]:
    """Return the members that replace a FocusedSeq.

    The part in focus gets the name of the FocusedSeq, and the other parts become fields of their
    own. If this is impossible, the FocusedSeq is returned as the only member.
    """
    focus = inner.parsebuildfrom
    parts = {part.name: _strip_name(part) for part in inner.subcons}
    others = [part for part in inner.subcons if part.name != focus]
    count = _find_count(parts.get(focus), parts, focus)
    plain = [part for part in inner.subcons if count is None or part.name not in (focus, count)]
    is_complete = focus in parts and all(part.flagbuildnone for part in others)
    if not is_complete or not all(map(_is_fixed, plain)):
        return [con]
    members = list[Construct]()
    for number, part in enumerate(inner.subcons, 1):
        content = _strip_name(part)
        if part.name == focus and count is not None:
            array = Array(construct.this[f"{con.name}_{count}"], content.subcon)
            members.append(construct.Renamed(array, newname=con.name, newdocs=con.docs))
        elif part.name == focus:
            members += _expand_content(con, content)
        else:
            what = "part of"
            if count is not None and part.name == count:
                content = CountField(content.subcon, con.name)
                what = "number of"
            name = part.name or f"constant_{number}"
            members.append(_name_field(con, f"_{name}", content, what))
    return members


#: Numbers of elements that are tried with the field of a count. If the field has a mask or a limit,
#: it changes at least one of them.
COUNT_TRIALS = (0, 1, 3, *((1 << bit) - 1 for bit in range(3, 17)))


def _to_count_field(member: Construct, later: Sequence[Construct]) -> Construct:
    """Return a `CountField` for a member that counts the elements of a later member.

    Any other member is returned unchanged.
    """
    content = _strip_name(member)
    if not member.name or not isinstance(content, construct.Rebuild):
        return member
    for part in later:
        if part.name and _is_count(content, member.name, _strip_name(part), part.name):
            count = CountField(content.subcon, part.name)
            return construct.Renamed(count, newname=member.name, newdocs=member.docs)
    return member


def _is_fixed(con: Construct) -> bool:
    """Return whether a part has a fixed size and does not depend on other parts."""
    return is_independent(con, _DESCRIBED_KINDS) and fixed_size(con) > 0


def _find_count(array: Construct | None, parts: Mapping[str, Construct], focus: str) -> str | None:
    """Return the name of the part of a FocusedSeq that counts an array.

    Args:
        focus: the name of the array.
    """
    if not isinstance(array, Array):
        return None
    return next((name for name, part in parts.items() if _is_count(part, name, array, focus)), None)


def _is_count(part: Construct, name: str, array: Construct, array_name: str) -> bool:
    """Return whether a part of a struct is a Rebuild that counts an array or bytes."""
    if isinstance(array, Array):
        count = array.count
    elif isinstance(array, Bytes):
        count = array.length
    else:
        return False
    if not isinstance(part, construct.Rebuild) or not callable(count):
        return False
    # The functions of a plugin may raise anything.
    with contextlib.suppress(Exception):
        return all(
            part.func(Container({array_name: [0] * length})) == length
            and count(Container({name: length})) == length
            for length in COUNT_TRIALS
        )
    return False


def _expand_padded(con: Construct, inner: Subconstruct) -> tuple[list[Construct], tuple[str, str]]:
    """Return the members of a padded part, and the names of its first and last member."""
    members = _expand_content(con, inner.subcon)
    return members, (members[0].name, members[-1].name)


class _ComparisonRecorder:
    """Replaces the value that a validator checks, and records comparisons with it."""

    __hash__ = None  # type: ignore[assignment]

    def __init__(self) -> None:
        self.values: list[Any] = []

    def __eq__(self, other: object) -> bool:
        self.values.append(other)
        return False


def _find_allowed(con: construct.Validator) -> tuple[int, ...] | None:
    """Return the raw values that a validator accepts; None if they are unknown."""
    field = unwrap(con)
    subcon = con.subcon
    while isinstance(subcon, Subconstruct) and not isinstance(subcon, construct.Enum):
        subcon = subcon.subcon
    kind = number_kind(field)
    if kind not in ("i", "u"):
        return None
    width = bit_width(field)
    low = -(1 << (width - 1)) if kind == "i" else 0
    high = low + (1 << width) - 1
    # A function of a plugin may raise anything for the placeholder, or for an unexpected number.
    with contextlib.suppress(Exception):
        passes = con._validate(compared := _ComparisonRecorder(), None, "")
        if compared.values and not passes and all(type(value) is int for value in compared.values):
            return tuple(
                value
                for value in sorted({*compared.values})
                if low <= value <= high and con._validate(value, None, "")
            )
    with contextlib.suppress(Exception):
        if width <= 16:
            seen = (
                (lambda raw: subcon._decode(raw, None, None))
                if isinstance(subcon, construct.Enum)
                else int
            )
            return tuple(raw for raw in range(low, high + 1) if con._validate(seen(raw), None, ""))
    return None


#: Constructs that read all available bytes.
GREEDY = (construct.GreedyRange, type(construct.GreedyBytes))

#: Constructs that read all available bytes and convert them to other bytes.
RECODING = (construct.Tunnel, construct.ProcessXor, construct.ProcessRotateLeft)


def is_greedy(
    con: Construct, kinds: tuple[type, ...] = (*GREEDY, *RECODING, construct.NullStripped)
) -> bool:
    """Return whether a part reads all bytes that are available.

    Args:
        kinds: the constructs that read all bytes.
    """
    if isinstance(con, kinds):
        return True
    if isinstance(
        con,
        Array
        | construct.NullTerminated
        | construct.NullStripped
        | construct.FixedSized
        | construct.Prefixed
        | BoundedPart,
    ):
        return False
    return any(
        is_greedy(child, kinds)
        for child in (children(con)[-1:] if isinstance(con, Struct) else children(con))
    )


def unwrap(con: Construct, *, bits: bool = True) -> Construct:
    """Return a construct without its name, unit, checksum and other wrappers.

    Args:
        bits: whether to remove a conversion of bytes to bits, such as that of a BitStruct.
    """
    while isinstance(con, Subconstruct) and not isinstance(con, Array | Const):
        if isinstance(con, construct.Transformed | construct.Restreamed) and not bits:
            return con
        con = con.subcon
    return con


def is_struct(con: Construct) -> bool:
    """Return whether a construct is a Struct, with or without a checksum."""
    return isinstance(unwrap(con, bits=False), Struct)


def has_member(con: Construct, dotted: str) -> bool:
    """Return whether a struct has a member with this dotted name."""
    inner: Any = unwrap(con)
    for part in dotted.split("."):
        if not isinstance(inner, Struct) or part not in inner._subcons:
            return False
        inner = unwrap(inner._subcons[part])
    return True


def bit_width(con: Construct) -> int:
    """Return the number of bits of a field of fixed size."""
    inner = unwrap(con)
    if isinstance(inner, BitsInteger):
        return int(inner.length)
    if isinstance(inner, FormatField | BytesInteger | Bytes):
        return 8 * int(inner.length)
    return 8 * int(inner.sizeof())


def number_kind(con: Construct) -> str:
    """Return "f" for a float, "i" for a signed and "u" for an unsigned integer.

    Returns "" if the construct is not a number.
    """
    if isinstance(con, BytesInteger | BitsInteger):
        return "i" if con.signed else "u"
    code = con.fmtstr[-1] if isinstance(con, FormatField) else "?"
    if code == "?":
        return ""
    if code in "efd":
        return "f"
    return "i" if code.islower() else "u"


def fixed_size(con: Construct) -> int:
    """Return the number of bytes of a construct; 0 if its size is not fixed."""
    try:
        return int(con.sizeof())
    except Exception:  # construct raises KeyError if a condition reads a field
        return 0


#: Constructs that depend only on their own bytes.
_INDEPENDENT_KINDS = (
    FormatField,
    BytesInteger,
    Bytes,
    Array,
    construct.Sequence,
    Struct,
    construct.Adapter,
    construct.NullStripped,
    construct.FixedSized,
    construct.Renamed,
    Const,
    construct.ProcessXor,
    type(construct.GreedyBytes),
)

#: The same constructs, and constructs that the frame tree describes, so that no function has to
#: decode them.
_DESCRIBED_KINDS = (
    *_INDEPENDENT_KINDS,
    DescribedField,
    construct.Padded,
    construct.Default,
    construct.Transformed,
    construct.Restreamed,
    BitsInteger,
    type(construct.Flag),
    type(construct.Pass),
)


def is_independent(con: Construct, kinds: tuple[type, ...] = _INDEPENDENT_KINDS) -> bool:
    """Return whether a part depends only on its own bytes.

    Args:
        kinds: the constructs that depend only on their own bytes.
    """
    if isinstance(con, construct.ProcessXor) and find_xor_key(con) is None:
        return False
    return isinstance(con, kinds) and all(is_independent(child, kinds) for child in children(con))


def to_public(parsed: Any) -> Any:
    """Return a parsed object without private entries.

    Construct's values of an Enum are replaced by `EnumValue`.
    """
    if isinstance(parsed, dict):
        return Container(
            {name: to_public(value) for name, value in parsed.items() if not name.startswith("_")}
        )
    if isinstance(parsed, list):
        return construct.ListContainer(to_public(value) for value in parsed)
    if isinstance(parsed, construct.EnumIntegerString):
        return EnumValue(parsed.intvalue, str(parsed))
    if isinstance(parsed, construct.EnumInteger):
        return EnumValue(parsed)
    return parsed


def field_path(path: str | None) -> str:
    """Return a path of construct as a field path.

    "(parsing) -> points[1] -> intensity" becomes "points[1].intensity".
    """
    # If a part has documentation but no name, construct adds "None" to the path.
    names = re.sub(r" -> None(?=$| ->|\[)", "", path or "").split(" -> ")[1:]
    return ".".join(names)


def declared_class_name(con: Construct) -> str:
    """Return the name of the construct class that the plugin's struct declares.

    If `prepare` has replaced the class, this is the name of the replaced class.
    """
    classes = type(con).__mro__
    own = [kind for kind in classes if not kind.__module__.startswith("lidarspec.spec.syntax")]
    return own[0].__name__


def children(con: Construct) -> list[Construct]:
    """Return the constructs directly inside a construct, including its branches."""
    if isinstance(con, Struct | construct.Sequence | construct.FocusedSeq):
        return list(con.subcons)
    below = [getattr(con, name) for name in _INNER if name in vars(con)]
    return below + (list(con.cases.values()) if "cases" in vars(con) else [])


def iter_checksummed(con: Construct) -> Iterator[ChecksummedBase]:
    """Yield the structs with checksums in a struct, outer structs first."""
    if isinstance(con, ChecksummedBase):
        yield con
    for child in children(con):
        yield from iter_checksummed(child)


def iter_leaves(
    parsed: Any, keys: tuple[str | int, ...] = ()
) -> Iterator[tuple[tuple[str | int, ...], Any]]:
    """Yield the values of a parsed object with the keys that lead to them."""
    if isinstance(parsed, dict):
        for name, value in parsed.items():
            if not name.startswith("_"):
                yield from iter_leaves(value, (*keys, name))
    elif isinstance(parsed, list):
        for index, value in enumerate(parsed):
            yield from iter_leaves(value, (*keys, index))
    else:
        yield keys, int(parsed) if isinstance(parsed, construct.EnumIntegerString) else parsed


def is_expression(value: object) -> bool:
    """Return whether a value is an expression of construct, such as `this.a > 1`.

    A Construct object, such as `Int8ub`, also counts as an expression, because it too has no value
    without a frame.
    """
    return isinstance(value, ExprMixin | Construct)


#: Half of the random numbers are below one of these limits, because a large number is hardly ever a
#: valid count or key.
SMALL_LIMITS = (1, 6, 40)

#: The maximum number of attempts to draw a valid part.
MAX_DRAWS = 100


def random_value(
    con: Construct, source: random.Random, drawn: Drawn, scope: Any = None, path: str = ""
) -> Any:
    """Return a random value that a construct can build.

    Args:
        source: the source of random numbers. If it has the methods `draw_number` and
            `draw_elements`, they draw integers, floats and arrays.
        drawn: the functions that draw the values of certain fields, by path.
        scope: the context for expressions.
    """
    if path in drawn:
        return drawn[path](source)
    if isinstance(con, Const):
        # For an Enum this is its name with the number, which expressions need.
        return con.parse(con.build(con.value), _verify=False)
    if isinstance(con, construct.Rebuild):
        # It may depend on later fields; it is evaluated again when the frame is built.
        with contextlib.suppress(Exception):
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
    if isinstance(con, RawPart):
        return Container(value=random_value(con.subcon, source, drawn, scope, f"{path}.value"))
    if isinstance(con, construct.GreedyRange):
        return [
            random_value(con.subcon, source, drawn, scope, path)
            for _ in range(source.randint(0, 4))
        ]
    if isinstance(con, construct.RepeatUntil):
        return _draw_until(con, source, drawn, scope, path)
    if isinstance(con, Partition):
        return _draw_parts(con, source, drawn, scope, path)
    if isinstance(con, Array):
        count = check_bound(construct.evaluate(con.count, scope), con.limit, "count", path)
        check_bound(count * _count_elements(con.subcon, scope), con.limit, "count", path)
        draw_one = functools.partial(random_value, con.subcon, source, drawn, scope, path)
        if hasattr(source, "draw_elements"):
            return source.draw_elements(count, draw_one)
        return [draw_one() for _ in range(count)]
    if isinstance(con, construct.IfThenElse):
        holds = construct.evaluate(con.condfunc, scope)
        branch = con.thensubcon if holds else con.elsesubcon
        return random_value(branch, source, drawn, scope, path)
    if isinstance(con, construct.Switch):
        case = con.cases.get(construct.evaluate(con.keyfunc, scope), con.default)
        return random_value(case, source, drawn, scope, path)
    if isinstance(con, LimitedNumber):
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
        return _draw_leaf(con, source, scope, path)
    if isinstance(con, construct.Adapter):
        return to_public(
            con.parse(con.subcon.build(random_value(con.subcon, source, drawn, scope, path)))
        )
    return random_value(con.subcon, source, drawn, scope, path)


def _draw_until(
    con: construct.RepeatUntil, source: random.Random, drawn: Drawn, scope: Any, path: str
) -> list[Any]:
    """Return random elements, up to the first element that ends the array."""
    found: list[Any] = construct.ListContainer()
    for _ in range(MAX_DRAWS):
        element = random_value(con.subcon, source, drawn, scope, path)
        found.append(element)
        if con.predicate is True or con.predicate(element, found, scope):
            break
    return found


def _count_elements(con: Construct, scope: Any) -> int:
    """Return the number of values in an element of an array; 1 for a single value."""
    with contextlib.suppress(Exception):  # the count may depend on fields that are not drawn yet
        if isinstance(con, Array):
            return int(construct.evaluate(con.count, scope)) * _count_elements(con.subcon, scope)
        return 1
    return 1


def _draw_parts(
    con: Partition, source: random.Random, drawn: Drawn, scope: Any, path: str
) -> ParsedParts:
    """Return random parts.

    Each part is built, because expressions of later fields may use the total size of the parts
    (`ParsedParts.size`).
    """
    parts = ParsedParts()
    around = Container(
        {**scope, "_params": Container(), "_parsing": False, "_building": True, "_sizing": False}
    )
    for _ in range(source.randint(0, 4)):
        name = source.choice(list(con.cases))
        stream = io.BytesIO()
        parts.append(_draw_part(con.cases[name], source, drawn, scope, path))
        con.cases[name]._build(parts[-1], stream, around, path)
        parts.spans.append((name, 0, stream.tell()))
    return parts


def _draw_part(con: Construct, source: random.Random, drawn: Drawn, scope: Any, path: str) -> Any:
    """Return a random part; try again if its values are invalid."""
    # Without these attempts, frames with several counts would hardly ever have a part.
    for _ in range(MAX_DRAWS):
        with contextlib.suppress(Fault):
            return random_value(con, source, drawn, scope, path)
    return random_value(con, source, drawn, scope, path)


def _draw_leaf(con: Construct, source: random.Random, scope: Any, path: str) -> Any:
    if con is construct.Pass or isinstance(con, construct.Check | PaddingField | Reserved):
        # checks and padding are computed when the frame is built
        return None
    if isinstance(con, construct.NullTerminated):
        return str(source.randrange(10 ** source.randint(1, 4))).encode()
    if isinstance(con, construct.Computed):
        return construct.evaluate(con.func, scope)
    if isinstance(con, SkippableChecksum):
        return None  # computed when the frame is built
    if con is construct.GreedyBytes:
        return source.randbytes(source.randint(0, 4))
    if isinstance(con, Bytes):
        return source.randbytes(
            check_bound(construct.evaluate(con.length, scope), con.limit, "length", "")
        )
    kind = number_kind(con)
    if kind and hasattr(source, "draw_number"):
        return source.draw_number(path, bit_width(con), kind)
    if kind and source.random() < 0.5:
        # It may be a count.
        limit = min(source.choice(SMALL_LIMITS), (1 << (bit_width(con) - 1)) - 1)
        return con.parse(con.build(source.randint(0, limit)))
    if con in (construct.VarInt, construct.ZigZag):
        return source.randint(0, source.choice(SMALL_LIMITS))
    if isinstance(con, BitsInteger):
        value = source.getrandbits(con.length)
        if con.signed and value >> (con.length - 1):
            return value - (1 << con.length)
        return value
    return con.parse(source.randbytes(con.sizeof()))
