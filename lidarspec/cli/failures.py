"""Report a failure as one message on standard error, and an exit code.

A traceback is printed only with --verbose or LIDARSPEC_DEBUG.
"""

from __future__ import annotations

import os
import shlex
import traceback

import click

from lidarspec import errors
from lidarspec.cli.terminal import note, verbosity
from lidarspec.known_sensors import no_sensors_text

FINDINGS = 1
USAGE = 2
SOURCE = 3
NO_DATA = 4
DEVICE = 5
INTERRUPTED = 130

#: (error class, exit code, next command). The first entry whose class matches an error is used.
#: "{sensor}" and "{verb}" are replaced.
CODES: tuple[tuple[type[Exception] | tuple[type[Exception], ...], int, str], ...] = (
    (errors.UnknownSensor, USAGE, "lidarspec sensors"),
    (
        (errors.UnknownFrame, errors.UnknownField, errors.MissingField, errors.OutOfRange),
        USAGE,
        "lidarspec show {sensor}",
    ),
    ((errors.UsageError, click.ClickException), USAGE, "lidarspec {verb} --help"),
    (errors.CommandError, DEVICE, "lidarspec show {sensor}"),
    ((errors.SourceError, OSError), SOURCE, "lidarspec {verb} --help"),
    (errors.WireError, NO_DATA, "lidarspec show {sensor}"),
    (errors.SpecError, FINDINGS, "lidarspec check {sensor}"),
    (errors.LidarSpecError, FINDINGS, "lidarspec plugins"),
)


def report(error: Exception, verb: str) -> int:
    """Print an error and the next command, and return the exit code."""
    code, command = next(
        ((code, command) for kind, code, command in CODES if isinstance(error, kind)),
        (FINDINGS, ""),
    )
    is_detailed = verbosity.loudness > 0 or (
        not command and bool(os.environ.get("LIDARSPEC_DEBUG"))
    )
    verbosity.loudness = 0
    if is_detailed:
        note("".join(traceback.format_exception(error)))
    if not command:
        note(f"this is a bug in lidarspec: {type(error).__name__}: {error}")
        note("  next: repeat with LIDARSPEC_DEBUG=1, and report the output")
        return code
    message = _format_message(error)
    note(message)
    if _lacks_sensors(error):
        note(f"  {no_sensors_text()}")
        return code
    if not errors.suggestion(error):
        errors.suggest(error, _find_next_command(error, command, verb))
    for remark in error.__notes__:
        note(f"  {remark}")
    return code


def _lacks_sensors(error: Exception) -> bool:
    """Return whether the cause of an error is that no sensor is installed."""
    suggestion = errors.suggestion(error)
    named = (
        str(getattr(error, "sensor", ""))
        or " -s " in suggestion
        or suggestion.startswith("pip install")
    )
    if named or not isinstance(error, errors.WireError | errors.CommandError):
        return False
    from lidarspec.plugins import sensors

    return not sensors()


def _format_message(error: Exception) -> str:
    if isinstance(error, click.ClickException):
        return error.format_message()
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {errors.failure_reason(error.filename, error)}"
    if isinstance(error, errors.WireError) and error.data:
        from lidarspec.explaining.formatting import hexdump

        return f"{error}\n{hexdump(error)}"
    return str(error)


def _find_next_command(error: Exception, command: str, verb: str) -> str:
    """Return the command to suggest after an error."""
    from lidarspec.plugins import registry

    if isinstance(error, errors.UnknownSensor):
        if any(plugin.error for plugin in registry().plugins):
            return "lidarspec plugins"
        return command
    sensor = str(getattr(error, "sensor", "") or getattr(error, "place", "")).partition(" ")[0]
    if isinstance(error, errors.SpecError) and error.path.endswith(".py"):
        return f"lidarspec check {shlex.quote(error.path)}"
    # The user named the file of the plugin.
    if isinstance(error, errors.PluginError) and error.file and sensor not in registry():
        return f"lidarspec check {shlex.quote(errors.format_path(error.file))}"
    if "{sensor}" in command and not sensor:
        if isinstance(error, errors.SpecError):
            return "lidarspec plugins"
        return "lidarspec sensors"
    return command.format(sensor=shlex.quote(sensor) if sensor else "", verb=verb).replace(
        "  ", " "
    )
