"""A frame type as a tree of nodes: what stands on the wire, in order, with formulas where fields of
the header decide.

`lidarspec.spec.syntax` makes it from an author's struct, once for each frame; schema, layouts,
examples, wire tables, explain and exports walk it (`children`, `nodes`) and know nothing of
construct. Everything here is immutable. A node says what it is (`FieldInfo` for what carries a
value) and how it is stored; where it begins is the sum of what stands before it.

    Struct          members in a row
    Sealed          a Struct with a checksum
    Number          an integer or float of whole bytes
    Blob            plain bytes; a constant without name is one with name ""
    Block           so many bytes whose bits make up one or more integers (`Part`)
    Repeat          one element so many times
    Parts           frames within the frame, one after another, each of a size of its own
    When            a part that a condition decides on
    Select          a part that a key decides on
    Empty           nothing
    Check           nothing, under a condition that the frame has to meet
    Never           what no frame has
    Opaque          what construct alone can read

Counts, lengths, conditions and keys are formulas: numbers, references to fields (`Ref`) and
operations on both (`Op`). An expression that cannot be written down like this is `Untraced`, and
construct reads its frames.

Parts stand in the tree twice: as they are described, with paths from the top of the frame
(`Kind.element`), and as frames in themselves, with paths from their own start (`Kind.root`), which
layouts and tables are made of.

A field that says how long a part is (`FieldInfo.held`) follows from what the nodes of that part add
up to (`size`), and what pads a part is so many bytes: both are formulas like all others. An axis
has its name in `Repeat.axis` and `FieldInfo.axes`; one element of an array is an index in `Ref`. A
wire form, which recodes the bytes before they have places, is a value of the `Frame`, beside its
tree.
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

from lidarspec.errors import SpecError
from lidarspec.spec.bits import BitField
from lidarspec.spec.checksums import Checksum

#: the name that is shown for a constant without one.
UNNAMED = "(constant)"


def exact(number: float | int) -> Fraction:
    """The decimal number that was written, not the binary one nearest to it: 0.001 is 1/1000."""
    if isinstance(number, float):
        return Fraction(repr(float(number)))
    return Fraction(number)


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
        allowed: the raw values that it may have (construct's OneOf, NoneOf and Mapping), in their
            order; None for any.
        rebuilt: what its value in a frame that is made follows from, None where it is given
            (construct's Rebuild).
        default: the value that a frame gets if none is given: raw, or a formula; of bytes, a
            pattern of one byte that fills the field.
        held: whether a frame that comes is held to that (`SizeOf`).
        labels: meanings of raw values (construct's Enum).
        optional: whether some headers leave it out.
        measured: whether the author says what it measures, with a unit or as a pure number.
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
    held: bool = False
    labels: Mapping[int, str] = field(default_factory=dict)
    optional: bool = False
    measured: bool = False

    @property
    def name(self) -> str:
        """The last part of the path."""
        return self.path.rpartition(".")[2]

    @property
    def scaled(self) -> bool:
        """Whether the physical value is another number than the raw one."""
        return self.scale != 1 or self.offset != 0

    def physical(self, raw: Any) -> Any:
        """Raw values in the field's unit.

        Args:
            raw: a number, or an array of any shape.

        Returns:
            The same kind of thing; raw values themselves where no scale is declared. A Fraction is
            scaled exactly.
        """
        if not self.scaled:
            return raw
        if isinstance(raw, Fraction):
            return raw * exact(self.scale) + exact(self.offset)
        return raw * self.scale + self.offset

    def raw(self, physical: Any) -> Any:
        """The raw values nearest to physical ones, halfway to the even one; of a float field those
        that are equal.

        Args:
            physical: a number in the field's unit, or an array of any shape.

        Returns:
            An int, or int64 of the same shape; floats for a float field. They may be beyond the
            field's limits.
        """
        if isinstance(physical, Fraction):
            steps: Any = (physical - exact(self.offset)) / exact(self.scale)
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

    @property
    def limits(self) -> tuple[int, int]:
        """The lowest and highest raw value of an integer field."""
        signed = self.dtype is not None and self.dtype.kind == "i"
        if signed:
            return (-(1 << (self.bits - 1)), (1 << (self.bits - 1)) - 1)
        return (0, (1 << self.bits) - 1)

    @property
    def initial(self) -> int:
        """The raw value used if none is given: 0, or the first allowed value."""
        if self.allowed is None or 0 in self.allowed:
            return 0
        return self.allowed[0]


def runs_of(values: Sequence[int]) -> list[tuple[int, int]]:
    """The first and last of each run of values that follow one another; they ascend."""
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
    """Return bytes and integers in hexadecimal, other values as Python shows them."""
    if isinstance(value, bytes):
        return value.hex(" ")
    if isinstance(value, int):
        return f"0x{value:x}"
    return repr(value)


def listed(values: Sequence[int]) -> str:
    """Some raw values in words: "1, 3, 5 to 7"."""
    between = {0: "{0}", 1: "{0}, {1}"}
    return ", ".join(
        between.get(last - first, "{0} to {1}").format(first, last)
        for first, last in runs_of(values)
    )


@dataclass(frozen=True)
class Ref:
    """The raw value of a field that stands before the formula.

    Attributes:
        path: from the top of the frame, dotted, without indices; within an array it is the field of
            the same element.
        info: the field.
    """

    path: str
    info: FieldInfo


@dataclass(frozen=True)
class Op:
    """An operation on integers as Python does it: ``//`` and ``%`` round down, comparisons give 1
    or 0.

    Attributes:
        symbol: + - * // % & | ^ << >> == != < <= > >= with two arguments; - and not with one.
    """

    symbol: str
    args: tuple[Formula, ...]


@dataclass(frozen=True, eq=False)
class Untraced:
    """A formula that cannot be written down, such as a Python function that decides on values.

    construct reads the frames of a struct with such a formula, one at a time.

    Attributes:
        reason: why it cannot be written down, with the path of the part that it belongs to.
        text: the formula as the author wrote it, with fields by their whole paths; "?" for a
            function.
    """

    reason: str
    text: str


Formula = int | Ref | Op | Untraced
#: From the path of a field to its raw value; to None if the header leaves the field out.
Read = Callable[[str], "int | None"]

_OPERATIONS: dict[str, Callable[..., Any]] = {
    **{
        "+": operator.add,
        "*": operator.mul,
        "//": operator.floordiv,
        "%": operator.mod,
        "&": operator.and_,
        "|": operator.or_,
    },
    **{"^": operator.xor, "<<": operator.lshift, ">>": operator.rshift, "not": operator.not_},
    **{
        "==": operator.eq,
        "!=": operator.ne,
        "<": operator.lt,
        "<=": operator.le,
        ">": operator.gt,
        ">=": operator.ge,
    },
    "-": lambda first, *second: first - second[0] if second else -first,
}


def calculated(symbol: str, *args: Formula) -> Formula:
    """An operation, done at once where it is a sum or product of numbers."""
    if all(isinstance(arg, int) for arg in args) and symbol in ("+", "-", "*"):
        return int(_OPERATIONS[symbol](*args))
    return Op(symbol, args)


def evaluated(formula: Formula, read: Read) -> Any:
    """The value of a formula.

    Args:
        read: what gives the values of fields; a field that the header leaves out counts as None, as
            in construct.

    Raises:
        Exception: whatever the operation raises on these values.
    """
    match formula:
        case Ref():
            return read(formula.path)
        case Op("*", (condition, _)) if _is_condition(condition) and not evaluated(condition, read):
            return (
                0  # the size of an alternative that is not there, whose fields nobody can ask for
            )
        case Op():
            return _OPERATIONS[formula.symbol](*(evaluated(arg, read) for arg in formula.args))
        case Untraced():
            raise ValueError(formula.reason)
    return formula


def arrays(formula: Formula, columns: Mapping[str, Any], dtype: Any) -> Any:
    """Return the values of a formula by arrays of its fields of a type that holds all it
    comes to; truths stay truths.
    """
    match formula:
        case Ref():
            return columns[formula.path]
        case Op("not", (operand,)):
            return arrays(operand, columns, dtype) == 0
        case Op(symbol, args):
            values = [arrays(arg, columns, dtype) for arg in args]
            if symbol not in _OF_TRUTHS:
                values = [
                    np.asarray(value, dtype) if isinstance(value, np.ndarray) else value
                    for value in values
                ]
            return _OPERATIONS[symbol](*values)
    return formula


#: operations that give 1 or 0.
COMPARISONS = frozenset({"==", "!=", "<", "<=", ">", ">="})

#: operations that take truths for 1 and 0 in arrays too.
_OF_TRUTHS = COMPARISONS | {"&", "|", "^"}


def _is_condition(formula: Formula) -> bool:
    return isinstance(formula, Op) and (
        formula.symbol in COMPARISONS
        or (formula.symbol == "*" and all(map(_is_condition, formula.args)))
    )


def written(formula: Formula, named: Callable[[Ref], str], operations: Mapping[str, str]) -> str:
    """A formula, that is traced in it, as an expression of another language.

    Args:
        named: what gives the text of a field.
        operations: symbol -> text with "{}" for each argument, where the language says it in
            another way than Python.
    """
    match formula:
        case Ref():
            return named(formula)
        case Op("-", (operand,)):
            return f"(-{written(operand, named, operations)})"
        case Op(symbol, args):
            text = operations.get(
                symbol, "(not {})" if symbol == "not" else f"({{}} {symbol} {{}})"
            )
            return text.format(*(written(arg, named, operations) for arg in args))
        case Untraced():
            raise ValueError(formula.reason)
    if formula < 0:
        return f"({formula})"
    return str(formula)


def element_of(info: FieldInfo, path: str, indices: Mapping[str, int]) -> FieldInfo | None:
    """A field by its place in some of its arrays, as a field of its own; None where it is not in
    these.
    """
    if not indices.keys() <= set(info.axes):
        return None
    is_byte = info.kind == "bytes" and info.path in indices
    kind, bits = ("int", 8) if is_byte else (info.kind, info.bits)
    return replace(
        info,
        path=path,
        axes=tuple(axis for axis in info.axes if axis not in indices),
        kind=kind,
        bits=bits,
    )


def parts(formula: Formula) -> Iterator[Formula]:
    """A formula and all that it is made of."""
    yield formula
    if isinstance(formula, Op):
        for arg in formula.args:
            yield from parts(arg)


def refs(formula: Formula) -> tuple[Ref, ...]:
    """The fields that a formula depends on, in the order in which it names them, each once."""
    return tuple(dict.fromkeys(part for part in parts(formula) if isinstance(part, Ref)))


#: bits of a value that a formula in 64-bit integers may reach.
MOST_BITS = 62


def width(formula: Formula) -> int:
    """How many bits, besides a sign, a formula that is traced takes at most."""
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


def moved(formula: Formula, axis: str) -> Formula:
    """A formula of a part as one of the frame around it, in which the part is at a path."""
    match formula:
        case Ref(path):
            return replace(formula, path=path[2:] if path.startswith("_.") else f"{axis}.{path}")
        case Op(symbol, args):
            return Op(symbol, tuple(moved(arg, axis) for arg in args))
    return formula


@dataclass(frozen=True, eq=False)
class Number:
    """An integer or float of whole bytes.

    Attributes:
        info: the field; `info.const` is the value that it must have.
        size: in bytes.
        kind: "uint", "int" or "float".
        order: byte order.
    """

    info: FieldInfo
    size: int
    kind: Literal["uint", "int", "float"]
    order: Literal["little", "big"]

    @property
    def name(self) -> str:
        """The field's own name."""
        return self.info.name

    def encoded(self, value: float) -> bytes:
        """The bytes that a raw value is on the wire."""
        if self.kind == "float":
            order = "<" if self.order == "little" else ">"
            code = {2: "e", 4: "f", 8: "d"}[self.size]
            return struct.pack(order + code, value)
        return int(value).to_bytes(self.size, self.order, signed=self.kind == "int")


