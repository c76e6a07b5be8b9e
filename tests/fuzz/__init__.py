"""Hostile input by the million, for everything that reads what others wrote: `make fuzz`.

`targets` says what is read, from which valid examples the inputs are made, and which exceptions are
documented; `trial` reads one input within its limits of time and memory; `campaign` makes the
inputs of one target and keeps those that reach new lines; `python -m tests.fuzz` spreads a number
of inputs over all targets, a process each, goes on where it stopped, and says what it found.
"""

from __future__ import annotations


def slug(name: str) -> str:
    """A target's name as that of a file."""
    return name.replace(" ", ".")
