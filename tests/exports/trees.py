"""What exports are tried on, and parsed frames taken apart for comparing."""

from __future__ import annotations

from typing import Any

import lidarspec
from lidarspec import Sensor
from tests.exports import oddities
from tests.shapes import SHAPES

EVERY: dict[str, Sensor] = {**lidarspec.sensors(), **SHAPES, oddities.SENSOR.id: oddities.SENSOR}
#: one sensor of those that share their frames.
DISTINCT: dict[str, Sensor] = {
    sensor.id: sensor for sensor in {tuple(map(id, each.frames.values())): each for each in EVERY.values()}.values()
}


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
