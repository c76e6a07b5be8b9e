"""Raise errors for structs that cannot describe a frame.

Examples are structs with two members of the same name, and constructs that lose bits.
"""

from __future__ import annotations

from collections.abc import Iterator

import construct
from construct import Array, Const, Construct, Container, Struct

from lidarspec.errors import SpecError
from lidarspec.spec import tree
from lidarspec.spec.syntax.adapters import is_int_adapter, try_values
from lidarspec.spec.syntax.replacements import (
    BoundedPart,
    DescribedField,
    Partition,
)
from lidarspec.spec.syntax.structs import (
    GREEDY,
    RECODING,
    children,
    declared_class_name,
    fixed_size,
    is_greedy,
    unwrap,
)

#: The field names that are reserved for `points` and the engine.
RESERVED = frozenset({"state", "on"})
SHADOWED = frozenset(name for name in dir(Container) if not name.startswith("_"))

#: The constructs that are not supported, with the rule of `lidarspec check` and the reason.
_REFUSED: dict[type, tuple[str, str]] = {
    type(construct.Pickled): ("LS110", "Pickled executes code from the wire: use other fields"),
    construct.FlagsEnum: (
        "LS108",
        "FlagsEnum loses undeclared bits: declare each bit as a field of a BitStruct",
    ),
    construct.Union: (
        "LS109",
        (
            "Union parses the same bytes as several fields, but builds one field: declare a"
            " single field"
        ),
    ),
    construct.Padded: (
        "LS106",
        ("a rebuilt frame loses the bytes of padding: declare a field, 'reserved' / Bytes(n)"),
    ),
    construct.Aligned: (
        "LS106",
        (
            "a rebuilt frame loses the padding of Aligned: make Aligned a named member of a Struct,"
            " as in Struct('part' / Aligned(4, ...))"
        ),
    ),
    construct.Slicing: (
        "LS106",
        "Slicing loses elements of its array: use the Array without Slicing",
    ),
    construct.Indexing: (
        "LS106",
        "Indexing loses elements of its array: use the Array without Indexing",
    ),
    construct.Pointer: (
        "LS112",
        "Pointer reads outside the frame: declare fields in the order of the wire",
    ),
    construct.Seek: (
        "LS112",
        "Seek reads outside the frame: declare the skipped bytes, 'reserved' / Bytes(n)",
    ),
    construct.Select: (
        "LS113",
        "Select and Optional hide errors in the bytes: use If or Switch on a header field",
    ),
    construct.Probe: (
        "LS105",
        "Probe prints while parsing: use lidarspec explain to see every byte of a frame",
    ),
    construct.StopIf: (
        "LS105",
        "StopIf omits the rest of a struct: use 'rest' / If(this.more, Struct(...))",
    ),
}

#: The constructs that give a greedy part an end.
_BOUNDED_KINDS = (construct.NullTerminated, construct.FixedSized, construct.Prefixed, BoundedPart)


def check_struct(con: Construct) -> SpecError | None:
    """Raise `SpecError` if a construct cannot describe a frame.

    Returns:
        An error if the last part of the frame has no end in a byte stream, else None. The error is
        not raised, because such frames are valid in datagrams.

    Raises:
        SpecError: for a shadowed, reserved, duplicate or missing name, for a construct that loses
            bits, or for a part without an end that is followed by other parts.
    """
    endless = _check_ends(con, "", bounded=False)
    constructs = list(_iter_constructs(con, "", in_bits=False))
    for path, part, in_bits in constructs:
        _check_class(part, path, in_bits=in_bits)
    for path, part, in_bits in constructs:
        if isinstance(part, Struct):
            _check_names(part, path, in_bits=in_bits)
        if isinstance(part, construct.FocusedSeq):
            _check_focus(part, path)
        if isinstance(part, Partition) and any(
            child.name == "frame" for case in part.cases.values() for child in unwrap(case).subcons
        ):
            raise SpecError(
                "no field of a part may be called 'frame', because f.frame is the outer frame",
                path=f"{path}.frame",
                rule="LS102",
            )
    _check_measures(con, "", (1, 0, ""), {})
    return endless


def _check_class(part: Construct, path: str, *, in_bits: bool) -> None:
    """Raise SpecError if the class of a part is not supported."""
    lost = try_values(part).lost if is_int_adapter(part) else None
    if lost is not None and not isinstance(part, construct.FlagsEnum):
        raw, back = lost
        reason = (
            f"{declared_class_name(part)} changes {raw} to {back!r:.80} when a parsed frame is"
            " built again"
        )
        raise SpecError(reason, path=path, rule="LS106")
    for kind, (rule, reason) in _REFUSED.items():
        is_exact = kind is construct.FlagsEnum and is_int_adapter(part) and lost is None
        if isinstance(part, kind) and not is_exact:
            raise SpecError(reason, path=path, rule=rule)
    if isinstance(part, type(construct.Flag)) and not in_bits:
        raise SpecError(
            "Flag keeps only one bit of its byte: use a BitStruct, or Int8ul",
            path=path,
            rule="LS107",
        )


