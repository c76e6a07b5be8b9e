"""Fuzz tests of everything that reads outside data: `make fuzz`.

`targets` lists the readers, the valid examples that inputs are derived from, and the documented
exceptions. `trial` reads one input within its limits of time and memory. `campaign` makes the
inputs of one target and keeps those that reach new lines. `python -m tests.fuzz` runs a number of
inputs on all targets, one process each, resumes an interrupted run, and reports its findings.
"""

from __future__ import annotations


def slug(name: str) -> str:
    """Return a target's name as a file name."""
    return name.replace(" ", ".")
