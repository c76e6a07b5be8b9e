"""Headers that nobody sent: drawn by chance for examples, and tried out before any frame arrives."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Mapping

import construct
from construct import Construct
from construct.expr import BinExpr, UniExpr

from lidarspec.errors import SpecError
from lidarspec.frames.layout import Layout, Leaf
from lidarspec.frames.walk import NotCompilable, TooLong, walk
from lidarspec.rules import children

#: headers tried before any arrives.
TRIED = 64

Draw = Callable[[random.Random], int]


def choose(con: Construct, limit: int, source: random.Random, drawn: Mapping[str, Draw]) -> tuple[Layout, dict[str, int]]:
    """A layout of a header chosen at random, with the values of the fields it depends on, by path.

    Args:
        limit: the longest frame, in bytes.
        drawn: field path -> what draws its value in place of chance.

    Raises:
        SpecError: where hundreds of headers give no frame.
    """
    keys = sorted(_switch_keys(con))
    for _ in range(400):
        chosen: dict[str, int] = {}

        def read(leaf: Leaf, chosen: dict[str, int] = chosen) -> int:
            if leaf.info.path not in chosen:
                own = drawn.get(leaf.info.path)
                chosen[leaf.info.path] = own(source) if own else _some_value(source, leaf, keys)
            return chosen[leaf.info.path]

        try:
            return walk(con, read, limit).layout(), chosen
        except (TooLong, ArithmeticError, LookupError, TypeError, ValueError):
            continue
    raise SpecError("no header was found that gives a frame within its longest length")


def try_headers(con: Construct, limit: int) -> None:
    """Walk the struct for values at which its expressions may decide otherwise, so that what does not compile is known by now."""
    keys = sorted({*_switch_keys(con), *_compared(con)})
    pending: list[dict[str, int]] = [{}]
    for given in pending:
        asked: dict[str, list[int]] = {}

        def read(leaf: Leaf, given: dict[str, int] = given, asked: dict[str, list[int]] = asked) -> int:
            check_control(leaf)
            values = asked[leaf.info.path] = _edges(leaf, keys)
            return given.get(leaf.info.path, values[0])

        try:
            walk(con, read, limit)
        except (NotCompilable, SpecError):
            raise
        except Exception:
            pass  # a header that leads to no frame; the next one may
        for path, values in asked.items():
            if path not in given:
                further = [{**given, path: value} for value in values[1:]]
                pending += [one for one in further if one not in pending][: max(TRIED - len(pending), 0)]


def check_control(leaf: Leaf) -> None:
    """Raise `NotCompilable` if a layout cannot be made to depend on a field."""
    if leaf.shape or leaf.info.kind != "int":
        raise NotCompilable(leaf.info.path, "the layout depends on a field that is not one integer")


def _some_value(source: random.Random, leaf: Leaf, keys: list[int]) -> int:
    if leaf.info.const is not None:
        return int(leaf.info.const)
    top = (1 << leaf.info.bits) - 1
    kinds = [source.randint(0, top), source.randint(0, min(top, 8)), source.randint(0, min(top, 40))]
    named = [key for key in (*leaf.info.labels, *keys) if key <= top]
    value = source.choice(kinds + named[:16] * (1 if source.random() < 0.7 else 0))
    is_negative = leaf.info.dtype is not None and leaf.info.dtype.kind == "i" and value >> (leaf.info.bits - 1)
    return value - (1 << leaf.info.bits) if is_negative else value


def _switch_keys(con: Construct) -> Iterator[int]:
    if isinstance(con, construct.Switch):
        yield from (key for key in con.cases if isinstance(key, int))
    for child in children(con):
        yield from _switch_keys(child)


def _edges(leaf: Leaf, keys: list[int]) -> list[int]:
    """Values of a field at which a layout may change: a usual one first."""
    if leaf.info.const is not None:
        return [int(leaf.info.const)]
    low, high = leaf.info.limits
    return [value for value in dict.fromkeys((1, 0, *leaf.info.labels, *keys, 2, high, low)) if low <= value <= high]


def _compared(con: Construct) -> Iterator[int]:
    """The numbers in the expressions of a tree, and those beside them."""
    pending = [vars(con).get(name) for name in ("count", "length", "condfunc", "keyfunc")]
    while pending:
        part = pending.pop()
        if isinstance(part, BinExpr):
            pending += [part.lhs, part.rhs]
        elif isinstance(part, UniExpr):
            pending.append(part.operand)
        elif isinstance(part, int):
            yield from (part - 1, part, part + 1)
    for child in children(con):
        yield from _compared(child)