def _check_ends(
    con: Construct, path: str, *, bounded: bool, is_last: bool = True
) -> SpecError | None:
    """Raise SpecError if a part that reads all available bytes is not the last part.

    Returns:
        An error if the last part of the frame reads all bytes of a stream, else None.

    Raises:
        SpecError: if another part follows, or if a part loses bytes.
    """
    if isinstance(con, construct.Renamed):
        path = f"{path}.{con.name}".strip(".")
    below = children(con)
    endless: SpecError | None = None
    if con is construct.Terminated:
        reason = "Terminated expects the end of a stream: remove Terminated"
        endless = SpecError(reason, path=path, rule="LS111")
        if not is_last:
            raise endless
    if isinstance(con, (*GREEDY, *RECODING)) and not bounded:
        what = "count" if isinstance(con, construct.GreedyRange) else "length"
        reason = (
            f"{declared_class_name(con)} has no end in a stream: declare a {what} or a terminator,"
            " or use Prefixed or FixedSized"
        )
        endless = SpecError(reason, path=path, rule="LS111")
        if not is_last:
            raise endless
    for child in below:
        passes = not hasattr(con, "subcons") or child is below[-1]
        passes = passes and not isinstance(con, Array | construct.GreedyRange)
        is_bounded = isinstance(con, (*_BOUNDED_KINDS, *RECODING)) or (passes and bounded)
        error = _check_ends(child, path, bounded=is_bounded, is_last=passes and is_last)
        endless = endless or error
    is_sized = isinstance(con, construct.FixedSized)
    fits = is_sized and isinstance(con.length, int) and fixed_size(con.subcon) == con.length
    # A named part after its length has a length field, which must equal the size of the part.
    is_held = isinstance(con, BoundedPart) and not is_greedy(con.subcon, (construct.NullStripped,))
    if (
        isinstance(con, _BOUNDED_KINDS)
        and not is_held
        and not fits
        and not _keeps_all_bytes(con.subcon, padded=is_sized)
    ):
        name = "Prefixed" if isinstance(con, BoundedPart) else type(con).__name__
        if isinstance(con, BoundedPart | construct.NullTerminated):
            named = ""
        else:
            named = f", or make {name} a named member of a Struct"
        reason = (
            f"{name} loses bytes that its content does not read: end the content with the field"
            f" 'rest' / GreedyBytes{named}"
        )
        raise SpecError(reason, path=path, rule="LS106")
    return endless


def _keeps_all_bytes(con: Construct, *, padded: bool) -> bool:
    """Return whether a part of known size is parsed and built without a loss of bytes.

    Args:
        con: the content of the part.
        padded: whether construct fills the part with zeros if the built content is too short.
    """
    if isinstance(con, construct.NullStripped):
        return padded and con.pad == b"\0" and con.subcon is construct.GreedyBytes
    if isinstance(con, (Array, *_BOUNDED_KINDS)) or not children(con):
        return con is construct.GreedyBytes
    return isinstance(con, construct.GreedyRange) or _keeps_all_bytes(
        children(con)[-1], padded=padded
    )


def _check_focus(con: construct.FocusedSeq, path: str) -> None:
    """Raise SpecError for a FocusedSeq that loses the value of a field."""
    for member in con.subcons:
        if member.name != con.parsebuildfrom and not member.flagbuildnone:
            reason = (
                f"FocusedSeq keeps only {con.parsebuildfrom!r} and loses"
                f" {member.name or type(member).__name__!r}: use a Struct"
            )
            raise SpecError(reason, path=path, rule="LS105")


def _check_names(struct: Struct, path: str, *, in_bits: bool) -> None:
    seen: set[str] = set()
    for child in struct.subcons:
        name = child.name
        if path:
            place = f"{path}.{name}"
        else:
            place = str(name)
        if unwrap(child) is construct.Terminated:
            continue
        if name is None:
            if in_bits or not isinstance(unwrap(child), Const):
                kind = declared_class_name(unwrap(child))
                reason = f"an unnamed {kind} would lose its value: give it a name"
                raise SpecError(reason, path=path, rule="LS105")
            continue
        if name in seen:
            raise SpecError(
                "duplicate field name: the last field would silently replace the first",
                path=place,
                rule="LS104",
            )
        if name in RESERVED and not path:
            raise SpecError("no field may be called 'state' or 'on'", path=place, rule="LS102")
        if name in SHADOWED:
            raise SpecError(
                f"the name {name!r} is shadowed by a method of construct's Container",
                path=place,
                rule="LS101",
            )
        if name.startswith("_") or not name.isidentifier():
            raise SpecError(
                "a field name must be a Python identifier without a leading underscore",
                path=place,
                rule="LS103",
            )
        seen.add(name)


def _check_measures(
    con: Construct,
    path: str,
    scale_and_unit: tuple[float, float, str],
    found_by_path: dict[str, tuple[float, float, str]],
) -> None:
    """Raise SpecError if a field has different scales or units in several branches.

    Args:
        scale_and_unit: the scale, the offset and the unit that `con` has if it is a number.
        found_by_path: the scale, the offset and the unit of the fields that were checked before, by
            path; the function adds the fields of `con`.
    """
    if isinstance(con, construct.Renamed):
        if path:
            path = f"{path}.{con.name}"
        else:
            path = str(con.name)
        scale_and_unit = (1, 0, "")
    if isinstance(con, DescribedField):
        described = con.describe(tree.FieldInfo(""))
        scale_and_unit = (described.scale, described.offset, described.unit)
    is_number = isinstance(
        con, construct.FormatField | construct.BytesInteger | construct.BitsInteger
    )
    if is_number and found_by_path.setdefault(path, scale_and_unit) != scale_and_unit:
        raise SpecError(
            "the branches have different scales or units: give the field a different name in"
            " each branch",
            path=path,
        )
    for child in children(con):
        if not isinstance(con, Struct) or child.name is not None:
            _check_measures(child, path, scale_and_unit, found_by_path)


def _iter_constructs(
    con: Construct, path: str, *, in_bits: bool
) -> Iterator[tuple[str, Construct, bool]]:
    if con.name is not None and isinstance(con, construct.Renamed):
        path = f"{path}.{con.name}" if path else con.name
    yield path, con, in_bits
    if isinstance(con, construct.Transformed | construct.Restreamed):
        in_bits = True
    for child in children(con):
        yield from _iter_constructs(child, path, in_bits=in_bits)
