"""The frame tree: a frame type as a tree of nodes in wire order.

`lidarspec.spec.syntax` makes the tree from a plugin's struct. Schemas, layouts, wire tables and
exports iterate over it (`children`, `nodes`) and do not use construct. A node describes how bytes
are stored, and its `FieldInfo` describes their value.

    Struct             a sequence of members
    ChecksummedStruct  a Struct with a checksum
    Number             an integer or float of whole bytes
    Blob               plain bytes; the name of an unnamed constant is ""
    Block              bytes that contain one or more integers as bits (`BlockInteger`)
    Repeat             an array: one element, repeated
    PartSequence       frames within the frame, one after another, each with its own size
    When               one of two nodes, by a condition
    Select             one of several nodes, by a key
    Empty              no bytes
    Check              no bytes; a condition that the frame must meet
    Never              an alternative that is always an error
    Derived            no bytes; a value made from other bytes of the frame
    Opaque             a part that only construct can read

Counts, lengths, conditions and keys are formulas, which consist of numbers, references to fields
(`Ref`) and operations on both (`Op`). An expression that cannot be converted to a formula is
`Untraced`. Frames with such an expression are read by construct.
"""

from __future__ import annotations

import functools
import operator
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import SpecError
from lidarspec.spec.bits import BitField
from lidarspec.spec.checksums import Checksum

#: The displayed name of a constant that has no name.
UNNAMED = "(constant)"


def to_exact(number: float | int) -> Fraction:
    """Return a number as a fraction of its shortest decimal form: 0.001 is 1/1000."""
    if isinstance(number, float):
        return Fraction(repr(float(number)))
    return Fraction(number)


@dataclass(frozen=True, eq=False)
class Adapter:
    """Functions that convert between the raw values of a field and decoded values.

    Attributes:
        encode: a function of a value and the size of the field in bytes.
        dtype: the dtype of a column; uint8 if columns have the raw bytes.
        allowed: the raw values that can be decoded; None if there is no list.
        is_partial: whether there are raw values that cannot be decoded. A frame with such a value
            is invalid.
        form: a text that describes how the value is stored; "" for a plain number.
        decode_bytes: a function that decodes an array of bytes along the last axis, or None.
    """

    decode: Callable[[Any], Any]
    encode: Callable[[Any, int], Any]
    dtype: np.dtype[Any]
    allowed: tuple[int, ...] | None = None
    is_partial: bool = False
    form: str = ""
    decode_bytes: Callable[[NDArray[Any]], NDArray[Any]] | None = None

    @property
    def has_columns(self) -> bool:
        """Whether columns contain the decoded values, instead of the raw values."""
        return self.dtype != np.uint8 or self.decode_bytes is not None

    def decode_column(self, raw: NDArray[Any], *, is_bytes: bool) -> NDArray[Any]:
        """Return the decoded values of a column.

        Args:
            raw: the raw values, as integers or as bytes along the last axis.
        """
        if self.decode_bytes is not None:
            return self.decode_bytes(raw)
        values, where, shape = _find_distinct(raw, is_bytes=is_bytes)
        decoded = np.empty(len(values), self.dtype)
        for index, value in enumerate(values):
            decoded[index] = self.decode(value)
        return np.asarray(decoded[where]).reshape(shape)

    def can_decode(self, raw: NDArray[Any], *, is_bytes: bool) -> NDArray[np.bool_]:
        """Return for each raw value of a column whether it can be decoded."""
        values, where, shape = _find_distinct(raw, is_bytes=is_bytes)
        valid = np.zeros(len(values), np.bool_)
        for index, value in enumerate(values):
            try:
                self.decode(value)
                valid[index] = True
            except Exception:  # the author's code may raise anything
                continue
        return np.asarray(valid[where]).reshape(shape)


def _find_distinct(
    raw: NDArray[Any], *, is_bytes: bool
) -> tuple[list[Any], NDArray[np.intp], tuple[int, ...]]:
    """Return the distinct values, the index of each value among them, and the shape."""
    if not is_bytes:
        values, where = np.unique(raw, return_inverse=True)
        return values.tolist(), where.reshape(-1), raw.shape
    shape = raw.shape[:-1]
    size = raw.shape[-1]
    if not raw.size:
        count = int(np.prod(shape))
        return [b""] if count else [], np.zeros(count, np.intp), shape
    packed = np.ascontiguousarray(raw).reshape(-1, size).view(f"V{size}").reshape(-1)
    found, where = np.unique(packed, return_inverse=True)
    return [value.tobytes() for value in found], where.reshape(-1), shape