@dataclass(frozen=True, eq=False)
class Blob:
    """Plain bytes with an optional constant content.

    `const` is None if any content is allowed. Only a constant may have no name.
    """

    name: str
    info: FieldInfo
    size: Formula
    const: bytes | None = None


@dataclass(frozen=True, eq=False)
class Part:
    """One integer of a block.

    Attributes:
        info: the field.
        bits: which bits of the block make it up: `bits.segments`, `bits.width`, `bits.signed`.
        names: from the block down to it: (), ("distance",).
        indices: which element it is, for each array inside the block.
    """

    info: FieldInfo
    bits: BitField
    names: tuple[str, ...]
    indices: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Block:
    """So many bytes whose bits make up its parts; a block of one part without names is a plain
    field of odd width or order.
    """

    name: str
    info: FieldInfo
    size: int
    parts: tuple[Part, ...]


@dataclass(frozen=True, eq=False)
class Struct:
    """Members in a row; `path` is "" for the frame itself, `docs` is the author's text on all of
    them.
    """

    name: str
    path: str
    members: tuple[Node, ...]
    docs: str = ""

    @property
    def struct(self) -> Struct:
        """Itself, as `Sealed.struct`."""
        return self


@dataclass(frozen=True, eq=False)
class Sealed:
    """A struct with a checksum.

    Attributes:
        body: the struct, which may be sealed by other fields too.
        fields: paths of what holds the checksum, low bits first.
        over: paths of the first and last member that it covers; None: all bytes of the body that
            hold no bit of `fields`.
        declared: the algorithm, None where a hook has to supply it.
        absent: values that mean "not filled", and pass.
    """

    body: Struct | Sealed
    fields: tuple[str, ...]
    over: tuple[str, str] | None
    declared: Checksum | None
    absent: tuple[int, ...]

    @property
    def algorithm(self) -> Checksum:
        """The algorithm of the checksum.

        Raises:
            SpecError: where there is none.
        """
        if self.declared is None:
            raise SpecError(
                "a checksum without algorithm, and no lidarspec_checksum hook supplies one",
                path=self.fields[0],
            )
        return self.declared

    @property
    def struct(self) -> Struct:
        """The struct itself, below all its seals."""
        return self.body.struct

    @property
    def name(self) -> str:
        """The name of the struct."""
        return self.body.name


