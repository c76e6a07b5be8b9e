"""Scenes for simulated sensors, in which ranges are measured.

A scene consists of upright boxes in the axes of the sensor: x forward, y left, z up, in metres,
with the sensor at the origin. Some boxes (movers) move with time. A scene can be read from a TOML
file:

    [room]                                  # walls, floor and ceiling; optional
    low = [-3.0, -2.2, -1.2]                # metres, in the sensor's axes: x forward, y left, z up
    high = [4.6, 3.1, 1.6]

    [[box]]
    low = [2.0, 0.8, -1.2]
    high = [2.7, 1.6, 0.9]

    [[mover]]                               # goes along its path and back again
    size = [0.4, 0.5, 1.7]
    path = [[1.4, -1.5], [0.8, 1.9]]
    speed = 0.8                             # metres per second
    floor = -1.2
"""

from __future__ import annotations

import random
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from reprlib import repr as shown
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import UsageError, did_you_mean
from lidarspec.trusted_files import read_document

Floats = NDArray[np.float64]
#: A number that applies to all beams, or an array that broadcasts against the beams.
Value = Any
Vector = tuple[Value, Value, Value]
ORIGIN: Vector = (0.0, 0.0, 0.0)


class Scene(Protocol):
    """The interface of a scene: any object with this `measure` can be used as a scene."""

    def measure(
        self, azimuth: Floats, elevation: Floats, origin: Vector = ORIGIN, time: Value = 0.0
    ) -> Floats:
        """Return the range of each beam in metres, inf if it hits nothing.

        Args:
            azimuth, elevation: radians, of shapes that broadcast.
            origin: x, y and z of the start of the beams, metres. Each coordinate broadcasts against
                the beams.
            time: seconds since the scene began; broadcasts against the beams.
        """


