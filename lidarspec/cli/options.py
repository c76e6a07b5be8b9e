"""Options that several verbs share, and the types of their values."""

from __future__ import annotations

import functools
import math
import tomllib
from collections.abc import Callable, Sequence
from datetime import datetime
from typing import Any, TypeVar

import click

from lidarspec.errors import UsageError
from lidarspec.plugins import sensor
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.fields import factor, parse_duration, parse_share, split_unit

Function = TypeVar("Function", bound=Callable[..., Any])


def sensor_option(function: Function) -> Function:
    """Add ``-s/--sensor`` and the options that configure the sensor."""
    return _add_sensor_option(configuration_options(function))  # type: ignore[return-value]


def configuration_options(function: Function) -> Function:
    """Add ``-O`` and ``--calibration``, which configure the sensor.

    The argument `sensor_id` of the verb is the configured `Sensor`, or only the id of the sensor if
    none of these options is given.
    """

    @functools.wraps(function)
    def call_with_sensor(
        *args: Any,
        sensor_id: str | None,
        options: Sequence[str],
        calibration: str | None,
        **others: Any,
    ) -> Any:
        return function(
            *args, sensor_id=configure_sensor(sensor_id, options, calibration), **others
        )

    return _add_configuration_options(call_with_sensor)  # type: ignore[return-value]


