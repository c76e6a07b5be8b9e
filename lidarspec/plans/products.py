"""Sums of what packets or blocks have once, times rows that all of them share: matrix products, and angles that are near half a turn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.frames.tracing import Node
from lidarspec.plans.expressions import Term
from lidarspec.plans.registers import Run

Floats = NDArray[np.float64]

TURN = 2 * np.pi
#: radians from which on float32 is too coarse for an angle.
NEAR = 4.0
#: multiplications up to which OpenBLAS stays in one thread (`SMP_THRESHOLD_MIN` times `GEMM_MULTITHREAD_THRESHOLD`).
_ALONE = 1 << 18


@dataclass(frozen=True, eq=False)
class Product:
    """Numbers of packets or blocks times rows, summed.

    Attributes:
        lows: the numbers, None for 1.
        rows: (k, inner), of each the row that it is multiplied by.
        outer: the axes after the packets' that the numbers have.
    """

    lows: Sequence[Node | None]
    rows: Floats
    outer: tuple[int, ...]

    @classmethod
    def of(cls, parts: Sequence[Term], shape: tuple[int, ...], level: int) -> Product:
        """The product of the parts of a sum that are low, for points of this shape; `level`: axes that the numbers may have."""
        inner = math.prod(shape[level:])
        rows = [np.broadcast_to(part.row, shape[level:] if part.row.ndim else (inner,)).reshape(inner) for part in parts]
        return cls([part.low for part in parts], np.stack(rows), shape[:level])

    @property
    def inner(self) -> int:
        """The length of a row."""
        return int(self.rows.shape[1])

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
        """The angles that a product makes; None where nothing is the same for all points of a packet or block."""
        level = [bool((row == row[0]).all()) for row in product.rows]
        start = [(low, float(row[0])) for low, row, is_level in zip(product.lows, product.rows, level, strict=True) if is_level]
        if not any(low is not None for low, _ in start) or not np.isfinite((*product.rows.flat, *more)).all():
            return None
        others = [index for index, is_level in enumerate(level) if not is_level]
        rows = np.vstack([np.ones(product.inner), product.rows[others]])
        return cls(start, Product([None, *(product.lows[index] for index in others)], rows, product.outer), more)

    @property
    def nodes(self) -> list[Node]:
        """What has to be known of a batch."""
        return [*self.around.nodes, *(low for low, _ in self.start if low is not None)]

    @property
    def all_alike(self) -> bool:
        """Whether all points of a packet or block have the same angle."""
        return len(self.around.rows) == 1 and self.more == (0.0, 0.0)

    def left(self, run: Run) -> tuple[Floats, NDArray[np.bool_]]:
        """The numbers, (k, rows), the first of each within half a turn; and where angles may be that have to be reduced all the same."""
        found, rows = self.around.left(run), self.around.rows
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
    """Radians without whole turns: within half a turn either way."""
    return angles - np.rint(angles / TURN) * TURN


def multiplied(left: NDArray[Any], right: NDArray[Any], out: NDArray[Any]) -> None:
    """A matrix product in pieces that a BLAS does in one thread; with two, a chunk would wait for the one that is busy elsewhere.

    Rows come out the same in any company: for that a lone one needs another, as it would be summed in another order.
    """
    step = max(_ALONE // right.size, 2)
    for start in range(0, len(left), step):
        part, target = left[start : start + step], out[start : start + step]
        if len(part) > 1:
            np.matmul(part, right, out=target)
        else:
            target[...] = (part.repeat(2, axis=0) @ right)[:1]
