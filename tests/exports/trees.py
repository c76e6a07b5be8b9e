"""What exports are tried on, and parsed frames taken apart for comparing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from construct import EnumIntegerString

from lidarspec import Sensor
from tests import all_sensors
from tests.exports import oddities

EVERY = {**all_sensors.EVERY, oddities.SENSOR.id: oddities.SENSOR}
DISTINCT = all_sensors.distinct(EVERY)


def in_forms(sensors: Mapping[str, Sensor]) -> dict[str, str]:
    """Those of them that no other language reads, since they stand on the wire in a form of their own, with the reason."""
    formed = (name for name, sensor in sensors.items() if any(frame.wire is not None for frame in sensor.frames.values()))
    return dict.fromkeys(formed, "no other language recodes")


def number(value: Any) -> Any:
    """A value without the name that an Enum gives it, which other languages do not compare by."""
    return int(value) if isinstance(value, EnumIntegerString) else value


def values(parsed: Any) -> dict[str, list[Any]]:
    """The values of a parsed frame in the order of the wire, by path without indices."""
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
