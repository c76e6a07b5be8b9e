"""Counts, conditions and keys as Kaitai writes them, with fields by their way from the type that asks."""

from __future__ import annotations

import re
from dataclasses import dataclass

from lidarspec.export import Refused
from lidarspec.export.formulas import Formula, Op, Ref

COMPARISONS = {"==", "!=", "<", "<=", ">", ">="}


def identifier(name: str) -> str:
    """A name as Kaitai takes it."""
    return re.sub(r"[^a-z0-9_]", "_", name.lower())


@dataclass(frozen=True)
class Names:
    """The types that a place stands in, outermost first, by the path of their struct; None for one that has no struct."""

    levels: tuple[str | None, ...] = ()

    def inside(self, path: str) -> Names:
        """In the type of the struct at a path."""
        return Names((*self.levels, path))

    def wrapped(self) -> Names:
        """In a type that holds one part alone."""
        return Names((*self.levels, None))

    def way(self, ref: Ref) -> str:
        """The way from here to a field.

        Raises:
            Refused: to one that no type around this place holds.
        """
        for up, path in enumerate(reversed(self.levels)):
            if path is not None and (path == "" or ref.path.startswith(f"{path}.")):
                below = ref.path[len(path) + 1 :] if path else ref.path
                return "_parent." * up + ".".join(identifier(name) for name in below.split("."))
        raise Refused(f"{ref.path} cannot be reached in Kaitai")


def number(formula: Formula, names: Names) -> str:
    """A formula as an integer."""
    match formula:
        case Ref():
            return names.way(formula) + (".to_i" if formula.info.bits == 1 else "")
        case Op(symbol) if symbol in COMPARISONS or symbol == "not":
            return f"({truth(formula, names)} ? 1 : 0)"
        case Op(symbol, (operand,)):
            return f"({symbol}{number(operand, names)})"
        case Op(symbol, (left, right)):
            return f"({number(left, names)} {'/' if symbol == '//' else symbol} {number(right, names)})"
        case _:
            return str(formula)


def truth(formula: Formula, names: Names) -> str:
    """A formula as a condition: not 0."""
    match formula:
        case Op("not", (operand,)):
            return f"not ({truth(operand, names)})"
        case Op(symbol, (left, right)) if symbol in COMPARISONS:
            return f"{number(left, names)} {symbol} {number(right, names)}"
        case int():
            return "true" if formula else "false"
        case _:
            return f"{number(formula, names)} != 0"
