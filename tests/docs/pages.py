"""Run the examples of a documentation page and compare their output.

A block with ``title="NAME"`` is the file of that name; a second block with the same name is
appended. A block with ``title="Output"`` is the output of the block before it, and ``...`` matches
anything. All other ``sh`` and ``python`` blocks run in the order of the page, all Python of a page
in one session. Blocks in other languages (``text``, ``console``) are not run. Python that imports a
missing library is skipped with its output, and the skip is reported.
"""

from __future__ import annotations

import ast
import contextlib
import doctest
import importlib
import io
import os
import re
import subprocess
import sys
import textwrap
import venv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parents[2] / "docs"
OUTPUT = "Output"
#: Separator between two blocks of a file.
SEPARATOR = "\n\n"
#: pip takes the build backend from what is installed, and needs no package index.
OFFLINE = {"PIP_NO_INDEX": "1", "PIP_NO_BUILD_ISOLATION": "0", "PIP_DISABLE_PIP_VERSION_CHECK": "1"}
_FENCE = re.compile(
    r"^( *)```(\w+)(?: title=\"([^\"]+)\")?\n(.*?)^\1```$", re.MULTILINE | re.DOTALL
)


@dataclass(frozen=True)
class Block:
    """A fenced block of a page; its title is "" if it has none."""

    language: str
    title: str
    text: str
    place: str
    line: int


def blocks(page: str) -> list[Block]:
    """Return the fenced blocks of a page under docs/, in order."""
    text = (DOCS / page).read_text(encoding="utf-8")
    return [
        Block(
            found[2],
            found[3] or "",
            textwrap.dedent(found[4]),
            page,
            text.count("\n", 0, found.start()) + 2,
        )
        for found in _FENCE.finditer(text)
    ]


def follow(
    page: str, place: Path, environment: Mapping[str, str] | None = None
) -> tuple[int, list[str]]:
    """Run the blocks of a page in an empty folder.

    Returns:
        The number of blocks that ran, and the reasons why others were skipped.

    Raises:
        AssertionError: if a block fails, or its output differs from the page.
    """
    session: dict[str, Any] = {"__name__": "__main__"}
    written: set[str] = set()
    printed: str | None = ""
    ran, left_out = 0, list[str]()
    for block in blocks(page):
        if block.title == OUTPUT:
            if printed is not None:
                assert_printed(block, printed)
        elif block.title:
            path = place / block.title
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("a" if block.title in written else "w", encoding="utf-8") as file:
                file.write(f"{SEPARATOR}{block.text}" if block.title in written else block.text)
            written.add(block.title)
        elif block.language == "sh":
            printed, ran = shell(block, place, environment), ran + 1
        elif block.language == "python" and (missing := lacking(block)):
            printed, left_out = (
                None,
                [*left_out, f"{', '.join(missing)} is not installed ({block.place}:{block.line})"],
            )
        elif block.language == "python":
            printed, ran = python(block, place, session), ran + 1
    return ran, left_out


def lacking(block: Block) -> list[str]:
    """Return the libraries that a Python block imports and that cannot be imported."""
    imports = [
        node
        for node in ast.walk(ast.parse(block.text))
        if isinstance(node, ast.Import | ast.ImportFrom)
    ]
    names = [
        name
        for node in imports
        for name in (
            [node.module or ""]
            if isinstance(node, ast.ImportFrom)
            else [one.name for one in node.names]
        )
    ]
    return [name for name in (name.partition(".")[0] for name in names) if not _loads(name)]


def _loads(name: str) -> bool:
    try:
        importlib.import_module(name)
    except ImportError:
        return False
    return True


def shell(block: Block, place: Path, environment: Mapping[str, str] | None = None) -> str:
    """Return the output of a shell block, including errors."""
    command = ["bash", "-euo", "pipefail", "-c", block.text]
    given = {**os.environ, **OFFLINE, "COLUMNS": "140", "NO_COLOR": "1", **(environment or {})}
    done = subprocess.run(
        command,
        check=False,
        cwd=place,
        env=given,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, (
        f"{block.place}:{block.line}: exit code {done.returncode}\n{done.stdout}"
    )
    return done.stdout


def python(block: Block, place: Path, session: dict[str, Any]) -> str:
    """Run a Python block in `session`, and return its output.

    An exception names the line of the page.
    """
    code = compile(
        "\n" * (block.line - 1) + block.text, str(DOCS / block.place), "exec", dont_inherit=True
    )
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.chdir(place):
        exec(code, session)
    return out.getvalue()


def assert_printed(block: Block, printed: str) -> None:
    """Compare an output with the page, without trailing blanks."""
    expected, got = (
        "".join(f"{line.rstrip()}\n" for line in text.splitlines())
        for text in (block.text, printed)
    )
    same = doctest.OutputChecker().check_output(expected, got, doctest.ELLIPSIS)
    assert same, f"{block.place}:{block.line}: the page says\n{expected}\nbut there comes\n{got}"


def clean_environment(place: Path) -> dict[str, str]:
    """Create a separate environment for installations; return its variables.

    It has access to the packages that are installed here.
    """
    venv.create(place, with_pip=False, symlinks=os.name != "nt")
    scripts = place / ("Scripts" if os.name == "nt" else "bin")
    inner = subprocess.run(
        [scripts / "python", "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout.strip()
    outer = [path for path in sys.path if path.endswith("site-packages")]
    Path(inner, "outer.pth").write_text(
        "".join(f"import site; site.addsitedir({path!r})\n" for path in outer), encoding="utf-8"
    )
    for name, module in (("pip", "pip"), ("pytest", "pytest"), ("lidarspec", "lidarspec")):
        script = scripts / name
        script.write_text(
            f'#!/bin/sh\nexec "{scripts / "python"}" -m {module} "$@"\n', encoding="utf-8"
        )
        script.chmod(0o755)
    return {"PATH": f"{scripts}{os.pathsep}{os.environ['PATH']}", "VIRTUAL_ENV": str(place)}