def sensor_words(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of `sensor_option`, without configuring the sensor.

    The verb gets the arguments `sensor_id`, `options` and `calibration`, as texts.
    """
    return _add_sensor_option(_add_configuration_options(function))


def _add_sensor_option(function: Callable[..., Any]) -> Callable[..., Any]:
    help_text = "Id or alias of the sensor, or a file ./mysensor.py."
    return click.option("-s", "--sensor", "sensor_id", metavar="ID", help=help_text)(function)


def _add_configuration_options(function: Callable[..., Any]) -> Callable[..., Any]:
    unit = click.option(
        "--calibration",
        metavar="FILE",
        help="Calibration file of the device; short for -O calibration=FILE.",
    )(function)
    help_text = "Set an option of the sensor, such as calibration=FILE; can be repeated."
    return click.option(
        "-O", "--option", "options", metavar="NAME=VALUE", multiple=True, help=help_text
    )(unit)


def configure_sensor(
    sensor_id: str | None, options: Sequence[str], calibration: str | None
) -> str | Sensor | None:
    """Return the id of a sensor, or the configured sensor if options are given.

    Args:
        sensor_id: the id of the sensor; None if it is not given.
        options: texts "NAME=VALUE".
        calibration: the name of a calibration file; None for no file.

    Raises:
        UsageError: for options without a sensor, an option without a value, or an option that the
            sensor does not have.
    """
    options = [*options, *(() if calibration is None else (f"calibration={calibration}",))]
    if not options:
        return sensor_id
    if sensor_id is None:
        raise UsageError(f"-O {options[0].partition('=')[0]} requires a sensor: name it with -s")
    texts = dict(option.partition("=")[::2] for option in options)
    if unset := [option for option in options if "=" not in option]:
        raise UsageError(f"-O {unset[0]}: expected NAME=VALUE")
    named: Sensor = sensor(sensor_id)
    configured: Sensor = named.configure(
        **{name: _parse_value(named, name, text) for name, text in texts.items()}
    )
    return configured


def _parse_value(sensor: Sensor, name: str, text: str) -> Any:
    """Return the value of an option given as text."""
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text
    if sensor.configure.accepts_value(name, value):
        return value
    return text


def count_option(what: str, **more: Any) -> Callable[[Function], Function]:
    """Add ``-n/--count``: the verb ends after this number of items."""
    return click.option(
        "-n",
        "--count",
        type=click.IntRange(min=1),
        metavar="N",
        help=f"Stop after this many {what}.",
        **more,
    )


def colour_option(function: Function) -> Function:
    """Add ``--colour``, also spelled ``--color``, for pictures."""
    help_text = "Colour the points by range, intensity, or a further column of the points."
    return click.option(
        "--colour",
        "--color",
        "ramp",
        metavar="COLUMN",
        default="range",
        show_default=True,
        help=help_text,
    )(function)


class NumberType(click.ParamType):  # type: ignore[type-arg]  # older versions of click have no types
    """The type of an option whose value is one or two numbers in a special syntax.

    Args:
        name: the name of the type, for help pages.
        parse: converts a text to a number; raises ValueError or UsageError for an invalid text.
        form: a description of the expected syntax, for error messages.
    """

    def __init__(self, name: str, parse: Callable[[str], Any], form: str) -> None:
        self.name = name
        self._parse = parse
        self._form = form

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the number, or fail with a message."""
        if not isinstance(value, str):
            return value
        try:
            return self._parse(value)
        except (ValueError, UsageError):
            self.fail(f"expected {self._form}, got {value!r}", param, ctx)


def _parse_duration(text: str) -> float:
    seconds = parse_duration(text)
    if seconds <= 0:
        raise ValueError(text)
    return seconds


def _parse_share(text: str) -> float:
    if not 0 <= (number := parse_share(text)) <= 1:
        raise ValueError(text)
    return number


def _parse_bytes(text: str) -> float:
    digits = text.upper().removesuffix("B")
    number = float(digits.rstrip("KMG")) * {"K": 1e3, "M": 1e6, "G": 1e9}.get(digits[-1:], 1)
    if not 1e6 <= number < math.inf:
        raise ValueError(text)
    return number


def _parse_offset(text: str) -> int:
    offset = int(text, 0)
    if offset < 0:
        raise ValueError(text)
    return offset


def _parse_speed(text: str) -> float:
    if text == "max":
        speed = 0.0
    else:
        speed = float(text.removesuffix("x"))
    if text != "max" and not 0 < speed < math.inf:
        raise ValueError(text)
    return speed


def _parse_pair(text: str, parse: Callable[[str], Any]) -> tuple[Any, Any]:
    """Return the values before and after a colon; None for an empty side."""
    for index in (index for index, mark in enumerate(text) if mark == ":"):
        try:
            low, high = (
                parse(part) if part else None for part in (text[:index], text[index + 1 :])
            )
        except (ValueError, UsageError):
            continue
        if (low, high) != (None, None) and (None in (low, high) or type(low) is type(high)):
            return low, high
    raise ValueError(text)


def _parse_moment(text: str) -> float | datetime:
    try:
        return parse_duration(text)
    except UsageError:
        return datetime.fromisoformat(text)


def _parse_index(text: str) -> int:
    return int(text)  # `Selection` raises an error with the reason for negative numbers


def _parse_indices(text: str) -> tuple[int, int | None]:
    low, high = _parse_pair(text, _parse_index)
    return low or 0, high


def _parse_metres(text: str) -> float:
    number, unit = split_unit(text)
    scale = factor(unit or "m", "m")
    if scale is None or not 0 <= float(number) < math.inf:
        raise ValueError(text)
    return float(number) * float(scale)


def _parse_distances(text: str) -> tuple[float, float]:
    low, high = _parse_pair(text, _parse_metres)
    return low or 0.0, math.inf if high is None else high


#: Seconds, from a text such as "10s", "500ms", "2min", "1h" or "10".
DURATION = NumberType(
    "duration", _parse_duration, "a duration above 0, such as 10s, 500ms, 2min or 1h"
)
#: A number from 0 to 1, from "1%" or "0.01".
SHARE = NumberType("share", _parse_share, "a share, such as 1% or 0.01")
#: An offset in bytes, from "940" or "0x3ac".
OFFSET = NumberType("offset", _parse_offset, "the offset of a byte, such as 940 or 0x3ac")
#: A number of bytes, from "256MB" or "1GB".
BYTES = NumberType("size", _parse_bytes, "a size of at least 1MB, such as 256MB or 1GB")
#: A factor above 0; 0 for "max".
SPEED = NumberType("speed", _parse_speed, "a speed, such as 1, 0.5, 10 or max")
#: A start and an end, in seconds or as dates, from "10s:20s", ":1min" or "2026-11-23T05:02:00Z:".
SLICE = NumberType(
    "slice",
    lambda text: _parse_pair(text, _parse_moment),
    "a slice of time, such as '10s:20s', '10s:', ':1min' or '2026-11-23T05:02:00Z:'",
)
#: A first and a last index, from "5:10".
INDICES = NumberType(
    "indices", _parse_indices, "a slice of whole numbers, such as '5:10', '5:' or ':10'"
)
#: A minimum and a maximum range in metres, from "0.5m:30m".
DISTANCES = NumberType(
    "distances", _parse_distances, "a span of distances, such as '0.5m:30m', '50cm:' or ':30'"
)

#: Argument of `Selection` -> the option that sets it.
SELECTING: dict[str, Callable[[Any], Any]] = {
    "times": click.option(
        "--slice",
        "times",
        type=SLICE,
        metavar="FROM:TO",
        help="Select scans by the time since the first scan, such as 10s:20s, or by date.",
    ),
    "scans": click.option(
        "--scans",
        "scans",
        type=INDICES,
        metavar="FROM:TO",
        help="Select scans by number: 5:10 is scans 5 to 9; the first scan is 0.",
    ),
    "every": click.option(
        "--every", type=click.IntRange(min=1), metavar="N", help="Keep every Nth selected scan."
    ),
    "ranges": click.option(
        "--range",
        "ranges",
        type=DISTANCES,
        metavar="NEAR:FAR",
        help="Drop returns outside this range, such as 0.5m:30m.",
    ),
    "returns": click.option(
        "--returns",
        type=click.Choice(["first", "last", "strongest", "all"]),
        metavar="WHICH",
        help="Keep one return of each firing: first, last or strongest.  [default: all]",
    ),
    "columns": click.option(
        "--columns",
        metavar="NAME,...",
        help="Names of the columns to write, in this order, such as x,y,z,intensity.",
    ),
    "time": click.option(
        "--time",
        type=click.Choice(["sensor", "utc", "host"]),
        help="Clock for the stamps and for --slice; utc: the sensor's clock converted to UTC, host:"
        " arrival times.  [default: sensor]",
    ),
    "beams": click.option(
        "--beams",
        type=click.IntRange(min=1),
        metavar="N",
        help="Number of ranges in each LaserScan message.",
    ),
    "frame_id": click.option(
        "--frame-id", metavar="NAME", help="frame_id of the ROS messages.  [default: laser]"
    ),
}


def selection_options(*names: str) -> Callable[[Function], Function]:
    """Add options that select scans, and pass a `Selection` to the verb.

    Args:
        names: the arguments of `Selection` for which options are added; keys of `SELECTING`.
    """

    def options(function: Function) -> Function:
        @functools.wraps(function)
        def call_with_selection(*args: Any, **others: Any) -> Any:
            from lidarspec.scans.selection import Selection

            given = {name: value for name in names if (value := others.pop(name)) is not None}
            if "columns" in given:
                given["columns"] = _parse_columns(given["columns"])
            return function(*args, selection=Selection(**given), **others)

        return functools.reduce(
            lambda decorated, name: SELECTING[name](decorated), reversed(names), call_with_selection
        )  # type: ignore[return-value]

    return options


def _parse_columns(text: str) -> tuple[str, ...]:
    names = [name.strip() for name in text.split(",")]
    if not all(names) or len(set(names)) < len(names):
        raise UsageError(f"--columns: expected different names, such as x,y,z, got {text!r}")
    return tuple(names)


def points_option(function: Function) -> Function:
    """Add ``--all`` and ``--valid``."""
    help_text = "All points, or only points with a valid return.  [default: --valid]"
    return click.option("--all/--valid", "every_point", default=False, help=help_text)(function)
