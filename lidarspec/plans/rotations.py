"""Cosines and sines of angles that lie close together: the one in the middle of a packet or block, turned by a series.

cos(m + d) is a polynomial of d whose coefficients are cosines and sines of m. So the points of a packet or block cost one
row of a matrix product in float32, and no trigonometry.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lidarspec.plans.products import Angles, Floats, reduced
from lidarspec.plans.registers import Run

Singles = NDArray[np.float32]

#: terms of the series, and radians from the middle up to which what follows them is below 1e-8.
TERMS, NARROW = 5, 1 / 16
#: of each term from the third on: what it is of the one before the last, besides the square of the distance.
_FACTORS = np.array([[-1 / (term * (term - 1))] for term in range(2, TERMS)], np.float32)


@dataclass(frozen=True, eq=False)
class Rotation:
    """How the points of a packet or block are turned from its middle.

    Attributes:
        angles: what is turned.
        moving: whether packets or blocks have a number of their own for how far; else it is the same in all.
    """

    angles: Angles
    moving: bool

    @classmethod
    def of(cls, angles: Angles) -> Rotation | None:
        """The rotation that makes these angles; None where that takes more than one row of numbers besides their middle."""
        lows = angles.around.lows
        return None if len(lows) > 2 or angles.more != (0.0, 0.0) else cls(angles, lows[-1] is not None)

    @property
    def inner(self) -> int:
        """Points of a packet or block."""
        return self.angles.around.inner

    @cached_property
    def span(self) -> tuple[float, float]:
        """What is in the middle of the row, and half of its width."""
        row = self.angles.around.rows[-1]
        return (float(row.max()) + float(row.min())) / 2, (float(row.max()) - float(row.min())) / 2

    @cached_property
    def rows(self) -> Singles:
        """The right side of the products, (k, inner)."""
        middle, half = self.span
        row = self.angles.around.rows[-1] - middle
        series = (row / half) ** np.arange(TERMS)[:, None] if self.moving else np.stack([np.cos(row), np.sin(row)])
        return series.astype(np.float32)

    def turns(self, run: Run) -> Turns:
        """The left sides of the products, for a batch."""
        around, (middle, half) = self.angles.around, self.span
        terms = [(low, factor) for low, factor in self.angles.start]
        terms.append((around.lows[-1], middle))
        values = [(np.ones((1, *around.outer)) if low is None else around.values(run, low), factor) for low, factor in terms]
        return Turns(self, values, half)


class Turns:
    """The left sides of the products of a batch, chunk by chunk.

    Args:
        rotation: whose.
        terms: what makes the angle in the middle: numbers, (n or 1, *outer), and their factors; the last are those that move.
        half: the factor of those that makes the distance of the farthest points from the middle.

    Attributes:
        cos, sin: (k, rows of the chunk).
        wide: which rows are not close enough together.
        some_wide, all_wide: whether there are such, and no others.
    """

    def __init__(self, rotation: Rotation, terms: list[tuple[Floats, float]], half: float) -> None:
        self._rotation, self._terms, self._half = rotation, terms, half

    def move(self, start: int, stop: int) -> None:
        """Go to the packets from `start` to `stop`."""
        parts = [(values[start:stop] if len(values) > 1 else values, factor) for values, factor in self._terms]
        middle = np.zeros((stop - start, *self._rotation.angles.around.outer))
        for values, factor in parts:
            middle += values * factor
        middle = reduced(middle.reshape(-1))
        moved = np.broadcast_to(parts[-1][0], (stop - start, *self._rotation.angles.around.outer)).reshape(-1)
        aside = (moved * self._half).astype(np.float32)
        close = np.abs(aside) <= NARROW
        self.some_wide = self._rotation.moving and not close.all()
        self.all_wide = self.some_wide and not close.any()
        self.wide: slice | NDArray[np.intp] = slice(None) if self.all_wide else np.flatnonzero(~close)
        self._found = middle, moved
        if not self.all_wide:
            self._expand(middle, aside)

    def _expand(self, middle: Floats, aside: Singles) -> None:
        """The coefficients of both: of the series, each term is the one before the last, times a number for its packet or block."""
        single = middle.astype(np.float32)
        rest = (middle - single).astype(np.float32)
        cos, sin = np.cos(single), np.sin(single)
        terms = np.empty((len(self._rotation.rows), 2, len(aside)), np.float32)
        np.subtract(cos, rest * sin, out=terms[0, 0])
        np.add(sin, rest * cos, out=terms[0, 1])
        np.multiply(terms[0, 1], -aside if self._rotation.moving else -1, out=terms[1, 0])
        np.multiply(terms[0, 0], aside if self._rotation.moving else 1, out=terms[1, 1])
        if self._rotation.moving:
            for index, factor in enumerate(aside * aside * _FACTORS, 2):
                np.multiply(terms[index - 2], factor, out=terms[index])
        self.cos, self.sin = terms[:, 0], terms[:, 1]

    def angles(self) -> Floats:
        """The angles of the rows that are wide, (rows, inner) radians."""
        middle, moved = (values[self.wide] for values in self._found)
        row, (at, _) = self._rotation.angles.around.rows[-1], self._rotation.span
        return reduced(middle[:, None] + moved[:, None] * (row - at))
