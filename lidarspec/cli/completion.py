"""Completion of the command line in bash, zsh and fish.

This module extends the completion of click. `BY_NAME` has the functions that return the possible
values of a parameter.
"""

from __future__ import annotations

import functools
import glob
import os
import warnings
from collections.abc import Callable, Iterable

import click
from click.shell_completion import (
    BashComplete,
    CompletionItem,
    add_completion_class,
    shell_complete,
)

from lidarspec.detect.identification import find_declared_sensor
from lidarspec.device.named_devices import find_device, read_devices
from lidarspec.errors import LidarSpecError
from lidarspec.frames.schema import make_schema
from lidarspec.plugins import registry, sensor as named_sensor
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.tree import FieldInfo
from lidarspec.transports.ports import list_serial_ports

#: The environment variable with the request of the shell.
VARIABLE = "_LIDARSPEC_COMPLETE"
#: The characters at which bash splits words.
WORD_BREAKS = ":="


@add_completion_class
class BashCompletion(BashComplete):
    """click's completion for bash, with support for words that contain ``:`` or ``=``."""

    source_template = BashComplete.source_template.replace(
        "COMPREPLY+=($value)",
        "COMPREPLY+=($value)\n            [[ $value == *[=:/] ]] && compopt -o nospace",
    )
    _bash_prefix = ""  # the part of the current word that bash treats as separate words

    def get_completion_args(self) -> tuple[list[str], str]:
        """Return the words before the cursor, and the word at the cursor."""
        args, incomplete = super().get_completion_args()
        words: list[str] = []
        for word in (*args, incomplete):
            if words and word and (word[0] in WORD_BREAKS or words[-1][-1:] in WORD_BREAKS):
                words[-1] += word
            elif word or not words or words[-1][-1:] not in WORD_BREAKS:
                words.append(word)
        *args, incomplete = words
        self._bash_prefix = incomplete[: max(incomplete.rfind(mark) for mark in WORD_BREAKS) + 1]
        return args, incomplete

    def format_completion(self, item: CompletionItem) -> str:
        """Return the part of a completion that bash inserts."""
        return f"{item.type},{item.value.removeprefix(self._bash_prefix)}"


def complete(group: click.Command, instruction: str) -> int:
    """Print the completions that a shell requests, and return the exit code."""
    try:
        with warnings.catch_warnings(action="ignore"):  # the verb itself prints the warnings
            return shell_complete(group, {}, "lidarspec", VARIABLE, instruction)
    except LidarSpecError:  # faulty settings or plugins, which the verb itself reports
        return 1


def attach(command: click.Command) -> None:
    """Add completion to the parameters of a verb, if `BY_NAME` has their names."""
    for param in command.params:
        list_names = BY_NAME.get(param.name or "")
        if list_names is not None and isinstance(param.type, click.types.StringParamType):
            param.shell_complete = functools.partial(  # type: ignore[method-assign]
                _complete_word, list_names
            )


def _complete_word(
    list_names: Callable[[click.Context, str], Iterable[str]], ctx: click.Context, incomplete: str
) -> list[CompletionItem]:
    """Return the possible values that begin with a word, or a request for file names."""
    items = [
        CompletionItem(name)
        for name in list_names(ctx, incomplete)
        if name.startswith(incomplete) and name != incomplete
    ]
    if items or list_names in WITHOUT_FILES:
        return items
    return [CompletionItem(incomplete, type="file")]


def _complete_sensors(ctx: click.Context, incomplete: str) -> Iterable[str]:
    return registry().names()


def _complete_sources(ctx: click.Context, incomplete: str) -> Iterable[str]:
    """Return devices, ports, simulated sensors, and files that begin with `incomplete`.

    If only files begin with `incomplete`, returns an empty list, and the shell completes the names.
    """
    if incomplete.startswith("sim:"):
        simulated = [f"sim:{name}" for name in registry().names()]
    else:
        simulated = ["sim:"]
    sources = [
        *read_devices(),
        *(port.path for port in list_serial_ports()),
        "udp://",
        "tcp://",
        *simulated,
    ]
    if not any(source.startswith(incomplete) for source in sources):
        return []
    paths = sorted(glob.glob(glob.escape(incomplete) + "*"))
    return [*sources, *(f"{path}/" if os.path.isdir(path) else path for path in paths)]


