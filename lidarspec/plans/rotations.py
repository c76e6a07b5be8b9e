"""Cosines and sines of angles that lie close together: the one in the middle of a packet or block, turned by a series.

cos(m + d) is a polynomial of d whose coefficients are cosines and sines of m. So the points of a packet or block cost one
row of a matrix product in float32, and no trigonometry.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lidarspec.plans.products import NEAR, Angles, Floats, multiplied, reduced
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
    def _span(self) -> tuple[float, float]:
        """What is in the middle of the row, and half of its width."""
        row = self.angles.around.rows[-1]
        return (float(row.max()) + float(row.min())) / 2, (float(row.max()) - float(row.min())) / 2

    @cached_property
    def rows(self) -> Singles:
        """The right side of the products, (k, inner)."""
        middle, half = self._span
        row = self.angles.around.rows[-1] - middle
        series = (row / half) ** np.arange(TERMS)[:, None] if self.moving else np.stack([np.cos(row), np.sin(row)])
        return series.astype(np.float32)

    def turns(self, run: Run) -> Turns:
        """The left sides of the products, for a batch."""
        numbers, middle, _ = self.angles.left(run)
        return Turns(self, numbers, middle, numbers[..., -1] * self._span[1] if self.moving else np.zeros_like(middle))


class Turns:
    """The left sides of the products of a batch, chunk by chunk.

    Attributes:
        cos, sin: (k, rows of the chunk).
        wide: which rows are not close enough together.
        some_wide, all_wide: whether there are such, and no others.
    """

    def __init__(self, rotation: Rotation, numbers: Floats, middle: Floats, aside: Floats) -> None:
        self._rotation, self._numbers, self._middle, self._aside = rotation, numbers, middle, aside

    def move(self, start: int, stop: int) -> None:
        """Go to the packets from `start` to `stop`."""
        middle, aside = self._middle[start:stop].reshape(-1), self._aside[start:stop].reshape(-1)
        close = (np.abs(aside) <= NARROW) & (np.abs(middle) <= NEAR)
        self.all_wide = not close.any()
        self.some_wide = self.all_wide or not close.all()
        self.wide: slice | NDArray[np.intp] = slice(None) if self.all_wide else np.flatnonzero(~close)
        self._chunk = slice(start, stop)
        if not self.all_wide:
            self._expand(middle, aside.astype(np.float32))

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
        around = self._rotation.angles.around
        numbers = self._numbers[self._chunk].reshape(-1, len(around.rows))[self.wide]
        found = np.empty((len(numbers), around.inner))
        multiplied(numbers, around.rows, found)
        return reduced(found)
