"""Cosines and sines of angles that lie close together: the one in the middle of a packet or block, turned by a series.

cos(m + d) is a polynomial of d whose coefficients are cosines and sines of m. So the points of a packet or block cost one
row of a matrix product in float32, and no trigonometry.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lidarspec.plans.products import TURN, Angles, Floats, reduced
from lidarspec.plans.registers import Run

Singles = NDArray[np.float32]

#: terms of the series, and radians from the middle up to which what follows them is below 1e-8.
TERMS, NARROW = 5, 1 / 16
#: of the derivatives of a cosine and of a sine, where cosine and sine take turns.
_SIGNS = (1, -1, -1, 1, 1), (1, 1, -1, -1, 1)
#: packets or blocks whose coefficients are made together.
_WINDOW = 1 << 14


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
    def rows(self) -> tuple[Singles, Singles]:
        """The right sides of the products, for cosines and for sines, (k, inner)."""
        middle, half = self.span
        row = self.angles.around.rows[-1] - middle
        if not self.moving:
            return _single([np.cos(row), -np.sin(row)]), _single([np.cos(row), np.sin(row)])
        series = [(row / half) ** term / math.factorial(term) for term in range(TERMS)]
        return tuple(_single([s * t for s, t in zip(signs, series, strict=True)]) for signs in _SIGNS)  # type: ignore[return-value]

    def turns(self, run: Run) -> Turns:
        """The left sides of the products, for a batch."""
        around, (middle, half) = self.angles.around, self.span
        terms = [*self.angles.start, (around.lows[-1], middle)]
        values = [(around.values(run, low), factor / TURN) for low, factor in terms if low is not None]
        return Turns(self, len(run.rows), values, sum(factor for low, factor in terms if low is None) / TURN, half)


class Turns:
    """The left sides of the products of a batch, chunk by chunk.

    Args:
        rotation: whose.
        number: of packets.
        terms: what makes the angle in the middle: numbers, (n or 1, *outer), and their factors in turns; the last are those that move.
        fixed: turns that are added to it.
        half: the factor of those that makes the distance of the farthest points from the middle.

    Attributes:
        left: for cosines and for sines, (rows of the chunk, k).
        wide: which rows are not close enough together.
        some_wide, all_wide: whether there are such, and no others.
    """

    def __init__(self, rotation: Rotation, number: int, terms: list[tuple[Floats, float]], fixed: float, half: float) -> None:
        self._rotation, self._number, self._terms, self._fixed, self._half = rotation, number, terms, fixed, half
        self._outer = math.prod(rotation.angles.around.outer)
        self._first = self._last = 0

    def move(self, start: int, stop: int) -> None:
        """Go to the packets from `start` to `stop`."""
        if not self._first <= start < stop <= self._last:
            self._first, self._last = start, min(max(stop, start + _WINDOW // self._outer), self._number)
            self._expand()
        rows = slice((start - self._first) * self._outer, (stop - self._first) * self._outer)
        self.left = self._series[:, 0, rows].T, self._series[:, 1, rows].T
        self.some_wide = self.all_wide = False
        if self._any_wide:
            wide = self._wide[rows]
            self.some_wide, self.all_wide = bool(wide.any()), bool(wide.all())
            self.wide: slice | NDArray[np.intp] = slice(None) if self.all_wide else np.flatnonzero(wide)
            self._chunk = self._middle[rows][self.wide], self._moved[rows][self.wide]

    def _expand(self) -> None:
        """The coefficients of the packets that come next: of each, its cosine and sine times powers of how far its points go."""
        chosen = [self._rows(values) for values, _ in self._terms]
        middle = chosen[0] * self._terms[0][1]
        for values, (_, factor) in zip(chosen[1:], self._terms[1:], strict=True):
            middle += values * factor
        middle += self._fixed
        middle -= np.rint(middle)
        middle *= TURN
        single = middle.astype(np.float32)
        rest = (middle - single).astype(np.float32)
        cos, sin = np.cos(single), np.sin(single)
        series = self._series = np.empty((len(self._rotation.rows[0]), 2, len(middle)), np.float32)
        np.subtract(cos, rest * sin, out=series[0, 0])
        np.add(sin, rest * cos, out=series[0, 1])
        self._any_wide = False
        if self._rotation.moving:
            self._moved, self._middle = chosen[-1], middle
            aside = (chosen[-1] * self._half).astype(np.float32)
            self._wide = ~(np.abs(aside) <= NARROW)
            self._any_wide = bool(self._wide.any())
            np.multiply(series[0, ::-1], aside, out=series[1])
            aside *= aside
            np.multiply(series[:2], aside, out=series[2:4])
            np.multiply(series[2], aside, out=series[4])
        else:
            series[1] = series[0, ::-1]

    def _rows(self, values: Floats) -> Floats:
        """Numbers of the packets that come next, one for each of their rows."""
        if len(values) == 1:
            return np.broadcast_to(values.reshape(-1), (self._last - self._first, self._outer)).reshape(-1)
        return values[self._first : self._last].reshape(-1)

    def angles(self) -> Floats:
        """The angles of the rows that are wide, (rows, inner) radians."""
        middle, moved = self._chunk
        row, (at, _) = self._rotation.angles.around.rows[-1], self._rotation.span
        return reduced(middle[:, None] + moved[:, None] * (row - at))


def _single(rows: Sequence[Floats]) -> Singles:
    return np.stack(rows).astype(np.float32)