@dataclass(frozen=True, eq=False)
class Repeat:
    """One element `count` times; `axis` is the name of the array, its path, with brackets where it
    is directly in an array.
    """

    name: str
    axis: str
    count: Formula
    element: Node
    default: Any = None


@dataclass(frozen=True, eq=False)
class Kind:
    """What a part can be.

    Attributes:
        name: by which it is asked for; "" where all parts are of one kind.
        element: it as it stands in the frame.
        root: it as a frame in itself; a field of the frame around it is "_." and its path there.
        following: of fields of `root`: the bytes of the part behind it, 0 behind the last; None
            where parts are no chain.
    """

    name: str
    element: Node
    root: Node
    following: Formula | None


@dataclass(frozen=True, eq=False)
class Parts:
    """Frames within the frame: `count` of them, a chain whose first is `size` bytes long, or as
    many as fill `within` bytes.

    Attributes:
        axis: its path, the name of the array that parts are elements of.
        kinds: those that a part is compared with, in this order.
        outer: fields of the frame that formulas of the parts ask for.
        total: the bytes of all parts, as formulas behind them ask for it.
    """

    name: str
    axis: str
    kinds: tuple[Kind, ...]
    count: Formula | None
    size: Formula | None
    within: Formula | None
    outer: tuple[Ref, ...]
    total: FieldInfo

    def following(self, kind: Kind) -> Formula | None:
        """The bytes of the part behind one of a kind, by the paths that its fields have in the
        frame.
        """
        if kind.following is None:
            return None
        return moved(kind.following, self.axis)


