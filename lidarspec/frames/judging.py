"""Whether candidates are frames: their constants, their checksums, and what is plausible, for many at a time.

The order is that of the counters: a candidate with a wrong constant is none at all, one with a wrong checksum is counted
as such, and only what is intact is asked whether it is plausible.
"""

from __future__ import annotations

import functools
import math
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.frames.access import Fields
from lidarspec.frames.columns import Batch, Column, unpadded
from lidarspec.frames.conditions import Check
from lidarspec.frames.constants import marks, right, words
from lidarspec.frames.layout import Bytes2D, Layout, Seal
from lidarspec.frames.schema import Schema
from lidarspec.frames.tables import Group, Rows, Table
from lidarspec.spec import Frame

VALID, SHORT, LENGTH, CONSTANT, CHECKSUM, IMPLAUSIBLE, PLUGIN = range(7)

Status = NDArray[np.uint8]


class Judge:
    """Judges candidates of one layout, whose first constants (`prefix`) are known to be right.

    Args:
        checks: the test of plausibility, taken apart; None where only the function itself can tell.
    """

    def __init__(
        self, frame: Frame, schema: Schema, layout: Layout, prefix: Mapping[int, tuple[int, int]], checks: list[Check] | None
    ) -> None:
        self._frame, self._schema, self._layout, self._checks = frame, schema, layout, checks
        self._constants = words(marks({spot: known for spot, known in layout.constants.items() if prefix.get(spot) != known}))

    def __call__(self, rows: Bytes2D, errors: list[str]) -> Status:
        """The status of each candidate, (n,); tracebacks out of plugins go to `errors`."""
        status = np.zeros(len(rows), np.uint8)
        held = right(self._constants, rows) if len(rows) else None
        if held is not None:
            status[~held] = CONSTANT
        for seal in self._layout.seals:
            _among(status, rows, functools.partial(intactness, seal, errors))
        if self._checks is not None:
            self._check(status, rows, self._checks)
        elif self._frame.plausible is not None:
            _among(status, rows, lambda some: self._asked(some, errors))
        return status

    def _check(self, status: Status, rows: Bytes2D, checks: list[Check]) -> None:
        for check in checks:
            held = check(rows)
            if np.count_nonzero(held) < len(held):
                status[~held & (status == VALID)] = IMPLAUSIBLE

    def _asked(self, rows: Bytes2D, errors: list[str]) -> Status:
        return plausibility(self._frame, Rows(self._schema, [Group(self._layout, np.arange(len(rows)), rows)]), errors)


def _among(status: Status, rows: Bytes2D, judge: Callable[[Bytes2D], Status]) -> None:
    """Judge those that are valid so far."""
    if not np.count_nonzero(status):
        status[:] = judge(rows)
        return
    left = np.flatnonzero(status == VALID)
    if len(left):
        status[left] = judge(taken(rows, left))


def taken(rows: Bytes2D, which: NDArray[np.intp] | NDArray[np.bool_]) -> Bytes2D:
    """Some of the rows, by index or mask, each copied as one piece."""
    whole = rows.view(f"V{rows.shape[1]}")[:, 0]
    some = whole.take(which) if which.dtype != np.bool_ and rows.flags.c_contiguous else whole[which]
    return some.view(np.uint8).reshape(-1, rows.shape[1])


def intactness(seal: Seal, errors: list[str], rows: Bytes2D) -> Status:
    """`VALID`, `CHECKSUM` or `PLUGIN` for each frame, by one of its checksums."""
    try:
        wrong = ~seal.intact(rows)
        return np.multiply(wrong.view(np.uint8), np.uint8(CHECKSUM))
    except Exception:
        errors += [traceback.format_exc()] * len(rows)
        return np.full(len(rows), PLUGIN, np.uint8)


def plausibility(frame: Frame, table: Table, errors: list[str]) -> Status:
    """`VALID`, `IMPLAUSIBLE` or `PLUGIN` for each frame of a table, by the frame's own test."""
    assert frame.plausible is not None
    batch = Batch(table, np.zeros(len(table), np.bool_))
    try:
        with np.errstate(all="ignore"):
            answer = frame.plausible(Fields(batch))
        array = np.broadcast_to(np.asarray(answer), (len(table), *np.shape(answer)[1:])) if np.ndim(answer) else np.full(len(table), answer)
        return np.where(_all(array, answer, batch), VALID, IMPLAUSIBLE).astype(np.uint8)
    except Exception:
        errors += [traceback.format_exc()] * len(table)
        return np.full(len(table), PLUGIN, np.uint8)


def _all(array: NDArray[Any], answer: Any, batch: Batch) -> NDArray[np.bool_]:
    """Whether a condition holds everywhere in each frame, padding left out."""
    flat = array.reshape(len(array), math.prod(array.shape[1:])).astype(np.bool_)
    mask = unpadded(answer.axes, array.shape, batch) if isinstance(answer, Column) else None
    return np.asarray((flat if mask is None else flat | ~mask).all(axis=1))


@dataclass(frozen=True, eq=False)
class Survey:
    """What candidates are.

    Attributes:
        status: of each.
        sizes: of those that are valid; for those short of bytes how many tell more (0: any).
        errors: tracebacks out of plugins.
        rows: the bytes of all candidates, one a row, where all have one layout and are whole.
        layout: that all have, where that is known.
    """

    status: Status
    sizes: NDArray[np.intp]
    errors: tuple[str, ...] = ()
    rows: Bytes2D | None = None
    layout: Layout | None = None
