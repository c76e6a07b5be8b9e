"""Install the libraries that lidarspec is compared with, and find them again.

    python benchmarks/environments.py

The extra `bench` of pyproject.toml goes into the environment that runs this. Each library of
`SEPARATE` goes into an environment of its own, because it pins other versions of libraries that
lidarspec's extras need. If the requirements of an environment cannot be installed together, each
is installed by itself; the table of the benchmarks names those that failed, with the reason.
"""

from __future__ import annotations

import functools
import importlib.metadata
import json
import re
import shutil
import subprocess
import sys
import tomllib
import venv
from collections.abc import Sequence
from pathlib import Path

PYPROJECT = Path(__file__).parents[1] / "pyproject.toml"
#: libraries with an environment of their own: the requirement by the name of the distribution.
SEPARATE = {"ouster-sdk": "ouster-sdk>=1.0"}  # pins rosbags 0.9; the extra `ros` needs 0.11
FAILURES = Path(sys.prefix) / "bench-failures.json"
MAX_REASON_CHARACTERS = 120
NOT_INSTALLED = "not installed"


def install_all() -> dict[str, str]:
    """Install everything; return the reason for each requirement that failed, by its name."""
    project = tomllib.loads(PYPROJECT.read_text(encoding="utf-8"))["project"]
    failures = install(Path(sys.executable), project["optional-dependencies"]["bench"])
    for name, requirement in SEPARATE.items():
        python = separate_python(name)
        venv.create(python.parents[1], symlinks=True, with_pip=shutil.which("uv") is None)
        failures |= install(python, [requirement])
    return failures


def install(python: Path, requirements: Sequence[str]) -> dict[str, str]:
    """Install requirements into an environment, together if possible.

    Returns:
        The reason for each failed requirement, by its name without versions: "lds2d",
        "lidarspec[jit]".
    """
    reason = run_installer(python, requirements)
    if not reason:
        return {}
    if len(requirements) == 1:
        return {requirement_name(requirements[0]): reason}
    reasons = {requirement_name(one): run_installer(python, [one]) for one in requirements}
    return {name: reason for name, reason in reasons.items() if reason}


def run_installer(python: Path, requirements: Sequence[str]) -> str:
    """Run uv, if it is on PATH, or else pip; return why it failed, "" if it did not."""
    if uv := shutil.which("uv"):
        command = [uv, "pip", "install", "--python", str(python)]
    else:
        command = [str(python), "-m", "pip", "--disable-pip-version-check", "install"]
    done = subprocess.run(
        [*command, "--quiet", *requirements], stderr=subprocess.PIPE, text=True, check=False
    )
    return find_reason(done.stderr) if done.returncode else ""


def find_reason(stderr: str) -> str:
    """Return what pip or uv name as the cause of a failure, in one short line."""
    errors = re.findall(r"^(?:ERROR: |error: |.*╰─▶ )(.+(?:\n {6}.+)*)", stderr, re.MULTILINE)
    text = " ".join((errors or stderr.splitlines()[-1:] or ["no message"])[0].split())
    if len(text) > MAX_REASON_CHARACTERS:
        text = text[: MAX_REASON_CHARACTERS - 3] + "..."
    return text


def requirement_name(requirement: str) -> str:
    """Return the name and extras of a requirement, without versions and markers."""
    found = re.match(r"[\w.-]+(?:\[[^]]*\])?", requirement)
    assert found is not None
    return found[0]


def separate_python(name: str) -> Path:
    """Return the interpreter of a library's own environment, whether it exists or not."""
    return Path(sys.prefix) / "separate" / name / "bin" / "python"


@functools.cache
def read_failures() -> dict[str, str]:
    """Return the reasons that `install_all` found in this environment; {} if it never ran here."""
    if not FAILURES.is_file():
        return {}
    failures: dict[str, str] = json.loads(FAILURES.read_text(encoding="utf-8"))
    return failures


def find_version(name: str) -> str:
    """Return the version of a distribution, in its own environment if it has one.

    If there is none: "not installed", with the reason if it is known.
    """
    python = separate_python(name)
    code = f"import importlib.metadata; print(importlib.metadata.version({name!r}))"
    if python.is_file():
        done = subprocess.run([python, "-c", code], capture_output=True, text=True, check=False)
        if done.returncode == 0:
            return done.stdout.strip()
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        reason = read_failures().get(name)
        return f"{NOT_INSTALLED} ({reason})" if reason else NOT_INSTALLED


def main() -> None:
    failures = install_all()
    for name, reason in failures.items():
        print(f"{name}: {NOT_INSTALLED}: {reason}", file=sys.stderr)
    FAILURES.write_text(json.dumps(failures, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
