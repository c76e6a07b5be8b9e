"""Values, formulas and places as C."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from lidarspec.export import Refused
from lidarspec.export.formulas import Formula, Op, Ref
from lidarspec.frames.schema import FieldInfo

#: bits of a value that a formula in 64-bit integers may reach.
MOST_BITS = 62
_CALLED = {"//": "lidarspec_floor_div", "%": "lidarspec_floor_mod"}
COMPARISONS = frozenset({"==", "!=", "<", "<=", ">", ">="})
#: (path, ending) -> the C name of a function.
Name = Callable[[str, str], str]
_INDICES = "ijklmnoq"


@dataclass(frozen=True)
class Extent:
    """A number of bytes: a constant, and C expressions added to it."""

    number: int = 0
    terms: tuple[str, ...] = ()

    def __add__(self, other: Extent) -> Extent:
        return Extent(self.number + other.number, self.terms + other.terms)

    def times(self, factor: int | str) -> Extent:
        """The extent of so many of them."""
        if isinstance(factor, int) and not self.terms:
            return Extent(self.number * factor)
        if str(self) == "0":
            return self
        return Extent(0, (str(factor) if str(self) == "1" else f"{self.grouped} * {factor}",))

    @property
    def grouped(self) -> str:
        """As a factor in a product."""
        return f"({self})" if len(self.terms) + (self.number != 0) > 1 else str(self)

    def __str__(self) -> str:
        return " + ".join([str(self.number)] * (self.number != 0 or not self.terms) + list(self.terms))


def index(depth: int) -> str:
    """The name of an array index by its depth."""
    return _INDICES[depth]


def parameters(depth: int) -> str:
    """The parameters of a function for what is in so many arrays."""
    return ", ".join(["const uint8_t *p", *(f"size_t {index(level)}" for level in range(depth))])


def arguments(depth: int) -> str:
    """The arguments of a call of such a function."""
    return ", ".join(["p", *map(index, range(depth))])


def identifier(text: str) -> str:
    """A text as a part of a C name."""
    return re.sub(r"\W", "_", text.replace("[]", "_inner"), flags=re.ASCII)


def formula(value: Formula, name: Name) -> str:
    """A formula as a C expression of type int64_t; `name` gives the functions of a path.

    Raises:
        Refused: where 64-bit integers cannot hold what it may come to.
    """
    if bits(value) > MOST_BITS:
        raise Refused("a formula that may pass what a 64-bit integer holds")
    return _term(value, name)


def truth(value: Formula, name: Name) -> str:
    """A formula as a C condition; raises as `formula`."""
    text = formula(value, name)
    return text[1:-1] if isinstance(value, Op) and value.symbol in COMPARISONS else f"{text} != 0"


def _term(value: Formula, name: Name) -> str:
    if isinstance(value, Ref):
        return f"(int64_t){name(value.path, '')}({arguments(len(value.info.axes))})"
    if isinstance(value, Op):
        args = [_term(arg, name) for arg in value.args]
        if value.symbol == "not":
            return f"(int64_t)!{args[0]}"
        if len(args) == 1:
            return f"(-{args[0]})"
        if value.symbol in _CALLED:
            return f"{_CALLED[value.symbol]}({args[0]}, {args[1]})"
        if value.symbol in COMPARISONS:  # through a function: compilers warn of what a narrow number can never be
            return f"(lidarspec_int({args[0]}) {value.symbol} {args[1]})"
        return f"({args[0]} {value.symbol} {args[1]})"
    return f"({value})" if value < 0 else str(value)


def bits(value: Formula) -> int:
    """How many bits, besides a sign, a formula takes at most."""
    if isinstance(value, Ref):
        return value.info.bits
    if isinstance(value, int):
        return value.bit_length()
    args = [bits(arg) for arg in value.args]
    match value.symbol:
        case "+" | "-":
            return max(args) + 1
        case "*":
            return sum(args)
        case "<<":
            most = value.args[1] if isinstance(value.args[1], int) else (1 << args[1]) - 1 if args[1] < 8 else 99
            return args[0] + most
        case "//" | ">>":
            return args[0] + 1
        case "not":
            return 1
    return 1 if value.symbol in COMPARISONS else max(args)


def number_type(infos: Sequence[FieldInfo]) -> str:
    """The C type that holds what any of these fields holds."""
    if any(info.kind == "float" for info in infos):
        return "double" if max(info.bits for info in infos) > 32 or any(info.kind != "float" for info in infos) else "float"
    signed = any(info.dtype is not None and info.dtype.kind == "i" for info in infos)
    mixed = signed and any(info.dtype is not None and info.dtype.kind == "u" for info in infos)
    width = next(size for size in (8, 16, 32, 64) if max(info.bits for info in infos) + mixed <= size or size == 64)
    return f"{'int' if signed else 'uint'}{width}_t"


def comment(*texts: str) -> str:
    """A comment of one line, whatever the texts hold; "" where they hold nothing."""
    text = "; ".join(" ".join(part.split()) for part in texts if part).replace("*/", "* /").replace("/*", "/ *")
    return f"/* {text} */" if text else ""


def quoted(data: bytes) -> str:
    """Bytes as a C string, each as a literal of its own, so that no escape runs into the next."""
    return '"' + "".join(f"\\{byte:03o}" for byte in data) + '"'
