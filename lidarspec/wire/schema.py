"""The fields of a frame type as a table, read off its construct tree without any bytes.

Path, axes, type, unit and text of each field; where it stands is `layout`'s business, since that can depend on the
header. Both engines (compiled and interpreted) make their columns by this table, so that they agree on types.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import construct
import numpy as np
from construct import Array, BitsInteger, Bytes, BytesInteger, Const, Construct, FormatField, Struct

from lidarspec.errors import SpecError
from lidarspec.spec.fields import Checksummed, Scaled


@dataclass(frozen=True, eq=False)
class FieldInfo:
    """One field of a frame.

    Attributes:
        path: dotted, without indices: "points.distance".
        axes: paths of the arrays it is in, outermost first; a bytes field adds its own path.
        dtype: type of the raw value in native byte order; None where construct alone knows it.
        kind: "int", "float", "bytes" or "other".
        scale, offset, unit: ``physical = raw * scale + offset``.
        bits: width in bits; 0 where not fixed.
        const: the value it must have, None where free.
        rebuilt: the function of the fields around it that gives its value in a frame that is made (construct's Rebuild).
        labels: meanings of raw values (construct's Enum).
        optional: whether some headers leave it out.
    """

    path: str
    axes: tuple[str, ...] = ()
    dtype: np.dtype[Any] | None = None
    kind: str = "other"
    scale: float = 1
    offset: float = 0
    unit: str = ""
    docs: str = ""
    bits: int = 0
    const: Any = None
    rebuilt: Any = None
    labels: Mapping[int, str] = field(default_factory=dict)
    optional: bool = False

    @property
    def name(self) -> str:
        """The last part of the path."""
        return self.path.rpartition(".")[2]

    @property
    def scaled(self) -> bool:
        """Whether the physical value is another number than the raw one."""
        return self.scale != 1 or self.offset != 0

    @property
    def limits(self) -> tuple[int, int]:
        """The lowest and highest raw value of an integer field."""
        signed = self.dtype is not None and self.dtype.kind == "i"
        return (-(1 << (self.bits - 1)), (1 << (self.bits - 1)) - 1) if signed else (0, (1 << self.bits) - 1)

    def seen(self, raw: int) -> Any:
        """A raw value as the expressions of a struct see it: where construct's Enum has a name for it, that name."""
        return construct.EnumIntegerString.new(raw, self.labels[raw]) if raw in self.labels else raw


@dataclass(frozen=True, eq=False)
class Schema:
    """All fields of a frame type, in the order of the wire, and the arrays they are in.

    `arrays`: path -> declared count; a number where every frame has so many elements, else a function of the fields around it, or None.
    """

    fields: Mapping[str, FieldInfo]
    arrays: Mapping[str, Any]

    def chain(self) -> tuple[str, ...]:
        """The axes of the deepest nesting of arrays; the first one of equally deep ones."""
        return self._chain

    @cached_property
    def _chain(self) -> tuple[str, ...]:
        return max((info.axes for info in self.fields.values() if info.kind != "bytes"), key=len, default=())

    def depth(self) -> int:
        """How many arrays are nested at most."""
        return len(self.chain())


def schema(con: Construct) -> Schema:
    """The table of fields of a construct tree, the author's or the prepared one."""
    fields: dict[str, FieldInfo] = {}
    arrays: dict[str, Any] = {}
    _walk(con, FieldInfo(""), fields, arrays)
    return Schema(fields, arrays)


def _walk(con: Construct, info: FieldInfo, fields: dict[str, FieldInfo], arrays: dict[str, Any]) -> None:
    con, info = peeled(con, info)
    if isinstance(con, Checksummed | construct.Transformed | construct.Restreamed):
        _walk(con.subcon, info, fields, arrays)
    elif isinstance(con, Struct):
        for child in con.subcons:
            if child.name is not None:
                _walk(child, replace(info, path=f"{info.path}.{child.name}" if info.path else child.name), fields, arrays)
    elif isinstance(con, Array):
        axis, count = axis_path(info), _sometimes(con.count) if info.optional else con.count
        arrays[axis] = _common_count(arrays[axis], count) if axis in arrays else count
        _walk(con.subcon, replace(info, axes=(*info.axes, axis)), fields, arrays)
    elif isinstance(con, construct.IfThenElse | construct.Switch):
        for branch in branches(con):
            _walk(branch, replace(info, optional=True), fields, arrays)
    elif con is not construct.Pass and info.path:
        leaf = _leaf(con, info)
        if leaf.kind == "bytes":
            axis, length = leaf.axes[-1], getattr(con, "length", None)
            length = _sometimes(length) if info.optional else length
            arrays[axis] = _common_count(arrays[axis], length) if axis in arrays else length
        known = fields.get(leaf.path)
        fields[leaf.path] = leaf if known is None else _merged(known, leaf)


def _sometimes(count: Any) -> Any:
    """A count that holds where there is the array at all: no number, since the length is then another."""
    return (lambda context: count) if isinstance(count, int) else count


def _common_count(known: Any, other: Any) -> Any:
    """The declared count of an array that several branches declare: a number where all say it."""
    if not isinstance(known, int) or known == other:
        return known
    return other if callable(other) else None


def axis_path(info: FieldInfo) -> str:
    """The name of the axis of an array at this place; an array directly in an array gets brackets."""
    path = info.path
    while path in info.axes:
        path += "[]"
    return path


def branches(con: Construct) -> list[Construct]:
    """The alternatives of an If, IfThenElse or Switch."""
    if isinstance(con, construct.Switch):
        return [*con.cases.values(), con.default]
    return [con.thensubcon, con.elsesubcon]


def peeled(con: Construct, info: FieldInfo) -> tuple[Construct, FieldInfo]:
    """What is below the wrappers that only describe (name, unit, labels, constant), and what they say."""
    while True:
        if isinstance(con, construct.Renamed):
            info = replace(info, docs=con.docs or info.docs)
        elif isinstance(con, Scaled):
            info = replace(info, scale=con.scale, offset=con.offset, unit=con.unit)
        elif isinstance(con, construct.Enum):
            info = replace(info, labels={int(value): str(name) for value, name in con.ksymapping.items()})
        elif isinstance(con, Const):
            info = replace(info, const=_constant(con))
        elif isinstance(con, construct.Rebuild):
            info = replace(info, rebuilt=con.func)
        elif not isinstance(con, construct.Default):
            return con, info
        con = con.subcon


def _constant(con: Const) -> Any:
    """The raw value of a constant, also where it is given by the name that construct's Enum has for it."""
    below = con.subcon
    while isinstance(con.value, str) and isinstance(below, construct.Subconstruct):
        if isinstance(below, construct.Enum):
            if con.value not in below.encmapping:
                raise SpecError(f"the constant {str(con.value)!r} is none of {', '.join(map(str, below.encmapping))}")
            return int(below.encmapping[con.value])
        below = below.subcon
    return con.value


def fields_below(con: Construct, info: FieldInfo) -> dict[str, FieldInfo]:
    """The fields of a part of a tree, by path; `info` says where it stands."""
    fields: dict[str, FieldInfo] = {}
    _walk(con, info, fields, {})
    return fields


def _leaf(con: Construct, info: FieldInfo) -> FieldInfo:
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


def integer_type(bits: int, *, signed: bool = False) -> np.dtype[Any]:
    """The smallest integer type of at least so many bits."""
    size = next(size for size in (1, 2, 4, 8) if bits <= 8 * size)
    return np.dtype(f"{'i' if signed else 'u'}{size}")


def _merged(known: FieldInfo, other: FieldInfo) -> FieldInfo:
    """One column for a field that several branches declare."""
    kinds = {known.kind, other.kind}
    if known.axes != other.axes or "other" in kinds or kinds > {"bytes"} or known.dtype is None or other.dtype is None:
        return replace(known, dtype=None, kind="other")
    dtype = np.promote_types(known.dtype, other.dtype)
    bits = known.bits if (known.bits, known.dtype) == (other.bits, other.dtype) else 0 if known.kind == "bytes" else 8 * dtype.itemsize
    const = known.const if known.const == other.const else None
    labels = known.labels if known.labels == other.labels else {}
    return replace(known, dtype=dtype, kind="float" if dtype.kind == "f" else known.kind, bits=bits, const=const, labels=labels)
