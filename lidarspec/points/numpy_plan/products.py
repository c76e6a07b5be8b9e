"""Sums and angles of packets and blocks as matrix products.

What packets or blocks have once, times rows that all of them share, summed, is one matrix product
(`Product`). Angles that are such a sum lie around one of their packet or block: that one alone is
reduced to half a turn before they become float32 (`Angles`).

Cosines and sines of angles that lie close together are those of the one in the middle of their
packet or block, turned by a series: cos(m + d) is a polynomial of d whose coefficients are cosines
and sines of m. So the points of a packet or block cost one row of a matrix product in float32, and
no trigonometry (`Rotation`, `Turns`).

Which sums and angles are so is decided here from their terms; `numpy_plan.compiler` makes steps of
them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.expressions.graph import Node, Term, chosen, split_level, terms
from lidarspec.frames.layout import Leaf
from lidarspec.points.numpy_plan.program import Run
from lidarspec.points.windows import possible

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

TURN = 2 * np.pi
#: radians from which on float32 is too coarse for an angle.
NEAR = 4.0
#: points that blocks with rows of their own have at least: each block takes a matrix product.
WORTHWHILE = 16
#: multiplications up to which OpenBLAS stays in one thread (`SMP_THRESHOLD_MIN` times
#: `GEMM_MULTITHREAD_THRESHOLD`).
_ALONE = 1 << 18


@dataclass(frozen=True, eq=False)
class Product:
    """Numbers of packets or blocks times rows, summed.

    Attributes:
        lows: the numbers, None for 1.
        rows: (k, inner), of each the row that it is multiplied by; (k, groups, inner) where these
            differ by the block of a packet.
        outer: the axes after the packets' that the numbers have.
    """

    lows: Sequence[Node | None]
    rows: Floats
    outer: tuple[int, ...]

    @classmethod
    def of(cls, parts: Sequence[Term], shape: tuple[int, ...]) -> Product | None:
        """Return the product of the low terms of a sum, for points of this shape.

        Returns None if there are none, or if the product would be of very small matrices.
        """
        if not parts:
            return None
        level, crossing = split_level(parts, len(shape))
        if crossing and math.prod(shape[level:]) < WORTHWHILE:
            return None
        if crossing:
            whole = shape
            inner = math.prod(shape[level:])
        else:
            whole = shape[level:]
            inner = math.prod(shape[level:])
        rows = np.stack([np.broadcast_to(part.row, whole).reshape(-1, inner) for part in parts])
        return cls([part.low for part in parts], rows if crossing else rows[:, 0], shape[:level])

    @property
    def inner(self) -> int:
        """The length of a row."""
        return int(self.rows.shape[-1])

    @property
    def groups(self) -> int:
        """How many blocks of a packet have rows of their own."""
        return 1 if self.rows.ndim == 2 else self.rows.shape[1]

    @property
    def nodes(self) -> list[Node]:
        """What has to be known of a batch."""
        return [low for low in self.lows if low is not None]

    def left(self, run: Run) -> Floats:
        """The numbers, (k, n times what `outer` holds)."""
        found = np.empty((len(self.lows), len(run.rows), *self.outer))
        for column, low in zip(found, self.lows, strict=True):
            column[...] = 1.0 if low is None else self.values(run, low)
        return found.reshape(len(self.lows), -1)

    def values(self, run: Run, low: Node) -> Floats:
        """The numbers of one column, (n or 1, *outer)."""
        values = run.values(low)
        return values.reshape(values.shape[: 1 + len(self.outer)])


@dataclass(frozen=True, eq=False)
class Angles:
    """Angles that lie around one of their packet or block, which alone is reduced to half a turn.

    Attributes:
        start: what makes that one: numbers of packets or blocks, each with its factor.
        around: the others; the first column of its product is for the start.
        more: radians that other parts of the angles add, at least and at most.
    """

    start: Sequence[tuple[Node | None, float]]
    around: Product
    more: tuple[float, float]

    @classmethod
    def of(cls, product: Product, more: tuple[float, float]) -> Angles | None:
        """Return the angles that a product gives.

        Returns None if no term is the same for all points of a packet or block.
        """
        level = [bool((row == row.flat[0]).all()) for row in product.rows]
        start = [
            (low, float(row.flat[0]))
            for low, row, is_level in zip(product.lows, product.rows, level, strict=True)
            if is_level
        ]
        if (
            not any(low is not None for low, _ in start)
            or not np.isfinite((*product.rows.flat, *more)).all()
        ):
            return None
        others = [index for index, is_level in enumerate(level) if not is_level]
        rows = np.concatenate([np.ones((1, *product.rows.shape[1:])), product.rows[others]])
        return cls(
            start,
            Product([None, *(product.lows[index] for index in others)], rows, product.outer),
            more,
        )

    @property
    def nodes(self) -> list[Node]:
        """What has to be known of a batch."""
        return [*self.around.nodes, *(low for low, _ in self.start if low is not None)]

    @property
    def all_alike(self) -> bool:
        """Whether all points of a packet or block have the same angle."""
        return len(self.around.rows) == 1 and self.more == (0.0, 0.0)

    def left(self, run: Run) -> tuple[Floats, NDArray[np.bool_]]:
        """Return the numbers, (k, rows), and which rows have angles to reduce.

        The first numbers are reduced to within half a turn.
        """
        found = self.around.left(run)
        rows = self.around.rows.reshape(len(self.around.rows), -1)
        start = found[0].reshape(len(run.rows), *self.around.outer)
        start[...] = 0
        for low, factor in self.start:
            start += factor if low is None else self.around.values(run, low) * factor
        (lowest, highest), least, most = self.more, rows.min(axis=1), rows.max(axis=1)
        middle = found[0] + (highest + lowest) / 2
        for numbers, at in zip(found[1:], (least + most)[1:] / 2, strict=True):
            middle += numbers * at
        whole = np.rint(middle * (1 / TURN))
        whole *= TURN
        found[0] -= whole
        middle -= whole
        reach = np.abs(middle, out=middle)
        for numbers, half in zip(found[1:], (most - least)[1:] / 2, strict=True):
            reach += np.abs(numbers * half)
        return found, ~(reach <= NEAR - (highest - lowest) / 2)


def reduced(angles: Floats) -> Floats:
    """Angles in radians without whole turns, within half a turn either way, of the same shape."""
    return angles - np.rint(angles / TURN) * TURN


def multiplied(left: NDArray[Any], right: NDArray[Any], out: NDArray[Any]) -> None:
    """Compute a matrix product in pieces that a BLAS does in one thread.

    With two threads, a chunk would wait for the one that is busy elsewhere.

    Rows come out the same in any company: for that a lone one needs another, as it would be summed
    in another order. Where the right side differs by group, rows belong to the groups by turns.
    """
    if right.ndim == 3:
        for group in range(right.shape[1]):
            multiplied(
                np.ascontiguousarray(left[group :: right.shape[1]]),
                right[:, group],
                out[group :: right.shape[1]],
            )
        return
    step = max(_ALONE // right.size, 2)
    for start in range(0, len(left), step):
        part = left[start : start + step]
        target = out[start : start + step]
        if len(part) > 1:
            np.matmul(part, right, out=target)
        else:
            target[...] = (part.repeat(2, axis=0) @ right)[:1]


#: terms of the series, and radians from the middle up to which what follows them is below 1e-8.
TERMS = 5
NARROW = 1 / 16
#: of the derivatives of a cosine and of a sine, where cosine and sine take turns.
_SIGNS = (1, -1, -1, 1, 1), (1, 1, -1, -1, 1)
#: packets or blocks whose coefficients are made together.
_WINDOW = 1 << 14


@dataclass(frozen=True, eq=False)
class Rotation:
    """How the points of a packet or block are turned from its middle.

    Attributes:
        angles: what is turned.
        moving: whether packets or blocks have a number of their own for how far; else it is the
            same in all.
    """

    angles: Angles
    moving: bool

    @classmethod
    def of(cls, angles: Angles) -> Rotation | None:
        """Return the rotation that gives these angles.

        Returns None if several rows besides the middle have numbers of packets or blocks.
        """
        numbered = [low for low in angles.around.lows if low is not None]
        if len(numbered) > 1 or angles.more != (0.0, 0.0):
            return None
        return cls(angles, bool(numbered))

    @property
    def inner(self) -> int:
        """Points of a packet or block."""
        return self.angles.around.inner

    @cached_property
    def row(self) -> Floats:
        """The factors of the number of a packet or block.

        Without such numbers it is the angle by which each point is turned.
        """
        around = self.angles.around
        return next(
            (row for row, low in zip(around.rows, around.lows, strict=True) if low is not None),
            self.aside,
        )

    @cached_property
    def aside(self) -> Floats:
        """By how much each point is turned in all packets or blocks alike."""
        around = self.angles.around
        fixed = [
            row for row, low in zip(around.rows[1:], around.lows[1:], strict=True) if low is None
        ]
        return np.sum(fixed, axis=0) if fixed else np.zeros(around.rows.shape[1:])

    @cached_property
    def joint(self) -> bool:
        """Whether points are turned both by numbers of their packet or block and alike in all."""
        return self.moving and bool(self.aside.any())

    @cached_property
    def span(self) -> tuple[float, float]:
        """What is in the middle of the row, and half of its width."""
        lowest = float(self.row.min())
        highest = float(self.row.max())
        return (highest + lowest) / 2, (highest - lowest) / 2

    @cached_property
    def rows(self) -> tuple[Singles, Singles]:
        """The right sides of the products, for cosines and for sines, (k, inner)."""
        middle, half = self.span
        row = self.row - middle
        if not self.moving:
            return _single([np.cos(row), -np.sin(row)]), _single([np.cos(row), np.sin(row)])
        series = [(row / half) ** term / math.factorial(term) for term in range(TERMS)]
        cos, sin = (
            [sign * part for sign, part in zip(signs, series, strict=True)] for signs in _SIGNS
        )
        if not self.joint:
            return _single(cos), _single(sin)
        across = np.sin(self.aside)
        along = np.cos(self.aside)
        pairs = list(zip(cos, sin, strict=True))
        return (
            _single([part for one, other in pairs for part in (one * along, -other * across)]),
            _single([part for one, other in pairs for part in (one * across, other * along)]),
        )

    def turns(self, run: Run) -> Turns:
        """The left sides of the products, for a batch."""
        around, (middle, half) = self.angles.around, self.span
        numbered = [low for low in around.lows if low is not None]
        if numbered:
            terms = [*self.angles.start, *((low, middle) for low in numbered)]
        else:
            terms = [*self.angles.start, (None, middle)]
        values = [
            (around.values(run, low), factor / TURN) for low, factor in terms if low is not None
        ]
        return Turns(
            self,
            len(run.rows),
            values,
            sum(factor for low, factor in terms if low is None) / TURN,
            half,
        )


class Turns:
    """The left sides of the products of a batch, chunk by chunk.

    Args:
        rotation: whose.
        number: of packets.
        terms: what makes the angle in the middle: numbers, (n or 1, *outer), and their factors in
            turns; the last are those that move.
        fixed: turns that are added to it.
        half: the factor of those that makes the distance of the farthest points from the middle.

    Attributes:
        left: for cosines and for sines, (k, groups, rows of the chunk of each group).
        wide: which rows are not close enough together.
        some_wide, all_wide: whether there are such, and no others.
    """

    def __init__(
        self,
        rotation: Rotation,
        number: int,
        terms: list[tuple[Floats, float]],
        fixed: float,
        half: float,
    ) -> None:
        self._rotation = rotation
        self._number = number
        self._terms = terms
        self._fixed = fixed
        self._half = half
        self._outer = math.prod(rotation.angles.around.outer)
        self._groups = rotation.angles.around.groups
        self._first = self._last = 0

    def move(self, start: int, stop: int) -> None:
        """Go to the packets from `start` to `stop`."""
        if not self._first <= start < stop <= self._last:
            self._first, self._last = (
                start,
                min(max(stop, start + _WINDOW // self._outer), self._number),
            )
            self._expand()
        series = self._of_chunk(self._series, start, stop)
        if self._rotation.joint:
            both = series.reshape(2 * TERMS, *series.shape[2:])
            self.left = both, both
        else:
            self.left = series[:, 0], series[:, 1]
        self.some_wide = self.all_wide = False
        if self._any_wide:
            wide, middle, moved = (
                self._of_chunk(array, start, stop).T.reshape(-1)
                for array in (self._wide, self._middle, self._moved)
            )
            self.some_wide = bool(wide.any())
            self.all_wide = bool(wide.all())
            self.wide: slice | NDArray[np.intp] = (
                slice(None) if self.all_wide else np.flatnonzero(wide)
            )
            self._chunk = np.flatnonzero(wide) % self._groups, middle[self.wide], moved[self.wide]

    def multiply(self, which: int, out: Singles) -> None:
        """The products, of cosines for 0 and of sines for 1, (rows of the chunk, inner)."""
        right = self._rotation.rows[which]
        for group, left in enumerate(np.moveaxis(self.left[which], 1, 0)):
            multiplied(
                left.T, right if right.ndim == 2 else right[:, group], out[group :: self._groups]
            )

    def _of_chunk(self, array: NDArray[Any], start: int, stop: int) -> NDArray[Any]:
        """Return a view of an array for the packets of a chunk, (..., groups, rows).

        The array is (..., rows of the window), group by group.
        """
        each = self._outer // self._groups
        whole = array.reshape(*array.shape[:-1], self._groups, -1)
        return whole[..., (start - self._first) * each : (stop - self._first) * each]

    def _expand(self) -> None:
        """Compute the coefficients of the next packets.

        They are cosine and sine of each packet, times powers of the extent of its points.
        """
        chosen = [self._rows(values) for values, _ in self._terms]
        middle = chosen[0] * self._terms[0][1]
        for values, (_, factor) in zip(chosen[1:], self._terms[1:], strict=True):
            middle += values * factor
        middle += self._fixed
        middle -= np.rint(middle)
        middle *= TURN
        single = middle.astype(np.float32)
        rest = (middle - single).astype(np.float32)
        cos = np.cos(single)
        sin = np.sin(single)
        series = self._series = np.empty(
            (TERMS if self._rotation.moving else 2, 2, len(middle)), np.float32
        )
        np.subtract(cos, rest * sin, out=series[0, 0])
        np.add(sin, rest * cos, out=series[0, 1])
        self._any_wide = False
        if self._rotation.moving:
            self._moved = chosen[-1]
            self._middle = middle
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
        number = self._last - self._first
        rows = np.broadcast_to(
            (
                values.reshape(-1, self._outer)
                if len(values) == 1
                else values[self._first : self._last].reshape(number, -1)
            ),
            (number, self._outer),
        )
        if self._groups == 1:
            return rows.reshape(-1)
        return rows.T.reshape(-1)

    def angles(self) -> Floats:
        """The angles of the rows that are wide, (rows, inner) radians."""
        groups, middle, moved = self._chunk
        row, aside = (
            row if row.ndim == 1 else row[groups]
            for row in (self._rotation.row, self._rotation.aside)
        )
        return reduced(middle[:, None] + moved[:, None] * (row - self._rotation.span[0]) + aside)


def _single(rows: Sequence[Floats]) -> Singles:
    return np.stack(rows).astype(np.float32)


def split(node: Node, width: int) -> tuple[list[Term], list[Term]]:
    """Split a sum into its low terms and the terms with a value for each point.

    A low term has one value for a packet or block, not one for each of the `width` points.
    """
    parts = terms(node, width)
    return [part for part in parts if part.full is None], [
        part for part in parts if part.full is not None
    ]


def product_of(node: Node, shape: tuple[int, ...]) -> Product | None:
    """Return the low part of a sum as one product.

    Returns None if there is none, or if a term with a value for each point has a row as its factor.
    """
    low, full = split(node, math.prod(shape))
    if any(part.row.ndim for part in full):
        return None
    return Product.of(low, shape)


def angles_of(node: Node, shape: tuple[int, ...], leaves: Mapping[str, Leaf]) -> Angles | None:
    """Return angles that vary around one angle of their packet or block.

    Returns None if they do not, or if this is not known.
    """
    product = product_of(node, shape)
    if product is None:
        return None
    reaches = [_reach(part, math.prod(shape), leaves) for part in split(node, math.prod(shape))[1]]
    return Angles.of(
        product, (float(sum(low for low, _ in reaches)), float(sum(high for _, high in reaches)))
    )


def _reach(part: Term, width: int, leaves: Mapping[str, Leaf]) -> tuple[float, float]:
    """The least and the most of what is full in a sum; infinite where it is not known."""
    assert part.full is not None
    options = chosen(part.full, width)
    values = np.concatenate(
        [_every(value, leaves) for value in ((part.full,) if options is None else options[1:])]
    )
    reach = np.outer(values, part.row.reshape(-1))
    return float(reach.min()), float(reach.max())


def _every(value: Any, leaves: Mapping[str, Leaf]) -> Floats:
    """All values that an expression of one field can have."""
    if not isinstance(value, Node):
        return np.array([value])
    values = possible(value, leaves)
    if values is None:
        return np.array([np.inf])
    return values
