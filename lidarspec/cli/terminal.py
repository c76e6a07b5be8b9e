"""Print to standard output and standard error.

Addresses, file names and texts from devices and plugins are not trusted. Characters in these texts
that control a terminal are escaped. An error is raised if data cannot be printed. A verb continues
if a remark cannot be printed, so that a recording is not lost.
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

from lidarspec.errors import SourceError, escape_controls


class Verbosity:
    """How many remarks are printed on standard error.

    Attributes:
        loudness: -1 to print no remarks, 0 to print the usual remarks, 1 to print more remarks.
    """

    loudness = 0


verbosity = Verbosity()
#: Matches an escape sequence that changes only colours.
_COLOURS = re.compile(r"(\x1b\[[0-9;]*m)")


def say(content: str | bytes, *, nl: bool = True, colour: bool | None = None) -> None:
    """Print data on standard output.

    Args:
        content: bytes, which are written unchanged, or a text. Characters of the text that control
            a terminal are escaped.
        nl: whether to end the output with a line break.
        colour: whether to print the colours of a coloured text; None for a text without colours.

    Raises:
        BrokenPipeError: if the reader has closed the pipe.
        SourceError: if the data cannot be written for another reason.
    """
    if isinstance(content, str):
        if colour is None:
            content = escape_controls(content)
        else:
            content = "".join(map(_escape_part, _COLOURS.split(content)))
    with _translate_write_errors():
        click.echo(content, nl=nl, color=colour)


def note(text: str) -> None:
    """Print a remark on standard error, unless remarks are switched off."""
    if verbosity.loudness < 0:
        return
    try:
        click.echo(escape_controls(text), err=True)
    except (OSError, ValueError):
        _discard_stream(sys.stderr)


@contextlib.contextmanager
def prepare_streams() -> Iterator[None]:
    """Make the standard streams usable, and flush output when the context ends.

    Closed streams are replaced, characters that cannot be encoded are printed as "?", and warnings
    are printed as remarks.

    Raises:
        BrokenPipeError: if the reader has closed the pipe.
        SourceError: if output cannot be written for another reason.
    """
    verbosity.loudness = 0
    for name, flags in (("stdin", os.O_RDONLY), ("stdout", os.O_RDONLY), ("stderr", os.O_WRONLY)):
        if getattr(sys, name) is None:
            # Otherwise a file that is opened later would get the descriptor of the closed stream,
            # and printed text would be written to this file. Output to a closed stream fails.
            descriptor = os.open(os.devnull, flags)
            mode = "r" if name == "stdin" else "w"
            setattr(sys, name, open(descriptor, mode, closefd=False))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(AttributeError):
            stream.reconfigure(errors="replace")  # type: ignore[union-attr]
    reported: set[str] = set()
    with warnings.catch_warnings():
        shown = warnings.showwarning

        def tell(message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
            if category is not UserWarning:
                shown(message, category, *rest, **more)
            elif str(message) not in reported:
                reported.add(str(message))
                note(str(message))

        warnings.showwarning = tell
        warnings.simplefilter("always", UserWarning)
        yield
    with _translate_write_errors():
        sys.stdout.flush()


def discard_output() -> None:
    """Discard buffered output, so that a closed pipe causes no error at exit."""
    _discard_stream(sys.stdout)


def _escape_part(part: str) -> str:
    if _COLOURS.fullmatch(part):
        return part
    return escape_controls(part)


@contextlib.contextmanager
def _translate_write_errors() -> Iterator[None]:
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        discard_output()
        raise SourceError(f"standard output: {error.strerror or error}") from None


def _discard_stream(stream: Any) -> None:
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


@contextlib.contextmanager
def handle_sigterm() -> Iterator[None]:
    """Handle SIGTERM like Ctrl-C in this context, so that a verb cleans up."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
