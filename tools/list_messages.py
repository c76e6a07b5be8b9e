"""List every text that a user may read: errors, warnings, help, labels and rules.

`make messages` prints the list for review, by module, one text a line. Inserted values are shown as
{}. The list comes from the syntax trees: every string with at least two words that is not a
docstring, a regular expression or a dict key.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: at least two words, one of them of three lower-case letters.
_PROSE = re.compile(r"[A-Za-z]\S*\s+\S*[a-z]|[a-z]{3,}\S*\s+\S")
#: characters of regular expressions, formats of code and SQL, which are no prose.
_CODE = re.compile(r"\(\?|\\[dswb]|\[\^|^\s*(?:SELECT|CREATE|INSERT|PRAGMA)\b|[{};]\s*\n|^\s*<|</")
#: calls with strings that are not text for a reader.
_NOT_READ = {"compile", "sub", "match", "fullmatch", "split", "strip", "replace", "writelines"}


def iter_texts(tree: ast.Module) -> Iterator[tuple[int, str, str]]:
    """Yield (line, call, text) of each string that a user may read, in the order of the source."""
    docstrings = set(_iter_docstrings(tree))
    stack: list[tuple[ast.AST, str]] = [(tree, "")]
    while stack:
        node, call = stack.pop()
        if node in docstrings:
            continue
        if isinstance(node, ast.Constant | ast.JoinedStr | ast.BinOp):
            text = _text(node)
            if text is not None:
                if _PROSE.search(text) and not _CODE.search(text) and call not in _NOT_READ:
                    yield node.lineno, call, " ".join(text.split())
                continue
        if isinstance(node, ast.Call):
            call = _name(node.func)
        if isinstance(node, ast.AnnAssign):
            children: list[ast.AST] = [node.value] if node.value else []
        else:
            children = list(ast.iter_child_nodes(node))
        stack.extend((child, call) for child in reversed(children))


def _iter_docstrings(tree: ast.Module) -> Iterator[ast.AST]:
    """Yield the nodes of docstrings, except help texts of commands, which are read."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        decorators = getattr(node, "decorator_list", [])
        if any("command" in ast.unparse(decorator) for decorator in decorators):
            continue
        for statement in node.body:
            if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
                yield statement.value


def _text(node: ast.AST) -> str | None:
    """Return the text of a string expression with {} for its values, None for other nodes."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else None
    if isinstance(node, ast.JoinedStr):
        parts = [
            str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values
        ]
        return "".join(parts)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        left = _text(node.left)
        right = _text(node.right)
        if left is None and right is None:
            return None
        return (left or "{}") + (right or "{}")
    return None


def _name(function: ast.expr) -> str:
    if isinstance(function, ast.Attribute):
        return function.attr
    return function.id if isinstance(function, ast.Name) else ""


def main() -> None:
    paths = sorted((ROOT / "lidarspec").rglob("*.py"))
    paths += sorted((ROOT / "plugins").glob("*/lidarspec_*/**/*.py"))
    for path in paths:
        texts = list(iter_texts(ast.parse(path.read_text(encoding="utf-8"))))
        if not texts:
            continue
        print(f"\n## {path.relative_to(ROOT).as_posix()}")
        for line, call, text in texts:
            print(f"{line:5} {call:16} {text}")


if __name__ == "__main__":
    main()
