"""The commands of a sensor as forms of the page."""

from __future__ import annotations

from typing import Any

from lidarspec import Sensor
from lidarspec.explaining.formatting import format_argument_type
from lidarspec.exports.reference import describe_effect
from lidarspec.frames.commands import find_argument_slot, has_only_names, list_choices
from lidarspec.spec.arguments import Range


def make_form(sensor: Sensor, name: str) -> dict[str, Any]:
    """Return the form of a command: its text, and its arguments with ranges and units."""
    command = sensor.commands[name]
    return {
        "name": name,
        "group": _find_group(sensor, name),
        "only_stopped": command.only_stopped,
        "text": describe_effect(sensor, name),
        "arguments": [_describe_argument(sensor, name, argument) for argument in command.args],
    }


def find_restart(sensor: Sensor) -> dict[str, str] | None:
    """Return the commands that stop the data and start it again.

    Returns None if the sensor lacks one of the two commands.
    """
    names = [*sensor.on_open, *sensor.commands]
    plain = [name for name in names if not sensor.commands[name].args]
    stop = next((name for name in plain if sensor.commands[name].stops), None)
    start = next((name for name in plain if sensor.commands[name].starts), None)
    if stop is None or start is None:
        return None
    return {"stop": stop, "start": start}


def _find_group(sensor: Sensor, name: str) -> str:
    """Return the group of a command: "switch", "ask" or "set"."""
    command = sensor.commands[name]
    if command.starts or command.stops:
        return "switch"
    if name.startswith("get_"):
        return "ask"
    return "set"


def _describe_argument(sensor: Sensor, name: str, argument: str) -> dict[str, Any]:
    """Return the description of the input field for an argument."""
    kind = sensor.commands[name].arguments[argument].kind
    info = find_argument_slot(sensor, name, argument).info
    field = {"name": argument, "unit": info.unit, "default": None}
    if not isinstance(kind, Range):
        text = ": ".join(filter(None, (info.docs, format_argument_type(kind))))
        return {**field, "text": text, "low": None, "high": None, "choices": []}
    names = list_choices(info, kind)
    choices = []
    if has_only_names(kind, names):
        choices = [{"value": f"{value:g}", "text": label} for label, value in names.items()]
    return {**field, "text": info.docs, "low": kind.low, "high": kind.high, "choices": choices}
