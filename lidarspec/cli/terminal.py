"""Standard output and standard error: all that verbs print goes through here, whatever it is made
of and whether or not anybody reads it.

Addresses, file names and texts of devices and plugins are others': what would steer a terminal is
spelled out. Remarks that nobody can read end no verb, a recording least of all; data that cannot be
written are a failure.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import sys
import warnings
from collections.abc import Iterator
from typing import Any

import click

from lidarspec.errors import SourceError, printable


class Voice:
    """How much is said beside the data.

    Attributes:
        loudness: -1 nothing, 1 more than by default; each command begins with 0.
    """

    loudness = 0


voice = Voice()
#: what a line changes about colours, and nothing else.
_COLOURS = re.compile(r"(\x1b\[[0-9;]*m)")


def say(content: str | bytes, *, nl: bool = True, colour: bool | None = None) -> None:
    """Print data on standard output; bytes as they are.

    Args:
        colour: whether colours in the text stay in a pipe; None: it has none of ours.

    Raises:
        BrokenPipeError: where nobody reads any more.
        SourceError: where it cannot be written otherwise.
    """
    if isinstance(content, str):
        if colour is None:
            content = printable(content)
        else:
            content = "".join(map(_escape_part, _COLOURS.split(content)))
    with _translate_write_errors():
        click.echo(content, nl=nl, color=colour)


def note(text: str) -> None:
    """Print a remark beside the data on standard error, if anybody reads there and wants to."""
    if voice.loudness < 0:
        return
    try:
        click.echo(printable(text), err=True)
    except (OSError, ValueError):
        _lose(sys.stderr)


@contextlib.contextmanager
def streams() -> Iterator[None]:
    """What a verb needs around it: all three streams, also closed ones; warnings as remarks, once
    each; everything printed.

    Raises:
        BrokenPipeError, SourceError: as `say`.
    """
    voice.loudness = 0
    for name, flags in (("stdin", os.O_RDONLY), ("stdout", os.O_RDONLY), ("stderr", os.O_WRONLY)):
        if getattr(sys, name) is None:
            # A file opened later would take its number and what is printed; output that was closed
            # is refused.
            descriptor = os.open(os.devnull, flags)
            mode = "r" if name == "stdin" else "w"
            setattr(sys, name, open(descriptor, mode, closefd=False))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(AttributeError):
            stream.reconfigure(errors="replace")  # type: ignore[union-attr]
    told: set[str] = set()
    with warnings.catch_warnings():
        shown = warnings.showwarning

        def tell(message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
            if category is not UserWarning:
                shown(message, category, *rest, **more)
            elif str(message) not in told:
                told.add(str(message))
                note(str(message))

        warnings.showwarning = tell
        warnings.simplefilter("always", UserWarning)
        yield
    with _translate_write_errors():
        sys.stdout.flush()


def silence() -> None:
    """Nobody reads any more: what is still buffered goes nowhere, without a complaint at exit."""
    _lose(sys.stdout)


def _escape_part(part: str) -> str:
    if _COLOURS.fullmatch(part):
        return part
    return printable(part)


@contextlib.contextmanager
def _translate_write_errors() -> Iterator[None]:
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        silence()
        raise SourceError(f"standard output: {error.strerror or error}") from None


def _lose(stream: Any) -> None:
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


@contextlib.contextmanager
def ended_by_terminate() -> Iterator[None]:
    """SIGTERM ends it as Ctrl-C does, so that a link does not stay behind."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