@dataclass(frozen=True, eq=False)
class FieldInfo:
    """One field of a frame.

    Attributes:
        path: the path without indices, such as "points.distance".
        axes: the paths of the arrays that contain the field, outermost first. A field of bytes
            counts as an array of bytes, so the last entry is its own path.
        dtype: the dtype of the raw value in native byte order; None if only construct can read it.
        kind: "int", "float", "bytes" or "other".
        scale, offset, unit: ``physical = raw * scale + offset``, in this unit.
        bits: the width in bits; 0 if the width is not fixed.
        const: the value that the field must have; None if any value is valid.
        allowed: the raw values that the field may have, in ascending order; None for any value.
        rebuilt: the formula of the value in a built frame (construct's Rebuild); None if the caller
            supplies the value.
        default: the raw value that `build` uses if the caller supplies no value, or the formula of
            this value. For bytes, it is one byte that is repeated to fill the field.
        is_enforced: whether a parsed frame must have the value of `rebuilt` (`SizeOf`).
        labels: the names of raw values (construct's Enum).
        optional: whether some frames do not have the field.
        has_declared_unit: whether the plugin declares the unit with `Scaled`. The declared unit may
            be "", for a plain number; all fields without `Scaled` have the unit "" too.
        adapter: the functions that decode raw values; None if raw values are not decoded.
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
    allowed: tuple[int, ...] | None = None
    rebuilt: Formula | None = None
    default: Any = None
    is_enforced: bool = False
    labels: Mapping[int, str] = field(default_factory=dict)
    optional: bool = False
    has_declared_unit: bool = False
    adapter: Adapter | None = None

    @functools.cached_property
    def name(self) -> str:
        """The last name of the path."""
        return self.path.rpartition(".")[2]

    @functools.cached_property
    def scaled(self) -> bool:
        """Whether physical values differ from raw values."""
        return self.scale != 1 or self.offset != 0

    def physical(self, raw: Any) -> Any:
        """Convert raw values to the field's unit.

        Args:
            raw: a number, or an array of any shape.

        Returns:
            A number, or an array of the same shape; `raw` itself if no scale is declared. A
            Fraction is scaled exactly.
        """
        if not self.scaled:
            return raw
        if isinstance(raw, Fraction):
            return raw * to_exact(self.scale) + to_exact(self.offset)
        return raw * self.scale + self.offset

    def raw(self, physical: Any) -> Any:
        """Convert physical values to raw values.

        For an integer field, values are rounded to the nearest raw value; a value halfway between
        two raw values is rounded to the even one.

        Args:
            physical: a number in the field's unit, or an array of any shape.

        Returns:
            An int, or an int64 array of the same shape; floats for a float field. The raw values
            may exceed the limits of the field.
        """
        if isinstance(physical, Fraction):
            steps: Any = (physical - to_exact(self.offset)) / to_exact(self.scale)
        else:
            if self.scaled:
                steps = (physical - self.offset) / self.scale
            else:
                steps = physical
        if self.kind == "float":
            if isinstance(steps, Fraction):
                return float(steps)
            return steps
        if isinstance(steps, np.ndarray):
            return np.rint(steps).astype(np.int64)
        return round(steps)

    @functools.cached_property
    def limits(self) -> tuple[int, int]:
        """The lowest and highest raw value of an integer field."""
        signed = self.dtype is not None and self.dtype.kind == "i"
        if signed:
            return (-(1 << (self.bits - 1)), (1 << (self.bits - 1)) - 1)
        return (0, (1 << self.bits) - 1)

    @property
    def initial(self) -> int:
        """The raw value if no value is given: 0, or the first allowed value."""
        if self.allowed is None or 0 in self.allowed:
            return 0
        return self.allowed[0]


def find_runs(values: Sequence[int]) -> list[tuple[int, int]]:
    """Return the first and last value of each run of consecutive values.

    Args:
        values: integers in ascending order.
    """
    ends = [
        index
        for index, value in enumerate(values)
        if index + 1 == len(values) or values[index + 1] != value + 1
    ]
    return [
        (values[first], values[last])
        for first, last in zip([0, *(end + 1 for end in ends)], ends, strict=False)
    ]


def format_hex(value: object) -> str:
    """Return the text of a value: bytes and integers in hexadecimal, others by `repr`."""
    if isinstance(value, bytes):
        return value.hex(" ")
    if isinstance(value, int):
        return f"0x{value:x}"
    return repr(value)


def format_values(values: Sequence[int]) -> str:
    """Return raw values as text, e.g. "1, 3, 5 to 7"."""
    formats = {0: "{0}", 1: "{0}, {1}"}
    return ", ".join(
        formats.get(last - first, "{0} to {1}").format(first, last)
        for first, last in find_runs(values)
    )


@dataclass(frozen=True)
class Ref:
    """A reference to the raw value of an earlier field.

    Attributes:
        path: the path from the top of the frame. A path without indices refers to the current
            element of each array.
    """

    path: str
    info: FieldInfo


@dataclass(frozen=True)
class Op:
    """An operation on integers, as in Python.

    Comparisons return 1 or 0.

    Attributes:
        symbol: one of + - * // % & | ^ << >> == != < <= > >= with two arguments, or - and not with
            one argument. The formula of a `Derived` value can also have / and floats.
    """

    symbol: str
    args: tuple[Formula, ...]


@dataclass(frozen=True, eq=False)
class Untraced:
    """An expression that cannot be a formula, such as a function with branches.

    Attributes:
        reason: the reason, preceded by the path of the field with the expression.
        text: the expression in the plugin, with the whole paths of fields; "?" for a function.
    """

    reason: str
    text: str


Formula = int | Ref | Op | Untraced
#: A function that returns the raw value of a field by its path, and None if the frame does not have
#: the field.
Read = Callable[[str], "int | None"]

_OPERATIONS: dict[str, Callable[..., Any]] = {
    "+": operator.add,
    "*": operator.mul,
    "/": operator.truediv,
    "//": operator.floordiv,
    "%": operator.mod,
    "&": operator.and_,
    "|": operator.or_,
    "^": operator.xor,
    "<<": operator.lshift,
    ">>": operator.rshift,
    "not": operator.not_,
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "-": lambda first, *second: first - second[0] if second else -first,
}


def make_operation(symbol: str, *args: Formula) -> Formula:
    """Return the formula of an operation.

    A sum, difference or product of integers is returned as an integer.
    """
    if all(isinstance(arg, int) for arg in args) and symbol in ("+", "-", "*"):
        return int(_OPERATIONS[symbol](*args))
    return Op(symbol, args)


def evaluate(formula: Formula, read: Read) -> Any:
    """Return the value of a formula.

    Args:
        read: a function that returns the value of a field, or None for a missing field.

    Raises:
        Exception: if an operation fails, for example a division by 0.
    """
    match formula:
        case Ref():
            return read(formula.path)
        case Op("*", (condition, _)) if _is_condition(condition) and not evaluate(condition, read):
            # The size of an alternative that is not present: its fields cannot be read.
            return 0
        case Op():
            return _OPERATIONS[formula.symbol](*(evaluate(arg, read) for arg in formula.args))
        case Untraced():
            raise ValueError(formula.reason)
    return formula


def evaluate_arrays(formula: Formula, columns: Mapping[str, Any], dtype: Any) -> Any:
    """Evaluate a formula for many frames at once; a condition gives booleans.

    Args:
        columns: the values of each field, by path.
        dtype: a dtype that can represent all intermediate values.
    """
    match formula:
        case Ref():
            return columns[formula.path]
        case Op("not", (operand,)):
            return evaluate_arrays(operand, columns, dtype) == 0
        case Op(symbol, args):
            values = [evaluate_arrays(arg, columns, dtype) for arg in args]
            if symbol not in _BOOLEAN_OPERATIONS:
                values = [
                    np.asarray(value, dtype) if isinstance(value, np.ndarray) else value
                    for value in values
                ]
            return _OPERATIONS[symbol](*values)
    return formula


#: The operations that return 1 or 0.
COMPARISONS = frozenset({"==", "!=", "<", "<=", ">", ">="})

#: The operations that accept boolean arrays without a conversion to integers.
_BOOLEAN_OPERATIONS = COMPARISONS | {"&", "|", "^"}


def _is_condition(formula: Formula) -> bool:
    return isinstance(formula, Op) and (
        formula.symbol in COMPARISONS
        or (formula.symbol == "*" and all(map(_is_condition, formula.args)))
    )


def format_formula(
    formula: Formula, format_ref: Callable[[Ref], str], operations: Mapping[str, str]
) -> str:
    """Return a formula as an expression of another language.

    Args:
        format_ref: a function that returns the text of a field.
        operations: the texts of operations that differ from Python, such as "({} / {})" for "//".

    Raises:
        ValueError: if a part of the formula is `Untraced`.
    """
    match formula:
        case Ref():
            return format_ref(formula)
        case Op("-", (operand,)):
            return f"(-{format_formula(operand, format_ref, operations)})"
        case Op(symbol, args):
            text = operations.get(
                symbol, "(not {})" if symbol == "not" else f"({{}} {symbol} {{}})"
            )
            return text.format(*(format_formula(arg, format_ref, operations) for arg in args))
        case Untraced():
            raise ValueError(formula.reason)
    if formula < 0:
        return f"({formula})"
    return str(formula)


def get_element(info: FieldInfo, path: str, indices: Mapping[str, int]) -> FieldInfo | None:
    """Return the `FieldInfo` of a field for one element of its arrays.

    Returns None if `indices` has an array that does not contain the field.

    Args:
        info: the field in all elements.
        path: the path of the field with the indices.
        indices: the path of an array -> the index of the element in this array.
    """
    if not indices.keys() <= set(info.axes):
        return None
    axes = tuple(axis for axis in info.axes if axis not in indices)
    element = replace(info, path=path, axes=axes)
    if info.kind == "bytes" and info.path in indices:
        return replace(element, kind="int", bits=8)
    return element


def fraction_in(formula: Formula) -> str | float | None:
    """Return the first "/" or float in a formula; None if the formula has neither."""
    for part in iter_subformulas(formula):
        if isinstance(part, float):
            return part
        if isinstance(part, Op) and part.symbol == "/":
            return part.symbol
    return None


def iter_subformulas(formula: Formula) -> Iterator[Formula]:
    """Yield a formula and all its operands, recursively."""
    yield formula
    if isinstance(formula, Op):
        for arg in formula.args:
            yield from iter_subformulas(arg)


def refs(formula: Formula) -> tuple[Ref, ...]:
    """Return the fields that a formula depends on, each once, in order."""
    return tuple(dict.fromkeys(part for part in iter_subformulas(formula) if isinstance(part, Ref)))


#: The maximum number of bits that values of a formula may have to be computed in 64-bit integers.
MAX_FORMULA_BITS = 62


def width(formula: Formula) -> int:
    """Return the number of bits that a value of a formula can need, without the sign.

    Raises:
        ValueError: if a part of the formula is `Untraced`.
    """
    if isinstance(formula, Ref):
        return formula.info.bits
    if isinstance(formula, int):
        return formula.bit_length()
    if isinstance(formula, Untraced):
        raise ValueError(formula.reason)
    args = [width(arg) for arg in formula.args]
    match formula.symbol:
        case "+" | "-":
            return max(args) + 1
        case "*":
            return sum(args)
        case "<<":
            if isinstance(formula.args[1], int):
                most = formula.args[1]
            elif args[1] < 8:
                most = (1 << args[1]) - 1
            else:
                most = 99
            return args[0] + most
        case "//" | ">>":
            return args[0] + 1
        case "not":
            return 1
    if formula.symbol in COMPARISONS:
        return 1
    return max(args)


def to_outer_paths(formula: Formula, axis: str) -> Formula:
    """Return a formula of a part with paths that start at the top of the frame.

    Args:
        formula: a formula with paths that start at the part.
        axis: the path of the array of parts.
    """
    match formula:
        case Ref(path):
            return replace(formula, path=path[2:] if path.startswith("_.") else f"{axis}.{path}")
        case Op(symbol, args):
            return Op(symbol, tuple(to_outer_paths(arg, axis) for arg in args))
    return formula


@dataclass(frozen=True, eq=False)
class Number:
    """An integer or float of whole bytes.

    Attributes:
        size: the size in bytes.
        kind: "uint", "int" or "float".
        order: the byte order, "little" or "big".
    """

    info: FieldInfo
    size: int
    kind: Literal["uint", "int", "float"]
    order: Literal["little", "big"]

    @functools.cached_property
    def name(self) -> str:
        """The name of the field."""
        return self.info.name

    def encode(self, value: float) -> bytes:
        """Return the bytes of a raw value on the wire."""
        if self.kind == "float":
            order = "<" if self.order == "little" else ">"
            code = {2: "e", 4: "f", 8: "d"}[self.size]
            return struct.pack(order + code, value)
        return int(value).to_bytes(self.size, self.order, signed=self.kind == "int")


@dataclass(frozen=True)
class Ending:
    """The end of bytes of variable size: a mark, or the end of the datagram.

    Attributes:
        size: a field that has no bytes in the frame. Formulas use it for the number of bytes before
            the end.
        mark: the bytes of the mark, such as a terminator; b"" if the bytes end with the datagram.
        mask: the bits of each byte that are compared with the mark.
        is_content: whether the mark belongs to the content, as in a number of variable size.
    """

    size: FieldInfo
    mark: bytes
    mask: bytes
    is_content: bool = False

    @property
    def terminator(self) -> bytes:
        """The end mark, or b"" if it belongs to the content."""
        return b"" if self.is_content else self.mark

    def find(self, data: bytes) -> int:
        """Return the size of the content at the start of `data`; -1 if its end is missing."""
        step = len(self.mark)
        if not step:
            return len(data)
        if step == 1 and self.terminator and self.mask == b"\xff":
            return data.find(self.mark)
        for start in range(0, len(data) - step + 1, step):
            unit = data[start : start + step]
            if bytes(byte & bits for byte, bits in zip(unit, self.mask, strict=True)) == self.mark:
                return start + step * self.is_content
        return -1


@dataclass(frozen=True, eq=False)
class Blob:
    """Plain bytes, which may be constant.

    Attributes:
        size: the number of bytes, without the terminator.
        const: the bytes; None if any bytes are allowed.
        ending: the end of bytes of variable size; None if `size` alone determines their number.
    """

    name: str
    info: FieldInfo
    size: Formula
    const: bytes | None = None
    ending: Ending | None = None


@dataclass(frozen=True, eq=False)
class BlockInteger:
    """One integer of a block.

    Attributes:
        bits: the bits of the block that contain the integer.
        names: the names that lead from the block to the integer, such as ("distance",); () if the
            block is a single integer.
        indices: the index of the integer in each array inside the block.
    """

    info: FieldInfo
    bits: BitField
    names: tuple[str, ...]
    indices: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Block:
    """Bytes that contain one or more integers as bits.

    Attributes:
        info: a description of the whole block as a field.
        size: the size in bytes.
    """

    name: str
    info: FieldInfo
    size: int
    parts: tuple[BlockInteger, ...]


@dataclass(frozen=True, eq=False)
class Struct:
    """A sequence of members.

    Attributes:
        path: the path of the struct; "" for the frame itself.
    """

    name: str
    path: str
    members: tuple[Node, ...]
    docs: str = ""

    @property
    def struct(self) -> Struct:
        """The struct itself, as for a `ChecksummedStruct`."""
        return self


@dataclass(frozen=True, eq=False)
class ChecksummedStruct:
    """A struct with a checksum.

    Attributes:
        body: the struct, or a `ChecksummedStruct` of the struct with another checksum.
        fields: the paths of the fields with the checksum, low bits first.
        over: the paths of the first and the last member that the checksum covers; None for all
            bytes of the body without the bytes of `fields`.
        declared: the declared algorithm; None if a hook has to return the algorithm.
        absent: the values of the checksum that mean that the sensor has computed no checksum.
    """

    body: Struct | ChecksummedStruct
    fields: tuple[str, ...]
    over: tuple[str, str] | None
    declared: Checksum | None
    absent: tuple[int, ...]

    @property
    def algorithm(self) -> Checksum:
        """The algorithm of the checksum.

        Raises:
            SpecError: if no algorithm is declared.
        """
        if self.declared is None:
            raise SpecError(
                "the checksum has no algorithm, and no lidarspec_checksum hook provides one",
                path=self.fields[0],
            )
        return self.declared

    @property
    def struct(self) -> Struct:
        """The struct without its checksums."""
        return self.body.struct

    @property
    def name(self) -> str:
        """The name of the struct."""
        return self.body.name


@dataclass(frozen=True, eq=False)
class Repeat:
    """An array of `count` elements.

    Attributes:
        axis: the path of the array, with "[]" appended for each inner level of nested arrays.
    """

    name: str
    axis: str
    count: Formula
    element: Node
    default: Any = None


@dataclass(frozen=True, eq=False)
class Kind:
    """A kind of parts.

    Attributes:
        name: the name of the kind; "" if all parts are of one kind.
        element: the part, with paths from the top of the frame.
        root: the part as a frame of its own. Fields of the outer frame have paths with "_.".
        following: the size of the next part in bytes, as a formula of `root`; 0 after the last
            part; None if not declared.
        until: a condition that only the last part meets, as a formula of `root`; None if not
            declared.
    """

    name: str
    element: Node
    root: Node
    following: Formula | None
    until: Formula | None = None


@dataclass(frozen=True, eq=False)
class PartSequence:
    """Frames within the frame, one after another.

    Attributes:
        axis: the path of the array of parts.
        kinds: the kinds of parts, in the order in which they are tried.
        count: the number of parts; None if it is not declared.
        size: the size of the first part in bytes; None if it is not declared.
        within: the total size of all parts in bytes; None if it is not declared.
        outer: the fields of the outer frame that formulas of the parts use.
        total: a field that has no bytes in the frame. Later formulas use it for the total size of
            all parts.
        is_array: whether the plugin declares an array whose elements differ in size; False if the
            plugin declares `Parts`.
    """

    name: str
    axis: str
    kinds: tuple[Kind, ...]
    count: Formula | None
    size: Formula | None
    within: Formula | None
    outer: tuple[Ref, ...]
    total: FieldInfo
    is_array: bool = False

    def following(self, kind: Kind) -> Formula | None:
        """Return the size of the part that follows a part of this kind, as a formula.

        Returns None if parts do not declare the size of the next part.
        """
        if kind.following is None:
            return None
        return to_outer_paths(kind.following, self.axis)


@dataclass(frozen=True, eq=False)
class When:
    """The node `then` if the condition is not 0, else the node `otherwise`."""

    name: str
    condition: Formula
    then: Node
    otherwise: Node


@dataclass(frozen=True, eq=False)
class Select:
    """A node for each value of a key, and a node for all other values."""

    name: str
    key: Formula
    cases: tuple[tuple[Any, Node], ...]
    default: Node


@dataclass(frozen=True, eq=False)
class Empty:
    """A node without bytes."""

    name: str = ""


@dataclass(frozen=True, eq=False)
class Check:
    """A condition whose value is not 0 in valid frames.

    Attributes:
        axes: the axes of the arrays that contain the condition.
    """

    name: str
    path: str
    axes: tuple[str, ...]
    condition: Formula


@dataclass(frozen=True, eq=False)
class Derived:
    """A value of a parsed frame that has no bytes of its own.

    Attributes:
        kind: "computed" for a value computed from other fields (construct's Computed), "offset" for
            its own offset in the frame (Tell), "size" or "bytes" for the size or the bytes of an
            earlier part (RawCopy), "peeked" for the value of the following bytes (Peek).
        formula: the formula of a computed value; None if the value is `constant`.
        constant: a computed value that depends on no field.
        part: the path of the part that is measured or copied.
        node: the node that is peeked.
    """

    info: FieldInfo
    kind: Literal["computed", "offset", "size", "bytes", "peeked"]
    formula: Formula | None = None
    constant: Any = None
    part: str = ""
    node: Node | None = None

    @functools.cached_property
    def name(self) -> str:
        """The name of the field."""
        return self.info.name


@dataclass(frozen=True, eq=False)
class Never:
    """An alternative that no valid frame has."""

    name: str


@dataclass(frozen=True, eq=False)
class Opaque:
    """A part that only construct can read.

    Attributes:
        kind: the name of its construct class.
        reason: why the part cannot be converted to another node.
        inside: the nodes inside the part; () if the part has no members. Their offsets in the frame
            are not known.
        size: the size in bytes; None if it depends on the content.
        form: how the value is stored, as text to display.
        in_bits: whether the part is a bit block.
    """

    name: str
    info: FieldInfo
    kind: str
    reason: str
    inside: tuple[Node, ...] = ()
    size: Formula | None = None
    form: str = ""
    in_bits: bool = False


Node = (
    Number
    | Blob
    | Block
    | Struct
    | ChecksummedStruct
    | Repeat
    | PartSequence
    | When
    | Select
    | Empty
    | Check
    | Never
    | Derived
    | Opaque
)


def children(node: Node) -> tuple[Node, ...]:
    """Return the nodes directly below a node."""
    match node:
        case Struct():
            return node.members
        case ChecksummedStruct():
            return (node.body,)
        case Repeat():
            return (node.element,)
        case PartSequence():
            return tuple(kind.element for kind in node.kinds)
        case When():
            return (node.then, node.otherwise)
        case Select():
            return (*(case for _, case in node.cases), node.default)
        case Opaque():
            return node.inside
        case _:
            return ()


def nodes(node: Node) -> Iterator[Node]:
    """Yield a node and all nodes below it, in wire order."""
    yield node
    for child in children(node):
        yield from nodes(child)


def formulas(node: Node) -> tuple[Formula, ...]:
    """Return the formulas of a node, without the formulas of the nodes below it."""
    match node:
        case Blob():
            return (node.size,)
        case Repeat():
            return (node.count,)
        case PartSequence():
            own = (node.count, node.size, node.within, *map(node.following, node.kinds))
            return tuple(formula for formula in own if formula is not None)
        case When():
            return (node.condition,)
        case Select():
            return (node.key,)
    return ()


def size(node: Node) -> Formula | None:
    """Return the size of a node in bytes as a formula of header fields.

    Returns None if only construct can determine the size.
    """
    match node:
        case Blob() if node.ending is not None:
            return combine("+", node.size, len(node.ending.terminator))
        case Number() | Block() | Blob() | Opaque():
            return node.size
        case Repeat():
            return combine("*", node.count, size(node.element))
        case PartSequence():
            return Ref(node.total.path, node.total)
        case When():
            return _sum_alternatives(
                [
                    (make_operation("!=", node.condition, 0), size(node.then)),
                    (make_operation("==", node.condition, 0), size(node.otherwise)),
                ]
            )
        case Select():
            cases = [
                (make_operation("==", node.key, value), size(case))
                for value, case in node.cases
                if not isinstance(case, Never)
            ]
            others = [make_operation("!=", node.key, value) for value, _ in node.cases]
            if isinstance(node.default, Never):
                return _sum_alternatives(cases)
            return _sum_alternatives(
                [
                    *cases,
                    (
                        functools.reduce(functools.partial(make_operation, "*"), others),
                        size(node.default),
                    ),
                ]
            )
    return sum_sizes(size(below) for below in children(node))


def sum_sizes(sizes: Iterable[Formula | None]) -> Formula | None:
    """Return the sum of sizes as a formula; None if any size is None."""
    sum_: Formula | None = 0
    for each in sizes:
        sum_ = combine("+", sum_, each)
    return sum_


def combine(symbol: str, one: Formula | None, other: Formula | None) -> Formula | None:
    """Return a simplified sum, difference or product; None if an operand is None."""
    if one is None or other is None:
        return None
    neutral = 1 if symbol == "*" else 0
    if other == neutral:
        return one
    if one == neutral and symbol != "-":
        return other
    if symbol == "*" and 0 in (one, other):
        return 0
    if symbol == "+" and isinstance(one, int):
        one, other = other, one
    match symbol, one, other:
        case "+" | "-", Op("+" | "-" as inner, (first, int() as known)), int():
            number = (known if inner == "+" else -known) + (other if symbol == "+" else -other)
            return combine("+" if number >= 0 else "-", first, abs(number))
    return make_operation(symbol, one, other)


def _sum_alternatives(cases: Sequence[tuple[Formula, Formula | None]]) -> Formula | None:
    """Return the size of a node with alternatives, as a formula.

    Args:
        cases: the condition and the size of each alternative.
    """
    first = cases[0][1] if cases else 0
    if all(each == first for _, each in cases):
        return first
    return sum_sizes(combine("*", holds, each) for holds, each in cases)


def infos(node: Node) -> tuple[FieldInfo, ...]:
    """Return the fields of a node, without the fields of the nodes below it."""
    match node:
        case Number() | Blob() | Opaque():
            return (node.info,)
        case Block():
            return tuple(part.info for part in node.parts)
    return ()


class Scope:
    """Replaces construct's context when an expression is traced.

    Args:
        parent: the context of the outer struct, which is "_" in expressions.
        path: the path of the struct.
        asked: a list to which each field that an expression reads is appended.
    """

    def __init__(self, parent: Scope | None, path: str, asked: list[Ref]) -> None:
        self.parent = parent
        self.path = path
        self.asked = asked
        self.names: dict[str, Ref | Scope | Value] = {}
        #: The names that have different definitions in different branches.
        self.ambiguous: set[str] = set()

    def add(self, name: str, part: Ref | Scope | Value) -> None:
        """Add a field, a computed value or a struct for later expressions."""
        known = self.names.get(name)
        if known is not None and not (
            isinstance(known, Ref)
            and isinstance(part, Ref)
            and known.info.labels == part.info.labels
        ):
            self.ambiguous.add(name)
        self.names[name] = part

    def __getitem__(self, name: str) -> Any:
        if name == "_":
            return self.parent
        if name == "_root":
            if self.parent is not None:
                return self.parent["_root"]
            return self
        if name not in self.names:
            raise UntraceableExpressionError(
                f"an expression uses {name!r}, which is not an earlier field"
            )
        part = self.names[name]
        if isinstance(part, Scope):
            return part
        self.asked += [part] if isinstance(part, Ref) else part.refs
        if name in self.ambiguous:
            raise UntraceableExpressionError(
                f"an expression uses {name!r}, which is declared differently in several branches"
            )
        if isinstance(part, Value):
            return part.read()
        return Symbol(part)

    def __getattr__(self, name: str) -> Any:
        return self[name]

    def __len__(self) -> int:
        raise UntraceableExpressionError("an expression uses the length of an array")


class RawCopyScope(Scope):
    """The context of the value of a construct RawCopy."""

    def __init__(self, scope: Scope | None, path: str, asked: list[Ref]) -> None:
        super().__init__(scope, path, asked)
        self._outer = scope

    def __getitem__(self, name: str) -> Any:
        if name in self.names or self._outer is None:
            return super().__getitem__(name)
        return self._outer[name]


@dataclass(frozen=True, eq=False)
class Value:
    """A computed value that later expressions can read.

    Attributes:
        content: a formula or a constant; `Untraced` if neither is known.
    """

    content: Any

    @property
    def refs(self) -> tuple[Ref, ...]:
        """The fields that the value depends on."""
        return refs(self.content)

    def read(self) -> Any:
        """Return a symbol for a formula; a constant is returned unchanged.

        Raises:
            UntraceableExpressionError: if the value has no formula.
        """
        if isinstance(self.content, Untraced):
            raise UntraceableExpressionError(self.content.reason.partition(": ")[2])
        if isinstance(self.content, Ref | Op):
            return Symbol(self.content)
        return self.content


class OuterScope(Scope):
    """The context of the outer frame for expressions in a part."""

    def __init__(self, scope: Scope, asked: list[Ref]) -> None:
        super().__init__(None, f"_.{scope.path}".rstrip("."), asked)
        self._scope = scope

    def __getitem__(self, name: str) -> Any:
        value = self._scope[name]
        if isinstance(value, Scope):
            return OuterScope(value, self.asked)
        if isinstance(value, Symbol) and isinstance(value.formula, Ref):
            self.asked.append(Ref(f"_.{value.formula.path}", value.formula.info))
            return Symbol(self.asked[-1])
        return value


#: The reason why a number that has a name in an Enum is never equal to a parsed value.
NAME_IS_COMPARED = "construct compares the name of an Enum value, not its number"


class UntraceableExpressionError(Exception):
    """Raised if an expression cannot be converted to a formula."""


class Symbol:
    """A placeholder for a value, which records the operations on it as a formula."""

    __hash__ = None  # type: ignore[assignment]

    def __init__(self, formula: Formula) -> None:
        self.formula = formula

    def __bool__(self) -> bool:
        raise UntraceableExpressionError("a Python function branches on the values of fields")

    __index__ = __int__ = __float__ = __len__ = __iter__ = __bool__

    def __invert__(self) -> Symbol:
        return Symbol(Op("-", (Op("+", (self.formula, 1)),)))

    def __neg__(self) -> Symbol:
        return Symbol(Op("-", (self.formula,)))

    def __pos__(self) -> Symbol:
        return self

    def __getattr__(self, name: str) -> Any:
        raise UntraceableExpressionError(f"an expression uses the attribute {name!r} of a number")

    def __getitem__(self, key: object) -> Any:
        known = self.formula
        if isinstance(known, Ref) and len(known.info.axes) == 1 and type(key) is int and key >= 0:
            path = f"{known.path}[{key}]"
            info = get_element(known.info, path, {known.info.axes[0]: key})
            return Symbol(Ref(path, info or known.info))
        raise UntraceableExpressionError(
            "an expression uses an element of an array, or a byte of a field"
        )


def _trace_operation(symbol: str, left: Any, right: Any) -> Symbol:
    """Return a symbol for the result of an operation on symbols and numbers."""
    pair: list[Any] = [part.formula if isinstance(part, Symbol) else part for part in (left, right)]
    for one, other in ((0, 1), (1, 0)):
        known = pair[other]
        if not isinstance(known, Ref) or not known.info.labels:
            continue
        if symbol not in ("==", "!=") or not isinstance(pair[one], int | str):
            raise UntraceableExpressionError(
                f"an expression uses the Enum field {known.path} as a number, but the value of this"
                " field is a name: compare it with a name, or declare the field without Enum"
            )
        if pair[one] in known.info.labels:
            name = known.info.labels[pair[one]]
            outcome = "never" if symbol == "==" else "always"
            raise UntraceableExpressionError(
                f"{known.path} {symbol} {pair[one]} is {outcome} true, because"
                f" {NAME_IS_COMPARED}: write {known.path} {symbol} {name!r}"
            )
        pair[one] = _find_label_value(known, pair[one]) if isinstance(pair[one], str) else pair[one]
    wrong = next((part for part in pair if not isinstance(part, int | float | Ref | Op)), None)
    if wrong is not None:
        raise UntraceableExpressionError(f"an expression uses {wrong!r}, which is not a number")
    return Symbol(
        make_operation(symbol, *(int(part) if isinstance(part, bool) else part for part in pair))
    )


def _refuse_fraction(sign: str) -> Any:
    raise UntraceableExpressionError(
        f"the result of an expression with {sign!r} is not always an integer"
    )


_SYMBOLS = {
    **{
        "truediv": "/",
        "add": "+",
        "sub": "-",
        "mul": "*",
        "floordiv": "//",
        "mod": "%",
        "and": "&",
        "or": "|",
        "xor": "^",
        "lshift": "<<",
        "rshift": ">>",
    },
    **{"eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">", "ge": ">="},
}
for _name, _symbol in _SYMBOLS.items():
    setattr(
        Symbol,
        f"__{_name}__",
        lambda self, other, symbol=_symbol: _trace_operation(symbol, self, other),
    )
    if _symbol not in COMPARISONS:
        setattr(
            Symbol,
            f"__r{_name}__",
            lambda self, other, symbol=_symbol: _trace_operation(symbol, other, self),
        )
for _name, _symbol in {"pow": "**", "divmod": "divmod", "matmul": "@"}.items():
    for _full in (f"__{_name}__", f"__r{_name}__"):
        setattr(Symbol, _full, lambda self, other, sign=_symbol: _refuse_fraction(sign))


def _find_label_value(ref: Ref, label: str) -> int:
    """Return the raw value of a label of a field.

    Raises:
        UntraceableExpressionError: if the field does not have this label.
    """
    for value, name in ref.info.labels.items():
        if name == str(label):
            return value
    raise UntraceableExpressionError(f"{ref.path} has no value named {label!r}")
