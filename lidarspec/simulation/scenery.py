"""Scenes as small TOML files.

[room]                                  # walls, floor and ceiling; left out: in the open
low = [-3.0, -2.2, -1.2]                # metres, in the sensor's axes: x forward, y left, z up
high = [4.6, 3.1, 1.6]

[[box]]
low = [2.0, 0.8, -1.2]
high = [2.7, 1.6, 0.9]

[[mover]]                               # goes along its path and back again
size = [0.4, 0.5, 1.7]
path = [[1.4, -1.5], [0.8, 1.9]]
speed = 0.8                             # metres a second
floor = -1.2
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lidarspec.errors import SourceError, UsageError, did_you_mean
from lidarspec.simulation.scenes import Box, Mover, Room


def read_scene(path: str | Path) -> Room:
    """The scene of a TOML file.

    Raises:
        SourceError: where it cannot be read.
        UsageError: where it is no TOML, or says something that is no scene: the key is named.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise UsageError(f"{path}: no TOML, since it is no text in UTF-8") from None
    try:
        return scene_of(tomllib.loads(text), str(path))
    except tomllib.TOMLDecodeError as error:
        raise UsageError(f"{path}: {error}") from None


def scene_of(table: Mapping[str, Any], place: str = "scene") -> Room:
    """The scene that a table describes; see the module's text.

    Args:
        place: what errors begin with.

    Raises:
        UsageError: for what is no scene.
    """
    _known(table, ("room", "box", "mover"), place)
    walls = None
    if "room" in table:
        if not isinstance(table["room"], Mapping):
            raise UsageError(f"{place}: room: one table, [room]")
        walls = _box(table["room"], f"{place}: room")
        if not all(low < 0 < high for low, high in zip(walls.low, walls.high, strict=True)):
            raise UsageError(f"{place}: room: the sensor, at [0, 0, 0], has to stand in it")
    boxes = [_box(entry, where) for entry, where in _entries(table, "box", place)]
    movers = [_mover(entry, where) for entry, where in _entries(table, "mover", place)]
    return Room(walls, tuple(boxes), tuple(movers))


def _box(table: Mapping[str, Any], place: str) -> Box:
    _known(table, ("low", "high"), place)
    low, high = (_numbers(table, name, 3, place) for name in ("low", "high"))
    if not all(a < b for a, b in zip(low, high, strict=True)):
        raise UsageError(f"{place}: every number of high has to be above that of low, and {low} and {high} are not so")
    return Box((low[0], low[1], low[2]), (high[0], high[1], high[2]))


def _mover(table: Mapping[str, Any], place: str) -> Mover:
    _known(table, ("size", "path", "speed", "floor"), place)
    size = _numbers(table, "size", 3, place)
    if min(size) <= 0:
        raise UsageError(f"{place}.size: numbers above 0, not {size}")
    path = table.get("path")
    if not isinstance(path, list) or len(path) < 2:
        raise UsageError(f"{place}.path: two places or more, such as [[1, -1], [1, 1]]")
    places = [_numbers({f"path[{index}]": spot}, f"path[{index}]", 2, place) for index, spot in enumerate(path)]
    if len(set(map(tuple, places))) < 2:
        raise UsageError(f"{place}.path: it leads nowhere")
    others = {name: _number(table[name], f"{place}.{name}") for name in ("speed", "floor") if name in table}
    return Mover((size[0], size[1], size[2]), tuple((x, y) for x, y in places), **others)


def _entries(table: Mapping[str, Any], name: str, place: str) -> list[tuple[Mapping[str, Any], str]]:
    entries = table.get(name, [])
    if not isinstance(entries, list) or not all(isinstance(entry, Mapping) for entry in entries):
        raise UsageError(f"{place}: {name}: tables in double brackets, [[{name}]]")
    return [(entry, f"{place}: {name}[{index}]") for index, entry in enumerate(entries)]


def _known(table: Mapping[str, Any], names: tuple[str, ...], place: str) -> None:
    for name in table:
        if name not in names:
            hint = did_you_mean(name, names) or f"; known are {', '.join(names)}"
            raise UsageError(f"{place}: unknown key {name!r}{hint}")


def _numbers(table: Mapping[str, Any], name: str, count: int, place: str) -> list[float]:
    values = table.get(name)
    if not isinstance(values, list) or len(values) != count:
        raise UsageError(f"{place}.{name}: {count} numbers in brackets, not {values!r}")
    return [_number(value, f"{place}.{name}") for value in values]


def _number(value: Any, place: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e6:
        raise UsageError(f"{place}: a number, not {value!r}")
    return float(value)