@dataclass(frozen=True, eq=False)
class When:
    """`then` where the condition is not 0, else `otherwise`."""

    name: str
    condition: Formula
    then: Node
    otherwise: Node


@dataclass(frozen=True, eq=False)
class Select:
    """A part for each value of the key, and one for all other values.

    The values are integers, unless the key is `Untraced`.
    """

    name: str
    key: Formula
    cases: tuple[tuple[Any, Node], ...]
    default: Node


@dataclass(frozen=True, eq=False)
class Empty:
    """Nothing."""

    name: str = ""


@dataclass(frozen=True, eq=False)
class Check:
    """A condition that frames have to meet: not 0; `axes` of the arrays that it is in."""

    name: str
    path: str
    axes: tuple[str, ...]
    condition: Formula


@dataclass(frozen=True, eq=False)
class Never:
    """What no frame has: an alternative that is an error."""

    name: str


@dataclass(frozen=True, eq=False)
class Opaque:
    """What construct alone can read.

    Attributes:
        info: the field, where it is one.
        kind: the name of construct's class, or of the author's.
        reason: why no node stands for it.
        inside: the parts of a bit block, or of a struct, that cannot be read as one; they have no
            places.
        size: in bytes, None where only the bytes themselves tell.
        form: how a field stands on the wire: "text up to" its terminator, else its kind.
        in_bits: whether it is a bit block.
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
    | Sealed
    | Repeat
    | Parts
    | When
    | Select
    | Empty
    | Check
    | Never
    | Opaque
)


def children(node: Node) -> tuple[Node, ...]:
    """The nodes directly below one."""
    match node:
        case Struct():
            return node.members
        case Sealed():
            return (node.body,)
        case Repeat():
            return (node.element,)
        case Parts():
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
    """A node and all below it, in the order of the wire."""
    yield node
    for child in children(node):
        yield from nodes(child)


def formulas(node: Node) -> tuple[Formula, ...]:
    """The formulas of a node, those of its parts left out."""
    match node:
        case Blob():
            return (node.size,)
        case Repeat():
            return (node.count,)
        case Parts():
            found = (node.count, node.size, node.within, *map(node.following, node.kinds))
            return tuple(formula for formula in found if formula is not None)
        case When():
            return (node.condition,)
        case Select():
            return (node.key,)
    return ()


def size(node: Node) -> Formula | None:
    """The bytes of a node as a formula of header fields; None where construct alone can tell."""
    match node:
        case Number() | Block() | Blob() | Opaque():
            return node.size
        case Repeat():
            return joined("*", node.count, size(node.element))
        case Parts():
            return Ref(node.total.path, node.total)
        case When():
            return _chosen(
                [
                    (calculated("!=", node.condition, 0), size(node.then)),
                    (calculated("==", node.condition, 0), size(node.otherwise)),
                ]
            )
        case Select():
            cases = [
                (calculated("==", node.key, value), size(case))
                for value, case in node.cases
                if not isinstance(case, Never)
            ]
            others = [calculated("!=", node.key, value) for value, _ in node.cases]
            if isinstance(node.default, Never):
                return _chosen(cases)
            return _chosen(
                [
                    *cases,
                    (
                        functools.reduce(functools.partial(calculated, "*"), others),
                        size(node.default),
                    ),
                ]
            )
    return total(size(below) for below in children(node))


def total(sizes: Iterable[Formula | None]) -> Formula | None:
    """The sum of sizes, None where one is not known."""
    found: Formula | None = 0
    for each in sizes:
        found = joined("+", found, each)
    return found


def joined(symbol: str, one: Formula | None, other: Formula | None) -> Formula | None:
    """A sum, difference or product, as short as it can be written; None where one of both is not
    known.
    """
    if one is None or other is None:
        return None
    neutral = 1 if symbol == "*" else 0
    if other == neutral or (one == neutral and symbol != "-"):
        if other == neutral:
            return one
        return other
    if symbol == "*" and 0 in (one, other):
        return 0
    if symbol == "+" and isinstance(one, int):
        one, other = other, one
    match symbol, one, other:
        case "+" | "-", Op("+" | "-" as inner, (first, int() as known)), int():
            number = (known if inner == "+" else -known) + (other if symbol == "+" else -other)
            return joined("+" if number >= 0 else "-", first, abs(number))
    return calculated(symbol, one, other)


def _chosen(cases: Sequence[tuple[Formula, Formula | None]]) -> Formula | None:
    """The size of alternatives, each with the condition under which it is there."""
    first = cases[0][1] if cases else 0
    if all(each == first for _, each in cases):
        return first
    return total(joined("*", holds, each) for holds, each in cases)


def infos(node: Node) -> tuple[FieldInfo, ...]:
    """The fields that a node is: one, or those of the parts of a block; none for a struct, an array
    or a choice.
    """
    match node:
        case Number() | Blob() | Opaque():
            return (node.info,)
        case Block():
            return tuple(part.info for part in node.parts)
    return ()


class Scope:
    """What an expression of a struct sees of the fields before it, as symbols, so that what it does
    with them can be written down.

    Args:
        asked: to which the fields are added that an expression asks for.
    """

    def __init__(self, parent: Scope | None, path: str, asked: list[Ref]) -> None:
        self.parent = parent
        self.path = path
        self.asked = asked
        self.names: dict[str, Ref | Scope] = {}
        #: names of parts that branches have in different forms.
        self.several: set[str] = set()

    def add(self, name: str, part: Ref | Scope) -> None:
        """Make a field or struct known from here on."""
        known = self.names.get(name)
        if known is not None and not (
            isinstance(known, Ref)
            and isinstance(part, Ref)
            and known.info.labels == part.info.labels
        ):
            self.several.add(name)
        self.names[name] = part

    def __getitem__(self, name: str) -> Any:
        if name == "_":
            return self.parent
        if name == "_root":
            if self.parent is not None:
                return self.parent["_root"]
            return self
        if name not in self.names:
            raise Untraceable(f"an expression asks for {name!r}, which is not a field before it")
        part = self.names[name]
        if isinstance(part, Scope):
            return part
        self.asked.append(part)
        if name in self.several:
            raise Untraceable(f"an expression asks for {name!r}, which has several forms")
        return Symbol(part)

    def __getattr__(self, name: str) -> Any:
        return self[name]

    def __len__(self) -> int:
        raise Untraceable("an expression asks for the length of an array")


class Outside(Scope):
    """What a part sees of the frame around it: the same symbols, with "_." before their paths."""

    def __init__(self, scope: Scope, asked: list[Ref]) -> None:
        super().__init__(None, f"_.{scope.path}".rstrip("."), asked)
        self._scope = scope

    def __getitem__(self, name: str) -> Any:
        found = self._scope[name]
        if isinstance(found, Scope):
            return Outside(found, self.asked)
        if isinstance(found, Symbol) and isinstance(found.formula, Ref):
            self.asked.append(Ref(f"_.{found.formula.path}", found.formula.info))
            return Symbol(self.asked[-1])
        return found


class Untraceable(Exception):
    """Why an expression cannot be written down as data."""


class Symbol:
    """A value that is not known yet; what is done with it is kept."""

    __hash__ = None  # type: ignore[assignment]

    def __init__(self, formula: Formula) -> None:
        self.formula = formula

    def __bool__(self) -> bool:
        raise Untraceable("a Python function decides on the values of fields")

    __index__ = __int__ = __float__ = __len__ = __iter__ = __bool__

    def __invert__(self) -> Symbol:
        return Symbol(Op("-", (Op("+", (self.formula, 1)),)))

    def __neg__(self) -> Symbol:
        return Symbol(Op("-", (self.formula,)))

    def __pos__(self) -> Symbol:
        return self

    def __getattr__(self, name: str) -> Any:
        raise Untraceable(f"an expression asks for {name!r} of a number")

    def __getitem__(self, key: object) -> Any:
        known = self.formula
        if isinstance(known, Ref) and len(known.info.axes) == 1 and type(key) is int and key >= 0:
            path = f"{known.path}[{key}]"
            info = element_of(known.info, path, {known.info.axes[0]: key})
            return Symbol(Ref(path, info or known.info))
        raise Untraceable("an expression takes an element of an array, or a byte")


def _traced_operation(symbol: str, left: Any, right: Any) -> Symbol:
    pair: list[Any] = [part.formula if isinstance(part, Symbol) else part for part in (left, right)]
    for one, other in ((0, 1), (1, 0)):
        known = pair[other]
        if not isinstance(known, Ref) or not known.info.labels:
            continue
        if symbol not in ("==", "!=") or not isinstance(pair[one], int | str):
            raise Untraceable("an expression takes the name of a value for a number")
        if pair[one] in known.info.labels:  # construct has the name in place of such a number
            return Symbol(int(symbol == "!="))
        pair[one] = _labelled(known, pair[one]) if isinstance(pair[one], str) else pair[one]
    wrong = next((part for part in pair if not isinstance(part, int | Ref | Op)), None)
    if wrong is not None:
        raise Untraceable(f"an expression with {wrong!r}")
    return Symbol(
        calculated(symbol, *(int(part) if isinstance(part, bool) else part for part in pair))
    )


def _no_integer(sign: str) -> Any:
    raise Untraceable(f"an expression with {sign!r}, which need not give an integer")


_SYMBOLS = {
    **{
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
        lambda self, other, symbol=_symbol: _traced_operation(symbol, self, other),
    )
    if _symbol not in COMPARISONS:
        setattr(
            Symbol,
            f"__r{_name}__",
            lambda self, other, symbol=_symbol: _traced_operation(symbol, other, self),
        )
for _name, _symbol in {"truediv": "/", "pow": "**", "divmod": "divmod", "matmul": "@"}.items():
    for _full in (f"__{_name}__", f"__r{_name}__"):
        setattr(Symbol, _full, lambda self, other, sign=_symbol: _no_integer(sign))


def _labelled(ref: Ref, label: str) -> int:
    """The raw value that a name of construct's Enum stands for."""
    for value, name in ref.info.labels.items():
        if name == str(label):
            return value
    raise Untraceable(f"{ref.path} has no value named {label!r}")