@dataclass(frozen=True)
class Box:
    """An upright box: its lowest and highest corner in the sensor's axes, in metres."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def find_corners(self, time: Value) -> tuple[Vector, Vector]:
        """Return the lowest and the highest corner in metres.

        The box does not move, so `time` has no effect; `Mover` has the same method.
        """
        return self.low, self.high

    @property
    def radius(self) -> float:
        """The distance from the centre to a corner, in metres."""
        return float(np.linalg.norm(np.subtract(self.high, self.low))) / 2


@dataclass(frozen=True)
class Mover:
    """A box that moves along a path and back again, repeatedly.

    Args:
        size: size of the box in x, y and z, metres.
        path: (x, y) of at least two points, metres; the centre of the box moves along this path.
        speed: speed, metres per second.
        floor: z of the underside of the box, metres.
    """

    size: tuple[float, float, float]
    path: tuple[tuple[float, float], ...]
    speed: float = 0.8
    floor: float = -1.2

    def find_corners(self, time: Value) -> tuple[Vector, Vector]:
        """Return the lowest and highest corner at a time, in metres.

        x and y have the shape of `time`; z is a number.
        """
        points = np.array(self.path, np.float64)
        along = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
        whole = along[-1]
        gone = np.asarray(time, np.float64) * self.speed % (2 * whole)
        gone = np.minimum(gone, 2 * whole - gone)
        x, y = (np.interp(gone, along, column) for column in points.T)
        half = [side / 2 for side in self.size]
        return (x - half[0], y - half[1], self.floor), (
            x + half[0],
            y + half[1],
            self.floor + self.size[2],
        )

    @property
    def radius(self) -> float:
        """The distance from the centre to a corner, in metres."""
        return float(np.linalg.norm(self.size)) / 2


@dataclass(frozen=True)
class Room:
    """A room around the sensor, with fixed and moving boxes.

    Args:
        walls: the box that the walls, the floor and the ceiling form; None for no walls.
        boxes: the fixed boxes.
        movers: the moving boxes.
    """

    walls: Box | None = Box((-3.0, -2.2, -1.2), (4.6, 3.1, 1.6))
    boxes: tuple[Box, ...] = (
        Box((2.0, 0.8, -1.2), (2.7, 1.6, 0.9)),
        Box((-1.6, -1.5, -1.2), (-1.1, -0.9, 1.2)),
    )
    movers: tuple[Mover, ...] = ()

    def measure(
        self, azimuth: Floats, elevation: Floats, origin: Vector = ORIGIN, time: Value = 0.0
    ) -> Floats:
        """Return the range of each beam in metres, inf if it hits nothing.

        Args:
            azimuth, elevation: radians, of shapes that broadcast.
            origin: x, y and z of the start of the beams, metres. Each coordinate broadcasts against
                the beams.
            time: seconds since the scene began; broadcasts against the beams.
        """
        level = np.cos(elevation)
        beams = (level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation))
        shape = np.broadcast_shapes(*(np.shape(part) for part in (*beams, *origin, time)))
        ranges = np.full(shape, np.inf)
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.walls is not None:
                for low, high, start, beam in zip(
                    self.walls.low, self.walls.high, origin, beams, strict=True
                ):
                    np.minimum(
                        ranges,
                        np.where(beam >= 0, high - start, start - low) / np.abs(beam),
                        out=ranges,
                    )
            bodies: tuple[Box | Mover, ...] = (*self.boxes, *self.movers)
            for body in bodies:
                _shorten_ranges(ranges, body, beams, origin, time)
        return ranges


def _shorten_ranges(
    ranges: Floats, body: Box | Mover, beams: Vector, origin: Vector, time: Value
) -> None:
    """Reduce the ranges of beams that hit the outside of a body, in place."""
    low, high = body.find_corners(time)
    near = _may_hit(body, low, high, beams, origin)
    where = np.flatnonzero(np.broadcast_to(near, ranges.shape))
    if not len(where):
        return

    def select(value: Value) -> Any:
        if np.ndim(value) == 0:
            return value
        return np.broadcast_to(value, ranges.shape).reshape(-1)[where]

    enter = np.full(len(where), -np.inf)
    leave = np.full(len(where), np.inf)
    for corner, other, start, beam in zip(low, high, origin, beams, strict=True):
        first = (select(corner) - select(start)) / select(beam)
        second = (select(other) - select(start)) / select(beam)
        np.fmax(enter, np.fmin(first, second), out=enter)
        np.fmin(leave, np.fmax(first, second), out=leave)
    hit = (enter > 0) & (enter <= leave)
    flat = ranges.reshape(-1)
    flat[where[hit]] = np.minimum(flat[where[hit]], enter[hit])


def _may_hit(body: Box | Mover, low: Vector, high: Vector, beams: Vector, origin: Vector) -> Any:
    """Return a mask that is False for beams that certainly miss a body."""
    middle = [(a + b) / 2 for a, b in zip(low, high, strict=True)]
    aside = np.sqrt(sum(np.max(np.square(part)) for part in origin))
    squared = sum(np.square(part) for part in middle) - (body.radius + aside) ** 2
    along = sum(part * beam for part, beam in zip(middle, beams, strict=True))
    return (squared <= 0) | (along >= np.sqrt(np.maximum(squared, 0)))


def make_room(seed: int = 0) -> Room:
    """Return a random room with boxes and a walking person."""
    walker = Mover((0.4, 0.5, 1.7), ((1.4, -1.5), (0.8, 1.9), (-1.8, 1.2)))
    if seed == 0:
        return Room(movers=(walker,))
    source = random.Random(f"scene {seed}")
    spread = source.uniform
    walls = Box(
        (-spread(2.5, 4), -spread(2, 3.5), -1.2), (spread(3, 6), spread(2.5, 4.5), spread(1.3, 2))
    )
    boxes = []
    for _ in range(source.randint(2, 4)):
        x = source.choice((spread(-2.2, -1.2), spread(1.6, 2.6)))
        y = source.choice((spread(-1.7, -1), spread(1.2, 2)))
        wide = spread(0.2, 0.5)
        deep = spread(0.2, 0.5)
        boxes.append(Box((x - wide, y - deep, -1.2), (x + wide, y + deep, spread(-0.3, 1.2))))
    return Room(walls, tuple(boxes), (walker,))


def read_scene(path: str | Path) -> Room:
    """Return the scene of a TOML file.

    Raises:
        SourceError: if the file cannot be read.
        UsageError: if the scene is invalid; the message names the key.
    """
    return parse_scene(read_document(Path(path)), str(path))


def parse_scene(table: Mapping[str, Any], place: str = "scene") -> Room:
    """Return the scene that a TOML table describes; see the module's docstring.

    Args:
        place: name of the table, for error messages.

    Raises:
        UsageError: for an invalid scene.
    """
    _check_keys(table, ("room", "box", "mover"), place)
    walls = None
    if "room" in table:
        if not isinstance(table["room"], Mapping):
            raise UsageError(f"{place}: room: expected one table, [room]")
        walls = _read_box(table["room"], f"{place}: room")
        if not all(low < 0 < high for low, high in zip(walls.low, walls.high, strict=True)):
            raise UsageError(
                f"{place}: room: the room must contain the sensor, which is at [0, 0, 0]"
            )
    boxes = [_read_box(entry, where) for entry, where in _read_entries(table, "box", place)]
    movers = [_read_mover(entry, where) for entry, where in _read_entries(table, "mover", place)]
    return Room(walls, tuple(boxes), tuple(movers))


def _read_box(table: Mapping[str, Any], place: str) -> Box:
    _check_keys(table, ("low", "high"), place)
    low, high = (_read_numbers(table, name, 3, place) for name in ("low", "high"))
    if not all(a < b for a, b in zip(low, high, strict=True)):
        raise UsageError(
            f"{place}: each coordinate in high must be above the coordinate in low, got low {low}"
            f" and high {high}"
        )
    return Box((low[0], low[1], low[2]), (high[0], high[1], high[2]))


def _read_mover(table: Mapping[str, Any], place: str) -> Mover:
    _check_keys(table, ("size", "path", "speed", "floor"), place)
    size = _read_numbers(table, "size", 3, place)
    if min(size) <= 0:
        raise UsageError(f"{place}.size: expected numbers above 0, got {size}")
    path = table.get("path")
    if not isinstance(path, list) or len(path) < 2:
        raise UsageError(
            f"{place}.path: expected at least two positions, such as [[1, -1], [1, 1]]"
        )
    points = [
        _read_numbers({f"path[{index}]": point}, f"path[{index}]", 2, place)
        for index, point in enumerate(path)
    ]
    if len(set(map(tuple, points))) < 2:
        raise UsageError(f"{place}.path: all positions are equal")
    others = {
        name: _read_number(table[name], f"{place}.{name}")
        for name in ("speed", "floor")
        if name in table
    }
    return Mover((size[0], size[1], size[2]), tuple((x, y) for x, y in points), **others)


def _read_entries(
    table: Mapping[str, Any], name: str, place: str
) -> list[tuple[Mapping[str, Any], str]]:
    entries = table.get(name, [])
    if not isinstance(entries, list) or not all(isinstance(entry, Mapping) for entry in entries):
        raise UsageError(f"{place}: {name}: expected tables in double brackets, [[{name}]]")
    return [(entry, f"{place}: {name}[{index}]") for index, entry in enumerate(entries)]


def _check_keys(table: Mapping[str, Any], names: tuple[str, ...], place: str) -> None:
    for name in table:
        if name not in names:
            hint = did_you_mean(name, names) or f"; expected one of {', '.join(names)}"
            raise UsageError(f"{place}: unknown key {name!r}{hint}")


def _read_numbers(table: Mapping[str, Any], name: str, count: int, place: str) -> list[float]:
    values = table.get(name)
    if not isinstance(values, list) or len(values) != count:
        raise UsageError(
            f"{place}.{name}: expected {count} numbers in brackets, got {shown(values)}"
        )
    return [_read_number(value, f"{place}.{name}") for value in values]


def _read_number(value: Any, place: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e6:
        raise UsageError(f"{place}: expected a number, got {shown(value)}")
    return float(value)
