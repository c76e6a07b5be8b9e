from __future__ import annotations

from collections.abc import Callable, Mapping

from lidarspec.exports.formulas import Formula, Op, Ref

COMPARISONS = frozenset({"==", "!=", "<", "<=", ">", ">="})


def written(formula: Formula, field: Callable[[Ref], str], operations: Mapping[str, str]) -> str:
    """A formula as an expression of another language.

    Args:
        field: what gives the text of a field.
        operations: symbol -> text with "{}" for each argument, where the language says it in another way than Python.
    """
    match formula:
        case Ref():
            return field(formula)
        case Op("-", (operand,)):
            return f"(-{written(operand, field, operations)})"
        case Op(symbol, args):
            text = operations.get(symbol, "(not {})" if symbol == "not" else f"({{}} {symbol} {{}})")
            return text.format(*(written(arg, field, operations) for arg in args))
        case _:
            return f"({formula})" if formula < 0 else str(formula)
