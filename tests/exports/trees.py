"""Sensors for the tests of exports, and parsed frames as trees to compare."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from typing import Any

from construct import EnumIntegerString

from lidarspec import Sensor
from lidarspec.framing.frame_engine import get_codec
from tests.exports import oddities
from tests.installed import distinct_sensors_in, sensor_modules
from tests.shapes import SHAPES

#: the invented sensors that have frames, by id.
SHAPED = {sensor.id: sensor for sensor in (*SHAPES.values(), oddities.SENSOR) if sensor.frames}
#: The reason of the refusal of a sensor that has only frames in a wire form.
RECODED = "this export does not support frames of text or of escaped bytes"
#: The installed sensors that other languages cannot read because of a struct, with the reason.
NULL_TERMINATED = dict.fromkeys(
    ("hokuyo-urg04lx", "hokuyo-utm30lx", "hokuyo-utm30lxew"),
    "bytes whose size depends on their content",
)


@functools.cache
def installed_sensors() -> dict[str, Sensor]:
    """Load one installed sensor for each set of frames, by id."""
    return {
        sensor.id: sensor for module in sensor_modules() for sensor in distinct_sensors_in(module)
    }


def distinct_sensors() -> dict[str, Sensor]:
    """Load one sensor for each set of frames, shapes and installed ones, by id."""
    return {**SHAPED, **installed_sensors()}


def distinct_frames(sensors: Iterable[Sensor]) -> list[tuple[Sensor, str]]:
    """Return each frame type of these sensors once, with the first sensor that has it."""
    frames: dict[int, tuple[Sensor, str]] = {}
    for sensor in sensors:
        for name, frame in sensor.frames.items():
            frames.setdefault(id(frame), (sensor, name))
    return list(frames.values())


def is_recoded(sensor: Sensor) -> bool:
    """Return whether a frame has a wire form, which other languages cannot read."""
    return any(frame.wire is not None for frame in sensor.frames.values())


def list_byte_frames(sensor: Sensor) -> list[str]:
    """Return the names of the frame types without a wire form."""
    return [name for name, frame in sensor.frames.items() if frame.wire is None]


def find_recoded(sensors: Iterable[Sensor]) -> dict[str, str]:
    """Return {id: reason of the refusal} of the sensors that have only frames in a wire form."""
    return {sensor.id: RECODED for sensor in sensors if not list_byte_frames(sensor)}


def number(value: Any) -> Any:
    """Return a value without its Enum name, which other languages do not compare."""
    return int(value) if isinstance(value, EnumIntegerString) else value


def parse_wire_fields(sensor: Sensor, frame: str, data: bytes) -> Any:
    """Return a parsed frame without its computed values, which C and Kaitai do not have."""
    parsed = sensor.parse(data, frame)
    for path in get_codec(sensor.frames[frame]).schema.derived:
        *outer, name = path.split(".")
        part = parsed
        for key in outer:
            part = part[key]
        del part[name]
    return parsed


def values(parsed: Any) -> dict[str, list[Any]]:
    """Return the values of a parsed frame in wire order, by path without indices."""
    found: dict[str, list[Any]] = {}
    _take(parsed, "", found)
    return found


def _take(value: Any, path: str, found: dict[str, list[Any]]) -> None:
    if isinstance(value, dict):
        for name, item in value.items():
            _take(item, f"{path}.{name}" if path else name, found)
    elif isinstance(value, list):
        for item in value:
            _take(item, path, found)
    elif value is not None:
        found.setdefault(path, []).append(value)
