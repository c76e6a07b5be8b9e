"""Counts, conditions and keys of a struct as data: integers, references to fields before them, and operations on both.

An expression of construct, and a Python function, are both called with a scope that hands out symbols; what they do with them is
written down. What they decide by looking at a value cannot be written down so, and is refused with the reason.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from construct.expr import BinExpr, UniExpr

from lidarspec.exports import Refused
from lidarspec.wire.schema import FieldInfo


@dataclass(frozen=True)
class Ref:
    """The raw value of a field that stands before the expression.

    Attributes:
        path: from the top of the frame, dotted, without indices; within an array it is the field of the same element.
        info: the field.
    """

    path: str
    info: FieldInfo


@dataclass(frozen=True)
class Op:
    """An operation on integers as Python does it: ``//`` and ``%`` round down, comparisons give 1 or 0.

    Attributes:
        symbol: + - * // % & | ^ << >> == != < <= > >= with two arguments; - and not with one.
    """

    symbol: str
    args: tuple[Formula, ...]


Formula = int | Ref | Op


def refs(formula: Formula) -> tuple[Ref, ...]:
    """The fields that a formula depends on, in the order in which it names them, each once."""
    if isinstance(formula, Op):
        return tuple(dict.fromkeys(ref for arg in formula.args for ref in refs(arg)))
    return (formula,) if isinstance(formula, Ref) else ()


def calculated(symbol: str, *args: Formula) -> Formula:
    """An operation, done at once where all its arguments are numbers."""
    if all(isinstance(arg, int) for arg in args) and symbol in _NUMBERS:
        return int(_NUMBERS[symbol](*args))
    return Op(symbol, args)


_NUMBERS: dict[str, Callable[..., int]] = {
    "+": lambda a, b: a + b,
    "-": lambda a, b=None: -a if b is None else a - b,
    "*": lambda a, b: a * b,
}


class Scope:
    """What an expression sees of the fields before it, as symbols."""

    def __init__(self, parent: Scope | None, path: str) -> None:
        self._parent, self._path = parent, path
        self._names: dict[str, _Symbol | Scope] = {}

    def add(self, name: str, found: FieldInfo | Scope) -> None:
        """Make a field or struct known from here on."""
        self._names[name] = found if isinstance(found, Scope) else _Symbol(Ref(found.path, found))

    def __getitem__(self, name: str) -> Any:
        if name == "_":
            return self._parent
        if name == "_root":
            return self._parent["_root"] if self._parent else self
        if name not in self._names:
            raise Refused(f"an expression asks for {name!r}, which is not a field before it")
        return self._names[name]

    def __getattr__(self, name: str) -> Any:
        return self[name]


class _Symbol:
    """A value that is not known yet; what is done with it is kept."""

    __hash__ = None  # type: ignore[assignment]

    def __init__(self, formula: Formula) -> None:
        self.formula = formula

    def __bool__(self) -> bool:
        raise Refused("a Python function decides on the values of fields")

    __index__ = __int__ = __float__ = __len__ = __iter__ = __bool__

    def __invert__(self) -> _Symbol:
        return _Symbol(Op("-", (Op("+", (self.formula, 1)),)))

    def __neg__(self) -> _Symbol:
        return _Symbol(Op("-", (self.formula,)))

    def __pos__(self) -> _Symbol:
        return self

    def __getattr__(self, name: str) -> Any:
        raise Refused(f"an expression asks for {name!r} of a number")

    def __getitem__(self, key: object) -> Any:
        raise Refused("an expression takes an element of an array, or a byte")


def _operators() -> None:
    for name, symbol in {
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
    }.items():
        setattr(_Symbol, f"__{name}__", lambda self, other, symbol=symbol: _operation(symbol, self, other))
        setattr(_Symbol, f"__r{name}__", lambda self, other, symbol=symbol: _operation(symbol, other, self))
    for name, symbol in {"eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">", "ge": ">="}.items():
        setattr(_Symbol, f"__{name}__", lambda self, other, symbol=symbol: _operation(symbol, self, other))
    for name, sign in {"truediv": "/", "pow": "**", "divmod": "divmod", "matmul": "@"}.items():
        for full in (f"__{name}__", f"__r{name}__"):
            setattr(_Symbol, full, lambda self, other, sign=sign: _no_integer(sign))


_operators()


def _no_integer(sign: str) -> Any:
    raise Refused(f"an expression with {sign!r}, which need not give an integer")


def _operation(symbol: str, left: Any, right: Any) -> _Symbol:
    pair: list[Any] = [part.formula if isinstance(part, _Symbol) else part for part in (left, right)]
    for one, other in ((0, 1), (1, 0)):
        known = pair[other]
        if isinstance(pair[one], str) and isinstance(known, Ref):
            pair[one] = labelled(known, pair[one])
    if not all(isinstance(part, int | Ref | Op) for part in pair):
        raise Refused(f"an expression with {next(part for part in pair if not isinstance(part, int | Ref | Op))!r}")
    return _Symbol(calculated(symbol, *(int(part) if isinstance(part, bool) else part for part in pair)))


def labelled(ref: Ref, label: str) -> int:
    """The raw value that a name of construct's Enum stands for.

    Raises:
        Refused: for a name that it does not have.
    """
    for value, name in ref.info.labels.items():
        if name == str(label):
            return value
    raise Refused(f"{ref.path} has no value named {label!r}")


def formula(expression: Any, scope: Scope, path: str) -> Formula:
    """An expression of a struct as data.

    Args:
        expression: a number, an expression of construct, or a function of the context.
        scope: the fields before it.
        path: of the part that it belongs to, for the reason of a refusal.

    Raises:
        Refused: where only Python can evaluate it.
    """
    if isinstance(expression, int):
        return int(expression)
    try:
        found = _traced(expression, scope)
    except Refused as refused:
        raise Refused(f"{path}: {refused}") from None
    except Exception as error:
        raise Refused(f"{path}: a Python function of other fields ({type(error).__name__}: {error})") from None
    if isinstance(found, bool | int):
        return int(found)
    if not isinstance(found, _Symbol):
        raise Refused(f"{path}: an expression that gives {found!r}")
    return found.formula


def _traced(expression: Any, scope: Scope) -> Any:
    """What an expression comes to; construct's own are walked, since its ``~`` asks for the truth of a value."""
    if isinstance(expression, BinExpr):
        return expression.op(_traced(expression.lhs, scope), _traced(expression.rhs, scope))
    if isinstance(expression, UniExpr):
        operand = _traced(expression.operand, scope)
        if expression.op is operator.not_ and isinstance(operand, _Symbol):
            return _Symbol(Op("not", (operand.formula,)))
        return expression.op(operand)
    return expression(scope) if callable(expression) else expression
