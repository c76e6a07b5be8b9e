"""Scenes for simulated sensors: what a beam in a direction meets, and how far away."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Scene(Protocol):
    """Something that can be measured."""

    def measure(self, azimuth: Floats, elevation: Floats) -> Floats:
        """Metres from the sensor to what each beam meets, inf where it meets nothing; arrays of one shape."""


@dataclass(frozen=True)
class Box:
    """An upright box by its corners, metres, in the sensor's axes."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def span(self, direction: Floats) -> tuple[Floats, Floats]:
        """Where beams, (3, ...), enter and leave; entering beyond leaving is a miss."""
        with np.errstate(divide="ignore", invalid="ignore"):
            edges = [np.array(corner).reshape(3, *(1,) * (direction.ndim - 1)) / direction for corner in (self.low, self.high)]
        near, far = np.fmin(*edges), np.fmax(*edges)
        return near.max(axis=0), far.min(axis=0)


@dataclass(frozen=True)
class Room:
    """Walls, floor and ceiling around the sensor, and boxes in it; no symmetry, so that a mirrored picture shows."""

    walls: Box = Box((-3.0, -2.2, -1.2), (4.6, 3.1, 1.6))
    boxes: tuple[Box, ...] = (Box((2.0, 0.8, -1.2), (2.7, 1.6, 0.9)), Box((-1.6, -1.5, -1.2), (-1.1, -0.9, 1.2)))

    def measure(self, azimuth: Floats, elevation: Floats) -> Floats:
        level = np.cos(elevation)
        direction = np.stack(np.broadcast_arrays(level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)))
        found: Any = self.walls.span(direction)[1]
        for box in self.boxes:
            enter, leave = box.span(direction)
            found = np.where((enter > 0) & (enter <= leave), np.minimum(found, enter), found)
        return np.asarray(found, np.float64)
