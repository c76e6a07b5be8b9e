"""Mistakes that show in the text of a plugin: what Python accepts, and what then does something else than it says."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from pathlib import Path

from lidarspec.testing.findings import Finding

#: calls that read the clock of the wall.
WALL_CLOCKS = frozenset(
    ["time.time", "time.time_ns", "datetime.now", "datetime.utcnow", "datetime.today", "datetime.datetime.now", "datetime.datetime.utcnow"]
)
BROAD = frozenset({"Exception", "BaseException"})


def written(files: Iterable[Path]) -> list[Finding]:
    """The findings in the text of some modules."""
    found = []
    for file in files:
        tree = ast.parse(file.read_text(encoding="utf-8"), str(file))
        found += [Finding(code, what, file=str(file), line=node.lineno) for code, what, node in _mistakes(tree)]
    return found


def _mistakes(tree: ast.Module) -> Iterator[tuple[str, str, ast.expr | ast.stmt | ast.ExceptHandler]]:
    expressions = _names_of_this(tree)
    sockets = any(isinstance(node, ast.Import | ast.ImportFrom) and "socket" in ast.unparse(node) for node in ast.walk(tree))
    for node in ast.walk(tree):
        match node:
            case ast.ExceptHandler() if _broad(node.type) and _silent(node.body):
                yield "LS801", f"except {ast.unparse(node.type) if node.type else ''}: {ast.unparse(node.body[0])}", node
            case ast.Call() if ast.unparse(node.func) in WALL_CLOCKS:
                yield "LS802", f"{ast.unparse(node.func)}()", node
            case ast.Call(func=ast.Name(id="hasattr"), args=[ast.Name(id=name), *_]) if name in expressions:
                yield "LS805", ast.unparse(node), node
            case ast.Expr(value=ast.Call() as call) if _short_write(call, sockets=sockets):
                yield "LS803", f"what {ast.unparse(call.func)} returns is dropped", node
        for test in _tests(node):
            if _is_expression(test, expressions):
                yield "LS804", f"Python asks whether `{ast.unparse(test)}` is true", test


def _names_of_this(tree: ast.Module) -> set[str]:
    """The names under which construct's `this` and `obj_` are known in a module."""
    imported = [alias for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module == "construct" for alias in node.names]
    return {alias.asname or alias.name for alias in imported if alias.name in ("this", "obj_", "len_")}


def _tests(node: ast.AST) -> list[ast.expr]:
    """The expressions whose truth Python asks for at a node."""
    match node:
        case ast.If(test=test) | ast.While(test=test) | ast.IfExp(test=test) | ast.Assert(test=test):
            return [test]
        case ast.BoolOp(values=values):
            return values
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            return [operand]
    return []


def _is_expression(test: ast.expr, names: set[str]) -> bool:
    """Whether a test is an expression of construct: made of `this`, and no call."""
    if isinstance(test, ast.BoolOp | ast.Call):
        return False
    return any(isinstance(node, ast.Name) and node.id in names for node in ast.walk(test))


def _broad(kind: ast.expr | None) -> bool:
    return kind is None or any(isinstance(node, ast.Name) and node.id in BROAD for node in ast.walk(kind))


def _silent(body: list[ast.stmt]) -> bool:
    """Whether a handler does nothing with what it caught."""
    only = body[0]
    if len(body) > 1:
        return False
    constant = isinstance(only, ast.Return) and (
        only.value is None or isinstance(only.value, ast.Constant | ast.List | ast.Dict | ast.Tuple)
    )
    return constant or isinstance(only, ast.Pass | ast.Continue) or (isinstance(only, ast.Expr) and isinstance(only.value, ast.Constant))


def _short_write(call: ast.Call, *, sockets: bool) -> bool:
    """Whether a call writes as much as it can, and its count is what is dropped."""
    match call.func:
        case ast.Attribute(value=ast.Name(id="os"), attr="write"):
            return True
        case ast.Attribute(attr="send"):
            return sockets and len(call.args) == 1 and not isinstance(call.args[0], ast.Constant)
    return False
