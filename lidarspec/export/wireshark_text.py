"""Values and formulas as Lua."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

from lidarspec.export.formulas import Formula, Op, Ref

WIDTH = 140


class Code(str):
    """Lua as it stands, not to be quoted."""


_BARE = {"+": "({} + {})", "-": "({} - {})", "*": "({} * {})", "<<": "({} * 2 ^ {})"}
_COMPARED = {"==": "==", "!=": "~=", "<": "<", "<=": "<=", ">": ">", ">=": ">="}
_CALLED = {"//": "int.div", "%": "int.mod", "&": "int.band", "|": "int.bor", "^": "int.bxor"}


def formula(value: Formula) -> Code:
    """A formula as a number, or as a function of the values of fields."""
    return Code(str(value)) if isinstance(value, int) else Code(f"function(v) return {_term(value)} end")


def _term(value: Formula) -> str:
    if isinstance(value, Ref):
        return f"v[{quoted(value.path)}]"
    if isinstance(value, Op):
        args = [_term(arg) for arg in value.args]
        if value.symbol == "not":
            return f"int.truth({args[0]} == 0)"
        if len(args) == 1:
            return f"(-{args[0]})"
        if value.symbol in _COMPARED:
            return f"int.truth({args[0]} {_COMPARED[value.symbol]} {args[1]})"
        if value.symbol == ">>":
            return f"int.div({args[0]}, 2 ^ {args[1]})"
        if value.symbol in _CALLED:
            return f"{_CALLED[value.symbol]}({args[0]}, {args[1]})"
        return _BARE[value.symbol].format(*args)
    return f"({value})" if value < 0 else str(value)


def lua(value: Any, indent: str = "") -> str:
    """Plain data as a Lua expression, on one line where it fits."""
    if isinstance(value, Code):
        return str(value)
    if isinstance(value, str):
        return quoted(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{value!r} has no Lua literal")
    if isinstance(value, int | float):
        return repr(value)
    entries = _entries(value, indent + "  ")
    line = "{" + ", ".join(entries) + "}"
    if len(indent) + len(line) <= WIDTH and "\n" not in line:
        return line
    return "{\n" + "".join(f"{indent}  {entry},\n" for entry in entries) + indent + "}"


def _entries(value: Any, indent: str) -> list[str]:
    if isinstance(value, Mapping):
        return [f"{_key(key)} = {lua(item, indent)}" for key, item in value.items() if item is not None]
    assert isinstance(value, Iterable)
    return [lua(item, indent) for item in value]


def _key(key: object) -> str:
    return key if isinstance(key, str) and key.isidentifier() and key.isascii() else f"[{lua(key)}]"


def quoted(text: str | bytes) -> str:
    """A Lua string; what is not printable ASCII as decimal escapes."""
    data = text.encode() if isinstance(text, str) else text
    return '"' + "".join(chr(byte) if 32 <= byte < 127 and byte not in b'"\\' else f"\\{byte:03d}" for byte in data) + '"'
