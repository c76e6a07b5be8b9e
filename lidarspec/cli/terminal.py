"""Standard output and standard error of all verbs.

Addresses, file names and texts of devices and plugins are not trusted: characters that control a
terminal are escaped. A remark that cannot be written does not end a verb, because that would stop a
recording; data that cannot be written is an error.
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


class Verbosity:
    """The amount of remarks that are printed on standard error.

    Attributes:
        loudness: -1 for no remarks, 0 for the default, 1 for more remarks; each command begins
            with 0.
    """

    loudness = 0


voice = Verbosity()
#: Pattern of the escape sequences that only change colours.
_COLOURS = re.compile(r"(\x1b\[[0-9;]*m)")


def say(content: str | bytes, *, nl: bool = True, colour: bool | None = None) -> None:
    """Print data on standard output; bytes as they are.

    Args:
        colour: True keeps the colours of the text in a pipe; None if lidarspec has not coloured it.

    Raises:
        BrokenPipeError: if the reader has closed the pipe.
        SourceError: if it cannot be written for another reason.
    """
    if isinstance(content, str):
        if colour is None:
            content = printable(content)
        else:
            content = "".join(map(_escape_part, _COLOURS.split(content)))
    with _translate_write_errors():
        click.echo(content, nl=nl, color=colour)


def note(text: str) -> None:
    """Print a remark on standard error, unless remarks are off or it is closed."""
    if voice.loudness < 0:
        return
    try:
        click.echo(printable(text), err=True)
    except (OSError, ValueError):
        _discard_stream(sys.stderr)


@contextlib.contextmanager
def prepare_streams() -> Iterator[None]:
    """Prepare standard input, output and error for a verb, and flush them at its end.

    Closed streams are replaced. Each warning is printed once, as a remark.

    Raises:
        BrokenPipeError: if the reader has closed the pipe.
        SourceError: if output cannot be written for another reason.
    """
    voice.loudness = 0
    for name, flags in (("stdin", os.O_RDONLY), ("stdout", os.O_RDONLY), ("stderr", os.O_WRONLY)):
        if getattr(sys, name) is None:
            # Without this, a file that is opened later would get the descriptor of the closed
            # stream, and with it the printed text. Writing to a closed output is refused.
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
    return printable(part)


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
    """Handle SIGTERM like Ctrl-C, so that a symbolic link is removed."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