def _find_sensor(ctx: click.Context) -> Sensor | None:
    """Return the sensor of an incomplete command; None if the command names none."""
    if ctx.params.get("sensor_id"):
        return named_sensor(ctx.params["sensor_id"])
    source = ctx.params.get("source") or ""
    device = find_device(source)
    if device:
        return device.configure()
    return find_declared_sensor(source)


def _complete_frames(ctx: click.Context, incomplete: str) -> Iterable[str]:
    sensor = _find_sensor(ctx)
    if sensor:
        return sensor.frames
    return ()


def _complete_commands(ctx: click.Context, incomplete: str) -> Iterable[str]:
    sensor = _find_sensor(ctx)
    if sensor:
        return sensor.commands
    return ()


def _complete_assignments(ctx: click.Context, incomplete: str) -> Iterable[str]:
    """Return the fields of a frame or the arguments of a command, followed by "="."""
    sensor = _find_sensor(ctx)
    frame = ctx.params.get("frame") or ""
    command = ctx.params.get("command") or ""
    if sensor and frame in sensor.frames:
        fields = make_schema(sensor.frames[frame].tree).all_fields
        return [
            f"{_format_path(path, info)}=" for path, info in fields.items() if info.const is None
        ]
    if sensor and command in sensor.commands:
        return [f"{argument}=" for argument in sensor.commands[command].args]
    return ()


def _format_path(path: str, info: FieldInfo) -> str:
    """Return the path of a field for all elements of its arrays: "points[*].distance"."""
    *outer, last = path.split(".")
    steps = [*(f"{step}[*]" if step in info.axes else step for step in outer), last]
    return ".".join(steps) + ("[*]" if last in info.axes and info.kind != "bytes" else "")


def _complete_columns(ctx: click.Context, incomplete: str) -> Iterable[str]:
    """Return the columns that every sensor has."""
    return ("range", "intensity")


def _complete_formats(ctx: click.Context, incomplete: str) -> Iterable[str]:
    from lidarspec.formats import formats  # imports NumPy

    return [suffix.removeprefix(".") for suffix in formats()]


def _complete_files(ctx: click.Context, incomplete: str) -> Iterable[str]:
    return ()


def _complete_verbs(ctx: click.Context, incomplete: str) -> Iterable[str]:
    root = ctx.find_root().command
    if isinstance(root, click.Group):
        return root.list_commands(ctx)
    return ()


def _complete_sensors_and_distributions(ctx: click.Context, incomplete: str) -> Iterable[str]:
    return [*registry().names(), *sorted({plugin.distribution for plugin in registry().plugins})]


#: The functions for parameters that do not accept files.
WITHOUT_FILES = (
    _complete_frames,
    _complete_commands,
    _complete_assignments,
    _complete_verbs,
    _complete_columns,
    _complete_formats,
)
#: name of a parameter -> function that returns its possible values.
BY_NAME: dict[str, Callable[[click.Context, str], Iterable[str]]] = {
    "sensor_id": _complete_sensors,
    "source": _complete_sources,
    "sources": _complete_sources,
    "frame": _complete_frames,
    "command": _complete_commands,
    "assignments": _complete_assignments,
    "name": _complete_sensors_and_distributions,
    "verb": _complete_verbs,
    "ramp": _complete_columns,
    "suffix": _complete_formats,
    **dict.fromkeys(
        (
            "file",
            "files",
            "words",
            "target",
            "output",
            "scene",
            "vectors",
            "capture",
            "into",
            "diff",
            "link",
            "place",
            "to",
            "folder",
        ),
        _complete_files,
    ),
}
